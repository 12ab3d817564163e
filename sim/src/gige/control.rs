//! The control channel: access rights, register reads and writes, and the heartbeat time-out of silent clients.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant};

use raysweep_core::{CameraSettings, Clock, PixelFormat, Shutter};

use super::faults::TriggerOrder;
use super::features::{CHUNKS, FeatureId, GLOBAL_SHUTTER, RegisterAccess, SINGLE_FRAME, SOFTWARE};
use super::gvcp::{GvcpCommand, GvcpRequest, GvcpStatus, seal, u32_at};
use super::gvsp::{FrameLayout, MAX_PACKET_BYTES, MIN_PACKET_BYTES};
use super::locks::lock;
use super::registers::{Registers, Write};
use super::sequencer::Sequencer;
use super::source::{SourceControls, TriggeredBy};
use super::stream::{StreamChannel, StreamOrder};
use super::wire::{Route, Wire};

/// Bits of the register `GevCCP`.
const EXCLUSIVE: u32 = 1;
const CONTROL: u32 = 2;
/// Bits of the register `GevSCPS`.
const FIRE_TEST_PACKET: u32 = 1 << 31;
const PACKET_BYTES: u32 = 0xFFFF;
/// Bits of the register `GevTimestampControl`.
const LATCH: u32 = 2;
const RESET: u32 = 1;
/// `UserSetSelector` value of the power-on settings.
const FACTORY_SET: u32 = 0;

/// The client in control of the camera.
struct Owner {
    address: SocketAddr,
    heard: Instant,
}

/// State of the control channel.
pub struct ControlChannel {
    registers: Registers,
    owner: Option<Owner>,
    factory_set: Vec<u8>,
    user_set: Vec<u8>,
    sequencer: Sequencer,
    /// Settings of the sensor.
    settings: CameraSettings,
    selector_written: bool,
    acquisitions: u64,
    controls: Arc<dyn SourceControls>,
    stream: Arc<StreamChannel>,
    wire: Wire,
    clock: Clock,
}

impl ControlChannel {
    /// The camera after power-on.
    pub fn new(
        registers: Registers,
        controls: Arc<dyn SourceControls>,
        stream: Arc<StreamChannel>,
        wire: Wire,
    ) -> Self {
        let settings = settings_of(&registers);
        let set = registers.snapshot();
        let mut control = Self {
            registers,
            owner: None,
            factory_set: set.clone(),
            user_set: set,
            sequencer: Sequencer::new(settings),
            settings,
            selector_written: false,
            acquisitions: 0,
            controls,
            stream,
            wire,
            clock: Clock::real(),
        };
        control.restart();
        control
    }

    /// Restarts after a power loss: factory settings, no client, no stream.
    pub fn restart(&mut self) {
        self.release();
        let factory_set = std::mem::take(&mut self.factory_set);
        self.registers.restore(&factory_set);
        self.factory_set = factory_set;
        self.selector_written = false;
        self.apply_all();
        self.sequencer = Sequencer::new(self.settings);
    }

    /// Applies faults that clients can see in registers.
    pub fn faults_changed(&mut self) {
        let faults = *lock(&self.stream.faults);
        self.registers.set_resends(faults.resend);
        self.controls.set_late_frames(faults.late_frames);
    }

    /// Handles a datagram and writes the answer to `reply`; returns whether to send it.
    pub fn handle(&mut self, datagram: &[u8], from: SocketAddr, now: Instant, reply: &mut Vec<u8>) -> bool {
        let Some(request) = GvcpRequest::parse(datagram) else { return false };
        if let Some(owner) = &mut self.owner
            && owner.address == from
        {
            owner.heard = now;
        }
        request.answer(GvcpStatus::Success, reply);
        let outcome = request.command.and_then(|command| self.obey(command, from, now, reply));
        if let Err(status) = outcome {
            let data = if let Ok(GvcpCommand::WriteRegisters(_)) = request.command {
                reply.split_off(8)
            } else {
                vec![]
            };
            request.answer(status, reply);
            reply.extend_from_slice(&data);
        }
        seal(reply);
        request.acknowledge && !matches!(request.command, Ok(GvcpCommand::Resend(_)))
    }

    /// Releases the camera if its client has been silent for too long.
    pub fn check_heartbeat(&mut self, now: Instant) {
        let timeout = Duration::from_millis(self.registers.number(FeatureId::GevHeartbeatTimeout).into());
        if self.owner.as_ref().is_some_and(|owner| now.saturating_duration_since(owner.heard) > timeout) {
            self.release();
        }
    }

    fn obey(
        &mut self,
        command: GvcpCommand<'_>,
        from: SocketAddr,
        now: Instant,
        reply: &mut Vec<u8>,
    ) -> Result<(), GvcpStatus> {
        match command {
            GvcpCommand::Discovery => reply.extend_from_slice(self.registers.discovery()),
            GvcpCommand::ReadRegisters(addresses) => {
                self.note_active_set();
                for address in addresses.as_chunks::<4>().0 {
                    let address = u32::from_be_bytes(*address);
                    self.may_read(from)?;
                    reply.extend_from_slice(self.registers.read(address, 4)?);
                }
            }
            GvcpCommand::ReadMemory(address, bytes) => {
                self.note_active_set();
                self.may_read(from)?;
                reply.extend_from_slice(&address.to_be_bytes());
                reply.extend_from_slice(self.registers.read(address, bytes)?);
            }
            GvcpCommand::WriteRegisters(pairs) => {
                reply.extend_from_slice(&[0; 4]);
                for (index, pair) in pairs.as_chunks::<8>().0.iter().enumerate() {
                    // Index of the current write: on an error, the answer tells which write was refused.
                    reply[8 + 3] = index as u8;
                    self.write(u32_at(pair, 0).unwrap_or(0), &pair[4..], from, now)?;
                    reply[8 + 3] += 1;
                }
            }
            GvcpCommand::WriteMemory(address, data) => {
                self.write(address, data, from, now)?;
                reply.extend_from_slice(&[0; 2]);
                reply.extend_from_slice(&(data.len() as u16).to_be_bytes());
            }
            GvcpCommand::Resend(wanted) => {
                // Clients send resend requests from the receiving socket, not from the controlling one.
                if self.owner.as_ref().is_some_and(|owner| owner.address.ip() == from.ip()) {
                    self.stream.resend(wanted, &mut self.wire);
                }
            }
        }
        Ok(())
    }

    /// Updates the active set, which changes by itself.
    fn note_active_set(&mut self) {
        let set = self.controls.active_set().unwrap_or(0);
        self.registers.set_number(FeatureId::SequencerSetActive, set as u32);
    }

    /// All clients may read, unless one has exclusive access.
    fn may_read(&self, from: SocketAddr) -> Result<(), GvcpStatus> {
        let exclusive = self.registers.number(FeatureId::GevCCP) & EXCLUSIVE != 0;
        let stranger = self.owner.as_ref().is_some_and(|owner| owner.address != from);
        if exclusive && stranger { Err(GvcpStatus::AccessDenied) } else { Ok(()) }
    }

    fn write(&mut self, address: u32, data: &[u8], from: SocketAddr, now: Instant) -> Result<(), GvcpStatus> {
        let write = self.registers.check(address, data)?;
        let owned = self.owner.as_ref().is_some_and(|owner| owner.address == from);
        if write.id == FeatureId::GevCCP && (owned || self.owner.is_none()) {
            if write.value() & (EXCLUSIVE | CONTROL) == 0 {
                self.release();
            } else {
                self.owner = Some(Owner { address: from, heard: now });
                self.registers.commit(write);
            }
            return Ok(());
        }
        if !owned || (write.access == RegisterAccess::ReadWriteIdle && self.stream.order().is_some()) {
            return Err(GvcpStatus::AccessDenied);
        }
        self.check_trigger_order(write.id)?;
        Sequencer::check(&self.registers, write.id)?;
        match write.id {
            FeatureId::GevSCPS => return self.set_packet_size(write),
            FeatureId::ExposureTime | FeatureId::TriggerDelay | FeatureId::SensorShutterMode => {
                self.registers.commit(write);
                lock(&self.stream.truth).settings_written += 1;
                return self.apply_settings();
            }
            _ => self.registers.commit(write),
        }
        self.effect(write)
    }

    /// Side effects of a register write.
    fn effect(&mut self, write: Write<'_>) -> Result<(), GvcpStatus> {
        let number = |id| self.registers.number(id);
        match write.id {
            FeatureId::AcquisitionStart => self.start()?,
            FeatureId::AcquisitionStop => self.stop(),
            FeatureId::GevSCPHostPort if write.value() == 0 => self.stop(),
            FeatureId::TriggerSoftware => self.controls.fire(),
            FeatureId::TriggerSelector => self.selector_written = true,
            FeatureId::TriggerMode
            | FeatureId::TriggerSource
            | FeatureId::AcquisitionFrameRate
            | FeatureId::AcquisitionFrameRateEnable => {
                self.controls.set_triggered_by(triggered_by(&self.registers));
            }
            FeatureId::TimestampLatch => self.latch(),
            FeatureId::GevTimestampControl => {
                if write.value() & RESET != 0 {
                    let mut clock = lock(&self.stream.clock);
                    *clock = clock.reset(self.clock.now_ns());
                }
                if write.value() & LATCH != 0 {
                    self.latch();
                }
            }
            FeatureId::UserSetLoad if self.stream.order().is_some() => return Err(GvcpStatus::AccessDenied),
            FeatureId::UserSetLoad => {
                let factory = number(FeatureId::UserSetSelector) == FACTORY_SET;
                let set = if factory { &self.factory_set } else { &self.user_set };
                self.registers.restore(set);
                self.apply_all();
            }
            FeatureId::UserSetSave if number(FeatureId::UserSetSelector) == FACTORY_SET => {
                return Err(GvcpStatus::WriteProtect);
            }
            FeatureId::UserSetSave => self.user_set = self.registers.snapshot(),
            FeatureId::SequencerMode if Sequencer::runs(&self.registers) => {
                let mut sets = self.sequencer.sequence(&self.registers, self.settings);
                sets.iter_mut().for_each(|(settings, _)| *settings = self.sensor_settings(*settings));
                self.controls.set_sequence(sets, number(FeatureId::SequencerSetStart) as usize);
            }
            FeatureId::SequencerMode => self.apply_settings()?,
            FeatureId::SequencerSetSelector => self.sequencer.show(&mut self.registers),
            FeatureId::SequencerSetSave => self.sequencer.save(&self.registers, self.settings),
            FeatureId::SequencerSetLoad => {
                self.sequencer.load(&mut self.registers);
                self.apply_settings()?;
            }
            FeatureId::Width
            | FeatureId::Height
            | FeatureId::OffsetX
            | FeatureId::OffsetY
            | FeatureId::PixelFormat => self.update_derived(),
            FeatureId::ChunkModeActive | FeatureId::ChunkEnable => self.update_derived(),
            _ => {}
        }
        Ok(())
    }

    fn check_trigger_order(&self, id: FeatureId) -> Result<(), GvcpStatus> {
        let mode = id == FeatureId::TriggerMode;
        let others =
            matches!(id, FeatureId::TriggerSource | FeatureId::TriggerActivation | FeatureId::TriggerDelay);
        let refused = match lock(&self.stream.faults).trigger_order {
            TriggerOrder::Any => false,
            TriggerOrder::SelectorFirst => (mode || others) && !self.selector_written,
            TriggerOrder::ModeLast => others && self.registers.number(FeatureId::TriggerMode) == 1,
        };
        if refused { Err(GvcpStatus::AccessDenied) } else { Ok(()) }
    }

    fn set_packet_size(&mut self, write: Write<'_>) -> Result<(), GvcpStatus> {
        let bytes = (write.value() & PACKET_BYTES) as usize;
        if !(MIN_PACKET_BYTES..=MAX_PACKET_BYTES).contains(&bytes) {
            return Err(GvcpStatus::InvalidParameter);
        }
        if self.stream.order().is_some() {
            return Err(GvcpStatus::AccessDenied);
        }
        self.registers.set_number(FeatureId::GevSCPS, write.value() & !FIRE_TEST_PACKET);
        if write.value() & FIRE_TEST_PACKET != 0
            && let Some(route) = self.route()
        {
            self.wire.send_test(bytes, route);
        }
        Ok(())
    }

    fn latch(&mut self) {
        let ticks = lock(&self.stream.clock).ticks(self.clock.now_ns());
        self.registers.set_long(FeatureId::GevTimestampValue, ticks);
    }

    /// Applies the registers' settings to the sensor and writes the actual values back.
    fn apply_settings(&mut self) -> Result<(), GvcpStatus> {
        let wanted = settings_of(&self.registers);
        let applied = self.controls.configure(&self.sensor_settings(wanted));
        if let Ok(actual) = applied {
            let delay_us =
                if self.is_triggered() { actual.trigger_delay_us } else { wanted.trigger_delay_us };
            self.settings = CameraSettings { trigger_delay_us: delay_us, ..actual };
        }
        let CameraSettings { shutter, exposure_us, trigger_delay_us } = self.settings;
        let shutter = if shutter == Shutter::Global { GLOBAL_SHUTTER } else { 0 };
        self.registers.set_number(FeatureId::SensorShutterMode, shutter);
        self.registers.set_float(FeatureId::ExposureTime, exposure_us);
        self.registers.set_float(FeatureId::TriggerDelay, trigger_delay_us);
        if applied.is_ok() { Ok(()) } else { Err(GvcpStatus::InvalidParameter) }
    }

    fn is_triggered(&self) -> bool {
        self.registers.number(FeatureId::TriggerMode) == 1
    }

    /// A free-running camera has no trigger delay.
    fn sensor_settings(&self, settings: CameraSettings) -> CameraSettings {
        let delay_us = if self.is_triggered() { settings.trigger_delay_us } else { 0.0 };
        CameraSettings { trigger_delay_us: delay_us, ..settings }
    }

    fn apply_all(&mut self) {
        // Cannot fail: the sensor has accepted a user set's values before.
        let _ = self.apply_settings();
        self.controls.set_triggered_by(triggered_by(&self.registers));
        self.update_derived();
    }

    /// Updates registers that depend on others.
    fn update_derived(&mut self) {
        let number = |id| self.registers.number(id);
        let (width, height) = (number(FeatureId::SensorWidth), number(FeatureId::SensorHeight));
        let derived = [
            (FeatureId::WidthMax, width - number(FeatureId::OffsetX)),
            (FeatureId::HeightMax, height - number(FeatureId::OffsetY)),
            (FeatureId::OffsetXMax, width - number(FeatureId::Width)),
            (FeatureId::OffsetYMax, height - number(FeatureId::Height)),
            (FeatureId::PayloadSize, self.view().payload_bytes() as u32),
        ];
        for (id, value) in derived {
            self.registers.set_number(id, value);
        }
    }

    fn view(&self) -> FrameLayout {
        let number = |id| self.registers.number(id);
        let format = PixelFormat::from_pfnc(number(FeatureId::PixelFormat));
        let enabled = |chunk: usize| self.registers.number_for(FeatureId::ChunkEnable, chunk as u32) == 1;
        let chunks = (number(FeatureId::ChunkModeActive) == 1).then(|| {
            let mut all = [false; CHUNKS.len()];
            all.iter_mut().enumerate().for_each(|(chunk, on)| *on = enabled(chunk));
            all
        });
        FrameLayout {
            // The register accepts only codes of pixel formats.
            format: format.unwrap_or(PixelFormat::Mono8),
            x: number(FeatureId::OffsetX) as usize,
            y: number(FeatureId::OffsetY) as usize,
            width: number(FeatureId::Width) as usize,
            height: number(FeatureId::Height) as usize,
            chunks,
        }
    }

    /// Destination of the stream; `None` until the client has set it.
    fn route(&self) -> Option<Route> {
        let port = self.registers.number(FeatureId::GevSCPHostPort) as u16;
        let address = Ipv4Addr::from(self.registers.number(FeatureId::GevSCDA));
        // GevSCPD counts ticks of the camera's clock.
        let tick_frequency_hz = lock(&self.stream.clock).tick_frequency_hz.max(1);
        let gap_ns = u64::from(self.registers.number(FeatureId::GevSCPD)) * 1_000_000_000 / tick_frequency_hz;
        (port != 0).then(|| Route { to: SocketAddrV4::new(address, port), gap_ns: gap_ns as i64 })
    }

    fn start(&mut self) -> Result<(), GvcpStatus> {
        if self.stream.order().is_some() {
            return Ok(());
        }
        // Acquisition needs a destination.
        let route = self.route().ok_or(GvcpStatus::AccessDenied)?;
        self.acquisitions += 1;
        let first_seq = self.controls.arm();
        self.stream.set_order(Some(StreamOrder {
            acquisition: self.acquisitions,
            view: self.view(),
            packet_bytes: (self.registers.number(FeatureId::GevSCPS) & PACKET_BYTES) as usize,
            route,
            first_seq,
            single: self.registers.number(FeatureId::AcquisitionMode) == SINGLE_FRAME,
        }));
        Ok(())
    }

    fn stop(&mut self) {
        self.controls.disarm();
        self.stream.set_order(None);
    }

    /// Releases control of the camera.
    fn release(&mut self) {
        self.stop();
        self.owner = None;
        self.registers.set_number(FeatureId::GevCCP, 0);
        self.registers.set_number(FeatureId::GevSCPHostPort, 0);
        self.registers.set_number(FeatureId::TLParamsLocked, 0);
    }
}

fn settings_of(registers: &Registers) -> CameraSettings {
    let global = registers.number(FeatureId::SensorShutterMode) == GLOBAL_SHUTTER;
    CameraSettings {
        shutter: if global { Shutter::Global } else { Shutter::Rolling },
        exposure_us: registers.float(FeatureId::ExposureTime),
        trigger_delay_us: registers.float(FeatureId::TriggerDelay),
    }
}

fn triggered_by(registers: &Registers) -> TriggeredBy {
    if registers.number(FeatureId::TriggerMode) == 1 {
        let software = registers.number(FeatureId::TriggerSource) == SOFTWARE;
        return if software { TriggeredBy::Software } else { TriggeredBy::Edges };
    }
    let limited = registers.number(FeatureId::AcquisitionFrameRateEnable) == 1;
    let period_ns = if limited { (1e9 / registers.float(FeatureId::AcquisitionFrameRate)) as i64 } else { 0 };
    TriggeredBy::FreeRun { period_ns }
}
