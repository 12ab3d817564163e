//! The thread that holds a camera's control channel.

use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use aravis::prelude::*;
use raysweep_core::{
    CameraCapabilities, CameraSettings, Clock, ClockModel, DeviceError, DeviceErrorKind, FrameBuf,
};

use super::chunks::Chunks;
use super::driver::RigFacts;
use super::features::{FeatureError, Features};
use super::frames::Frames;
use super::library::{Device, DeviceClock, Health, device_error};
use super::network::{self, SocketBuffer};
use super::sequencer::{self, SequencerSets};
use super::settings::FeatureWriter;
use super::setup::set_up;
use crate::arrival_clock::ArrivalClock;
use raysweep_config::rig::aravis::AravisConfig;

/// Interval of reading the clock of a camera that delivers no frames, which also checks that it is there.
const ASK_PERIOD: Duration = Duration::from_millis(200);
/// Maximum interval for a camera whose frames show that it is there, once its clock has been observed for long
/// enough.
const LONGEST_ASK_PERIOD: Duration = Duration::from_secs(1);
/// Its clock is extrapolated by at most this fraction (1/n) of the time that it has been observed.
const FORETOLD: u32 = 8;
/// Clock readings at first, so that the first frame has a time.
const FIRST_ASKS: usize = 8;

/// A command to the owner.
pub enum OwnerCommand {
    /// Open the camera, with the settings written last, and start answering triggers if it did before.
    Open,
    /// Start answering triggers.
    Arm,
    /// Stop answering triggers.
    Disarm,
    /// Write settings.
    Configure(CameraSettings),
    /// Let the camera's sequencer step through these settings.
    Sequence(Vec<CameraSettings>),
    /// The camera is lost: drop its stream and close it, perhaps to open it again.
    Release(Frames),
    /// Drop the stream and close the camera for good, as also when the channel closes.
    Close(Frames),
}

/// A command with a number that its reply repeats.
pub struct OwnerOrder {
    pub ticket: u64,
    pub command: OwnerCommand,
}

/// A message from the owner.
pub enum OwnerReply {
    /// The camera was opened, for the first time or again.
    OpenedCamera(Result<OpenedCamera, DeviceError>),
    /// An order was executed.
    Done(u64, Result<Done, DeviceError>),
}

/// Result of an order.
pub struct Done {
    /// When the last register was written, in host time.
    pub written_ns: i64,
    /// The camera's settings, if some were written.
    pub actual: Option<CameraSettings>,
    /// The sequence of its sequencer, if it was started.
    pub sequence: Option<SequencerSets>,
    /// Whether the camera had to be stopped, so that its frame count restarted.
    pub restarted: bool,
}

/// An open camera, for the thread that takes its frames.
pub struct OpenedCamera {
    pub frames: Frames,
    pub chunks: Option<Chunks>,
    pub capabilities: CameraCapabilities,
    /// Whether its clock can be read.
    /// Its clock, if it cannot be asked for its time.
    pub arrivals: Option<Box<ArrivalClock>>,
    /// Since when it answers triggers, if it does.
    pub armed_ns: Option<i64>,
}

/// Why serving a camera ended.
enum Ended {
    Released,
    Closed,
}

/// Shared by the owner thread and the thread that takes the frames.
#[derive(Clone)]
pub struct Shared {
    pub clock: Clock,
    pub health: Arc<Health>,
    /// Conversion from the camera's clock to the host's; locked while a line is fitted.
    pub model: Arc<Mutex<ClockModel>>,
}

impl Shared {
    pub fn with_model<T>(&self, f: impl FnOnce(&mut ClockModel) -> T) -> T {
        f(&mut self.model.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

pub struct Owner {
    pub config: AravisConfig,
    pub facts: RigFacts,
    pub shared: Shared,
    pub orders: Receiver<OwnerOrder>,
    pub replies: SyncSender<OwnerReply>,
    pub armed: bool,
    pub settings: Option<CameraSettings>,
    /// The settings of the camera's sequencer, which replace `settings`.
    pub sequence: Option<Vec<CameraSettings>>,
}

struct Connection {
    device: Device,
    writer: FeatureWriter,
    clock: Option<DeviceClock>,
}

impl Owner {
    /// Opens the camera when asked to and serves it until it is released, until the driver closes it.
    pub fn run(mut self) {
        while let Ok(OwnerOrder { ticket, command }) = self.orders.recv() {
            let (connection, reply) = match command {
                OwnerCommand::Open => match self.connect() {
                    Ok((connection, opened)) => (Some(connection), OwnerReply::OpenedCamera(Ok(opened))),
                    Err(error) => (None, OwnerReply::OpenedCamera(Err(error))),
                },
                OwnerCommand::Close(_) => return,
                _ => {
                    let error = DeviceError::new("camera", DeviceErrorKind::Disconnected, "is not open");
                    (None, OwnerReply::Done(ticket, Err(error)))
                }
            };
            if self.replies.send(reply).is_err() {
                return;
            }
            if let Some(connection) = connection
                && matches!(self.serve(connection), Ended::Closed)
            {
                return;
            }
        }
    }

    fn connect(&mut self) -> Result<(Connection, OpenedCamera), DeviceError> {
        let Self { config, facts, shared, .. } = self;
        let named = config.device().ok_or_else(|| {
            let what = "camera.aravis.address or camera.aravis.name: give one of them";
            DeviceError::new("camera", DeviceErrorKind::OutOfRange, what)
        })?;
        let device = Device::open(named, shared.health.clone())?;
        if device.has("AcquisitionStop") {
            // A client that died may have left it streaming; a camera that is not streaming may refuse this.
            let _ = device.execute("AcquisitionStop");
        }
        let set_up = set_up(&device, config, facts.format, facts.free_hz)?;
        let payload_bytes =
            device.camera.payload().map_err(|error| device_error("payload size", &error))? as usize;
        let socket = SocketBuffer::of(config, payload_bytes);
        network::prepare(&device.camera, config, socket);
        if let Some(warning) = socket.warning().filter(|_| device.camera.is_gv_device()) {
            tracing::warn!("{warning}");
        }
        if !set_up.lacks.is_empty() {
            tracing::warn!(camera = device.model(), "the camera lacks {}", set_up.lacks.join("; "));
        }
        let stream = device.camera.create_stream().map_err(|error| device_error("no stream", &error))?;
        network::tune(&device.camera, &stream, socket, payload_bytes);
        let image_bytes = facts.format.frame_bytes(set_up.width * set_up.height);
        let frames = Frames::new(stream, payload_bytes, FrameBuf::memory_bytes(image_bytes));
        let clock = DeviceClock::probe(&device, &shared.clock);
        shared.with_model(|model| *model = ClockModel::new(model.capacity()));
        if let Some(clock) = clock {
            for _ in 0..FIRST_ASKS {
                let trip = clock.ask(&device, &shared.clock)?;
                shared.with_model(|model| model.add(trip));
            }
        } else {
            tracing::warn!(
                camera = device.model(),
                "the camera cannot be asked for its time: exposures are dated by the arrival of their frames, late by the time that they travel"
            );
        }
        let readout_us = set_up.height as f64 * facts.row_time_us;
        let delay_us = match set_up.names.delay {
            Some(name) => device.float_range(name)?,
            None => 0.0..=0.0,
        };
        let capabilities = CameraCapabilities {
            model: device.model(),
            width: set_up.width,
            height: set_up.height,
            format: facts.format,
            row_time_us: facts.row_time_us,
            trigger_latency_us: config.trigger_latency_us,
            readout_us: config.readout_us.or(set_up.readout_us).unwrap_or(readout_us),
            readout: config.readout,
            exposure_us: device.float_range(set_up.names.exposure)?,
            trigger_delay_us: delay_us,
        };
        let chunks = device.chunk_parser().map(|parser| Chunks::new(parser, set_up.chunks));
        let mut writer = FeatureWriter::new(set_up.names);
        if let Some(settings) = &self.settings {
            writer.write(&device, settings)?;
        }
        if let Some(sequence) = &self.sequence {
            sequencer::start(&device, writer.names(), sequence)?;
            writer.forget();
        }
        let armed_ns = self.armed.then(|| self.shared.clock.now_ns());
        if self.armed {
            device.execute("AcquisitionStart")?;
        }
        let arrivals = clock.is_none().then(|| Box::new(ArrivalClock::new(0)));
        let opened = OpenedCamera { frames, chunks, capabilities, arrivals, armed_ns };
        Ok((Connection { device, writer, clock }, opened))
    }

    fn serve(&mut self, mut connection: Connection) -> Ended {
        let opened = Instant::now();
        let (mut asked, mut next_look) = (opened, opened + ASK_PERIOD);
        loop {
            match self.orders.recv_timeout(next_look.saturating_duration_since(Instant::now())) {
                Ok(OwnerOrder { command: OwnerCommand::Release(frames), .. }) => {
                    drop(frames);
                    return Ended::Released;
                }
                Ok(OwnerOrder { command: OwnerCommand::Close(frames), .. }) => {
                    let _ = connection.device.execute("AcquisitionStop");
                    // Fails harmlessly if the camera is gone.
                    let _ = self.end_sequence(&mut connection);
                    drop(frames);
                    return Ended::Closed;
                }
                Err(RecvTimeoutError::Disconnected) => return Ended::Closed,
                Ok(OwnerOrder { ticket, command }) => {
                    let done = self.obey(&mut connection, command);
                    if self.replies.send(OwnerReply::Done(ticket, done)).is_err() {
                        return Ended::Closed;
                    }
                }
                Err(RecvTimeoutError::Timeout) => {
                    let now = Instant::now();
                    let foretold = ((now - opened) / FORETOLD).min(LONGEST_ASK_PERIOD);
                    if now - asked >= foretold || !self.shared.health.gave_frame_within(ASK_PERIOD) {
                        self.ask(&connection);
                        asked = now;
                    }
                    next_look = now + ASK_PERIOD;
                }
            }
        }
    }

    /// Reads the camera's clock, which also checks that it is there.
    fn ask(&self, Connection { device, clock, .. }: &Connection) {
        let answer = match clock {
            Some(clock) => clock
                .ask(device, &self.shared.clock)
                .map(|trip| self.shared.with_model(|model| model.add(trip))),
            None => device.ping(),
        };
        if let Err(error) = answer {
            tracing::debug!(%error, "camera does not answer");
            if error.kind == DeviceErrorKind::Disconnected {
                self.shared.health.gone();
            }
        }
    }

    /// Switches the camera's sequencer off, if it runs, and restores the earlier settings.
    fn end_sequence(
        &mut self,
        Connection { device, writer, .. }: &mut Connection,
    ) -> Result<(), FeatureError> {
        if self.sequence.take().is_some() {
            sequencer::stop(device)?;
            if let Some(settings) = &self.settings {
                writer.write(device, settings)?;
            }
        }
        Ok(())
    }

    fn obey(&mut self, connection: &mut Connection, command: OwnerCommand) -> Result<Done, DeviceError> {
        let Connection { device, writer, .. } = connection;
        let mut done = Done { written_ns: 0, actual: None, sequence: None, restarted: false };
        match command {
            OwnerCommand::Arm => {
                device.execute("AcquisitionStart")?;
                self.armed = true;
            }
            OwnerCommand::Disarm => {
                self.armed = false;
                device.execute("AcquisitionStop")?;
                self.end_sequence(connection)?;
            }
            OwnerCommand::Configure(settings) => {
                self.settings = Some(settings);
                let sequenced = self.sequence.take().is_some();
                // Shutter modes are locked while a camera streams, and its sequencer may be, too.
                done.restarted = self.armed && (sequenced || writer.changes_shutter(&settings));
                if done.restarted {
                    device.execute("AcquisitionStop")?;
                }
                if sequenced {
                    sequencer::stop(device)?;
                }
                let written = writer.write(device, &settings);
                if done.restarted {
                    device.execute("AcquisitionStart")?;
                }
                done.actual = Some(written?);
            }
            OwnerCommand::Sequence(settings) if sequencer::is_offered(device) => {
                done.restarted = self.armed;
                if done.restarted {
                    device.execute("AcquisitionStop")?;
                }
                let started = sequencer::start(device, writer.names(), &settings);
                writer.forget();
                if done.restarted {
                    device.execute("AcquisitionStart")?;
                }
                match started {
                    Ok(sequence) => {
                        (self.sequence, done.sequence) = (Some(settings), Some(sequence));
                    }
                    Err(error) if is_gone(&error) => return Err(error.into()),
                    Err(error) => {
                        tracing::warn!(
                            camera = device.model(),
                            "the camera's sequencer is not used, settings are written instead: {error}"
                        );
                    }
                }
            }
            OwnerCommand::Sequence(_)
            | OwnerCommand::Open
            | OwnerCommand::Release(_)
            | OwnerCommand::Close(_) => {}
        }
        done.written_ns = self.shared.clock.now_ns();
        Ok(done)
    }
}

fn is_gone(error: &FeatureError) -> bool {
    matches!(error.kind, DeviceErrorKind::Timeout | DeviceErrorKind::Disconnected)
}
