//! Examines a rig and its host: what is there, what answers, how well it keeps time, and what mends the rest. No
//! mirror is moved, and no light is turned on.

mod checkup;
mod devices;
mod host;
mod network;
mod nodes;
mod storage;
mod timing;

use std::path::Path;

use raysweep_proto::DoctorReport;

use self::checkup::Checkup;
use crate::rig::SharedRig;

pub use self::host::user;

/// What a plan writes.
#[derive(Debug, Clone, Copy)]
pub struct PlanNeeds {
    /// Size of its session.
    pub disk_bytes: u64,
    /// Time in which it is written.
    pub light_s: f64,
}

/// Examines a rig whose sessions are in the folder `data`, and the disk for the needs of a plan. Takes some seconds;
/// ends early, with what was found until then, when `go_on` says no.
pub fn examine(
    rig: &SharedRig,
    data: &Path,
    needs: Option<PlanNeeds>,
    go_on: &(dyn Fn() -> bool + Sync),
) -> DoctorReport {
    let mut checkup = Checkup::default();
    host::examine(&mut checkup);
    storage::examine(&mut checkup, data, needs);
    if let SharedRig::Plane(rig) = rig
        && !rig.file.calibration.is_overridden
    {
        storage::examine_calibration(&mut checkup, data);
    }
    nodes::examine(&mut checkup, &nodes::of(rig));
    network::examine(&mut checkup, rig);
    if go_on() {
        match rig {
            SharedRig::Plane(rig) => devices::examine_plane(&mut checkup, rig, go_on),
            SharedRig::Dots(rig) => devices::examine_dots(&mut checkup, rig, data),
        }
    }
    if !go_on() {
        checkup.failure("examination", "it was cancelled before its end", "`raysweep doctor` again");
    }
    checkup.report(host::user())
}
