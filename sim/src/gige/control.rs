//! The control channel: access rights, register reads and writes, and the heartbeat time-out of silent clients.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant};

use raysweep_core::{CameraSettings, Clock, PixelFormat, Shutter};

use super::faults::TriggerOrder;
use super::features::{Access, CHUNKS, GLOBAL_SHUTTER, Id, SINGLE_FRAME, SOFTWARE};
use super::gvcp::{Command, Request, Status, seal, u32_at};
use super::gvsp::{MAX_PACKET_BYTES, MIN_PACKET_BYTES, View};
use super::locks::lock;
use super::registers::{Registers, Write};
use super::sequencer::Sequencer;
use super::source::{Controls, TriggeredBy};
use super::stream::{Order, Stream};
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
pub struct Control {
    registers: Registers,
    owner: Option<Owner>,
    factory_set: Vec<u8>,
    user_set: Vec<u8>,
    sequencer: Sequencer,
    /// Settings of the sensor.
    settings: CameraSettings,
    selector_written: bool,
    acquisitions: u64,
    controls: Arc<dyn Controls>,
    stream: Arc<Stream>,
    wire: Wire,
    clock: Clock,
}

impl Control {
    /// The camera after power-on.
    pub fn new(registers: Registers, controls: Arc<dyn Controls>, stream: Arc<Stream>, wire: Wire) -> Self {
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
        let Some(request) = Request::parse(datagram) else { return false };
        if let Some(owner) = &mut self.owner
            && owner.address == from
        {
            owner.heard = now;
        }
        request.answer(Status::Success, reply);
        let outcome = request.command.and_then(|command| self.obey(command, from, now, reply));
        if let Err(status) = outcome {
            let data = if let Ok(Command::WriteRegisters(_)) = request.command {
                reply.split_off(8)
            } else {
                vec![]
            };
            request.answer(status, reply);
            reply.extend_from_slice(&data);
        }
        seal(reply);
        request.acknowledge && !matches!(request.command, Ok(Command::Resend(_)))
    }

    /// Releases the camera if its client has been silent for too long.
    pub fn check_heartbeat(&mut self, now: Instant) {
        let timeout = Duration::from_millis(self.registers.number(Id::GevHeartbeatTimeout).into());
        if self.owner.as_ref().is_some_and(|owner| now.saturating_duration_since(owner.heard) > timeout) {
            self.release();
        }
    }

    fn obey(
        &mut self,
        command: Command<'_>,
        from: SocketAddr,
        now: Instant,
        reply: &mut Vec<u8>,
    ) -> Result<(), Status> {
        match command {
            Command::Discovery => reply.extend_from_slice(self.registers.discovery()),
            Command::ReadRegisters(addresses) => {
                self.note_active_set();
                for address in addresses.as_chunks::<4>().0 {
                    let address = u32::from_be_bytes(*address);
                    self.may_read(from)?;
                    reply.extend_from_slice(self.registers.read(address, 4)?);
                }
            }
            Command::ReadMemory(address, bytes) => {
                self.note_active_set();
                self.may_read(from)?;
                reply.extend_from_slice(&address.to_be_bytes());
                reply.extend_from_slice(self.registers.read(address, bytes)?);
            }
            Command::WriteRegisters(pairs) => {
                reply.extend_from_slice(&[0; 4]);
                for (index, pair) in pairs.as_chunks::<8>().0.iter().enumerate() {
                    // Index of the current write: on an error, the answer tells which write was refused.
                    reply[8 + 3] = index as u8;
                    self.write(u32_at(pair, 0).unwrap_or(0), &pair[4..], from, now)?;
                    reply[8 + 3] += 1;
                }
            }
            Command::WriteMemory(address, data) => {
                self.write(address, data, from, now)?;
                reply.extend_from_slice(&[0; 2]);
                reply.extend_from_slice(&(data.len() as u16).to_be_bytes());
            }
            Command::Resend(wanted) => {
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
        self.registers.set_number(Id::SequencerSetActive, set as u32);
    }

    /// All clients may read, unless one has exclusive access.
    fn may_read(&self, from: SocketAddr) -> Result<(), Status> {
        let exclusive = self.registers.number(Id::GevCCP) & EXCLUSIVE != 0;
        let stranger = self.owner.as_ref().is_some_and(|owner| owner.address != from);
        if exclusive && stranger { Err(Status::AccessDenied) } else { Ok(()) }
    }

    fn write(&mut self, address: u32, data: &[u8], from: SocketAddr, now: Instant) -> Result<(), Status> {
        let write = self.registers.check(address, data)?;
        let owned = self.owner.as_ref().is_some_and(|owner| owner.address == from);
        if write.id == Id::GevCCP && (owned || self.owner.is_none()) {
            if write.value() & (EXCLUSIVE | CONTROL) == 0 {
                self.release();
            } else {
                self.owner = Some(Owner { address: from, heard: now });
                self.registers.commit(write);
            }
            return Ok(());
        }
        if !owned || (write.access == Access::ReadWriteIdle && self.stream.order().is_some()) {
            return Err(Status::AccessDenied);
        }
        self.check_trigger_order(write.id)?;
        Sequencer::check(&self.registers, write.id)?;
        match write.id {
            Id::GevSCPS => return self.set_packet_size(write),
            Id::ExposureTime | Id::TriggerDelay | Id::SensorShutterMode => {
                self.registers.commit(write);
                lock(&self.stream.truth).settings_written += 1;
                return self.apply_settings();
            }
            _ => self.registers.commit(write),
        }
        self.effect(write)
    }

    /// Side effects of a register write.
    fn effect(&mut self, write: Write<'_>) -> Result<(), Status> {
        let number = |id| self.registers.number(id);
        match write.id {
            Id::AcquisitionStart => self.start()?,
            Id::AcquisitionStop => self.stop(),
            Id::GevSCPHostPort if write.value() == 0 => self.stop(),
            Id::TriggerSoftware => self.controls.fire(),
            Id::TriggerSelector => self.selector_written = true,
            Id::TriggerMode
            | Id::TriggerSource
            | Id::AcquisitionFrameRate
            | Id::AcquisitionFrameRateEnable => {
                self.controls.set_triggered_by(triggered_by(&self.registers));
            }
            Id::TimestampLatch => self.latch(),
            Id::GevTimestampControl => {
                if write.value() & RESET != 0 {
                    let mut clock = lock(&self.stream.clock);
                    *clock = clock.reset(self.clock.now_ns());
                }
                if write.value() & LATCH != 0 {
                    self.latch();
                }
            }
            Id::UserSetLoad if self.stream.order().is_some() => return Err(Status::AccessDenied),
            Id::UserSetLoad => {
                let factory = number(Id::UserSetSelector) == FACTORY_SET;
                let set = if factory { &self.factory_set } else { &self.user_set };
                self.registers.restore(set);
                self.apply_all();
            }
            Id::UserSetSave if number(Id::UserSetSelector) == FACTORY_SET => {
                return Err(Status::WriteProtect);
            }
            Id::UserSetSave => self.user_set = self.registers.snapshot(),
            Id::SequencerMode if Sequencer::runs(&self.registers) => {
                let mut sets = self.sequencer.sequence(&self.registers, self.settings);
                sets.iter_mut().for_each(|(settings, _)| *settings = self.sensor_settings(*settings));
                self.controls.set_sequence(sets, number(Id::SequencerSetStart) as usize);
            }
            Id::SequencerMode => self.apply_settings()?,
            Id::SequencerSetSelector => self.sequencer.show(&mut self.registers),
            Id::SequencerSetSave => self.sequencer.save(&self.registers, self.settings),
            Id::SequencerSetLoad => {
                self.sequencer.load(&mut self.registers);
                self.apply_settings()?;
            }
            Id::Width | Id::Height | Id::OffsetX | Id::OffsetY | Id::PixelFormat => self.update_derived(),
            Id::ChunkModeActive | Id::ChunkEnable => self.update_derived(),
            _ => {}
        }
        Ok(())
    }

    fn check_trigger_order(&self, id: Id) -> Result<(), Status> {
        let mode = id == Id::TriggerMode;
        let others = matches!(id, Id::TriggerSource | Id::TriggerActivation | Id::TriggerDelay);
        let refused = match lock(&self.stream.faults).trigger_order {
            TriggerOrder::Any => false,
            TriggerOrder::SelectorFirst => (mode || others) && !self.selector_written,
            TriggerOrder::ModeLast => others && self.registers.number(Id::TriggerMode) == 1,
        };
        if refused { Err(Status::AccessDenied) } else { Ok(()) }
    }

    fn set_packet_size(&mut self, write: Write<'_>) -> Result<(), Status> {
        let bytes = (write.value() & PACKET_BYTES) as usize;
        if !(MIN_PACKET_BYTES..=MAX_PACKET_BYTES).contains(&bytes) {
            return Err(Status::InvalidParameter);
        }
        if self.stream.order().is_some() {
            return Err(Status::AccessDenied);
        }
        self.registers.set_number(Id::GevSCPS, write.value() & !FIRE_TEST_PACKET);
        if write.value() & FIRE_TEST_PACKET != 0
            && let Some(route) = self.route()
        {
            self.wire.send_test(bytes, route);
        }
        Ok(())
    }

    fn latch(&mut self) {
        let ticks = lock(&self.stream.clock).ticks(self.clock.now_ns());
        self.registers.set_long(Id::GevTimestampValue, ticks);
    }

    /// Applies the registers' settings to the sensor and writes the actual values back.
    fn apply_settings(&mut self) -> Result<(), Status> {
        let wanted = settings_of(&self.registers);
        let applied = self.controls.configure(&self.sensor_settings(wanted));
        if let Ok(actual) = applied {
            let delay_us =
                if self.is_triggered() { actual.trigger_delay_us } else { wanted.trigger_delay_us };
            self.settings = CameraSettings { trigger_delay_us: delay_us, ..actual };
        }
        let CameraSettings { shutter, exposure_us, trigger_delay_us } = self.settings;
        let shutter = if shutter == Shutter::Global { GLOBAL_SHUTTER } else { 0 };
        self.registers.set_number(Id::SensorShutterMode, shutter);
        self.registers.set_float(Id::ExposureTime, exposure_us);
        self.registers.set_float(Id::TriggerDelay, trigger_delay_us);
        if applied.is_ok() { Ok(()) } else { Err(Status::InvalidParameter) }
    }

    fn is_triggered(&self) -> bool {
        self.registers.number(Id::TriggerMode) == 1
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
        let (width, height) = (number(Id::SensorWidth), number(Id::SensorHeight));
        let derived = [
            (Id::WidthMax, width - number(Id::OffsetX)),
            (Id::HeightMax, height - number(Id::OffsetY)),
            (Id::OffsetXMax, width - number(Id::Width)),
            (Id::OffsetYMax, height - number(Id::Height)),
            (Id::PayloadSize, self.view().payload_bytes() as u32),
        ];
        for (id, value) in derived {
            self.registers.set_number(id, value);
        }
    }

    fn view(&self) -> View {
        let number = |id| self.registers.number(id);
        let format = PixelFormat::from_pfnc(number(Id::PixelFormat));
        let enabled = |chunk: usize| self.registers.number_for(Id::ChunkEnable, chunk as u32) == 1;
        let chunks = (number(Id::ChunkModeActive) == 1).then(|| {
            let mut all = [false; CHUNKS.len()];
            all.iter_mut().enumerate().for_each(|(chunk, on)| *on = enabled(chunk));
            all
        });
        View {
            // The register accepts only codes of pixel formats.
            format: format.unwrap_or(PixelFormat::Mono8),
            x: number(Id::OffsetX) as usize,
            y: number(Id::OffsetY) as usize,
            width: number(Id::Width) as usize,
            height: number(Id::Height) as usize,
            chunks,
        }
    }

    /// Destination of the stream; `None` until the client has set it.
    fn route(&self) -> Option<Route> {
        let port = self.registers.number(Id::GevSCPHostPort) as u16;
        let address = Ipv4Addr::from(self.registers.number(Id::GevSCDA));
        // GevSCPD counts ticks of the camera's clock.
        let tick_frequency_hz = lock(&self.stream.clock).tick_frequency_hz.max(1);
        let gap_ns = u64::from(self.registers.number(Id::GevSCPD)) * 1_000_000_000 / tick_frequency_hz;
        (port != 0).then(|| Route { to: SocketAddrV4::new(address, port), gap_ns: gap_ns as i64 })
    }

    fn start(&mut self) -> Result<(), Status> {
        if self.stream.order().is_some() {
            return Ok(());
        }
        // Acquisition needs a destination.
        let route = self.route().ok_or(Status::AccessDenied)?;
        self.acquisitions += 1;
        let first_seq = self.controls.arm();
        self.stream.set_order(Some(Order {
            acquisition: self.acquisitions,
            view: self.view(),
            packet_bytes: (self.registers.number(Id::GevSCPS) & PACKET_BYTES) as usize,
            route,
            first_seq,
            single: self.registers.number(Id::AcquisitionMode) == SINGLE_FRAME,
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
        self.registers.set_number(Id::GevCCP, 0);
        self.registers.set_number(Id::GevSCPHostPort, 0);
        self.registers.set_number(Id::TLParamsLocked, 0);
    }
}

fn settings_of(registers: &Registers) -> CameraSettings {
    let global = registers.number(Id::SensorShutterMode) == GLOBAL_SHUTTER;
    CameraSettings {
        shutter: if global { Shutter::Global } else { Shutter::Rolling },
        exposure_us: registers.float(Id::ExposureTime),
        trigger_delay_us: registers.float(Id::TriggerDelay),
    }
}

fn triggered_by(registers: &Registers) -> TriggeredBy {
    if registers.number(Id::TriggerMode) == 1 {
        let software = registers.number(Id::TriggerSource) == SOFTWARE;
        return if software { TriggeredBy::Software } else { TriggeredBy::Edges };
    }
    let limited = registers.number(Id::AcquisitionFrameRateEnable) == 1;
    let period_ns = if limited { (1e9 / registers.float(Id::AcquisitionFrameRate)) as i64 } else { 0 };
    TriggeredBy::FreeRun { period_ns }
}
