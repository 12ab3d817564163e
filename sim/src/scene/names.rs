//! Names of scenes.

use std::path::Path;

/// Names accepted by [`Scene::builtin`](super::Scene::builtin).
pub const BUILTIN_NAMES: [&str; 5] = ["v-groove", "mirror-ball", "slab", "candle", "mix"];

/// Names of the built-in scenes that move.
pub const MOVING_NAMES: [&str; 2] = ["pendulum", "moving-candle"];

/// Whether a scene's name is the path of a file.
pub fn is_file(name: &Path) -> bool {
    name.extension().is_some_and(|extension| extension == "npz")
}
