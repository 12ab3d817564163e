//! The camera behind the traits of `raysweep-core`: the side that takes frames.

use std::fmt::Display;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use aravis::{Buffer, BufferStatus};
use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, Clock, ClockModel, DeviceError, DeviceErrorKind,
    DeviceState, FirstFrame, FrameBuf, FrameStamp, LossCause, PixelFormat, SettingsId, ns_from_us,
    us_from_ns,
};

use super::chunks::{Chunks, Said};
use super::frames::{Frames, image_data};
use super::ids::FrameIds;
use super::library::Health;
use super::losses::Losses;
use super::owner::{Done, OpenedCamera, Owner, OwnerCommand, OwnerOrder, OwnerReply, Shared};
use super::promise::{Latency, Promises, Triggers, first_frame};
use super::sequencer::SequencerSets;
use crate::arrival_clock::ArrivalClock;
use crate::reopen::Reopening;
use raysweep_config::rig::aravis::{AravisConfig, TimestampAt};

/// Properties of the rig that the camera driver needs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigFacts {
    /// Pixel format of the frames.
    pub format: PixelFormat,
    /// From the start of one row's exposure to the start of the next row's.
    pub row_time_us: f64,
    /// From one trigger to the next.
    pub trigger_period_us: f64,
    /// Maximum amount by which a trigger may be early.
    pub trigger_margin_us: f64,
    /// How long a lost camera may stay away.
    pub reopen: Duration,
    /// Frames per second without the trigger, if the camera is to run freely whatever the rig file says of its trigger.
    pub free_hz: Option<f64>,
}

/// A camera that has neither answered nor delivered a frame for this long is lost.
const SILENCE_NS: i64 = 900_000_000;
/// Round trips in the clock model: they cover 20 s, or 100 s while frames arrive.
const ROUND_TRIPS: usize = 100;
/// Maximum wait on a channel or a stream before the camera's health is checked.
const LOOK: Duration = Duration::from_millis(50);
/// Opening a camera that is there takes less. One that is not there may block the owner thread for longer than it may
/// stay away.
const OPENING_TIME: Duration = Duration::from_secs(2);
/// A killed program keeps the camera until its heartbeat is missed, after 3 s.
const BUSY_PATIENCE: Duration = Duration::from_secs(5);
/// Pause between attempts to open a camera that another program holds.
const BUSY_PAUSE: Duration = Duration::from_millis(250);
/// Maximum wait for the owner thread on closing. With a dead camera it may be blocked for longer; it then ends by
/// itself.
const FAREWELL: Duration = Duration::from_secs(3);

/// A GenICam camera.
pub struct AravisCamera {
    capabilities: CameraCapabilities,
    config: AravisConfig,
    facts: RigFacts,
    shared: Shared,
    orders: Option<SyncSender<OwnerOrder>>,
    replies: Receiver<OwnerReply>,
    owner: Option<JoinHandle<()>>,
    ticket: u64,
    link: Link,
    reopening: Reopening,
    armed_ns: Option<i64>,
    ids: FrameIds,
    losses: Losses,
    promises: Promises<CameraSettings>,
    newest: Option<Newest>,
    /// The number of the first set of the camera's sequencer, while the sequencer runs.
    first_set: Option<i64>,
}

enum Link {
    Up {
        frames: Frames,
        chunks: Option<Chunks>,
        /// The clock of a camera that cannot be asked for its time.
        arrivals: Option<Box<ArrivalClock>>,
    },
    Lost,
    /// The owner thread is opening the lost camera.
    Opening {
        since: Instant,
    },
}

/// The newest complete frame.
#[derive(Clone, Copy)]
struct Newest {
    seq: u64,
    exposure_start_ns: i64,
    host_ns: i64,
    /// Its sequencer set, counted from the first set, if the frame reports it.
    set: Option<usize>,
}

fn error(kind: DeviceErrorKind, what: impl Into<String>) -> DeviceError {
    DeviceError::new("camera", kind, what.into())
}

/// Why a camera is lost that neither answers nor delivers frames.
const SILENT: &str = "it has stopped answering";

fn lost() -> DeviceError {
    error(DeviceErrorKind::Disconnected, "stopped answering and is being opened again")
}

fn thread_ended() -> DeviceError {
    error(DeviceErrorKind::Disconnected, "its thread has ended; the log has its message")
}

impl AravisCamera {
    /// Opens the camera and makes all settings that are the same for all sweeps.
    ///
    /// # Errors
    /// `Disconnected` if it does not answer, `Busy` if another program holds it, `Unsupported` or `OutOfRange` with
    /// the feature that it lacks or whose value it rejects.
    pub fn open(config: &AravisConfig, facts: RigFacts) -> Result<Self, DeviceError> {
        if let Some(fault) = config.faults().into_iter().next() {
            let what = format!("camera.aravis.{fault}");
            return Err(DeviceError::new("camera", DeviceErrorKind::OutOfRange, what));
        }
        let clock = Clock::real();
        let shared = Shared {
            health: Arc::new(Health::new(clock.clone())),
            model: Arc::new(Mutex::new(ClockModel::new(ROUND_TRIPS))),
            clock,
        };
        // At most one order is pending, in addition to those that release a lost camera and open it again.
        let (orders, todo) = sync_channel(4);
        let (answers, replies) = sync_channel(4);
        let owner = Owner {
            config: config.clone(),
            facts,
            shared: shared.clone(),
            orders: todo,
            replies: answers,
            armed: false,
            settings: None,
            sequence: None,
        };
        let thread = thread::Builder::new()
            .name("camera-owner".into())
            .spawn(move || owner.run())
            .map_err(|error| DeviceError::new("camera", DeviceErrorKind::NotReady, error))?;
        let begun = Instant::now();
        let opened = loop {
            let open = OwnerOrder { ticket: 0, command: OwnerCommand::Open };
            orders.send(open).map_err(|_closed| thread_ended())?;
            match replies.recv() {
                Ok(OwnerReply::OpenedCamera(Err(error)))
                    if error.kind == DeviceErrorKind::Busy && begun.elapsed() < BUSY_PATIENCE =>
                {
                    thread::sleep(BUSY_PAUSE);
                }
                Ok(OwnerReply::OpenedCamera(opened)) => break opened?,
                Ok(OwnerReply::Done(..)) | Err(_) => return Err(thread_ended()),
            }
        };
        let OpenedCamera { frames, chunks, capabilities, arrivals, .. } = opened;
        let mut ids = FrameIds::default();
        ids.restart(1);
        Ok(Self {
            capabilities,
            config: config.clone(),
            facts,
            reopening: Reopening::new("camera", facts.reopen, shared.clock.clone()),
            shared,
            orders: Some(orders),
            replies,
            owner: Some(thread),
            ticket: 0,
            link: Link::Up { frames, chunks, arrivals },
            armed_ns: None,
            ids,
            losses: Losses::new(),
            promises: Promises::new(),
            newest: None,
            first_set: None,
        })
    }

    /// Frames lost so far, by cause.
    pub fn losses(&self) -> impl Iterator<Item = (LossCause, u64)> {
        self.losses.totals()
    }

    /// Scatter of the round trips around the clock model; `None` if the camera's clock cannot be read.
    pub fn clock_residual_ns(&self) -> Option<f64> {
        self.shared.with_model(|model| model.residual_ns())
    }

    /// Sends a command to the owner thread; the channel has room for it.
    fn order(&mut self, command: OwnerCommand) -> Result<(), DeviceError> {
        self.ticket += 1;
        let order = OwnerOrder { ticket: self.ticket, command };
        let sent = self.orders.as_ref().is_some_and(|orders| orders.try_send(order).is_ok());
        sent.then_some(()).ok_or_else(thread_ended)
    }

    /// Lets the owner thread execute a command; gives up if the camera is silent.
    fn ask(&mut self, command: OwnerCommand) -> Result<Done, DeviceError> {
        if !matches!(self.link, Link::Up { .. }) {
            return Err(lost());
        }
        let asked_ns = self.shared.clock.now_ns();
        self.order(command)?;
        loop {
            match self.replies.recv_timeout(LOOK) {
                Ok(OwnerReply::Done(ticket, Err(error))) if ticket == self.ticket => {
                    if matches!(error.kind, DeviceErrorKind::Timeout | DeviceErrorKind::Disconnected) {
                        self.lose(&error.source)?;
                    }
                    return Err(error);
                }
                Ok(OwnerReply::Done(ticket, done)) if ticket == self.ticket => return done,
                // The reply to an order that was given up.
                Ok(OwnerReply::Done(..) | OwnerReply::OpenedCamera(_)) => {}
                Err(RecvTimeoutError::Timeout) if self.silent_since(asked_ns) => {
                    self.lose(&SILENT)?;
                    return Err(lost());
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(thread_ended()),
            }
        }
    }

    /// Whether the camera has been silent since `since_ns`, and for long enough to be lost.
    fn silent_since(&self, since_ns: i64) -> bool {
        let answered_ns = self.shared.health.answered_ns();
        answered_ns == i64::MIN
            || self.shared.clock.now_ns().saturating_sub(answered_ns.max(since_ns)) > SILENCE_NS
    }

    /// Closes the failed camera, to be opened again, unless it is given up.
    fn lose(&mut self, cause: &dyn Display) -> Result<(), DeviceError> {
        if let Link::Up { frames, .. } = std::mem::replace(&mut self.link, Link::Lost) {
            self.order(OwnerCommand::Release(frames))?;
        }
        self.reopening.failed(cause)
    }

    /// Waits up to `timeout` for a lost camera to come back; returns `Ok` also if it is still away.
    fn wait_for_return(&mut self, timeout: Duration) -> Result<(), DeviceError> {
        let until = Instant::now() + timeout;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if let Link::Lost = self.link {
                self.reopening.sleep(left);
                if !self.reopening.is_due() {
                    return Ok(());
                }
                self.order(OwnerCommand::Open)?;
                self.link = Link::Opening { since: Instant::now() };
                continue;
            }
            match self.replies.recv_timeout(left) {
                Ok(OwnerReply::OpenedCamera(Ok(opened))) => return self.resume(opened),
                Ok(OwnerReply::OpenedCamera(Err(error))) => {
                    self.link = Link::Lost;
                    self.reopening.failed(&error.source)?;
                }
                Ok(OwnerReply::Done(..)) => {}
                Err(RecvTimeoutError::Timeout) => {
                    return match self.link {
                        // It may be there after a pause of the run in which nobody asked for frames.
                        Link::Opening { since } if since.elapsed() < OPENING_TIME => Ok(()),
                        _ => self.reopening.check(),
                    };
                }
                Err(RecvTimeoutError::Disconnected) => return Err(thread_ended()),
            }
        }
    }

    /// Goes on with a camera that was opened again, if it is the same as before.
    fn resume(&mut self, opened: OpenedCamera) -> Result<(), DeviceError> {
        let OpenedCamera { frames, chunks, capabilities: found, arrivals, armed_ns } = opened;
        self.link = Link::Up { frames, chunks, arrivals };
        if found != self.capabilities {
            return self.lose(&format!(
                "there is now {} of {} x {} pixels, with other abilities than {}: connect the camera again that the run began with",
                found.model, found.width, found.height, self.capabilities.model
            ));
        }
        self.armed_ns = self.armed_ns.and(armed_ns);
        self.reopening.opened();
        self.resume_ids();
        Ok(())
    }

    /// Evaluates a received frame, of which `bytes` are used; `None` if it is incomplete.
    fn look_at(&mut self, from: &Buffer, bytes: usize) -> Result<Option<FrameStamp>, DeviceError> {
        match from.status() {
            BufferStatus::Success => {}
            // Left over from before a stop.
            BufferStatus::Aborted | BufferStatus::Cleared => return Ok(None),
            _ => {
                self.losses.incomplete(self.ids.of_part(from.frame_id()));
                return Ok(None);
            }
        }
        let host_ns = self.shared.clock.now_ns();
        let image_bytes = image_data(from).len();
        if image_bytes < bytes {
            let what = format!(
                "a frame has {image_bytes} bytes instead of {bytes}: its region or format was changed"
            );
            return Err(error(DeviceErrorKind::Protocol, what));
        }
        let Link::Up { chunks, arrivals, .. } = &mut self.link else { return Ok(None) };
        let Said { exposure_us, sequencer_set } =
            chunks.as_mut().map(|chunks| chunks.read(from, bytes)).unwrap_or_default();
        let set = sequencer_set.zip(self.first_set);
        let set = set.and_then(|(set, first_set)| usize::try_from(set - first_set).ok());
        let set_us =
            exposure_us.or(self.promises.newest().map(|settings| settings.exposure_us)).unwrap_or(0.0);
        let stamped_ns = i64::try_from(from.timestamp()).unwrap_or(i64::MAX);
        let device_ns = match self.config.timestamp_at {
            TimestampAt::ExposureStart => stamped_ns,
            TimestampAt::ExposureEnd => stamped_ns - ns_from_us(set_us),
        };
        let arrived_ns = host_ns - ns_from_us(set_us + self.capabilities.readout_us);
        let exposure_start_ns = match arrivals {
            Some(clock) => {
                clock.arrived(device_ns, arrived_ns);
                clock.host_ns_so_far(device_ns)
            }
            None => self.shared.with_model(|model| model.host_ns(device_ns)),
        };
        let exposure_start_ns = exposure_start_ns.unwrap_or(arrived_ns);
        let Some(seq) = self.ids.extend(from.frame_id()) else { return Ok(None) };
        self.losses.whole(seq);
        self.reopening.delivered();
        self.shared.health.gave_frame(host_ns);
        self.newest = Some(Newest { seq, exposure_start_ns, host_ns, set });
        Ok(Some(FrameStamp { seq, device_ns, exposure_start_ns, host_ns, exposure_us }))
    }

    /// The camera is back and has restarted its frame count. Skips as many ids as it would have answered triggers.
    /// The next frame has the settings that were written last, whatever was promised for earlier ones.
    fn resume_ids(&mut self) {
        let mut next_seq = self.promises.latest_seq();
        if let Some(newest) = self.newest {
            let settings = self.promises.newest();
            let periods = settings.map_or(1, |settings| {
                self.capabilities.periods_per_frame(&settings, self.facts.trigger_period_us)
            });
            let frame_us = f64::from(periods) * self.facts.trigger_period_us;
            let away_us = us_from_ns(self.shared.clock.now_ns() - newest.exposure_start_ns);
            next_seq = next_seq.max(newest.seq + (away_us / frame_us).ceil() as u64);
        }
        self.ids.restart(next_seq);
        if let Some(newest) = self.newest {
            self.losses.away(newest.seq + 1..self.ids.next());
        }
    }

    /// What is known about the triggers now.
    fn triggers(&self) -> Triggers {
        let period_us = if self.facts.free_hz.is_none() && self.config.is_triggered() {
            self.facts.trigger_period_us
        } else {
            // The frames of a free-running camera may follow each other as fast as it can deliver them.
            self.promises
                .newest()
                .map_or(0.0, |settings| settings.exposure_us)
                .max(self.capabilities.readout_us)
        };
        let period_ns = ns_from_us(period_us);
        let last_ns = self.armed_ns.map(|armed_ns| {
            let Some(newest) = self.newest.filter(|newest| newest.exposure_start_ns > armed_ns) else {
                return armed_ns - period_ns;
            };
            let longest_us = self
                .promises
                .possible(newest.seq)
                .map(|settings| settings.trigger_delay_us)
                .fold(0.0, f64::max);
            newest.exposure_start_ns - ns_from_us(longest_us + self.capabilities.trigger_latency_us)
        });
        Triggers {
            next_seq: self.ids.next(),
            last_ns,
            period_ns,
            margin_ns: ns_from_us(self.facts.trigger_margin_us),
        }
    }

    /// Discards received frames that nobody asked for.
    fn drain(&self) {
        if let Link::Up { frames, .. } = &self.link {
            frames.drain();
        }
    }
}

impl Camera for AravisCamera {
    fn capabilities(&self) -> &CameraCapabilities {
        &self.capabilities
    }

    fn state(&self) -> DeviceState {
        match (&self.link, self.armed_ns) {
            (Link::Lost | Link::Opening { .. }, _) => DeviceState::Lost,
            // It is open again but has delivered nothing.
            _ if self.reopening.is_lost() => DeviceState::Lost,
            (Link::Up { .. }, Some(_)) => DeviceState::Streaming,
            (Link::Up { .. }, None) => DeviceState::Ready,
        }
    }

    fn configure(&mut self, _: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        self.capabilities.allows(settings).map_err(|what| error(DeviceErrorKind::OutOfRange, what))?;
        let triggers = self.triggers();
        let Done { written_ns, actual, restarted, .. } = self.ask(OwnerCommand::Configure(*settings))?;
        self.first_set = None;
        let actual = actual.unwrap_or(*settings);
        if restarted {
            self.ids.restart(0);
        }
        let latency =
            Latency { min_frames: self.config.late_frames_min, max_frames: self.config.late_frames_max };
        let first_frame = first_frame(triggers, written_ns, latency);
        self.promises.push(first_frame, actual);
        Ok(Applied { actual, first_frame })
    }

    fn sequence(&mut self, settings: &[CameraSettings]) -> Result<Option<Vec<CameraSettings>>, DeviceError> {
        for settings in settings {
            self.capabilities.allows(settings).map_err(|what| error(DeviceErrorKind::OutOfRange, what))?;
        }
        let Done { sequence, restarted, .. } = self.ask(OwnerCommand::Sequence(settings.to_vec()))?;
        self.first_set = sequence.as_ref().map(|sequence| sequence.first_set);
        let sequence = sequence.map(|SequencerSets { settings, .. }| settings);
        if restarted {
            self.drain();
            self.ids.restart(0);
        }
        // Trigger times are derived from the longest delay that a frame may have.
        let by_delay =
            |a: &&CameraSettings, b: &&CameraSettings| a.trigger_delay_us.total_cmp(&b.trigger_delay_us);
        if let Some(longest) = sequence.iter().flatten().max_by(by_delay) {
            let next_seq = self.ids.next();
            self.promises.push(FirstFrame::Within { earliest: next_seq, certain: next_seq }, *longest);
        }
        Ok(sequence)
    }

    fn active_set(&self) -> Option<usize> {
        self.newest.and_then(|newest| newest.set)
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        if self.armed_ns.is_some() {
            return Ok(());
        }
        self.drain();
        self.ids.restart(0);
        let armed_ns = self.shared.clock.now_ns();
        self.ask(OwnerCommand::Arm)?;
        self.armed_ns = Some(armed_ns);
        self.reopening.opened();
        Ok(())
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        let Some(armed_ns) = self.armed_ns else {
            return Err(error(DeviceErrorKind::NotReady, "next_frame before arm: arm the camera first"));
        };
        let until = Instant::now() + timeout;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let Link::Up { frames, .. } = &self.link else {
                self.wait_for_return(left)?;
                return Ok(None);
            };
            let wait_us = left.min(LOOK).as_micros().try_into().unwrap_or(u64::MAX);
            let popped = frames.pop(wait_us);
            let Some(buffer) = popped else {
                let alive_ns = self.newest.map_or(armed_ns, |newest| newest.host_ns.max(armed_ns));
                if self.silent_since(alive_ns) {
                    self.lose(&SILENT)?;
                } else if left.is_zero() {
                    return self.reopening.check().map(|()| None);
                }
                continue;
            };
            if frames.is_full() {
                self.losses.full(self.ids.next() + frames.buffers() as u64);
            }
            let seen = self.look_at(&buffer, buf.len());
            let Link::Up { frames, .. } = &mut self.link else { return Ok(None) };
            match seen {
                Ok(Some(stamp)) => {
                    frames.take(buffer, buf);
                    return Ok(Some(stamp));
                }
                Ok(None) => frames.give_back(buffer),
                Err(error) => {
                    frames.give_back(buffer);
                    return Err(error);
                }
            }
        }
    }

    fn loss_of(&self, seq: u64) -> LossCause {
        self.losses.cause(seq)
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        if self.armed_ns.take().is_none() {
            return Ok(());
        }
        self.ask(OwnerCommand::Disarm)?;
        Ok(())
    }
}

impl Drop for AravisCamera {
    fn drop(&mut self) {
        let Some(orders) = self.orders.take() else { return };
        if let Link::Up { frames, .. } = std::mem::replace(&mut self.link, Link::Lost) {
            let _ = orders.try_send(OwnerOrder { ticket: 0, command: OwnerCommand::Close(frames) });
        }
        drop(orders);
        // The owner of a dead camera may be blocked in the library, so the wait is limited.
        let until = Instant::now() + FAREWELL;
        while self.owner.as_ref().is_some_and(|owner| !owner.is_finished()) && Instant::now() < until {
            match self.replies.recv_timeout(LOOK) {
                Err(RecvTimeoutError::Disconnected) => break,
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
            }
        }
        if let Some(owner) = self.owner.take().filter(JoinHandle::is_finished) {
            let _ = owner.join();
        }
    }
}
