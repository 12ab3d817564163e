//! Dark frames, flat field, calibration planes, then the scene.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use raysweep_config::BatchesPlan;
use raysweep_core::{Counts, FramePool, SettingsId, Subject};
use raysweep_pipeline::Policy;
use raysweep_pipeline::dots::{DarkRun, DotsFlow, DotsFlowConfig, FlatRun, Gathered, Loss, Sensor};
use raysweep_processing::batches::{CorrectOptions, DotTask, flat};
use raysweep_proto::RunState;
use raysweep_session::Session;
use raysweep_session::dots::RawFrames;
use raysweep_session::ledger::Ledger;
use raysweep_transport::dots::{DotsError, FlatField};

use super::frame_buffers;
use super::sink::{BatchSink, RawSink, StoredBatches, Writing};
use crate::devices::dots::camera::FrameRefused;
use crate::devices::dots::frames_waiting;
use crate::devices::dots::motion::Motion;
use crate::devices::dots::play::{Played, Player};
use crate::probes::Probes;
use crate::rig::{DotDevices, DotRig, Pace};
use crate::run::error::RunError;
use crate::run::life::Run;
use crate::run::orders::Orders;
use crate::run::patience::write_patiently;

/// Most times that the path is played for the frames without light, if the camera loses some.
const MOST_DARK_PASSES: u32 = 5;

/// Result of acquisition.
pub struct Acquired {
    /// The session.
    pub session: Session,
    /// Its ledger, still locked.
    pub ledger: Ledger,
    /// Warnings from before the run began, and problems with single dots and batches.
    pub problems: Vec<String>,
    /// The fault that ended acquisition early, if any.
    pub fault: Option<RunError>,
    /// Time from the last frame until all batches were on disk; `None` without frames.
    pub final_s: Option<f64>,
}

/// Acquires all batches.
///
/// # Errors
/// When the run could not begin. A later fault is in [`Acquired::fault`]: what was acquired is kept.
pub fn acquire(rig: &DotRig, task: &Arc<DotTask>, mut run: Run) -> Result<Acquired, RunError> {
    run.note_beginning()?;
    let earlier = task.earlier_flat_field(&run.data)?;
    let rate_hz = task.batches.camera_rate_hz();
    let opened = rig.open(&run.data, rate_hz)?;
    let DotDevices { mut camera, mirror, stand, clock, pace, .. } = run.probes.instead_of_dots(opened);
    let mut motion = Motion::new(mirror);
    let shape = task.shape;
    let found = (camera.capabilities().height, camera.capabilities().width);
    if found != (shape.height(), shape.width()) {
        return Err(RunError::OtherCamera { found, expected: (shape.height(), shape.width()) });
    }
    if let Some(Err(error)) = run.live.as_ref().map(|outlet| outlet.file.clear()) {
        tracing::warn!(%error, "the live file still shows the run before");
    }
    camera.configure(SettingsId { point: 0, attempt: 0 }, &task.camera_settings())?;
    let storage = BatchSink::start(Writing {
        task: task.clone(),
        dots: run.session.dots()?,
        ledger: run.ledger,
        board: run.board.clone(),
        orders: run.orders.clone(),
        live: run.live,
    })?;
    let frame_bytes = task.format.frame_bytes(shape.pixels());
    let waiting = frames_waiting(pace, rate_hz, frame_bytes);
    camera.arm()?;
    let _ = run.board.go(RunState::Armed);
    let _ = run.board.go(RunState::Running);
    let mut passes = DotPasses {
        task,
        probes: &run.probes,
        session: &run.session,
        earlier,
        orders: &run.orders,
        storage: &storage,
        waiting,
        last_frame: None,
        player: Player {
            orders: &run.orders,
            board: &run.board,
            motion: &mut motion,
            camera: &mut *camera,
            pool: FramePool::new(frame_buffers(task, pace), frame_bytes),
            stand,
            clock,
            pace,
        },
    };
    let passed = passes.all();
    let last_frame = passes.last_frame;
    // Turn the light off before anything else ends.
    drop(motion);
    let stored = storage.finish();
    let _ = run.board.go(RunState::Draining);
    if let Err(error) = camera.disarm() {
        tracing::warn!(%error, "camera not disarmed");
    }
    let StoredBatches { ledger, problems, error } = stored?;
    let final_s = last_frame.map(|last| last.elapsed().as_secs_f64());
    let fault = error.map(RunError::from).or(passed.err());
    let problems = [run.warnings, problems].concat();
    Ok(Acquired { session: run.session, ledger, problems, fault, final_s })
}

/// A pass that is over.
struct Passed {
    sensor: Sensor,
    raw: Option<RawSink>,
    /// Number of batches that it took.
    batches: u32,
    /// Whether a pause ended it, so that others may be left.
    is_held: bool,
}

struct DotPasses<'a> {
    task: &'a DotTask,
    probes: &'a Probes,
    session: &'a Session,
    /// The flat field of an earlier session, if the plan names one.
    earlier: Option<FlatField>,
    orders: &'a Orders,
    storage: &'a BatchSink,
    /// Queue length for frames between the camera and the workers.
    waiting: usize,
    /// When the last frame of a batch came.
    last_frame: Option<Instant>,
    player: Player<'a>,
}

impl DotPasses<'_> {
    /// Dark frames, flat field, planes, scene.
    fn all(&mut self) -> Result<(), RunError> {
        let plan = &self.task.batches;
        let Some(mut sensor) = self.sensor()? else { return Ok(()) };
        let mut raw = match plan.keep_raw {
            true => {
                let (rows, columns) = (self.task.shape.height(), self.task.shape.width());
                let path = self.session.raw_path();
                let create = || RawFrames::create(&path, rows, columns);
                let frames = write_patiently(self.orders, self.player.board, create)?;
                Some(self.storage.raw_sink(frames, self.task.format, self.task.shape.values()))
            }
            false => None,
        };
        let mut first_batch = 0;
        let planes = plan.calibration.iter().enumerate().map(|(index, plane)| (Some(index), plane.batches));
        for (plane, batches) in planes.chain([(None, plan.count)]) {
            self.player.place(plane.map_or(Subject::Scene, Subject::Plane), plan.calibration.len())?;
            let mut cut = 0;
            while cut < batches && self.orders.go_on() {
                let passed = self.pass(sensor, raw, first_batch + cut as usize, plane, batches - cut)?;
                (sensor, raw) = (passed.sensor, passed.raw);
                cut = if passed.is_held { cut + passed.batches } else { batches };
                self.orders.wait_while_paused();
            }
            if !self.orders.go_on() {
                break;
            }
            first_batch += batches as usize;
        }
        match raw {
            Some(raw) => Ok(raw.finish()?),
            None => Ok(()),
        }
    }

    /// Calibrates the sensor before the first dot; `None` if the run was told to end.
    fn sensor(&mut self) -> Result<Option<Sensor>, RunError> {
        let (task, plan) = (self.task, &self.task.batches);
        let CorrectOptions { hot_sigmas, background_batches, .. } = task.correct;
        let (shape, saturation_dn) = (task.shape, task.saturation_dn());
        let background_frames =
            background_batches.saturating_mul(plan.background_indices.len().max(1) as u32);
        let mut dark = DarkRun::new(shape, saturation_dn, plan.dark_frames, background_frames)?;
        if !self.without_light(plan.dark_frames, &mut |frame| dark.push(frame))? {
            return Ok(None);
        }
        let field = match plan.flat_frames {
            0 => self.earlier.take(),
            frames => {
                self.player.place(Subject::Diffuser, plan.calibration.len())?;
                let mut run = FlatRun::new(shape, saturation_dn, frames);
                if !self.orders.go_on() || !self.without_light(frames, &mut |frame| run.push(frame))? {
                    return Ok(None);
                }
                Some(run.finish(&dark, hot_sigmas, task.sampling())?)
            }
        };
        let sensor = dark.finish(hot_sigmas, field.as_ref(), task.sampling())?;
        if field.is_some() {
            let keep = || flat::keep(self.session, &sensor.correction);
            self.storage.note(write_patiently(self.orders, self.player.board, keep)?);
        }
        Ok(Some(sensor))
    }

    /// Takes frames with the mirror's light off, until `push` needs no more; returns whether the run continues. Lost frames
    /// are taken again, a few times.
    fn without_light(
        &mut self,
        wanted: u32,
        push: &mut (dyn FnMut(&[u16]) -> Result<bool, DotsError> + Send),
    ) -> Result<bool, RunError> {
        let task = self.task;
        let path = task.path.clone().with_light(|_| 0);
        let (mut counts, mut failed, mut frames) = (vec![0; task.shape.values()], None, 0);
        let has_enough = AtomicBool::new(false);
        let rounds = task.batches.dark_rounds(wanted);
        let mut passes = 0;
        while passes < MOST_DARK_PASSES {
            let mut arrived = 0;
            let Played { lost, is_held } =
                self.player.play(&path, rounds, wanted.into(), &has_enough, &mut |arrival| {
                    arrived += 1;
                    // Some more frames arrive while waiting for the camera's last one.
                    if !has_enough.load(Ordering::Relaxed) {
                        let unpacked = task.format.unpack_into(&arrival.frame.data, &mut counts);
                        let pushed = match unpacked {
                            Ok(()) => push(&counts).map_err(RunError::from),
                            Err(error) => Err(RunError::Frame(error.to_string())),
                        };
                        match pushed {
                            Ok(wants_more) => has_enough.store(!wants_more, Ordering::Relaxed),
                            Err(error) => {
                                failed = Some(error);
                                return Err(FrameRefused::Closed);
                            }
                        }
                    }
                    frames += 1 + arrival.lost_before.iter().map(|loss| loss.frames).sum::<u64>();
                    Ok(())
                })?;
            frames += lost.iter().map(|loss| loss.frames).sum::<u64>();
            if failed.is_none() {
                self.orders.wait_while_paused();
            }
            passes += u32::from(!is_held);
            // More frames would not help if as many as are wanted were of no use.
            let is_over = failed.is_some() || has_enough.load(Ordering::Relaxed) || arrived >= wanted;
            // A recording has no more frames.
            if is_over || self.player.is_recorded() || !self.orders.go_on() {
                break;
            }
        }
        // No batch needs these frames.
        self.storage.outside(Counts { expected: frames, settling: frames, ..Counts::default() });
        match failed {
            Some(failed) => Err(failed),
            None => Ok(self.orders.go_on()),
        }
    }

    /// Takes the batches of one plane or of the scene, until a pause.
    fn pass(
        &mut self,
        sensor: Sensor,
        raw: Option<RawSink>,
        first_batch: usize,
        plane: Option<usize>,
        batches: u32,
    ) -> Result<Passed, RunError> {
        let (task, plan) = (self.task, &self.task.batches);
        let Sensor { correction, background, floor } = sensor;
        let stage = self.probes.around(task.stage(&correction)?);
        let config = DotsFlowConfig {
            scan: task.scan(batches),
            format: task.format,
            saturation_dn: task.saturation_dn(),
            stage,
            correction: correction.clone(),
            background,
            floor,
            threads: 0,
            queue_frames: self.waiting,
            policy: match self.player.pace {
                Pace::Pipeline => Policy::Wait,
                Pace::Devices => Policy::Fail,
            },
        };
        let (flow, mut input) = DotsFlow::start(config, self.storage.sink(first_batch, plane, raw))?;
        let blind = flow.is_blind();
        let rounds = BatchesPlan::rounds(batches);
        let frames = u64::from(rounds) * u64::from(plan.dots);
        let (mut taken, mut last_frame) = (0_u64, None);
        let played = self.player.play(&task.path, rounds, frames, &blind, &mut |arrival| {
            taken += 1;
            last_frame = Some(Instant::now());
            Ok(input.offer(arrival)?)
        });
        self.last_frame = last_frame.or(self.last_frame);
        let needed = u64::from(batches) * u64::from(plan.dots);
        if self.player.is_recorded() && taken < needed && played.is_ok() && self.orders.go_on() {
            self.storage.problem(format!(
                "the recording ends after {taken} of the {needed} frames of {}",
                plane.map_or("the scene".into(), |plane| format!("plane {}", plane + 1))
            ));
        }
        drop(input);
        let gathered = flow.join();
        // An error of the mirror says more than what follows from it in the workers.
        let Played { lost, is_held } = played?;
        let Gathered { sink, background, error } = gathered?;
        let mut rest = Counts::default();
        for Loss { frames, cause } in lost {
            rest.expected += frames;
            rest.lose(cause, frames);
        }
        self.storage.outside(rest);
        // Of few frames, the trailing dot may not be found.
        if let Some(error) = error.filter(|_| self.orders.go_on() && !is_held) {
            return Err(error.into());
        }
        let (batches, raw) = sink.finish(is_held);
        Ok(Passed { sensor: Sensor { correction, background, floor }, raw, batches, is_held })
    }
}
