//! What is in front of the camera of a rig.

use std::fmt;

use serde::{Deserialize, Serialize};

/// What is in front of the camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Subject {
    /// The scene.
    Scene,
    /// One of the Lambertian calibration planes of a dot rig, counted from 0.
    Plane(usize),
    /// An evenly lit diffuser directly in front of the lens of a dot rig's camera.
    Diffuser,
    /// The flat, matt, white board of a plane rig's calibration, in the scene's place.
    Board,
    /// Another such board in the same place, of another material.
    SecondBoard,
    /// A cap on the lens of a plane rig's camera: no light at all.
    Cap,
}

/// Its name for an operator, who counts planes from 1.
impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Scene => write!(f, "the scene"),
            Self::Plane(plane) => write!(f, "calibration plane {}", plane + 1),
            Self::Diffuser => write!(f, "a diffuser"),
            Self::Board => write!(f, "the white board"),
            Self::SecondBoard => write!(f, "the second white board"),
            Self::Cap => write!(f, "the lens cap"),
        }
    }
}
