//! The manifest of a plane rig's session.

use std::collections::BTreeMap;

use raysweep_config::RigFile;
use raysweep_pipeline::{PointRole, Schedule};
use raysweep_session::ledger::State;
use raysweep_session::{Result, Session, manifest};
use serde_json::{Map, json};

use super::task::{PlaneTask, place};

/// Writes the manifest, the last file of a session.
///
/// # Errors
/// When the session cannot be written.
pub fn write(session: &Session, state: &State, task: &PlaneTask, rig: &RigFile) -> Result<()> {
    let software = BTreeMap::from([("raysweep".to_owned(), env!("CARGO_PKG_VERSION").to_owned())]);
    let mut settings = Map::new();
    settings.insert(
        "rig".into(),
        json!({
            "pixel_format": rig.camera.pixel_format,
            "white_dn": rig.camera.white_dn(),
            "black_dn": rig.camera.black_dn(),
            "period_us": rig.vsync.period_us,
            "rows": rig.projector.rows,
            "row_time_us": rig.projector.row_time_us,
            "first_row_us": rig.projector.first_row_us,
            "row_table_us": rig.projector.row_table,
            "beam_sigma_rows": rig.projector.beam_sigma_rows,
            "first_row": task.geometry.first_row,
            "row_pitch": rig.camera.row_pitch,
            "camera_row_time_us": rig.camera_row_time_us(),
        }),
    );
    if let Some(made) = &task.calibration_made {
        settings.insert("calibration".into(), json!({ "made": made }));
    }
    settings.insert("exposures_us".into(), json!(taken_exposures(state, &task.schedule)));
    settings.insert("latency".into(), json!(state.end.as_ref().and_then(|end| end.settings_latency)));
    manifest::write(session, state, software, settings)?;
    Ok(())
}

/// The exposures as the hardware took them: the sweep's, or, where there is none, those of the dark images.
fn taken_exposures(state: &State, schedule: &Schedule) -> Vec<f64> {
    let is_sweep = |role: PointRole| matches!(role, PointRole::Sweep(_));
    let is_any = !schedule.points.iter().any(|point| is_sweep(point.role));
    let mut exposures: Vec<f64> = schedule
        .points
        .iter()
        .filter(|point| is_any || is_sweep(point.role))
        .filter_map(|point| {
            let (array, index) = place(point.role);
            state.point(array, index).map(|entry| entry.exposure_us)
        })
        .collect();
    exposures.sort_by(f64::total_cmp);
    exposures.dedup();
    exposures
}
