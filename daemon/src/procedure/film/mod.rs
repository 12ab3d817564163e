//! Films: the settings of a cycle are repeated, and each cycle gives a transport.

mod advice;
mod check;
mod cycle;
mod sink;
mod worker;

use std::sync::Arc;

use raysweep_config::{ConfigError, FilmPlan, Plan};
use raysweep_core::{CameraCapabilities, SettingsId, SettingsLatency, VsyncStats, ns_from_us};
use raysweep_pipeline::{CycleOrder, Point, PointRole, ProductSpec, Stages};
use raysweep_processing::calibration::KeptCalibration;
use raysweep_processing::film::{
    FilmProducts, FilmTask, create_transports, shortcomings, write_products, write_report,
};
use raysweep_processing::plane::{Processing, manifest};
use raysweep_proto::{CheckReport, DesignParams, DesignReport, RpcError};
use raysweep_session::Session;
use raysweep_session::ledger::{EndEntry, EndState, Entry, Ledger};
use raysweep_session::stack::StackShape;

use self::cycle::CyclePlan;
use self::sink::{CycleTiming, Cycles, FilmSink};
use self::worker::{Account, Solving, Worker};
use crate::devices::camera::{Exposures, FilmSetting};
use crate::plane::advice::{advise, design};
use crate::plane::{Opened, PointSink, Taken, missing};
use crate::procedure::lab::{Lab, RigOfRun, keep_calibration, notice_if_uncalibrated};
use crate::rig::{Pace, Rig};
use crate::run::error::RunError;
use crate::run::life::{Ended, Foreseen, Measurement, Run, end_state};
use crate::run::orders::Orders;
use crate::run::progress::ProgressMeter;

/// Cycles between the assembler and the disk: while one is stored, frames of the next ones arrive.
const CYCLES_UNDER_WAY: usize = 4;

/// A film on a rig.
struct FilmRun {
    rig: Arc<Rig>,
    camera: CameraCapabilities,
    calibration: Option<Arc<KeptCalibration>>,
    film: FilmTask,
    products: Vec<ProductSpec>,
    stages: Stages,
}

/// Predicts a film.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee(
    lab: &Lab<'_>,
    rig: RigOfRun<'_>,
    plan: &Plan,
    own: FilmPlan,
) -> Result<Foreseen, ConfigError> {
    let film = FilmTask::new(plan, own, &rig.known()?);
    let products = film.products()?;
    let stages = lab.probes.after(&film.stages()?);
    let shape = StackShape { contents: film.contents(), rows: lab.camera.height, columns: lab.camera.width };
    Ok(Foreseen {
        report: rig.warned(check::check(&film, &products, lab)?),
        kind: plan.procedure.kind(),
        name: plan.name.clone(),
        shape,
        first_row: rig.first_row,
        instead: "take fewer settings",
        procedure: Box::new(FilmRun {
            rig: rig.rig.clone(),
            camera: lab.camera.clone(),
            calibration: rig.calibration,
            film,
            products,
            stages,
        }),
    })
}

impl Measurement for FilmRun {
    fn advise(&self, report: &mut CheckReport) {
        match advise(&self.film, report.settings.is_some(), &self.rig.file, &self.camera) {
            Ok(advice) => report.advice = Some(advice),
            Err(none) => report.warnings.push(none.to_string()),
        }
    }

    fn design(&self, params: &DesignParams) -> Result<DesignReport, RpcError> {
        Ok(design(&self.film, &self.rig.file, &self.camera, params)?)
    }

    fn keep(&self, session: &Session) -> Result<(), RpcError> {
        keep_calibration(self.calibration.as_deref(), session)
    }

    fn measure(self: Box<Self>, run: Run) -> Result<Ended, RunError> {
        let orders = run.orders.clone();
        let acquired = self.acquire(run)?;
        conclude(acquired, &self, &orders)
    }
}

/// Result of acquisition.
struct Acquired {
    session: Session,
    /// Still locked.
    ledger: Ledger,
    /// What has failed, and why.
    problems: Vec<String>,
    vsync: Option<VsyncStats>,
    exposures: Exposures,
    latency: Option<SettingsLatency>,
    /// The fault that ended acquisition early, if any.
    fault: Option<RunError>,
    /// Warnings from before the run began.
    warnings: Vec<String>,
}

impl FilmRun {
    /// Takes the dark image, then the film.
    fn acquire(&self, mut run: Run) -> Result<Acquired, RunError> {
        run.note_beginning()?;
        let (film, task) = (&self.film, &self.film.task);
        let opened = Opened::open(&self.rig, task, &run)?;
        let stack = run.session.stack()?;
        let is_setting =
            |id: &SettingsId| matches!(task.schedule.points[id.point as usize].role, PointRole::Sweep(_));
        // A film is never resumed, so no cycle has been stored yet.
        let mut missing = missing(task, run.ledger.state());
        missing.retain(|id| !is_setting(id));
        let cycles = CyclePlan::new(task, opened.camera());
        let account = Arc::new(Account::new(film.points()));
        let frames = self.cycles(&run, &cycles, opened.camera(), opened.pace, &account)?;
        let planned = missing.len() + film.points();
        let processing = Processing::without_demux(self.stages.clone());
        // A film's own transports serve as its live estimate.
        let progress = ProgressMeter::new(&run.orders, 0, planned);
        let (points, results) = PointSink::new(task, run, stack, processing, progress);
        let sink = FilmSink { points, film: frames };
        let under_way = CYCLES_UNDER_WAY * cycles.shots.len();
        let taken = opened.acquire(self.stages.clone(), under_way, sink, &results, |passes| {
            passes.acquire(missing)?;
            match passes.go_on() {
                true => passes.film(self.settings(&cycles), film.film.cycles),
                false => Ok(()),
            }
        })?;
        let Taken { sink: FilmSink { mut points, film: frames }, exposures, latency, fault } = taken;
        let solved = frames.finish();
        let no_light = points.no_light.map(|seen| RunError::NoLight {
            seen,
            cause: "every exposure lies where the projector draws nothing that the camera sees (film.delay_us, projector.first_row_us); the projector stays lit in the dark image too",
            then: "run the plan again",
        });
        let summary = account.summary();
        points.append(&Entry::Film(summary.clone()));
        points.run.board.set_film(summary);
        match solved {
            Ok(ended) => ended?,
            Err(error) => points.note_write_error(error),
        }
        Ok(Acquired {
            session: points.run.session,
            ledger: points.run.ledger,
            problems: points.processing.problems,
            vsync: points.vsync,
            exposures,
            latency,
            fault: points.write_error.map(RunError::from).or(no_light).or(fault),
            warnings: points.run.warnings,
        })
    }

    /// The settings in the order in which a cycle takes them.
    fn settings(&self, cycles: &CyclePlan) -> Vec<FilmSetting> {
        let points: Vec<(u32, Point)> =
            self.film.task.settings().map(|(ordinal, point)| (ordinal, *point)).collect();
        let CycleOrder { settings, periods } = &cycles.order;
        let before = periods.iter().cycle().skip(periods.len() - 1);
        let settings = settings.iter().zip(before).map(|(&setting, &periods_from_last)| {
            let (ordinal, point) = points[setting];
            FilmSetting { ordinal, point, shot: cycles.shots[setting], periods_from_last }
        });
        settings.collect()
    }

    /// The film's part of the sink, with the solver's thread behind it.
    fn cycles(
        &self,
        run: &Run,
        cycle_plan: &CyclePlan,
        camera: &CameraCapabilities,
        pace: Pace,
        account: &Arc<Account>,
    ) -> Result<Cycles, RunError> {
        let (film, task) = (&self.film, &self.film.task);
        let solver = film.solver()?;
        let transports = create_transports(&run.session, film, solver.reach_rows())?;
        if let Some(Err(error)) = run.live.as_ref().map(|outlet| outlet.file.clear()) {
            tracing::warn!(%error, "the live file still shows the run before");
        }
        let worker = Worker::start(Solving {
            solver,
            transports,
            live: run.live.clone(),
            board: run.board.clone(),
            account: account.clone(),
            orders: run.orders.clone(),
            pace,
        })?;
        let rolling_us = task.geometry.height.saturating_sub(1) as f64 * camera.row_time_us;
        let timing = CycleTiming {
            cycle_ns: f64::from(cycle_plan.order.cycle_periods()) * task.geometry.raster.period_us * 1e3,
            frame_ns: ns_from_us(film.film.exposure_us + rolling_us),
        };
        Ok(Cycles::new(task, run.session.film()?, worker, account.clone(), pace, timing))
    }
}

/// Makes a film's products, and writes its report. Its transports exist already, so a film that was ended early is like
/// a short one; but its products are not made, so that it ends soon.
fn conclude(acquired: Acquired, run: &FilmRun, orders: &Orders) -> Result<Ended, RunError> {
    let FilmRun { rig, film, products, stages, .. } = run;
    let Acquired { session, mut ledger, mut problems, vsync, exposures, latency, fault, mut warnings } =
        acquired;
    let state = end_state(fault.as_ref(), orders);
    let final_s = exposures.until.map(|until| until.elapsed().as_secs_f64());
    let go_on = || orders.go_on();
    let mut made = match state {
        EndState::Complete => {
            write_products(&session, ledger.state(), film, stages, products, &|_| true, &go_on)?
        }
        EndState::Cancelled | EndState::Faulted => FilmProducts::default(),
    };
    problems.append(&mut made.problems);
    if state != EndState::Complete && !products.is_empty() {
        problems.push(
            "the film was ended early, so its products are not made: `raysweep process` makes them".into(),
        );
    }
    let transports_missing = ledger.state().film.as_ref().map_or(0, |film| film.transports_missing);
    // Of very many warnings the first are kept.
    warnings.extend(shortcomings(ledger.state(), transports_missing));
    warnings.extend(problems.iter().cloned());
    let stored = ledger.state().stored_points();
    let end = EndEntry {
        error: fault.map(|fault| fault.to_string()),
        vsync,
        final_s,
        light_s: exposures.light_s(),
        simulated_time: exposures.is_simulated,
        settings_latency: latency,
        ..EndEntry::new(state, stored, ledger.state().missing_points(), warnings)
    };
    ledger.append(&Entry::End(end.clone()))?;
    if state != EndState::Faulted {
        write_report(&session, ledger.state(), film, &made, &problems)?;
        manifest::write(&session, ledger.state(), &film.task, &rig.file)?;
    }
    Ok(Ended { end, found: notice_if_uncalibrated(film.task.calibration_made.is_some()) })
}
