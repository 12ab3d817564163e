//! Chirps of a mirror, from which its resonances are identified.

mod acquire;
mod check;

use std::sync::Arc;

use raysweep_config::{ConfigError, Plan, ResponsePlan};
use raysweep_processing::response::{AXES, MirrorFindings, ResponseTask};
use raysweep_session::ledger::{EndEntry, EndState, Entry};
use raysweep_session::stack::StackShape;

use self::acquire::{Recorded, acquire};
use crate::procedure::lab::Lab;
use crate::rig::DotRig;
use crate::run::error::RunError;
use crate::run::life::{Ended, Foreseen, Measurement, Run};

/// A mirror's chirps on a rig.
struct ResponseRun {
    rig: Arc<DotRig>,
    task: Arc<ResponseTask>,
}

/// Predicts the run of a mirror's chirps.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee(
    lab: &Lab<'_>,
    rig: &Arc<DotRig>,
    plan: &Plan,
    own: ResponsePlan,
) -> Result<Foreseen, ConfigError> {
    let task = ResponseTask::new(plan, own, &rig.file, lab.camera.format, lab.size())?;
    let (rows, columns) = lab.size();
    Ok(Foreseen {
        report: check::check(&task, lab)?,
        kind: plan.procedure.kind(),
        name: plan.name.clone(),
        shape: StackShape { contents: task.contents(), rows, columns },
        first_row: 0,
        instead: "take smaller frames",
        procedure: Box::new(ResponseRun { rig: rig.clone(), task: Arc::new(task) }),
    })
}

impl Measurement for ResponseRun {
    fn measure(self: Box<Self>, run: Run) -> Result<Ended, RunError> {
        let Self { rig, task } = *self;
        let data = run.data.clone();
        let Recorded { session, mut ledger, mut fault, mut warnings } = acquire(&rig, &task, run)?;
        let stored = ledger.state().stored_points();
        let is_whole = fault.is_none() && stored == AXES.len();
        let findings = is_whole.then(|| MirrorFindings::of(&session, ledger.state(), &task)).transpose()?;
        if let Some(findings) = &findings {
            fault = findings.refusal().cloned().map(RunError::from);
            // Must come before the ledger records the run as complete.
            findings.keep(&session, ledger.state(), Some(&data))?;
            warnings.extend(findings.warnings());
        }
        let state = match (&fault, is_whole) {
            (Some(_), _) => EndState::Faulted,
            (None, true) => EndState::Complete,
            (None, false) => EndState::Cancelled,
        };
        let error = fault.map(|fault| fault.to_string());
        let missing = ledger.state().missing_points();
        let end = EndEntry { error, ..EndEntry::new(state, stored, missing, warnings) };
        ledger.append(&Entry::End(end.clone()))?;
        if let Some(findings) = &findings {
            findings.write(&session, ledger.state(), &task, &rig.file)?;
        }
        let found = findings.map_or_else(Vec::new, |findings| findings.resonances());
        Ok(Ended { end, found })
    }
}
