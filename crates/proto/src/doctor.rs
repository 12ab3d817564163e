//! What `doctor` takes and finds.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `doctor`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DoctorParams {
    /// Text of a plan whose needs the disk is examined for.
    #[serde(default)]
    pub plan: Option<String>,
}

/// What an examination of the rig and its host found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DoctorReport {
    /// The user who examined, and whose permissions therefore count.
    pub user: String,
    /// Version of the program that examined.
    pub version: String,
    /// What was examined, in order.
    pub checks: Vec<DoctorCheck>,
}

impl DoctorReport {
    /// The worst outcome.
    pub fn worst(&self) -> Grade {
        self.checks.iter().map(|check| check.grade).max().unwrap_or(Grade::Ok)
    }
}

/// One thing that was examined.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DoctorCheck {
    /// What was examined, such as `vsync` or `disk`.
    pub name: String,
    /// The outcome.
    pub grade: Grade,
    /// What was found.
    pub found: String,
    /// The command or the change that mends it.
    pub remedy: Option<String>,
}

/// Outcome of one check, best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// As it should be.
    Ok,
    /// Not examined, because it cannot be, or because something else must be mended first.
    Skipped,
    /// Runs are possible, but something will be lost or slow.
    Warning,
    /// Runs are impossible, or their data wrong.
    Failure,
}
