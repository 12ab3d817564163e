//! Images under many pictures: shows each picture once, and takes all of its images before the next.

mod check;

use std::sync::Arc;

use raysweep_config::plan::PatternsPlan;
use raysweep_config::{ConfigError, Plan};
use raysweep_core::SettingsId;
use raysweep_processing::calibration::KeptCalibration;
use raysweep_processing::patterns::{PatternProducts, PatternsTask};
use raysweep_processing::plane::Processing;
use raysweep_proto::RpcError;
use raysweep_session::Session;
use raysweep_session::ledger::{EndEntry, EndState, Entry};
use raysweep_session::stack::StackShape;

use crate::plane::{Opened, Passes, PointSink, Taken, is_any_lit, missing, regular_again};
use crate::procedure::lab::{Lab, RigOfRun, keep_calibration, notice_if_uncalibrated};
use crate::rig::Rig;
use crate::run::error::RunError;
use crate::run::life::{Ended, Foreseen, Measurement, Run, end_state};
use crate::run::progress::ProgressMeter;

/// Capacity of the queue of images between the assembler and the disk.
const UNITS_UNDER_WAY: usize = 8;

/// Images under pictures on a rig.
struct PatternsRun {
    rig: Arc<Rig>,
    calibration: Option<Arc<KeptCalibration>>,
    patterns: PatternsTask,
}

/// Predicts a run under pictures.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee(
    lab: &Lab<'_>,
    rig: RigOfRun<'_>,
    plan: &Plan,
    own: PatternsPlan,
) -> Result<Foreseen, ConfigError> {
    let patterns = PatternsTask::new(plan, own, &rig.known()?)?;
    Ok(Foreseen {
        report: rig.warned(check::check(&patterns, lab)?),
        kind: plan.procedure.kind(),
        name: plan.name.clone(),
        shape: StackShape { contents: patterns.contents(), rows: rig.size.0, columns: rig.size.1 },
        first_row: rig.first_row,
        instead: "show fewer pictures in a series",
        procedure: Box::new(PatternsRun { rig: rig.rig.clone(), calibration: rig.calibration, patterns }),
    })
}

impl Measurement for PatternsRun {
    fn keep(&self, session: &Session) -> Result<(), RpcError> {
        keep_calibration(self.calibration.as_deref(), session)
    }

    fn measure(self: Box<Self>, mut run: Run) -> Result<Ended, RunError> {
        run.note_beginning()?;
        let Self { rig, patterns, .. } = *self;
        let task = &patterns.task;
        let mut opened = Opened::open(&rig, task, &run)?;
        let (stack, state) = (run.session.stack()?, run.ledger.state().clone());
        if let Some(what) = task.unlike(&state) {
            return Err(RunError::OtherPlan(what));
        }
        let missing = missing(task, &state);
        let again = regular_again(task, &missing, &state);
        opened.looks_first = is_any_lit(task, &missing);
        let stages: Arc<[_]> = Arc::new([]);
        let processing = Processing::without_demux(stages.clone());
        let planned = task.schedule.points.len();
        let progress = ProgressMeter::new(&run.orders, planned - missing.len(), planned);
        let (sink, results) = PointSink::new(task, run, stack, processing, progress);
        let taken = opened.acquire(stages, UNITS_UNDER_WAY, sink, &results, |passes| {
            acquire(passes, &patterns, again.into_iter().chain(missing).collect())
        })?;
        let Taken { sink: PointSink { run, vsync, write_error, no_light, .. }, exposures, latency, fault } =
            taken;
        let Run { session, mut ledger, orders, mut warnings, .. } = run;
        let no_light = no_light.map(RunError::no_regular_light);
        let fault = write_error.map(RunError::from).or(no_light).or(fault);
        let state = end_state(fault.as_ref(), &orders);
        let products = (state == EndState::Complete)
            .then(|| PatternProducts::make(&session, ledger.state(), &patterns))
            .transpose()?;
        warnings.extend(products.iter().flat_map(PatternProducts::warnings).cloned());
        let stored = ledger.state().stored_points();
        let end = EndEntry {
            error: fault.map(|fault| fault.to_string()),
            vsync,
            light_s: exposures.light_s(),
            simulated_time: exposures.is_simulated,
            settings_latency: latency,
            ..EndEntry::new(state, stored, ledger.state().missing_points(), warnings)
        };
        ledger.append(&Entry::End(end.clone()))?;
        if let Some(products) = products {
            products.write_report(&session, ledger.state(), &patterns, &rig.file)?;
        }
        Ok(Ended { end, found: notice_if_uncalibrated(task.calibration_made.is_some()) })
    }
}

/// Acquires dark images and the regular one, then all settings of each picture.
fn acquire(
    passes: &mut Passes<'_>,
    patterns: &PatternsTask,
    wanted: Vec<SettingsId>,
) -> Result<(), RunError> {
    let attempts = wanted.into_iter().map(|id| {
        let point = patterns.task.schedule.points[id.point as usize];
        passes.attempt_at(id, point)
    });
    let mut attempts: Vec<_> = attempts.collect();
    // The regular image may be taken again by a resumed run, before all others.
    attempts.sort_by_key(|attempt| attempt.id.point);
    passes.acquire_under_each(attempts, |attempt| patterns.picture(attempt.id.point))
}
