//! The measurement procedures, one folder each. Nothing here depends on more than one of them, except [`foresee`],
//! which chooses the plan's.

mod batches;
mod calibration;
mod darks;
mod film;
pub mod lab;
mod patterns;
mod response;
mod sweep;
mod viewfinder;

use std::path::Path;

use raysweep_config::{ConfigError, FilmPlan, Plan, Procedure, SweepPlan};
use raysweep_processing::calibration::current_in;
use raysweep_processing::plane::check_mosaic;
use raysweep_session::ledger::SessionEntry;

use self::lab::{Lab, RigOfRun};
use crate::rig::SharedRig;
use crate::run::life::Foreseen;

/// Predicts a plan's run on the lab's rig.
///
/// # Errors
/// For a plan that cannot be run on it, with the positions in the text.
pub fn foresee(lab: &Lab<'_>, text: &str) -> Result<Foreseen, ConfigError> {
    let plan = Plan::parse(text)?;
    let calibrated = |rig| RigOfRun::of_new(lab, rig).calibrated(lab, &current_in(lab.data));
    let foreseen = match (lab.rig, plan.procedure.clone()) {
        (SharedRig::Plane(rig), Procedure::Sweep(own)) => {
            let rig = calibrated(rig)?;
            let chosen = rig.rows().and_then(|rows| own.chosen(&plan.places, rows));
            let settings = chosen.as_ref().map(SweepPlan::to_toml);
            chosen_or(own, chosen.zip(settings), |own| sweep::foresee(lab, rig.clone(), &plan, own))
        }
        (SharedRig::Plane(rig), Procedure::Darks(own)) => {
            darks::foresee(lab, RigOfRun::of_new(lab, rig), &plan, own)
        }
        (SharedRig::Plane(rig), Procedure::Calibration(own)) => {
            calibration::foresee(lab, RigOfRun::of_new(lab, rig), &plan, own, None)
        }
        (SharedRig::Plane(rig), Procedure::Patterns(own)) => {
            patterns::foresee(lab, calibrated(rig)?, &plan, own)
        }
        (SharedRig::Plane(rig), Procedure::Film(own)) => {
            let rig = calibrated(rig)?;
            let chosen = rig.rows().and_then(|rows| own.chosen(&plan.places, rows));
            let settings = chosen.as_ref().map(FilmPlan::to_toml);
            chosen_or(own, chosen.zip(settings), |own| film::foresee(lab, rig.clone(), &plan, own))
        }
        (SharedRig::Dots(rig), Procedure::Batches(own)) => batches::foresee(lab, rig, &plan, own),
        (SharedRig::Dots(rig), Procedure::Response(own)) => response::foresee(lab, rig, &plan, own),
        (SharedRig::Plane(rig), Procedure::Viewfinder(own)) => {
            viewfinder::foresee_plane(lab, RigOfRun::of_new(lab, rig), &plan, own)
        }
        (SharedRig::Dots(rig), Procedure::Viewfinder(own)) => viewfinder::foresee_dots(lab, rig, &plan, own),
        (SharedRig::Plane(_), Procedure::Batches(_) | Procedure::Response(_)) => Err(of_another_rig(
            &plan,
            "a plane rig runs plans of kind \"sweep\", \"film\", \"patterns\", \"darks\", \"calibration\" and \"viewfinder\"",
        )),
        (
            SharedRig::Dots(_),
            Procedure::Sweep(_)
            | Procedure::Film(_)
            | Procedure::Patterns(_)
            | Procedure::Darks(_)
            | Procedure::Calibration(_),
        ) => Err(of_another_rig(
            &plan,
            "a dot rig runs plans of kind \"batches\", \"response\" and \"viewfinder\"",
        )),
    }?;
    if let SharedRig::Plane(rig) = lab.rig {
        check_mosaic(&plan, rig.file.camera.pixel_format)?;
    }
    Ok(foreseen)
}

/// Predicts a run with settings that were chosen for the calibration in use, `chosen` with their table, or else with the
/// plan's own: a camera may not take those that suit the rig's rows.
fn chosen_or<T>(
    own: T,
    chosen: Option<(T, String)>,
    foresee: impl Fn(T) -> Result<Foreseen, ConfigError>,
) -> Result<Foreseen, ConfigError> {
    let Some((chosen, table)) = chosen else { return foresee(own) };
    let refused = match foresee(chosen) {
        Ok(mut foreseen) => {
            foreseen.report.settings = Some(table);
            return Ok(foreseen);
        }
        Err(error) => error,
    };
    let mut foreseen = foresee(own)?;
    foreseen.report.settings_refused = Some(format!(
        "the settings that suit the calibration in use cannot be taken, so the defaults of an uncalibrated rig are: {refused}"
    ));
    Ok(foreseen)
}

fn of_another_rig(plan: &Plan, what: &str) -> ConfigError {
    plan.places.error(&["kind"], format!("kind = \"{}\": {what}", plan.procedure.kind()))
}

/// Predicts the rest of a session, given by its folder, that was begun with this plan: of a kind whose sessions can be
/// resumed ([`Procedure::past`]).
///
/// # Errors
/// If the plan cannot be run on this rig.
pub fn foresee_rest(
    lab: &Lab<'_>,
    text: &str,
    session: &Path,
    begun: &SessionEntry,
) -> Result<Foreseen, ConfigError> {
    let plan = Plan::parse_stored(text)?;
    match (lab.rig, plan.procedure.clone()) {
        (SharedRig::Plane(rig), Procedure::Sweep(own)) => {
            // As it was when the session began.
            let rig = RigOfRun::of_begun(rig, begun).calibrated(lab, session)?;
            sweep::foresee(lab, rig, &plan, own)
        }
        (SharedRig::Plane(rig), Procedure::Patterns(own)) => {
            let rig = RigOfRun::of_begun(rig, begun).calibrated(lab, session)?;
            patterns::foresee(lab, rig, &plan, own)
        }
        (SharedRig::Plane(rig), Procedure::Darks(own)) => {
            darks::foresee(lab, RigOfRun::of_begun(rig, begun), &plan, own)
        }
        (SharedRig::Plane(rig), Procedure::Calibration(own)) => {
            calibration::foresee(lab, RigOfRun::of_begun(rig, begun), &plan, own, Some(begun.shape.contents))
        }
        (SharedRig::Dots(_), _)
        | (
            SharedRig::Plane(_),
            Procedure::Film(_) | Procedure::Batches(_) | Procedure::Response(_) | Procedure::Viewfinder(_),
        ) => Err(of_another_rig(&plan, "no session of it can be resumed on this rig")),
    }
}
