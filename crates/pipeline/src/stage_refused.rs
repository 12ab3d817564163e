//! Why a plan's stage cannot be created.

use raysweep_core::decoding_message;
use serde::de::DeserializeOwned;
use serde_json::Value;
use serde_path_to_error::Segment;

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
    #[error("stage {name}: {what}")]
    Options {
        /// The stage's name.
        name: String,
        /// The option, if the error is about one.
        key: Option<String>,
        /// What is wrong with it.
        what: String,
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

impl StageRefused {
    /// The key of the stage's table that the error is about, if it is about one.
    pub fn key(&self) -> Option<&str> {
        match self {
            Self::Unknown { .. } => Some("name"),
            Self::Options { key, .. } => key.as_deref(),
            // Messages about a value begin with its key: "alpha is -1, but must be ...", "step_px = 3: must be ...".
            Self::Invalid { what, .. } => {
                let (key, rest) = what.split_once(' ')?;
                let is_key = key.chars().all(|c| c.is_ascii_lowercase() || c == '_');
                (is_key && (rest.starts_with("is ") || rest.starts_with("= "))).then_some(key)
            }
        }
    }

    /// What is wrong, without the stage's name.
    pub fn what(&self) -> String {
        match self {
            Self::Unknown { .. } => self.to_string(),
            Self::Options { what, .. } | Self::Invalid { what, .. } => what.clone(),
        }
    }
}

/// The options of the stage `name`.
///
/// # Errors
/// For options that it does not have, and values of the wrong type.
pub fn options<T: DeserializeOwned>(name: &str, options: Value) -> Result<T, StageRefused> {
    serde_path_to_error::deserialize(options).map_err(|error| {
        let key = error.path().iter().find_map(|segment| match segment {
            Segment::Map { key } => Some(key.clone()),
            _ => None,
        });
        let what = decoding_message(&error.inner().to_string(), "table");
        let what = match &key {
            Some(key) if !what.starts_with("unknown key") => format!("{key}: {what}"),
            _ => what,
        };
        StageRefused::Options { name: name.into(), key, what }
    })
}
