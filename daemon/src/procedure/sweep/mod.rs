//! Sweeps: acquires points at all delays and exposures, then computes one transport.

mod advice;
mod check;

use std::sync::Arc;
use std::time::{Duration, Instant};

use raysweep_config::{ConfigError, Plan, SweepPlan};
use raysweep_core::{CameraCapabilities, Pattern, SettingsId, SettingsLatency, VsyncStats};
use raysweep_pipeline::PointRole;
use raysweep_processing::calibration::KeptCalibration;
use raysweep_processing::memory::{MemoryNeed, available_bytes};
use raysweep_processing::plane::{Processing, manifest};
use raysweep_processing::sweep::{Overview, Results, SweepTask, write_products, write_report};
use raysweep_proto::{CheckReport, DesignParams, DesignReport, RpcError};
use raysweep_session::Session;
use raysweep_session::ledger::{EndEntry, EndState, Entry, Ledger};
use raysweep_session::stack::StackShape;

use crate::devices::camera::Exposures;
use crate::live::{LiveEstimate, Outlet};
use crate::plane::advice::{advise, design};
use crate::plane::{Opened, Passes, PointSink, Taken, is_any_lit, missing, regular_again};
use crate::procedure::lab::{Lab, RigOfRun, keep_calibration, notice_if_uncalibrated};
use crate::rig::Rig;
use crate::run::error::RunError;
use crate::run::life::{Ended, Foreseen, Measurement, Run, end_state};
use crate::run::orders::Orders;
use crate::run::progress::ProgressMeter;

/// Capacity of the queue of units between the assembler and the disk.
const UNITS_UNDER_WAY: usize = 8;

/// A sweep on a rig.
struct SweepRun {
    rig: Arc<Rig>,
    calibration: Option<Arc<KeptCalibration>>,
    camera: CameraCapabilities,
    sweep: SweepTask,
    processing: Processing,
    /// Whether the results are made in strips of camera rows.
    in_strips: bool,
}

/// Predicts a sweep.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee(
    lab: &Lab<'_>,
    rig: RigOfRun<'_>,
    plan: &Plan,
    own: SweepPlan,
) -> Result<Foreseen, ConfigError> {
    let sweep = SweepTask::new(plan, own, &rig.known()?);
    let mut processing = sweep.processing()?;
    processing.stages = lab.probes.after(&processing.stages);
    let report = rig.warned(check::check(&sweep, &processing.products, lab)?);
    let memory = MemoryNeed::of_sweep(&sweep.task, &processing.products)
        .map_err(|error| sweep.task.refuse(&["sweep"], error.to_string()))?;
    let in_strips = memory.in_strips(available_bytes(lab.memory_limit_bytes));
    if in_strips {
        processing.keep_no_images();
    }
    let shape = StackShape { contents: sweep.contents(), rows: rig.size.0, columns: rig.size.1 };
    Ok(Foreseen {
        report,
        kind: plan.procedure.kind(),
        name: plan.name.clone(),
        shape,
        first_row: rig.first_row,
        instead: "solving in strips of camera rows does not suffice, so make shorter sequences",
        procedure: Box::new(SweepRun {
            rig: rig.rig.clone(),
            calibration: rig.calibration,
            camera: lab.camera.clone(),
            sweep,
            processing,
            in_strips,
        }),
    })
}

impl Measurement for SweepRun {
    fn advise(&self, report: &mut CheckReport) {
        match advise(&self.sweep, report.settings.is_some(), &self.rig.file, &self.camera) {
            Ok(advice) => report.advice = Some(advice),
            Err(none) => report.warnings.push(none.to_string()),
        }
    }

    fn design(&self, params: &DesignParams) -> Result<DesignReport, RpcError> {
        Ok(design(&self.sweep, &self.rig.file, &self.camera, params)?)
    }

    fn keep(&self, session: &Session) -> Result<(), RpcError> {
        keep_calibration(self.calibration.as_deref(), session)
    }

    fn measure(self: Box<Self>, run: Run) -> Result<Ended, RunError> {
        let Self { rig, sweep, processing, in_strips, .. } = *self;
        let (orders, live) = (run.orders.clone(), run.live.clone());
        let acquired = acquire(&rig, &sweep, processing, run)?;
        conclude(acquired, in_strips, &sweep, &rig, &orders, live.as_ref())
    }
}

/// Result of acquisition.
struct Acquired {
    session: Session,
    /// Still locked.
    ledger: Ledger,
    /// Its demultiplexer has received every stored point.
    processing: Processing,
    vsync: Option<VsyncStats>,
    exposures: Exposures,
    latency: Option<SettingsLatency>,
    /// The fault that ended acquisition early, if any.
    fault: Option<RunError>,
    /// Warnings from before the run began.
    warnings: Vec<String>,
}

/// Acquires what is missing.
fn acquire(
    rig: &Rig,
    sweep: &SweepTask,
    mut processing: Processing,
    mut run: Run,
) -> Result<Acquired, RunError> {
    run.note_beginning()?;
    let task = &sweep.task;
    let mut opened = Opened::open(rig, task, &run)?;
    let stack = run.session.stack()?;
    let state = run.ledger.state().clone();
    if let Some(what) = task.unlike(&state) {
        return Err(RunError::OtherPlan(what));
    }
    let missing = missing(task, &state);
    processing.feed_stored(task, &state, &stack, &|| run.orders.go_on());
    let planned = task.schedule.points.len();
    let stages = processing.stages.clone();
    let progress = ProgressMeter::new(&run.orders, planned - missing.len(), planned);
    let live = run.live.clone().and_then(start_live);
    let (mut sink, results) = PointSink::new(task, run, stack, processing, progress);
    sink.live = live;
    let again = regular_again(task, &missing, &state);
    opened.looks_first = is_any_lit(task, &missing);
    let taken = opened.acquire(stages, UNITS_UNDER_WAY, sink, &results, |passes| {
        acquire_points(passes, sweep, again, missing)
    })?;
    let Taken { sink, exposures, latency, fault } = taken;
    let no_light = sink.no_light.map(RunError::no_regular_light);
    Ok(Acquired {
        session: sink.run.session,
        ledger: sink.run.ledger,
        processing: sink.processing,
        vsync: sink.vsync,
        exposures,
        latency,
        fault: sink.write_error.map(RunError::from).or(no_light).or(fault),
        warnings: sink.run.warnings,
    })
}

/// Acquires the points of the sweep under white, then its bracket under less light; before them, the regular image
/// `again`, if a resumed run needs it to see whether there is light.
fn acquire_points(
    passes: &mut Passes<'_>,
    sweep: &SweepTask,
    again: Option<SettingsId>,
    missing: Vec<SettingsId>,
) -> Result<(), RunError> {
    let point_of = |id: SettingsId| sweep.task.schedule.points[id.point as usize];
    let (bracket, others): (Vec<_>, Vec<_>) =
        missing.into_iter().partition(|&id| matches!(point_of(id).role, PointRole::Bracket(_)));
    if let Some(again) = again {
        passes.acquire_under(Some(&Pattern::White), vec![passes.attempt_at(again, point_of(again))])?;
    }
    if passes.go_on() {
        passes.acquire(others)?;
    }
    let attempts: Vec<_> = bracket.into_iter().map(|id| passes.attempt_at(id, point_of(id))).collect();
    match sweep.bracket_picture() {
        Some(picture) if !attempts.is_empty() && passes.go_on() => {
            passes.acquire_under(Some(&picture), attempts)
        }
        _ => Ok(()),
    }
}

/// Starts the running estimate; the run works without it too.
fn start_live(outlet: Outlet) -> Option<LiveEstimate> {
    let started = outlet.file.clear().map_err(Into::into).and_then(|()| LiveEstimate::start(outlet));
    started.map_err(|error| tracing::warn!(%error, "no live estimate of this run")).ok()
}

/// Makes the results of the acquired data, unless the run is told to end: then it skips them to end soon.
fn conclude(
    acquired: Acquired,
    in_strips: bool,
    sweep: &SweepTask,
    rig: &Rig,
    orders: &Orders,
    live: Option<&Outlet>,
) -> Result<Ended, RunError> {
    let task = &*sweep.task;
    let Acquired { session, mut ledger, processing, vsync, exposures, latency, fault, mut warnings } =
        acquired;
    let whole = fault.is_none() && missing(task, ledger.state()).is_empty();
    let began = Instant::now();
    let make = || match in_strips {
        true => Results::in_strips(processing, &session, ledger.state(), task, &|| orders.go_on()),
        false => Results::whole(processing, &session, task, &|| orders.go_on()),
    };
    let mut results = whole.then(make).transpose()?;
    let computed = began.elapsed();
    let state = match (end_state(fault.as_ref(), orders), &results) {
        (EndState::Complete, None) => EndState::Faulted,
        (state, _) => state,
    };
    warnings.extend(results.iter().flat_map(Results::warnings).cloned());
    let stored = ledger.state().stored_points();
    let mut end = EndEntry {
        error: fault.map(|fault| fault.to_string()),
        vsync,
        light_s: exposures.light_s(),
        simulated_time: exposures.is_simulated,
        settings_latency: latency,
        ..EndEntry::new(state, stored, ledger.state().missing_points(), warnings)
    };
    if let (EndState::Complete, Some(results)) = (state, &mut results) {
        results.write_transport()?;
        end.final_s = exposures.until.map(|until| until.elapsed().as_secs_f64());
        let overview = results.overview();
        if let Some((live, overview)) = live.zip(overview.as_ref()) {
            show_last(live, overview, stored, computed);
        }
        write_products(&session, task, results, &|_| true, &|| orders.go_on())?;
        ledger.append(&Entry::End(end.clone()))?;
        write_report(&session, ledger.state(), sweep, results, overview.as_ref())?;
        manifest::write(&session, ledger.state(), task, &rig.file)?;
        let (computed_s, written_s) = (computed.as_secs_f64(), (began.elapsed() - computed).as_secs_f64());
        tracing::info!(computed_s, written_s, final_s = end.final_s, "results made");
    } else {
        ledger.append(&Entry::End(end.clone()))?;
    }
    Ok(Ended { end, found: notice_if_uncalibrated(task.calibration_made.is_some()) })
}

/// Publishes the result where the earlier estimates were published.
fn show_last(live: &Outlet, overview: &Overview, points: usize, took: Duration) {
    let Overview { epipolar, non_epipolar, total, .. } = overview;
    if let Err(error) = live.show_images([epipolar, non_epipolar, total], points, took, true) {
        tracing::warn!(%error, "the result is not among the live images");
    }
}
