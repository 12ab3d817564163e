//! Checks a viewfinder's plan, before anything moves.

use raysweep_config::plan::{FinderTrigger, ViewfinderPlan};
use raysweep_config::{ConfigError, Plan};
use raysweep_core::FinderPicture;
use raysweep_processing::viewfinder::FinderTask;
use raysweep_proto::CheckReport;

use super::dots;
use crate::procedure::lab::Lab;
use crate::rig::DotRig;

/// Memory for a picture and what is made of it, in bytes per pixel; pictures of rows are kept until the last.
const BYTES_PER_PX: u64 = 32 + 4 * 64;
/// Disk space of plan, rig file and ledger.
const DISK_BYTES: u64 = 1_000_000;

/// What a viewfinder would need.
pub fn report(plan: &ViewfinderPlan, lab: &Lab<'_>) -> CheckReport {
    let (rows, columns) = lab.size();
    let room = lab.room((rows * columns) as u64 * BYTES_PER_PX, DISK_BYTES);
    CheckReport { light_s: plan.seconds.unwrap_or(0.0), warnings: room.warnings(), ..room.report() }
}

/// Checks a plan for a plane rig.
///
/// # Errors
/// For what the camera cannot do, or a region outside of its frames.
pub fn plane(plan: &Plan, task: &FinderTask, lab: &Lab<'_>) -> Result<(), ConfigError> {
    let settings = task.settings(task.exposure_us(), 0.0, lab.camera);
    lab.camera.allows(&settings).map_err(|message| {
        plan.places.error(&["viewfinder", "exposure_us"], format!("viewfinder.{message}"))
    })?;
    region(plan, &task.plan, lab)
}

/// Checks a plan for a dot rig.
///
/// # Errors
/// For what camera or mirror cannot do, or a region outside of the frames.
pub fn dots(plan: &Plan, own: &ViewfinderPlan, rig: &DotRig, lab: &Lab<'_>) -> Result<(), ConfigError> {
    let refuse = |key, message: String| plan.places.error(&["viewfinder", key], message);
    lab.camera_at(own.camera_rate_hz)
        .allows(&dots::settings(rig, own))
        .map_err(|message| refuse("exposure_us", format!("viewfinder.{message}")))?;
    if own.picture == FinderPicture::Align {
        let message = "viewfinder.picture = \"align\": a dot rig has no rows to align; give \"white\"";
        return Err(refuse("picture", message.into()));
    }
    if own.trigger == FinderTrigger::None {
        let message =
            "viewfinder.trigger = \"none\": the mirror of a dot rig triggers its camera; leave it out";
        return Err(refuse("trigger", message.into()));
    }
    dots::path(rig, own, own.picture)
        .map_err(|error| refuse("tilt_deg", format!("viewfinder.tilt_deg: {error}")))?;
    region(plan, own, lab)
}

fn region(plan: &Plan, own: &ViewfinderPlan, lab: &Lab<'_>) -> Result<(), ConfigError> {
    let (rows, columns) = lab.size();
    match own.region {
        Some(region @ [_, bottom, _, right]) if bottom > rows || right > columns => {
            let message = format!(
                "viewfinder.region = {region:?}: the camera's frames have {rows} rows and {columns} columns"
            );
            Err(plan.places.error(&["viewfinder", "region"], message))
        }
        _ => Ok(()),
    }
}
