//! Names of the built-in scenes.

/// Names accepted by [`Scene::builtin`](super::Scene::builtin).
pub const BUILTIN_NAMES: [&str; 5] = ["v-groove", "mirror-ball", "slab", "candle", "mix"];

/// Names of the built-in scenes that move.
pub const MOVING_NAMES: [&str; 2] = ["pendulum", "moving-candle"];
