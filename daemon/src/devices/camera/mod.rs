//! The camera's thread: sets the camera for each point in turn and forwards its frames.

mod ahead;
mod glance;
mod probe;
mod sequence;
mod sets;
mod triggers;

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, OnceLock};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use raysweep_core::{
    Camera, CameraSettings, Clock, DeviceError, DeviceErrorKind, DeviceState, Frame, FrameBuf, FramePool,
    FrameStamp, LossCause, SettingsId, SettingsLatency, ns_from_us,
};
use raysweep_pipeline::{DeviceEvent, Failure, Input, Label, Point, QueueError, Shot, message_of};

pub use self::ahead::TriggerLine;
use self::ahead::{Ahead, Seen};
pub use self::glance::Glance;
pub use self::sequence::{FilmPass, FilmSetting};
use super::priority;
use crate::rig::Pace;
use crate::run::orders::Orders;

/// One attempt at a point.
#[derive(Debug, Clone, Copy)]
pub struct Attempt {
    /// Ids of the point and the attempt.
    pub id: SettingsId,
    /// What to acquire.
    pub point: Point,
    /// Camera settings for it.
    pub shot: Shot,
    /// How often this attempt was interrupted during this run.
    pub interruptions: u32,
}

impl Attempt {
    /// The next attempt after this one has failed.
    pub fn after(self, failure: Failure) -> Self {
        match failure {
            Failure::Losses => {
                let id = SettingsId { attempt: self.id.attempt + 1, ..self.id };
                Self { id, interruptions: 0, ..self }
            }
            Failure::Interrupted => Self { interruptions: self.interruptions + 1, ..self },
        }
    }
}

/// Points to acquire with one image on the projector.
#[derive(Debug, Clone)]
pub struct Pass {
    /// Attempts, in order.
    pub attempts: Vec<Attempt>,
    /// Frames exposed earlier may still show the previous image.
    pub not_before_ns: i64,
}

/// Work for the camera until its next flush.
#[derive(Debug, Clone)]
pub enum Work {
    /// Take a few frames of no point.
    Glance(Glance),
    /// Measure the settings latency, by changing from and to these settings.
    Probe(CameraSettings),
    /// Points, each until all its frames have arrived, and until all are decided.
    Pass(Pass),
    /// Points, each until all its frames have arrived. They are decided while more work is done, the last of which is
    /// [`Work::Settle`].
    PassOn(Pass),
    /// Wait until all points are decided.
    Settle,
    /// A film.
    Film(FilmPass),
}

/// Number of frame buffers between camera and assembler: more than the assembler ever holds while it waits for edges.
const POOL_BUFFERS: usize = 40;
/// Timeout of one wait for a frame; orders are checked in between.
const POLL: Duration = Duration::from_millis(100);
/// A camera that delivers no frames for this long, beyond the frame time, has lost its trigger.
const PATIENCE: Duration = Duration::from_secs(2);
/// Most frames in a row whose timestamps do not rise while exposures of a certain time are waited for.
const MOST_STANDING_FRAMES: u32 = 100;
/// Frames to skip before a run's first point, and at most after a pass's last, so that the line is known around each
/// frame.
const MARGIN_FRAMES: u32 = 6;

/// How a pass ended.
enum Ended {
    /// All of its points are decided, or will be: the pipeline has received the flush.
    Flushed(Result<(), DeviceError>),
    /// More work decides the points.
    Done(Result<(), DeviceError>),
    /// The pipeline accepts nothing any more.
    NotFlushed,
}

/// The camera's thread or the pipeline has failed: no more verdicts will come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gone;

/// Handle of the camera's thread.
pub struct CameraThread {
    work: SyncSender<Work>,
    ended: Receiver<Ended>,
    latency: Arc<OnceLock<SettingsLatency>>,
    thread: JoinHandle<Exposures>,
}

/// When the frames that points waited for were exposed.
#[derive(Debug, Clone, Copy, Default)]
pub struct Exposures {
    /// When the last of these exposures ended.
    pub until: Option<Instant>,
    /// From the start of the first lit exposure to the end of the last, on the camera's clock.
    lit_ns: Option<(i64, i64)>,
    /// Whether that clock is virtual.
    pub is_simulated: bool,
}

impl Exposures {
    /// Seconds from the start of the first lit exposure to the end of the last.
    pub fn light_s(&self) -> Option<f64> {
        self.lit_ns.map(|(from_ns, to_ns)| (to_ns - from_ns) as f64 * 1e-9)
    }
}

/// How a run's camera is driven.
pub struct Drive {
    /// The clock of the timestamps.
    pub clock: Clock,
    /// Whether the devices or the pipeline set the pace.
    pub pace: Pace,
    /// The line that triggers the camera.
    pub line: TriggerLine,
}

impl CameraThread {
    /// Arms the camera on its own thread.
    ///
    /// # Errors
    /// When the camera cannot be armed or the thread cannot be started.
    pub fn start(
        mut camera: Box<dyn Camera>,
        drive: Drive,
        input: Input<DeviceEvent>,
        orders: Arc<Orders>,
    ) -> Result<Self, DeviceError> {
        camera.arm()?;
        let latency = Arc::new(OnceLock::new());
        let (work, todo) = sync_channel::<Work>(1);
        let (done, ended) = sync_channel(1);
        let thread = thread::Builder::new()
            .name("camera".into())
            .spawn({
                let latency = latency.clone();
                move || {
                    // On a virtual clock, the camera computes frames all the time.
                    if drive.pace == Pace::Devices {
                        priority::for_device("camera");
                    }
                    let mut acquisition = Acquisition::new(camera, drive, input, orders);
                    for work in todo {
                        if done.send(acquisition.work(work, &latency)).is_err() {
                            break;
                        }
                    }
                    if let Err(error) = acquisition.camera.disarm() {
                        tracing::warn!(%error, "camera not disarmed");
                    }
                    acquisition.exposures
                }
            })
            .map_err(|error| DeviceError::new("camera", DeviceErrorKind::NotReady, error))?;
        Ok(Self { work, ended, latency, thread })
    }

    /// Does some work and waits until it ends. The verdicts on its points, followed by that on the flush, arrive at
    /// the pipeline's sink, even if the camera failed (the inner error); those of [`Work::PassOn`] after later work.
    ///
    /// # Errors
    /// [`Gone`] if there will be no verdicts.
    pub fn acquire(&self, work: Work) -> Result<Result<(), DeviceError>, Gone> {
        self.work.send(work).map_err(|_closed| Gone)?;
        match self.ended.recv() {
            Ok(Ended::Flushed(acquired) | Ended::Done(acquired)) => Ok(acquired),
            Ok(Ended::NotFlushed) | Err(_) => Err(Gone),
        }
    }

    /// The settings latency, once a probe has measured it.
    pub fn latency(&self) -> Option<SettingsLatency> {
        self.latency.get().copied()
    }

    /// Disarms the camera and ends its thread; returns when the frames that points waited for were exposed.
    ///
    /// # Errors
    /// When the thread panicked.
    pub fn join(self) -> Result<Exposures, DeviceError> {
        drop(self.work);
        self.thread.join().map_err(|panic| {
            let what = format!("its thread panicked: {}; resume the session", message_of(&*panic));
            DeviceError::new("camera", DeviceErrorKind::Disconnected, what)
        })
    }
}

/// What the camera's thread does: acquires points, one after the other.
struct Acquisition {
    camera: Box<dyn Camera>,
    clock: Clock,
    input: Input<DeviceEvent>,
    pace: Pace,
    pool: FramePool,
    /// Receives frames that are dropped for lack of a buffer.
    spare: FrameBuf,
    orders: Arc<Orders>,
    warmed_up: bool,
    /// The longest time from edge to last row of any frame so far.
    longest_frame_us: f64,
    line: TriggerLine,
    ahead: Ahead,
    /// The assembler knows the fate of every frame up to this one; `None` after a pause, whose frames do not count.
    told_seq: Option<u64>,
    /// Number of settings written only to lead in to others.
    lead_ins: u32,
    /// Whether the camera still has the settings of the work before, from which the next ones can be told apart.
    is_led_in: bool,
    exposures: Exposures,
}

/// A frame received from the camera.
struct Received {
    stamp: FrameStamp,
    seen: Seen,
    /// `None` if no buffer was free.
    data: Option<FrameBuf>,
}

/// Fate of a frame.
enum Taken {
    /// Handed to the assembler.
    Passed,
    /// Dropped for lack of room.
    Lost,
}

impl Acquisition {
    fn new(camera: Box<dyn Camera>, drive: Drive, input: Input<DeviceEvent>, orders: Arc<Orders>) -> Self {
        let Drive { clock, pace, line } = drive;
        let capabilities = camera.capabilities();
        let bytes = capabilities.format.frame_bytes(capabilities.width * capabilities.height);
        let pool = FramePool::new(POOL_BUFFERS, bytes);
        let spare = pool.spare();
        Self {
            ahead: Ahead::new(capabilities.clone(), line),
            camera,
            clock,
            input,
            pace,
            pool,
            spare,
            orders,
            warmed_up: false,
            longest_frame_us: 0.0,
            line,
            told_seq: None,
            lead_ins: 0,
            is_led_in: false,
            // Where the devices of a plane rig wait for the pipeline, they are simulated.
            exposures: Exposures { is_simulated: pace == Pace::Pipeline, ..Exposures::default() },
        }
    }

    /// Ends with a flush, so that every point is decided, unless more work is sure to follow.
    fn work(&mut self, work: Work, latency: &OnceLock<SettingsLatency>) -> Ended {
        // Frames since the last work do not count: an operator may have taken minutes to change the projected image.
        self.told_seq = None;
        let acquired = match work {
            Work::Glance(glance) => self.glance(&glance),
            Work::Probe(settings) => self.probe(&settings).map(|found| {
                if let Some(found) = found {
                    latency.get_or_init(|| found);
                }
            }),
            Work::Pass(pass) => self.sweep(pass).and_then(|()| self.settle()),
            Work::PassOn(pass) => {
                let swept = self.sweep(pass);
                self.is_led_in = swept.is_ok();
                return Ended::Done(swept);
            }
            Work::Settle => self.settle(),
            Work::Film(film) => self.film(&film),
        };
        match self.input.send(DeviceEvent::Flush) {
            Ok(()) => Ended::Flushed(acquired),
            Err(_) => Ended::NotFlushed,
        }
    }

    /// Skips frames until the line is known and the projector shows the image.
    fn warm_up(&mut self, not_before_ns: i64) -> Result<(), DeviceError> {
        let margin = if self.warmed_up { 0 } else { MARGIN_FRAMES };
        self.pass_frames(margin, not_before_ns)?;
        self.warmed_up = true;
        Ok(())
    }

    /// Skips at least `frames` frames, until exposures start at `not_before_ns` or later.
    fn pass_frames(&mut self, frames: u32, not_before_ns: i64) -> Result<(), DeviceError> {
        let mut left = frames;
        let mut watchdog = Watchdog::default();
        let mut reached_ns = i64::MIN;
        let mut standing = 0;
        while (left > 0 || reached_ns < not_before_ns) && self.orders.go_on() {
            let Some(received) = self.receive(POLL)? else {
                watchdog.missed(POLL, self.longest_frame_us, self.camera.state())?;
                continue;
            };
            watchdog.feed();
            let start_ns = received.stamp.exposure_start_ns;
            standing = if start_ns > reached_ns { 0 } else { standing + 1 };
            if standing > MOST_STANDING_FRAMES {
                let what = format!(
                    "its clock stands still: {standing} frames say that they are not later than the one before them; \
                     switch the camera off and on, and resume the session"
                );
                return Err(DeviceError::new("camera", DeviceErrorKind::Protocol, what));
            }
            if let Taken::Passed = self.pass(received)? {
                left = left.saturating_sub(1);
                reached_ns = start_ns;
            }
        }
        Ok(())
    }

    /// Skips a frame.
    fn pass(&mut self, received: Received) -> Result<Taken, DeviceError> {
        for _ in 0..received.seen.owner.unwrap_or(0) {
            self.ahead.pop();
        }
        self.hand_on(received, Label::Cancelled)
    }

    fn frame_us(&self, settings: &CameraSettings) -> f64 {
        let periods = self.camera.capabilities().periods_per_frame(settings, self.line.period_us);
        f64::from(periods) * self.line.period_us
    }

    /// Records the exposure of a frame that a point waited for and that has just arrived.
    fn note_exposure(&mut self, stamp: &FrameStamp, settings: &CameraSettings, is_lit: bool) {
        let capabilities = self.camera.capabilities();
        let rows_us = capabilities.height.saturating_sub(1) as f64 * capabilities.row_time_us;
        let end_ns = stamp.exposure_start_ns + ns_from_us(settings.exposure_us + rows_us);
        // The camera's clock may be virtual, so only differences of its times count.
        let since = Duration::from_nanos((stamp.host_ns - end_ns).try_into().unwrap_or(0));
        self.exposures.until = Instant::now().checked_sub(since);
        if is_lit {
            let (first_ns, _) = self.exposures.lit_ns.unwrap_or((stamp.exposure_start_ns, end_ns));
            self.exposures.lit_ns = Some((first_ns, end_ns));
        }
    }

    /// Waits for a frame; where the camera waits for the pipeline, first for a buffer, unless an order ends the run.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Received>, DeviceError> {
        let mut data = match self.pace {
            Pace::Pipeline => loop {
                match self.pool.take_within(POLL) {
                    None if !self.orders.go_on() => return Ok(None),
                    None => {}
                    free => break free,
                }
            },
            Pace::Devices => self.pool.try_take(),
        };
        let stamp = self.camera.next_frame(data.as_mut().unwrap_or(&mut self.spare), timeout)?;
        Ok(stamp.map(|stamp| Received { stamp, seen: self.ahead.see(&stamp), data }))
    }

    /// Hands a frame to the assembler, or reports that there was no room for it.
    fn hand_on(
        &mut self,
        Received { stamp, data, .. }: Received,
        label: Label,
    ) -> Result<Taken, DeviceError> {
        self.tell_losses(stamp.seq)?;
        self.told_seq = Some(stamp.seq);
        let Some(data) = data else { return self.lose(stamp, label, LossCause::PoolEmpty) };
        let frame = Frame { data, format: self.camera.capabilities().format, stamp };
        match self.input.offer(DeviceEvent::Frame(frame, label)) {
            Ok(()) => Ok(Taken::Passed),
            Err(QueueError::Full(_)) => self.lose(stamp, label, LossCause::QueueFull),
            Err(error @ QueueError::Closed) => Err(closed(error)),
        }
    }

    /// Tells the assembler why frames before `seq` never arrived, if the camera knows the reason.
    fn tell_losses(&mut self, seq: u64) -> Result<(), DeviceError> {
        let first = self.told_seq.map_or(seq, |told| told + 1);
        for lost in first..seq {
            let cause = self.camera.loss_of(lost);
            if cause != LossCause::CameraGap {
                self.input.send(DeviceEvent::Lost(lost, Some(cause))).map_err(closed)?;
            }
        }
        Ok(())
    }

    /// Only frames that a point waits for count as lost; others are merely skipped.
    fn lose(&mut self, stamp: FrameStamp, label: Label, cause: LossCause) -> Result<Taken, DeviceError> {
        let event = match label {
            Label::Counted | Label::CountedUnless { .. } => DeviceEvent::Lost(stamp.seq, Some(cause)),
            Label::Settling | Label::Cancelled => DeviceEvent::Lost(stamp.seq, None),
        };
        self.input.send(event).map_err(closed)?;
        Ok(Taken::Lost)
    }
}

/// Detects a camera that delivers no frames.
#[derive(Default)]
struct Watchdog {
    waited: Duration,
}

impl Watchdog {
    fn feed(&mut self) {
        self.waited = Duration::ZERO;
    }

    fn missed(
        &mut self,
        waited: Duration,
        longest_frame_us: f64,
        state: DeviceState,
    ) -> Result<(), DeviceError> {
        // A camera that its driver is reopening either comes back or ends the run itself.
        if state == DeviceState::Lost {
            self.waited = Duration::ZERO;
            return Ok(());
        }
        self.waited += waited;
        if self.waited < PATIENCE + Duration::from_secs_f64(3e-6 * longest_frame_us) {
            return Ok(());
        }
        Err(DeviceError::new(
            "camera",
            DeviceErrorKind::Timeout,
            format!(
                "no frame for {:.1} s: check that VSYNC reaches its trigger input and that its trigger mode is on",
                self.waited.as_secs_f64()
            ),
        ))
    }
}

fn closed<T>(_: QueueError<T>) -> DeviceError {
    DeviceError::new("camera", DeviceErrorKind::NotReady, "the pipeline has ended; the log says why")
}

#[cfg(test)]
mod tests;
