//! The camera's thread: sets the camera for one point after the other and hands its frames on.

mod film;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use raysweep_core::{
    Applied, Camera, CameraSettings, DeviceError, DeviceErrorKind, DeviceState, Frame, FrameBuf, FramePool,
    FrameStamp, LossCause, SettingsId, ns_from_us,
};
use raysweep_pipeline::{Event, Input, Job, Label, Point, QueueError, Shot, message_of};

pub use self::film::{FilmPass, FilmSetting};
use super::orders::{Order, Orders};
use crate::rig::Pace;

/// One attempt at a point.
#[derive(Debug, Clone, Copy)]
pub struct Attempt {
    /// Point and attempt.
    pub id: SettingsId,
    /// What to acquire.
    pub point: Point,
    /// How to set the camera for it.
    pub shot: Shot,
}

/// Points to acquire under one picture of the projector.
#[derive(Debug, Clone)]
pub struct Pass {
    /// In order.
    pub attempts: Vec<Attempt>,
    /// Frames exposed earlier may still see the picture before.
    pub not_before_ns: i64,
}

/// What the camera is for until its next flush.
#[derive(Debug, Clone)]
pub enum Work {
    /// Points, each until all its frames are there.
    Pass(Pass),
    /// A film.
    Film(FilmPass),
}

/// Buffers for frames on their way to the assembler: more than it ever holds while it waits for edges.
const POOL_BUFFERS: usize = 40;
/// One wait for a frame; orders are looked at in between.
const POLL: Duration = Duration::from_millis(100);
/// A camera without frames for so long, beyond the time that they take, has lost its trigger.
const PATIENCE: Duration = Duration::from_secs(2);
/// Frames that pass before a run's first point and after a pass's last, so that the line is known around each frame.
const MARGIN_FRAMES: u32 = 6;

/// How a pass ended.
enum Ended {
    /// Everything that it left is decided, or will be: the pipeline has its flush.
    Flushed(Result<(), DeviceError>),
    /// The pipeline takes nothing any more.
    NotFlushed,
}

/// The camera's thread or the pipeline has failed: no verdict comes any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gone;

/// The camera's thread as the run sees it.
pub struct CameraThread {
    work: SyncSender<Work>,
    ended: Receiver<Ended>,
    thread: JoinHandle<Option<Instant>>,
}

impl CameraThread {
    /// Arms the camera on its own thread.
    ///
    /// # Errors
    /// When the camera cannot be armed or the system gives no thread.
    pub fn start(
        mut camera: Box<dyn Camera>,
        input: Input<Event>,
        pace: Pace,
        period_us: f64,
        orders: Arc<Orders>,
    ) -> Result<Self, DeviceError> {
        camera.arm()?;
        let (work, todo) = sync_channel::<Work>(1);
        let (done, ended) = sync_channel(1);
        let thread = thread::Builder::new()
            .name("camera".into())
            .spawn(move || {
                let mut sequencer = Sequencer::new(camera, input, pace, period_us, orders);
                for work in todo {
                    if done.send(sequencer.work(&work)).is_err() {
                        break;
                    }
                }
                if let Err(error) = sequencer.camera.disarm() {
                    tracing::warn!(%error, "camera not disarmed");
                }
                sequencer.exposed_until
            })
            .map_err(|error| DeviceError::new("camera", DeviceErrorKind::NotReady, error))?;
        Ok(Self { work, ended, thread })
    }

    /// Does some work and waits for its end. The verdicts on its points, the last of them that it is flushed, arrive
    /// at the pipeline's sink, also when the camera failed (the inner error).
    ///
    /// # Errors
    /// [`Gone`] when there will be no verdicts.
    pub fn acquire(&self, work: Work) -> Result<Result<(), DeviceError>, Gone> {
        self.work.send(work).map_err(|_closed| Gone)?;
        match self.ended.recv() {
            Ok(Ended::Flushed(acquired)) => Ok(acquired),
            Ok(Ended::NotFlushed) | Err(_) => Err(Gone),
        }
    }

    /// Disarms the camera and ends its thread; says when the exposure of the last frame ended that a point waited for.
    ///
    /// # Errors
    /// When the thread panicked.
    pub fn join(self) -> Result<Option<Instant>, DeviceError> {
        drop(self.work);
        self.thread.join().map_err(|panic| {
            let what = format!("its thread panicked: {}; resume the session", message_of(&*panic));
            DeviceError::new("camera", DeviceErrorKind::NotReady, what)
        })
    }
}

struct Sequencer {
    camera: Box<dyn Camera>,
    input: Input<Event>,
    pace: Pace,
    pool: FramePool,
    /// Takes the frames that there is no room for.
    spare: FrameBuf,
    orders: Arc<Orders>,
    warmed_up: bool,
    /// The longest that a frame has taken so far, from its edge to its last row.
    longest_frame_us: f64,
    period_us: f64,
    /// Id of the newest frame.
    newest_seq: Option<u64>,
    /// Up to this frame the assembler knows what became of each; nothing after a pause, whose frames are nobody's.
    told_seq: Option<u64>,
    /// When the exposure of the last counted frame ended.
    exposed_until: Option<Instant>,
}

/// A frame off the camera.
struct Received {
    stamp: FrameStamp,
    /// Nothing where no buffer was free.
    data: Option<FrameBuf>,
}

/// What became of one wait for a frame.
enum Taken {
    /// It is with the assembler.
    Passed(FrameStamp, Label),
    /// There was no room for it.
    Lost,
    /// None came in time.
    None,
}

impl Sequencer {
    fn new(
        camera: Box<dyn Camera>,
        input: Input<Event>,
        pace: Pace,
        period_us: f64,
        orders: Arc<Orders>,
    ) -> Self {
        let capabilities = camera.capabilities();
        let bytes = capabilities.format.frame_bytes(capabilities.width * capabilities.height);
        let pool = FramePool::new(POOL_BUFFERS, bytes);
        let spare = pool.spare();
        Self {
            camera,
            input,
            pace,
            pool,
            spare,
            orders,
            warmed_up: false,
            longest_frame_us: 0.0,
            period_us,
            newest_seq: None,
            told_seq: None,
            exposed_until: None,
        }
    }

    /// Always ends with a flush, so that nothing stays undecided.
    fn work(&mut self, work: &Work) -> Ended {
        let acquired = match work {
            Work::Pass(pass) => self.attempts(pass),
            Work::Film(film) => self.film(film),
        };
        match self.input.send(Event::Flush) {
            Ok(()) => Ended::Flushed(acquired),
            Err(_) => Ended::NotFlushed,
        }
    }

    fn attempts(&mut self, pass: &Pass) -> Result<(), DeviceError> {
        self.warm_up(pass.not_before_ns)?;
        for attempt in &pass.attempts {
            if self.orders.now() == Order::Pause {
                self.idle()?;
            }
            if !self.orders.go_on() {
                return Ok(());
            }
            self.attempt(attempt)?;
        }
        self.pass_frames(MARGIN_FRAMES, i64::MIN)
    }

    /// Lets frames go by until the line is known and the picture is in the light.
    fn warm_up(&mut self, not_before_ns: i64) -> Result<(), DeviceError> {
        let margin = if self.warmed_up { 0 } else { MARGIN_FRAMES };
        self.pass_frames(margin, not_before_ns)?;
        self.warmed_up = true;
        Ok(())
    }

    fn attempt(&mut self, attempt: &Attempt) -> Result<(), DeviceError> {
        let Attempt { id, point, shot } = *attempt;
        let Some(applied) = self.configure(id, &shot.settings)? else { return Ok(()) };
        let job = Job {
            id,
            frames: point.frames,
            applied,
            delay_us: point.delay_us,
            light_edges_later: shot.light_edges_later,
            periods_from_last: None,
        };
        self.input.send(Event::Begin(job)).map_err(closed)?;
        self.longest_frame_us = self.longest_frame_us.max(self.frame_us(&applied.actual));
        let mut passed = 0;
        let mut watchdog = self.watchdog();
        // A point that has failed is taken with some frames to spare, the more the oftener it failed.
        let wanted = point.frames + id.attempt * point.frames.div_ceil(4);
        // Frames that found no room are taken again within the attempt, but not for ever.
        let mut spare_frames = 64 + 3 * point.frames;
        while passed < wanted && spare_frames > 0 && self.orders.go_on() {
            match self.take(|stamp| Label::of(stamp, &applied))? {
                Taken::Passed(stamp, Label::Counted) => {
                    passed += 1;
                    self.exposed_until = self.end_of_exposure(&stamp, &applied.actual);
                }
                Taken::Passed(..) => {}
                Taken::Lost => spare_frames -= 1,
                Taken::None => {
                    watchdog.missed(self.camera.state())?;
                    continue;
                }
            }
            watchdog.feed();
        }
        self.input.send(Event::End).map_err(closed)
    }

    /// Writes settings. A camera that is being opened again is waited for; nothing when the run ends meanwhile.
    fn configure(
        &mut self,
        id: SettingsId,
        settings: &CameraSettings,
    ) -> Result<Option<Applied>, DeviceError> {
        loop {
            match self.camera.configure(id, settings) {
                Err(_) if self.camera.state() == DeviceState::Lost => {
                    if !self.orders.go_on() {
                        return Ok(None);
                    }
                    self.take(|_| Label::Cancelled)?;
                }
                applied => return applied.map(Some),
            }
        }
    }

    /// Holds the run until it is told to go on.
    fn idle(&mut self) -> Result<(), DeviceError> {
        self.input.send(Event::Idle).map_err(closed)?;
        self.orders.wait_while_paused();
        self.told_seq = None;
        Ok(())
    }

    /// Lets frames go by: at least `frames` of them, and until exposures start at `not_before_ns` or later.
    fn pass_frames(&mut self, frames: u32, not_before_ns: i64) -> Result<(), DeviceError> {
        let mut left = frames;
        let mut watchdog = self.watchdog();
        let mut reached_ns = i64::MIN;
        while (left > 0 || reached_ns < not_before_ns) && self.orders.go_on() {
            match self.take(|_| Label::Cancelled)? {
                Taken::Passed(stamp, _) => {
                    left = left.saturating_sub(1);
                    reached_ns = stamp.exposure_start_ns;
                }
                Taken::Lost => {}
                Taken::None => {
                    watchdog.missed(self.camera.state())?;
                    continue;
                }
            }
            watchdog.feed();
        }
        Ok(())
    }

    fn frame_us(&self, settings: &CameraSettings) -> f64 {
        let periods = self.camera.capabilities().periods_per_frame(settings, self.period_us);
        f64::from(periods) * self.period_us
    }

    /// When the last row of a frame that has just come ended its exposure. The camera's clock may be a virtual one, so
    /// that only its differences count.
    fn end_of_exposure(&self, stamp: &FrameStamp, settings: &CameraSettings) -> Option<Instant> {
        let capabilities = self.camera.capabilities();
        let rows_us = capabilities.height.saturating_sub(1) as f64 * capabilities.row_time_us;
        let since_ns = stamp.host_ns - stamp.exposure_start_ns - ns_from_us(settings.exposure_us + rows_us);
        Instant::now().checked_sub(Duration::from_nanos(since_ns.try_into().unwrap_or(0)))
    }

    fn watchdog(&self) -> Watchdog {
        Watchdog {
            patience: PATIENCE + Duration::from_secs_f64(3e-6 * self.longest_frame_us),
            waited: Duration::ZERO,
        }
    }

    fn take(&mut self, label: impl FnOnce(&FrameStamp) -> Label) -> Result<Taken, DeviceError> {
        let Some(received) = self.receive()? else { return Ok(Taken::None) };
        let label = label(&received.stamp);
        self.hand_on(received, label)
    }

    /// Waits for a frame.
    fn receive(&mut self) -> Result<Option<Received>, DeviceError> {
        let mut data = match self.pace {
            Pace::Pipeline => Some(self.pool.take()),
            Pace::Devices => self.pool.try_take(),
        };
        let stamp = self.camera.next_frame(data.as_mut().unwrap_or(&mut self.spare), POLL)?;
        self.newest_seq = stamp.map(|stamp| stamp.seq).or(self.newest_seq);
        Ok(stamp.map(|stamp| Received { stamp, data }))
    }

    /// Gives a frame to the assembler, or notes that there was no room for it.
    fn hand_on(&mut self, Received { stamp, data }: Received, label: Label) -> Result<Taken, DeviceError> {
        self.tell_losses(stamp.seq)?;
        self.told_seq = Some(stamp.seq);
        let Some(data) = data else { return self.lose(stamp, label, LossCause::PoolEmpty) };
        let frame = Frame { data, format: self.camera.capabilities().format, stamp };
        match self.input.offer(Event::Frame(frame, label)) {
            Ok(()) => Ok(Taken::Passed(stamp, label)),
            Err(QueueError::Full(_)) => self.lose(stamp, label, LossCause::QueueFull),
            Err(error @ QueueError::Closed) => Err(closed(error)),
        }
    }

    /// Tells the assembler why frames before `seq` never came, where the camera knows more than that they did not.
    fn tell_losses(&mut self, seq: u64) -> Result<(), DeviceError> {
        let first = self.told_seq.map_or(seq, |told| told + 1);
        for lost in first..seq {
            let cause = self.camera.loss_of(lost);
            if cause != LossCause::CameraGap {
                self.input.send(Event::Lost(lost, Some(cause))).map_err(closed)?;
            }
        }
        Ok(())
    }

    /// Only a frame that a point waits for is lost; the others are merely not looked at.
    fn lose(&mut self, stamp: FrameStamp, label: Label, cause: LossCause) -> Result<Taken, DeviceError> {
        let event = match label {
            Label::Counted => Event::Lost(stamp.seq, Some(cause)),
            Label::Settling | Label::Cancelled => Event::Lost(stamp.seq, None),
        };
        self.input.send(event).map_err(closed)?;
        Ok(Taken::Lost)
    }
}

/// Notices a camera that gives no frames.
struct Watchdog {
    patience: Duration,
    waited: Duration,
}

impl Watchdog {
    fn feed(&mut self) {
        self.waited = Duration::ZERO;
    }

    fn missed(&mut self, state: DeviceState) -> Result<(), DeviceError> {
        // A camera that its driver opens again comes back or ends the run itself.
        if state == DeviceState::Lost {
            self.waited = Duration::ZERO;
            return Ok(());
        }
        self.waited += POLL;
        if self.waited < self.patience {
            return Ok(());
        }
        Err(DeviceError::new(
            "camera",
            DeviceErrorKind::Timeout,
            format!(
                "no frame for {:.1} s: is VSYNC on its trigger input, and is the trigger mode on?",
                self.waited.as_secs_f64()
            ),
        ))
    }
}

fn closed<T>(_: QueueError<T>) -> DeviceError {
    DeviceError::new("camera", DeviceErrorKind::NotReady, "the pipeline has ended; the log says why")
}
