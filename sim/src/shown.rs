//! What the projector shows, and the light that reaches the camera of it.

use std::sync::{Arc, OnceLock};

use raysweep_core::{Pattern, Subject};

use crate::optics::RasterOptics;

/// A pattern, and the subjects under it as far as they have stood before the camera.
pub struct ShownOptics {
    pub pattern: Pattern,
    /// The scene in each key position of its motion.
    pub scene: OnceLock<Arc<[RasterOptics]>>,
    pub board: OnceLock<RasterOptics>,
}

impl ShownOptics {
    pub fn new(pattern: Pattern) -> Self {
        Self { pattern, scene: OnceLock::new(), board: OnceLock::new() }
    }

    /// The subject under the pattern; `None`: no light.
    pub fn optics(&self, subject: Subject, key: usize) -> Option<&RasterOptics> {
        match subject {
            Subject::Scene => self.scene.get().map(|keys| &keys[key]),
            Subject::Board => self.board.get(),
            Subject::Cap | Subject::Plane(_) | Subject::Diffuser => None,
        }
    }
}
