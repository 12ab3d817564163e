//! Errors of dot scenes.

use std::path::PathBuf;

use super::still::BUILTIN_NAMES;

/// Why a scene cannot be loaded or computed.
#[derive(Debug, thiserror::Error)]
pub enum DotSceneError {
    /// There is no built-in scene of this name.
    #[error(
        "scene \"{name}\": no such built-in scene of dots; choose one of {}, or name a file that ends in .npz or .npy",
        BUILTIN_NAMES.join(", ")
    )]
    UnknownName {
        /// The requested name.
        name: String,
    },
    /// The file cannot be opened or is damaged.
    #[error("scene file {}: {reason}; check the path, or copy the file again", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The read error.
        reason: String,
    },
    /// The file's arrays do not form a scene.
    #[error("scene file {}: {found}; expected {expected}", path.display())]
    Layout {
        /// The file.
        path: PathBuf,
        /// What the file contains.
        found: String,
        /// What is required.
        expected: String,
    },
    /// Planes from files do not fit a built-in scene.
    #[error(
        "plane_files goes with a scene from a file, not with the built-in scene \"{name}\": leave it out, and use plane_depths"
    )]
    PlanesOfFiles {
        /// The scene.
        name: &'static str,
    },
    /// Light is negative or not finite.
    #[error(
        "scene file {}: T[{dot}] holds {value} (value {index} of its image): light must be finite and not negative",
        path.display()
    )]
    Value {
        /// The file.
        path: PathBuf,
        /// Index of the dot.
        dot: usize,
        /// Index of the value in the dot's image.
        index: usize,
        /// The invalid value.
        value: f32,
    },
}
