//! Sizes of built-in scenes, and parts of their images.

use std::ops::Range;

/// Minimum number of rows and columns of a built-in scene.
pub const MIN_SIDE: usize = 8;

/// Maximum number of entries of a built-in scene's transport: 2 GiB of float32; 720 x 720 x 720 fits in mono.
pub const MAX_ENTRIES: usize = 1 << 29;

/// Camera rows (equal to projector rows) and camera columns of a built-in scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SceneSize {
    /// Camera rows, equal to projector rows.
    pub rows: usize,
    /// Camera columns.
    pub columns: usize,
}

/// A rectangle of camera pixels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Window {
    /// Camera rows.
    pub rows: Range<usize>,
    /// Camera columns.
    pub columns: Range<usize>,
}
