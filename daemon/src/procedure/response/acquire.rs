//! A run that identifies a mirror's response: dark frames, then a chirp of each axis, on a plane.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use raysweep_core::{Counts, FramePool, PointUnderWay, SettingsId, Subject};
use raysweep_pipeline::dots::{Arrival, DarkRun, Loss, Sensor};
use raysweep_processing::batches::sampling;
use raysweep_processing::response::{AXES, DotFinder, Record, ResponseTask};
use raysweep_proto::{Event, RunState};
use raysweep_session::Session;
use raysweep_session::ledger::{AxisEntry, Entry, Ledger};

use crate::devices::dots::FRAMES_AT_WORK;
use crate::devices::dots::camera::FrameRefused;
use crate::devices::dots::motion::Motion;
use crate::devices::dots::play::{Played, Player};
use crate::rig::{DotDevices, DotRig};
use crate::run::error::RunError;
use crate::run::life::Run;
use crate::run::patience::write_patiently;
use crate::run::progress::ProgressMeter;

/// Pixels this many standard deviations beyond the others are hot.
const HOT_SIGMAS: f64 = 8.0;
/// Number of frames that the background is worth once it rolls.
const BACKGROUND_FRAMES: u32 = 64;
/// How often the progress within an axis is told.
const TOLD_OF_AXIS: usize = 20;

/// Result of acquisition.
pub struct Recorded {
    /// The session.
    pub session: Session,
    /// Its ledger, still locked.
    pub ledger: Ledger,
    /// The fault that ended acquisition early, if any.
    pub fault: Option<RunError>,
    /// Warnings from before the run began.
    pub warnings: Vec<String>,
}

/// Records both axes.
///
/// # Errors
/// When the run could not begin. A later fault is in [`Recorded::fault`]: what was recorded is kept.
pub fn acquire(rig: &DotRig, task: &Arc<ResponseTask>, mut run: Run) -> Result<Recorded, RunError> {
    run.note_beginning()?;
    let rate_hz = task.response.camera_rate_hz;
    let opened = rig.open(&run.data, rate_hz)?;
    let DotDevices { mut camera, mirror, stand, clock, pace, .. } = run.probes.instead_of_dots(opened);
    let mut motion = Motion::new(mirror);
    let found = (camera.capabilities().height, camera.capabilities().width);
    let expected = (task.shape.height(), task.shape.width());
    if found != expected {
        return Err(RunError::OtherCamera { found, expected });
    }
    camera.configure(SettingsId { point: 0, attempt: 0 }, &task.camera_settings())?;
    camera.arm()?;
    let _ = run.board.go(RunState::Armed);
    let _ = run.board.go(RunState::Running);
    let (orders, board) = (run.orders.clone(), run.board.clone());
    let mut player = Player {
        orders: &orders,
        board: &board,
        motion: &mut motion,
        camera: &mut *camera,
        pool: FramePool::new(FRAMES_AT_WORK, task.format.frame_bytes(task.shape.pixels())),
        stand,
        clock,
        pace,
    };
    let mut recorder = Recorder { task: task.clone(), run };
    let passed = recorder.passes(&mut player);
    let _ = board.go(RunState::Draining);
    // Turn the light off before anything else ends.
    drop(motion);
    if let Err(error) = camera.disarm() {
        tracing::warn!(%error, "camera not disarmed");
    }
    let Run { session, ledger, warnings, .. } = recorder.run;
    Ok(Recorded { session, ledger, fault: passed.err(), warnings })
}

/// Makes and stores the records.
struct Recorder {
    task: Arc<ResponseTask>,
    run: Run,
}

impl Recorder {
    fn passes(&mut self, player: &mut Player<'_>) -> Result<(), RunError> {
        let mut progress = ProgressMeter::new(&self.run.orders, 0, AXES.len());
        player.place(Subject::Plane(0), 1)?;
        if !self.run.orders.go_on() {
            return Ok(());
        }
        let sensor = self.sensor(player, &mut progress)?;
        let Some(sensor) = sensor.filter(|_| self.run.orders.go_on()) else { return Ok(()) };
        let finder = DotFinder::new(self.task.shape, self.task.region.clone(), &sensor);
        let mut axis = 0;
        while axis < AXES.len() {
            self.run.orders.wait_while_paused();
            if !self.run.orders.go_on() {
                break;
            }
            axis += usize::from(self.axis(axis, player, &finder, &mut progress)?);
        }
        Ok(())
    }

    /// Calibrates the sensor in the dark; `None` if the run was told to end.
    fn sensor(
        &mut self,
        player: &mut Player<'_>,
        progress: &mut ProgressMeter,
    ) -> Result<Option<Sensor>, RunError> {
        let (task, orders) = (self.task.clone(), self.run.orders.clone());
        let wanted = task.response.dark_frames;
        let mut dark = DarkRun::new(task.shape, task.saturation_dn(), wanted, BACKGROUND_FRAMES)?;
        let path = task.paths[0].clone().with_light(|_| 0);
        let rounds = wanted.div_ceil(task.frames() as u32) + 1;
        let has_enough = AtomicBool::new(false);
        loop {
            let mut arrivals = Arrivals::new(&task);
            let Played { lost, is_held } =
                player.play(&path, rounds, wanted.into(), &has_enough, &mut |arrival| {
                    arrivals.take(&arrival, |_, counts| {
                        if !has_enough.load(Ordering::Relaxed) {
                            has_enough.store(!dark.push(counts)?, Ordering::Relaxed);
                        }
                        Ok(())
                    })
                })?;
            let counts = arrivals.account(&lost, 0)?;
            // No record needs these frames.
            let settling = Counts { settling: counts.cancelled, cancelled: 0, ..counts };
            self.append(&Entry::Outside { counts: settling.clone() }, settling, progress)?;
            orders.wait_while_paused();
            if !is_held || has_enough.load(Ordering::Relaxed) || !orders.go_on() {
                break;
            }
        }
        match orders.go_on() {
            true => Ok(Some(dark.finish(HOT_SIGMAS, None, sampling(task.format))?)),
            false => Ok(None),
        }
    }

    /// Records the chirp of one axis; returns whether it is recorded, and not cut short by an order.
    fn axis(
        &mut self,
        axis: usize,
        player: &mut Player<'_>,
        finder: &DotFinder,
        progress: &mut ProgressMeter,
    ) -> Result<bool, RunError> {
        let task = self.task.clone();
        let mut record = Record::new(task.commanded_deg(axis));
        let frames = record.commanded_deg.len();
        let (mut came, mut shown) = (0, 0);
        let mut arrivals = Arrivals::new(&task);
        let never = AtomicBool::new(false);
        let Played { lost, is_held } =
            player.play(&task.paths[axis], 1, frames as u64, &never, &mut |arrival| {
                arrivals.take(&arrival, |frame, counts| {
                    if frame < frames {
                        came += 1;
                        if let Some(place) = finder.find(counts) {
                            record.note(frame, place);
                            shown += 1;
                        }
                        if came % (frames / TOLD_OF_AXIS).max(1) == 0 {
                            let (frames, of) = (came as u32, frames as u32);
                            progress.under_way = Some(PointUnderWay { frames, of });
                            self.run.board.publish(Event::Progress(progress.shown()));
                        }
                    }
                    Ok(())
                })
            })?;
        let counts = arrivals.account(&lost, shown)?;
        if is_held && came < frames || !self.run.orders.go_on() {
            // A record that was cut short does not count.
            progress.under_way = None;
            let counts = Counts { cancelled: counts.cancelled + counts.averaged, averaged: 0, ..counts };
            self.append(&Entry::Outside { counts: counts.clone() }, counts, progress)?;
            return Ok(false);
        }
        let Run { session, orders, board, .. } = &self.run;
        write_patiently(orders, board, || record.write(session, axis, &task))?;
        let of_axis = format!("products/chirp_{}.", AXES[axis]);
        let bound = self.run.session.bind(|file| file.starts_with(&of_axis))?;
        self.record(&bound)?;
        progress.stored += 1;
        progress.under_way = None;
        let empty = came - shown as usize;
        let entry = AxisEntry { axis, frames, lost: frames - came, empty, counts: counts.clone() };
        self.append(&Entry::Axis(entry), counts, progress)?;
        Ok(true)
    }

    fn record(&mut self, entry: &Entry) -> Result<(), RunError> {
        let Run { ledger, orders, board, .. } = &mut self.run;
        Ok(write_patiently(orders, board, || ledger.append(entry))?)
    }

    fn append(
        &mut self,
        entry: &Entry,
        counts: Counts,
        progress: &mut ProgressMeter,
    ) -> Result<(), RunError> {
        if counts != Counts::default() || !matches!(entry, Entry::Outside { .. }) {
            self.record(entry)?;
        }
        progress.counts.add(&counts);
        self.run.board.publish(Event::Progress(progress.shown()));
        Ok(())
    }
}

/// The frames of a path by their ids, unpacked into one buffer, and the account of its triggers.
struct Arrivals<'a> {
    task: &'a ResponseTask,
    pixels: Vec<u16>,
    /// Ids of the first and of the newest frame.
    ids: Option<(u64, u64)>,
    counts: Counts,
    failed: Option<RunError>,
}

impl<'a> Arrivals<'a> {
    fn new(task: &'a ResponseTask) -> Self {
        let pixels = vec![0; task.shape.values()];
        Self { task, pixels, ids: None, counts: Counts::default(), failed: None }
    }

    /// Unpacks a frame, if it is new, and hands it on with its number, counted from the first that arrived.
    fn take(
        &mut self,
        arrival: &Arrival,
        each: impl FnOnce(usize, &[u16]) -> Result<(), RunError>,
    ) -> Result<(), FrameRefused> {
        self.lose(&arrival.lost_before);
        let seq = arrival.frame.stamp.seq;
        if self.ids.is_some_and(|(_, newest)| seq <= newest) {
            return Ok(());
        }
        let first = self.ids.map_or(seq, |(first, _)| first);
        self.ids = Some((first, seq));
        self.counts.expected += 1;
        self.counts.cancelled += 1;
        let unpacked = self.task.format.unpack_into(&arrival.frame.data, &mut self.pixels);
        let done = unpacked
            .map_err(|error| RunError::Frame(error.to_string()))
            .and_then(|()| each((seq - first) as usize, &self.pixels));
        done.map_err(|error| {
            self.failed = Some(error);
            FrameRefused::Closed
        })
    }

    fn lose(&mut self, losses: &[Loss]) {
        for loss in losses {
            self.counts.expected += loss.frames;
            self.counts.lose(loss.cause, loss.frames);
        }
    }

    /// Accounts for the triggers: `used` of the frames went into a record, the others were not used.
    fn account(mut self, after: &[Loss], used: u64) -> Result<Counts, RunError> {
        self.lose(after);
        let Self { mut counts, failed, .. } = self;
        counts.cancelled -= used;
        counts.averaged += used;
        failed.map_or(Ok(counts), Err)
    }
}
