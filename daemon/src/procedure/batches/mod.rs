//! Batches of a flying dot.

mod acquire;
mod check;
mod sink;

use std::sync::Arc;

use raysweep_config::{BatchesPlan, ConfigError, Plan};
use raysweep_processing::batches::{DotTask, keep_patterns, make};
use raysweep_proto::{ErrorCode, RpcError};
use raysweep_session::Session;
use raysweep_session::ledger::{EndEntry, EndState, Entry};
use raysweep_session::stack::StackShape;

use self::acquire::{Acquired, acquire};
use crate::devices::dots::{FRAMES_AT_WORK, frames_waiting};
use crate::procedure::lab::Lab;
use crate::rig::{DotRig, Pace};
use crate::run::error::RunError;
use crate::run::life::{Ended, Foreseen, Measurement, Run, end_state};

/// A run of batches on a rig.
struct BatchesRun {
    rig: Arc<DotRig>,
    task: Arc<DotTask>,
}

/// Predicts a run of batches.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee(
    lab: &Lab<'_>,
    rig: &Arc<DotRig>,
    plan: &Plan,
    own: BatchesPlan,
) -> Result<Foreseen, ConfigError> {
    let task = DotTask::new(plan, own, &rig.file, lab.camera.format, lab.size(), lab.data)?;
    let shape = StackShape { contents: task.contents(), rows: lab.camera.height, columns: lab.camera.width };
    Ok(Foreseen {
        report: check::check(&task, lab, rig.pace())?,
        kind: plan.procedure.kind(),
        name: plan.name.clone(),
        shape,
        first_row: 0,
        instead: "take fewer or smaller frames",
        procedure: Box::new(BatchesRun { rig: rig.clone(), task: Arc::new(task) }),
    })
}

/// Buffers for the frames that are on their way from the camera to a batch.
fn frame_buffers(task: &DotTask, pace: Pace) -> usize {
    let frame_bytes = task.format.frame_bytes(task.shape.pixels());
    let waiting = frames_waiting(pace, task.batches.camera_rate_hz(), frame_bytes);
    waiting + FRAMES_AT_WORK + task.scan(task.batches.count).frames_kept()
}

impl Measurement for BatchesRun {
    fn keep(&self, session: &Session) -> Result<(), RpcError> {
        keep_patterns(session, &self.task).map_err(|error| RpcError::new(ErrorCode::InvalidPlan, error))?;
        match &self.task.predistortion {
            Some(predistortion) => predistortion
                .keep(session)
                .map_err(|error| RpcError::new(ErrorCode::Storage, error.to_string())),
            None => Ok(()),
        }
    }

    fn measure(self: Box<Self>, run: Run) -> Result<Ended, RunError> {
        let Self { rig, task } = *self;
        let orders = run.orders.clone();
        let Acquired { session, mut ledger, mut problems, fault, final_s } = acquire(&rig, &task, run)?;
        let state = end_state(fault.as_ref(), &orders);
        let mut products = None;
        if state == EndState::Complete {
            let go_on = || orders.go_on();
            let made = make(&session, ledger.state(), &task, &task.specs, problems, &go_on)?;
            problems = made.problems.clone();
            products = Some(made);
        }
        let stored = ledger.state().stored_points();
        let end = EndEntry {
            error: fault.map(|fault| fault.to_string()),
            final_s,
            ..EndEntry::new(state, stored, ledger.state().missing_points(), problems)
        };
        ledger.append(&Entry::End(end.clone()))?;
        if let Some(products) = products {
            products.write_report(&session, ledger.state(), &task, &rig.file)?;
        }
        Ok(Ended { end, found: Vec::new() })
    }
}
