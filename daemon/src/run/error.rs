//! Errors that end a run early.

use raysweep_config::ConfigError;
use raysweep_core::{Counts, DeviceError};
use raysweep_pipeline::{PipelineError, SeenLight};
use raysweep_processing::response::ResponseError;

use crate::rig::RigError;

/// Why a run could not be completed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A device failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The rig cannot be opened.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The session cannot be written.
    #[error(transparent)]
    Session(#[from] raysweep_session::Error),
    /// The pipeline failed.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The camera differs from the one that the session was begun with.
    #[error(
        "the camera has {} rows and {} columns, but the session has {} and {}: resume it on the rig that it was begun on",
        .found.0, .found.1, .expected.0, .expected.1
    )]
    OtherCamera {
        /// Rows and columns of the camera.
        found: (usize, usize),
        /// Rows and columns of the session.
        expected: (usize, usize),
    },
    /// The frames, or the calibration, of a dot rig cannot be used.
    #[error(transparent)]
    Dots(#[from] raysweep_transport::dots::DotsError),
    /// The mirror's response could not be identified.
    #[error(transparent)]
    Response(#[from] ResponseError),
    /// The images of a calibration are of no use.
    #[error(
        "the rig is not calibrated: {0}. The images are kept in the session; the calibration in use before stays in use"
    )]
    Calibration(#[from] raysweep_processing::calibration::CalibrationError),
    /// A frame cannot be read.
    #[error("{0}")]
    Frame(String),
    /// The plan gives no model on this rig.
    #[error("{0}")]
    Plan(#[from] ConfigError),
    /// The plan is not the one that the session was begun with.
    #[error("plan.toml was changed after the session was begun: {0}; restore the original")]
    OtherPlan(String),
    /// The projector's light does not reach the camera.
    #[error(
        "the camera sees no light: {seen}. Likely causes: the lens cap is on, or the aperture closed; the projector is off, asleep or shows another input; its light does not fall on what the camera sees; {cause}. No lit image is stored: remove the cause, then {then}"
    )]
    NoLight {
        /// The figures.
        seen: SeenLight,
        /// A cause that depends on the procedure.
        cause: &'static str,
        /// What to do after removing the cause.
        then: &'static str,
    },
    /// Points failed repeatedly.
    #[error(
        "{points} points failed in {passes} passes in a row; frames of the last pass: {}, {interrupted} attempts interrupted. The ledger lists the cause of each failure: fix it and resume the session",
        .counts.losses()
    )]
    Hopeless {
        /// Number of points.
        points: usize,
        /// Number of passes.
        passes: u32,
        /// Frame counts of the last pass.
        counts: Counts,
        /// Attempts of the last pass that ended before their last frame.
        interrupted: usize,
    },
    /// A thread of the run has ended unexpectedly; another error says which and why.
    #[error(
        "a thread of the run has ended unexpectedly; see the log. The stored data are kept: resume a sweep, patterns, darks or a calibration; `raysweep process` a film or batches"
    )]
    Interrupted,
    /// The run panicked, which is a bug.
    #[error(
        "the run panicked, which is a bug: {0}. The stored data are kept: resume a sweep, patterns, darks or a calibration; `raysweep process` a film or batches"
    )]
    Panicked(String),
}

impl RunError {
    /// A run whose regular image sees no light.
    pub fn no_regular_light(seen: SeenLight) -> Self {
        let cause = "the projector stays lit in the dark images too";
        Self::NoLight { seen, cause, then: "`raysweep resume` the session" }
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;

    use raysweep_core::DeviceErrorKind;

    use super::*;

    #[test]
    fn every_error_of_a_run_says_what_to_do() {
        let mut counts = Counts { expected: 300, averaged: 296, ..Counts::default() };
        counts.lose(raysweep_core::LossCause::CameraGap, 4);
        let errors: [RunError; _] = [
            DeviceError::new("camera", DeviceErrorKind::NotReady, "no frame for 5.0 s").into(),
            RigError::Config("rig.toml, line 3: camera.reopen_s = -1: must be from 0 to 3600".into()).into(),
            raysweep_session::Error::InUse { path: "ledger.jsonl".into() }.into(),
            PipelineError::Panicked("sink").into(),
            RunError::OtherCamera { found: (480, 640), expected: (720, 1280) },
            raysweep_transport::dots::DotsError::TooFew { what: "dark frames", given: 3, needed: 16 }.into(),
            RunError::Frame("frame does not match its format".into()),
            RunError::Plan(ConfigError::of_field("kind", "the plan's message")),
            RunError::NoLight {
                seen: SeenLight { mean_dn: 0.01, error_dn: 0.02, white_dn: 2500.0 },
                cause: "the projector's cause",
                then: "do this",
            },
            RunError::Hopeless { points: 3, passes: 8, counts, interrupted: 1 },
            RunError::Interrupted,
            RunError::Panicked("index out of bounds".into()),
        ];
        let mut shown = String::new();
        for error in errors {
            let debug = format!("{error:?}");
            let variant = debug.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
            writeln!(shown, "{variant}: {error}\n").unwrap();
        }
        insta::assert_snapshot!(shown);
    }
}
