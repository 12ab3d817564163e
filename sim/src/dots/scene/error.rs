//! What can go wrong with a scene of dots.

use std::path::PathBuf;

use super::BUILTIN_NAMES;

/// Why there is no scene.
#[derive(Debug, thiserror::Error)]
pub enum DotSceneError {
    /// No built-in scene of this name.
    #[error(
        "scene \"{name}\": no such built-in scene of dots; choose one of {}, or name a file that ends in .npz or .npy",
        BUILTIN_NAMES.join(", ")
    )]
    UnknownName {
        /// The name asked for.
        name: String,
    },
    /// The file cannot be opened or is damaged.
    #[error("scene file {}: {reason}; check the path, or copy the file again", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        reason: String,
    },
    /// The file's arrays do not make a scene.
    #[error("scene file {}: {found}; expected {expected}", path.display())]
    Layout {
        /// The file.
        path: PathBuf,
        /// What it has.
        found: String,
        /// What it needs.
        expected: String,
    },
    /// Light is finite and not negative.
    #[error(
        "scene file {}: T[{dot}] holds {value} (value {index} of its image): light must be finite and not negative",
        path.display()
    )]
    Value {
        /// The file.
        path: PathBuf,
        /// Of which dot.
        dot: usize,
        /// Which value of its image.
        index: usize,
        /// It.
        value: f32,
    },
}
