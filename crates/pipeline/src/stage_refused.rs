//! Why a plan's stage cannot be created.

use raysweep_core::decoding_message;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// Why a plan's stage cannot be created.
#[derive(Debug, thiserror::Error)]
pub enum StageRefused {
    /// The name does not exist.
    #[error("stage name = {name:?}: must be one of {known}")]
    Unknown {
        /// The name in the plan.
        name: String,
        /// All existing names.
        known: String,
    },
    /// An option that the stage does not have, or a value that it does not accept.
    #[error("stage {name}: {}", decoding_message(&source.to_string(), "table"))]
    Options {
        /// The stage's name.
        name: String,
        /// The error message of serde.
        source: serde_json::Error,
    },
    /// Options that are well formed but invalid.
    #[error("stage {name}: {what}")]
    Invalid {
        /// The stage's name.
        name: String,
        /// Field, value, and the allowed values.
        what: String,
    },
}

/// The options of the stage `name`.
///
/// # Errors
/// For options that it does not have, and values of the wrong type.
pub fn options<T: DeserializeOwned>(name: &str, options: Value) -> Result<T, StageRefused> {
    serde_json::from_value(options).map_err(|source| StageRefused::Options { name: name.into(), source })
}
