//! Dark images of the plane rig's camera.

mod check;

use std::sync::Arc;

use raysweep_config::plan::DarksPlan;
use raysweep_config::{ConfigError, Plan};
use raysweep_processing::darks::{DarksFindings, DarksTask};
use raysweep_processing::plane::Processing;
use raysweep_session::ledger::{EndEntry, EndState, Entry};
use raysweep_session::stack::StackShape;

use crate::plane::{Opened, PointSink, Taken, missing};
use crate::procedure::lab::{Lab, RigOfRun};
use crate::rig::Rig;
use crate::run::error::RunError;
use crate::run::life::{Ended, Foreseen, Measurement, Run, end_state};
use crate::run::progress::ProgressMeter;

/// Capacity of the queue of images between the assembler and the disk.
const UNITS_UNDER_WAY: usize = 8;

/// Dark images on a rig.
struct DarksRun {
    rig: Arc<Rig>,
    darks: DarksTask,
}

/// Predicts a run of dark images.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee(
    lab: &Lab<'_>,
    rig: RigOfRun<'_>,
    plan: &Plan,
    own: DarksPlan,
) -> Result<Foreseen, ConfigError> {
    let darks = DarksTask::new(plan, own, &rig.known()?);
    Ok(Foreseen {
        report: check::check(&darks, lab)?,
        kind: plan.procedure.kind(),
        name: plan.name.clone(),
        shape: StackShape { contents: darks.contents(), rows: rig.size.0, columns: rig.size.1 },
        first_row: rig.first_row,
        instead: "take fewer exposures",
        procedure: Box::new(DarksRun { rig: rig.rig.clone(), darks }),
    })
}

impl Measurement for DarksRun {
    fn measure(self: Box<Self>, mut run: Run) -> Result<Ended, RunError> {
        run.note_beginning()?;
        let Self { rig, darks } = *self;
        let opened = Opened::open(&rig, &darks.task, &run)?;
        let (stack, state) = (run.session.stack()?, run.ledger.state());
        let missing = missing(&darks.task, state);
        let stages: Arc<[_]> = Arc::new([]);
        let processing = Processing::without_demux(stages.clone());
        let progress = ProgressMeter::new(&run.orders, darks.points() - missing.len(), darks.points());
        let (sink, results) = PointSink::new(&darks.task, run, stack, processing, progress);
        let taken =
            opened.acquire(stages, UNITS_UNDER_WAY, sink, &results, |passes| passes.acquire(missing))?;
        let Taken { sink: PointSink { run, vsync, write_error, .. }, latency, fault, .. } = taken;
        let Run { session, mut ledger, orders, mut warnings, .. } = run;
        let fault = write_error.map(RunError::from).or(fault);
        let state = end_state(fault.as_ref(), &orders);
        let findings = (state == EndState::Complete)
            .then(|| DarksFindings::of(&session, ledger.state(), &darks))
            .transpose()?;
        warnings.extend(findings.iter().flat_map(|findings| findings.problems.clone()));
        let stored = ledger.state().stored_points();
        let end = EndEntry {
            error: fault.map(|fault| fault.to_string()),
            vsync,
            settings_latency: latency,
            ..EndEntry::new(state, stored, ledger.state().missing_points(), warnings)
        };
        ledger.append(&Entry::End(end.clone()))?;
        if let Some(findings) = findings {
            findings.write(&session, ledger.state(), &darks, &rig.file)?;
        }
        Ok(Ended { end, found: Vec::new() })
    }
}
