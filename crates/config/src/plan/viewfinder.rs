//! `[viewfinder]`: live pictures for focusing, aligning and exposing.

use raysweep_core::FinderPicture;
use serde::Deserialize;

use crate::document::Document;

/// `[viewfinder]`: nothing is measured and nothing is stored.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewfinderPlan {
    /// What the projector shows at first.
    pub picture: FinderPicture,
    /// What begins each frame; on a dot rig always the mirror.
    pub trigger: FinderTrigger,
    /// What must stand before the camera; default: whatever does.
    pub subject: Option<FinderSubject>,
    /// Exposure of each frame; default: 0.9 of the projector's period, or all of it without the trigger.
    pub exposure_us: Option<f64>,
    /// Region of the focus score and the other figures: first row, row after the last, first column, column after the
    /// last; default: everything.
    pub region: Option<[usize; 4]>,
    /// Most pictures per second.
    pub pictures_per_s: f64,
    /// When it ends; default: when it is cancelled.
    pub seconds: Option<f64>,
    /// On a dot rig: where the mirror holds the dot, in degrees of the mirror.
    pub tilt_deg: [f64; 2],
    /// On a dot rig: samples per second of the mirror.
    pub rate_hz: f64,
    /// On a dot rig: frames per second.
    pub camera_rate_hz: f64,
}

/// Why rows cannot be aligned by a camera that runs freely.
pub const ALIGN_NEEDS_TRIGGER: &str = "picture = \"align\" needs trigger = \"vsync\": a frame of a camera that runs freely may hold the light of two of its pictures";

/// What stands before the camera of a plane rig.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FinderSubject {
    /// The scene.
    Scene,
    /// A white board.
    Board,
}

/// What begins the frames of a plane rig's camera.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FinderTrigger {
    /// The projector's VSYNC, as in a run.
    #[default]
    Vsync,
    /// Nothing: the camera runs freely, before any line is wired.
    None,
}

impl FinderTrigger {
    /// All of them, the default first.
    pub const ALL: [Self; 2] = [Self::Vsync, Self::None];

    /// Its name in a plan.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vsync => "vsync",
            Self::None => "none",
        }
    }
}

impl Default for ViewfinderPlan {
    fn default() -> Self {
        Self {
            picture: FinderPicture::White,
            trigger: FinderTrigger::default(),
            subject: None,
            exposure_us: None,
            region: None,
            pictures_per_s: 15.0,
            seconds: None,
            tilt_deg: [0.0, 0.0],
            rate_hz: 10_000.0,
            camera_rate_hz: 100.0,
        }
    }
}

impl ViewfinderPlan {
    pub(super) fn check(&self, document: &mut Document<'_>) {
        let [x_deg, y_deg] = self.tilt_deg;
        let rules = [
            ("exposure_us", self.exposure_us.unwrap_or(1.0), 0.01..=1e6),
            ("pictures_per_s", self.pictures_per_s, 0.1..=30.0),
            ("seconds", self.seconds.unwrap_or(1.0), 0.1..=86_400.0),
            ("tilt_deg", if x_deg.abs() > y_deg.abs() { x_deg } else { y_deg }, -45.0..=45.0),
            ("rate_hz", self.rate_hz, 1.0..=1e6),
            ("camera_rate_hz", self.camera_rate_hz, 1.0..=1e6),
        ];
        for (key, value, allowed) in rules {
            document.check_range(&["viewfinder", key], value, allowed);
        }
        if let Some(region @ [top, bottom, left, right]) = self.region
            && (top >= bottom || left >= right)
        {
            let message = format!(
                "viewfinder.region = {region:?}: give [first row, row after the last, first column, column after the last]"
            );
            document.refuse(&["viewfinder", "region"], message);
        }
        if self.picture == FinderPicture::Align && self.trigger == FinderTrigger::None {
            document.refuse(&["viewfinder", "picture"], format!("viewfinder.{ALIGN_NEEDS_TRIGGER}"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::ViewfinderPlan;
    use crate::plan::tests::{documented, parse};
    use crate::plan::{Plan, Procedure};

    #[test]
    fn the_default_is_the_documented_one() {
        let documented = Plan::parse(documented("viewfinder")).unwrap();
        assert_eq!(documented.procedure, Procedure::Viewfinder(ViewfinderPlan::default()));
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_the_field_and_its_value() {
        for (line, told) in [
            ("picture = \"teapot\"", "picture"),
            ("trigger = \"line0\"", "expected `vsync` or `none`"),
            ("picture = \"align\"\ntrigger = \"none\"", "needs trigger = \"vsync\""),
            ("pictures_per_s = 31", "viewfinder.pictures_per_s = 31"),
            ("exposure_us = nan", "viewfinder.exposure_us = NaN"),
            ("seconds = 0", "viewfinder.seconds = 0"),
            ("tilt_deg = [1, -46]", "viewfinder.tilt_deg = -46"),
            ("region = [4, 4, 0, 9]", "viewfinder.region = [4, 4, 0, 9]"),
        ] {
            let error = parse(&format!("kind = \"viewfinder\"\n[viewfinder]\n{line}\n")).unwrap_err();
            assert!(error.to_string().contains(told), "{error}");
        }
        assert!(parse("kind = \"viewfinder\"\n[[stage]]\nname = \"demux\"\n").is_err());
    }
}
