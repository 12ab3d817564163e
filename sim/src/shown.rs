//! What the projector shows, and the light that reaches the camera of it.

use std::sync::{Arc, PoisonError, RwLock};

use raysweep_core::{Pattern, Subject};

use crate::optics::RasterOptics;

/// A pattern, and the subjects under it as far as they have stood before the camera.
pub struct ShownOptics {
    pub pattern: Pattern,
    /// The scene in each key position of its motion.
    scene: Prepared,
    /// The board alone.
    board: Prepared,
    second_board: Prepared,
}

/// A subject under a pattern, with the position of the projector's lens that it was computed for.
#[derive(Default)]
struct Prepared(RwLock<Option<(f64, Arc<[RasterOptics]>)>>);

impl ShownOptics {
    pub fn new(pattern: Pattern) -> Self {
        let [scene, board, second_board] = std::array::from_fn(|_| Prepared::default());
        Self { pattern, scene, board, second_board }
    }

    fn of(&self, subject: Subject) -> Option<&Prepared> {
        match subject {
            Subject::Scene => Some(&self.scene),
            Subject::Board => Some(&self.board),
            Subject::SecondBoard => Some(&self.second_board),
            Subject::Cap | Subject::Plane(_) | Subject::Diffuser => None,
        }
    }

    /// The subject under the pattern, in each key position, and the lens position that it was computed for; `None`: no
    /// light.
    pub fn optics(&self, subject: Subject) -> Option<(f64, Arc<[RasterOptics]>)> {
        self.of(subject)?.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Keeps what was computed of a subject.
    pub fn keep(&self, subject: Subject, lens_mm: f64, optics: Arc<[RasterOptics]>) {
        if let Some(prepared) = self.of(subject) {
            *prepared.0.write().unwrap_or_else(PoisonError::into_inner) = Some((lens_mm, optics));
        }
    }
}
