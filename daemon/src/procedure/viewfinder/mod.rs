//! Live pictures for focusing, aligning and exposing. Nothing is measured, and the session holds no images: it says who
//! had light on the rig, and when.

mod check;
mod dots;
mod finder;
mod plane;

use std::sync::Arc;
use std::time::{Duration, Instant};

use raysweep_config::plan::ViewfinderPlan;
use raysweep_config::{ConfigError, Plan};
use raysweep_processing::viewfinder::FinderTask;
use raysweep_session::ledger::{EndEntry, EndState, Entry};
use raysweep_session::stack::{Contents, StackShape};

use crate::procedure::lab::{Lab, RigOfRun};
use crate::rig::{DotRig, Rig};
use crate::run::error::RunError;
use crate::run::life::{Ended, Foreseen, Measurement, Run};

/// A viewfinder on a rig.
enum FinderRun {
    Plane { rig: Arc<Rig>, task: FinderTask },
    Dots { rig: Arc<DotRig>, plan: ViewfinderPlan },
}

/// Predicts a viewfinder on a plane rig.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee_plane(
    lab: &Lab<'_>,
    rig: RigOfRun<'_>,
    plan: &Plan,
    own: ViewfinderPlan,
) -> Result<Foreseen, ConfigError> {
    let task = FinderTask::new(plan, own, &rig.known()?);
    check::plane(plan, &task, lab)?;
    let first_row = rig.first_row;
    Ok(foreseen(lab, plan, first_row, FinderRun::Plane { rig: rig.rig.clone(), task }))
}

/// Predicts a viewfinder on a dot rig.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee_dots(
    lab: &Lab<'_>,
    rig: &Arc<DotRig>,
    plan: &Plan,
    own: ViewfinderPlan,
) -> Result<Foreseen, ConfigError> {
    check::dots(plan, &own, rig, lab)?;
    Ok(foreseen(lab, plan, 0, FinderRun::Dots { rig: rig.clone(), plan: own }))
}

fn foreseen(lab: &Lab<'_>, plan: &Plan, first_row: usize, run: FinderRun) -> Foreseen {
    let (rows, columns) = lab.size();
    let own = match &run {
        FinderRun::Plane { task, .. } => &task.plan,
        FinderRun::Dots { plan, .. } => plan,
    };
    Foreseen {
        report: check::report(own, lab),
        kind: plan.procedure.kind(),
        name: plan.name.clone(),
        shape: StackShape { contents: Contents::Nothing, rows, columns },
        first_row,
        instead: "read out a smaller region of the camera's sensor",
        procedure: Box::new(run),
    }
}

/// How long there was light.
#[derive(Default)]
struct LitTime {
    before: Duration,
    since: Option<Instant>,
}

impl LitTime {
    /// Notes that there is light from now on, or none.
    fn note(&mut self, is_lit: bool) {
        self.before += self.since.take().map_or(Duration::ZERO, |since| since.elapsed());
        self.since = is_lit.then(Instant::now);
    }
}

impl Measurement for FinderRun {
    fn measure(self: Box<Self>, mut run: Run) -> Result<Ended, RunError> {
        run.note_beginning()?;
        run.orders.look.open();
        if let Some(Err(error)) = run.live.as_ref().map(|outlet| outlet.file.clear()) {
            tracing::warn!(%error, "the live file still shows the run before");
        }
        let mut lit = LitTime::default();
        let viewed = match *self {
            Self::Plane { rig, task } => plane::view(&rig, task, &run, &mut lit),
            Self::Dots { rig, plan } => dots::view(&rig, &plan, &run, &mut lit),
        };
        lit.note(false);
        let error = viewed.err().map(|error| error.to_string());
        // It has no end of its own: whoever cancels it has seen enough.
        let state = if error.is_some() { EndState::Faulted } else { EndState::Complete };
        let light_s = Some(lit.before.as_secs_f64());
        let end = EndEntry { error, light_s, ..EndEntry::new(state, 0, 0, run.warnings) };
        run.ledger.append(&Entry::End(end.clone()))?;
        Ok(Ended { end, found: Vec::new() })
    }
}
