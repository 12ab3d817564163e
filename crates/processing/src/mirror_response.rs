//! Stores the mirror response that a run has identified, for later runs.

use std::path::{Path, PathBuf};

use jiff::Timestamp;
use raysweep_config::rig::dots::ResponseKey;
use raysweep_config::{ConfigError, DotRigFile};
use raysweep_core::{SecondOrder, io_text};
use raysweep_session::ledger::State;
use raysweep_session::{Error, Result, Session, durable, input};
use raysweep_transport::dots::identify::{Identified, Resonance};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Most bytes of the file.
const MOST_BYTES: u64 = 1 << 20;

/// Path of the file in the daemon's data folder or a session's folder.
pub fn path_in(folder: &Path) -> PathBuf {
    folder.join("mirror-response.json")
}

/// Contents of `mirror-response.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeptResponse {
    /// Start of the session that identified it.
    pub identified: Timestamp,
    /// Name of that session's folder.
    pub session: String,
    /// The axis in the plane of incidence.
    pub x: AxisResponse,
    /// The axis across it.
    pub y: AxisResponse,
}

/// Response of one axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AxisResponse {
    /// Resonance frequency.
    pub f0_hz: f64,
    /// Quality factor.
    pub q: f64,
    /// Delay of the response, counted from the first frame's exposure.
    pub delay_s: f64,
    /// Share of the measured movement that the model does not explain.
    pub residual: f64,
    /// Band in which the model was found to hold.
    pub band_hz: [f64; 2],
}

impl From<&Identified> for AxisResponse {
    fn from(found: &Identified) -> Self {
        let Identified { resonance: Resonance { f0_hz, q }, delay_s, residual, band_hz, .. } = *found;
        Self { f0_hz, q, delay_s, residual, band_hz }
    }
}

impl KeptResponse {
    /// The response identified in a session.
    pub fn new(session: &Session, state: &State, [x, y]: [&Identified; 2]) -> Self {
        let name = session.dir().file_name().unwrap_or(session.dir().as_os_str());
        Self {
            identified: state.session.created,
            session: name.to_string_lossy().into_owned(),
            x: x.into(),
            y: y.into(),
        }
    }

    /// Writes the file atomically and durably.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut text = serde_json::to_vec_pretty(self).map_err(|error| Error::Codec {
            action: "encode",
            what: path.display().to_string(),
            why: error.to_string(),
        })?;
        text.push(b'\n');
        durable::write(path, &text)
    }

    fn read(path: &Path) -> std::result::Result<Self, String> {
        let text = input::read(path, MOST_BYTES).map_err(|error| io_text(&error))?;
        let kept: Self = serde_json::from_slice(&text).map_err(|error| error.to_string())?;
        Ok(kept)
    }
}

/// The model that a run's path is predistorted with, and its origin.
#[derive(Debug, Clone, PartialEq)]
pub struct Predistortion {
    /// Responses of the axes, x and y.
    pub responses: [SecondOrder; 2],
    /// The identified response; `None` if the rig file states the values.
    kept: Option<KeptResponse>,
}

impl Predistortion {
    /// The predistortion that the rig file asks for; an identified response is read from `folder`, the daemon's data
    /// or a session's.
    ///
    /// # Errors
    /// When the identified response is to be used and cannot be read.
    pub fn of(rig: &DotRigFile, folder: &Path) -> std::result::Result<Option<Self>, ConfigError> {
        match rig.mirror.as_ref().and_then(|mirror| mirror.response) {
            None => Ok(None),
            Some(ResponseKey::Stated(responses)) => Ok(Some(Self { responses, kept: None })),
            Some(ResponseKey::Found(_)) => {
                let path = path_in(folder);
                let kept = KeptResponse::read(&path).map_err(|why| {
                    ConfigError::of_field(
                        "mirror.response",
                        format!(
                            "the rig file's mirror.response = \"identified\" needs {} ({why}): run a plan of kind = \"response\" first, such as plans/mirror-response.toml, or state mirror.response in numbers",
                            path.display()
                        ),
                    )
                })?;
                let responses =
                    [kept.x, kept.y].map(|AxisResponse { f0_hz, q, .. }| SecondOrder { f0_hz, q });
                Ok(Some(Self { responses, kept: Some(kept) }))
            }
        }
    }

    /// Stores the identified response in the session whose path it predistorted.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn keep(&self, session: &Session) -> Result<()> {
        self.kept.as_ref().map_or(Ok(()), |kept| kept.write(&session.mirror_response_path()))
    }

    /// Its entry in the manifest.
    pub fn to_json(&self) -> Value {
        let [x, y] = self.responses;
        match &self.kept {
            Some(kept) => json!({ "x": x, "y": y, "identified": kept.identified, "session": kept.session }),
            None => json!({ "x": x, "y": y, "stated_in": "rig.toml" }),
        }
    }
}
