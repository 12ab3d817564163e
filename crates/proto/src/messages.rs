//! Parameters, results and events. Field names are stable. Times are in seconds, or in microseconds if the
//! name ends in `_us`.

use std::fmt;
use std::path::PathBuf;

use raysweep_core::{ClockQuality, Counts, FilmSummary, PointUnderWay, SettingsLatency, VsyncStats};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{PlanAdvice, Role, ViewfinderValues};

/// What the daemon is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RunState {
    /// Idle; ready for a run.
    Idle,
    /// Opening the devices and the session.
    Preparing,
    /// The camera is armed; no point has begun.
    Armed,
    /// Acquiring.
    Running,
    /// Holding between two points.
    Paused,
    /// Acquisition is over; computing and writing the results.
    Draining,
    /// The last run ended with an error; ready for another run.
    Faulted,
}

impl RunState {
    /// Whether no run is in progress: another one may begin.
    pub const fn is_over(self) -> bool {
        matches!(self, Self::Idle | Self::Faulted)
    }

    /// Whether the daemon may go from this state to `next`.
    pub const fn may_become(self, next: RunState) -> bool {
        use RunState::{Armed, Draining, Faulted, Idle, Paused, Preparing, Running};
        matches!(
            (self, next),
            (Idle | Faulted, Preparing)
                | (Preparing, Idle | Armed | Draining | Faulted)
                | (Armed, Running | Draining | Faulted)
                | (Running, Paused | Draining | Faulted)
                | (Paused, Running | Draining | Faulted)
                | (Draining, Idle | Faulted)
        )
    }
}

/// Progress of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Progress {
    /// Points stored by this run and by the earlier runs that it resumes.
    pub points_stored: usize,
    /// Points that the run needs: those of the sweep, its dark images and the regular image.
    pub points_planned: usize,
    /// The point that is being taken, if that takes long.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub under_way: Option<PointUnderWay>,
    /// What became of this run's triggers so far.
    pub counts: Counts,
    /// Seconds since the run began.
    pub elapsed_s: f64,
    /// Estimated seconds left at the present pace; `None` while there is no estimate.
    pub left_s: Option<f64>,
    /// Frames averaged per second.
    pub frames_per_s: f64,
}

/// A light transport estimated during a film; the images themselves are not included.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FilmEstimate {
    /// Cycle of its newest frame, counted from 0.
    pub cycle: u32,
    /// Whether it uses the newest frame of each setting instead of one complete cycle. Such estimates are
    /// published, not stored.
    pub sliding: bool,
    /// Start of its oldest exposure, in seconds after the film's first.
    pub start_s: f64,
    /// From the end of its newest exposure to its publication, in ms; `None` on a virtual clock.
    pub latency_ms: Option<f64>,
    /// Solver time in ms.
    pub solve_ms: f64,
    /// Mean over all pixels of the light from the pixel's own projector row, 1 = white.
    pub epipolar: f64,
    /// The same for the light from all other rows.
    pub non_epipolar: f64,
    /// Summary of the film so far.
    pub film: FilmSummary,
}

/// Result of `check` for a film.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FilmCheck {
    /// Settings per cycle.
    pub settings: usize,
    /// Planned cycles.
    pub cycles: usize,
    /// VSYNC periods per cycle on this camera.
    pub periods_per_cycle: u32,
    /// Maximum number of light transports per second.
    pub transports_per_s: f64,
    /// Disk space for one minute, uncompressed.
    pub disk_bytes_per_minute: u64,
    /// What limits the pace.
    pub reason: String,
}

/// A stored batch of a flying dot; its floodlit image is in the live file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BatchStored {
    /// Its index in `dots.zarr`.
    pub batch: usize,
    /// The calibration plane that it shows, counted from 0; `None` for the scene.
    pub plane: Option<usize>,
    /// Start of its first exposure, in seconds after that of the run's first batch.
    pub start_s: f64,
    /// Dots of the scene without a frame.
    pub missing: usize,
    /// Dots whose frames show nothing above the background.
    pub empty: usize,
    /// Dots whose denoising stopped at the maximum number of discs.
    pub capped: usize,
    /// Frames received twice.
    pub duplicates: u64,
    /// Mean over all pixels of the floodlit image, in counts.
    pub floodlit: f64,
    /// Sequence number of that image in the live file, if there is a live file.
    pub sequence: Option<u64>,
}

/// Result of `check` for a plan of batches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BatchesCheck {
    /// Batches of the scene.
    pub scene: u32,
    /// Batches of each calibration plane.
    pub planes: Vec<u32>,
    /// Frames per batch.
    pub dots: u32,
    /// Frames per second.
    pub camera_rate_hz: f64,
    /// Duration of a batch in seconds.
    pub batch_s: f64,
    /// Frames without light before the first batch.
    pub dark_frames: u32,
    /// Samples of the mirror path.
    pub samples: usize,
    /// Samples per second.
    pub rate_hz: f64,
    /// Data rate of the camera.
    pub raw_bytes_per_s: u64,
    /// Disk space per batch.
    pub disk_bytes_per_batch: u64,
}

/// Result of `check` for a plan of mirror chirps, one per axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ResponseCheck {
    /// Start and end frequency of a chirp.
    pub band_hz: [f64; 2],
    /// Amplitude of the mirror's mechanical angle.
    pub amplitude_deg: f64,
    /// Duration of a chirp in seconds.
    pub chirp_s: f64,
    /// Rest after a chirp in seconds.
    pub rest_s: f64,
    /// Frames per axis.
    pub frames: usize,
    /// Frames per second.
    pub camera_rate_hz: f64,
    /// Frames without light before the first chirp.
    pub dark_frames: u32,
    /// Samples of the mirror path.
    pub samples: usize,
    /// Samples per second.
    pub rate_hz: f64,
}

/// Result of `status`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Status {
    /// Version of the daemon.
    pub version: String,
    /// Kind of the rig.
    pub rig: String,
    /// What the caller may do.
    #[serde(default)]
    pub role: Option<Role>,
    /// Group whose members are operators, if one is set.
    #[serde(default)]
    pub operators: Option<String>,
    /// What the daemon is doing.
    pub state: RunState,
    /// What the run waits for, if it does.
    #[serde(default)]
    pub question: Option<Question>,
    /// The folder of its sessions.
    #[serde(default)]
    pub data: Option<PathBuf>,
    /// The session of the current or the last run.
    pub session: Option<PathBuf>,
    /// Progress of that run.
    pub progress: Option<Progress>,
    /// Statistics of its VSYNC line, updated once per second.
    pub vsync: Option<VsyncStats>,
    /// Quality of the clock fit of the device that watches the VSYNC line.
    #[serde(default)]
    pub vsync_clock: Option<ClockQuality>,
    /// Summary of the film, if the run is a film.
    #[serde(default)]
    pub film: Option<FilmSummary>,
    /// The newest picture of the viewfinder, while one runs.
    #[serde(default)]
    pub viewfinder: Option<Box<ViewfinderValues>>,
    /// How many frames after a change the camera's settings take effect (0: the next frame), as measured by
    /// the run's probe.
    #[serde(default)]
    pub settings_latency: Option<SettingsLatency>,
    /// How the last run ended: `complete`, `cancelled` or `faulted`; `None` during a run.
    #[serde(default)]
    pub ended: Option<String>,
    /// Why the last run faulted.
    pub error: Option<String>,
    /// Reasons why the last run's results may be worse than they look.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// The file with the newest live images, if there is one; `describe` returns its layout.
    #[serde(default)]
    pub live: Option<PathBuf>,
    /// The mirror, if the rig has ever moved one.
    #[serde(default)]
    pub mirror: Option<MirrorStatus>,
}

/// A mirror and its light.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct MirrorStatus {
    /// Whether the mirror is at the origin with the light off.
    pub parked: bool,
    /// Whether samples with light may be playing.
    pub laser: bool,
    /// `interlock_closed`, `interlock_open`, `armed` or `not_armed`.
    pub light: String,
}

/// Parameters of `check`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CheckParams {
    /// The plan's TOML text.
    pub plan: String,
}

/// Result of `check`: what a plan would do. Nothing moves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CheckReport {
    /// Points of the sweep; for a film, its cycles.
    pub points: usize,
    /// Further points: dark images and the regular image.
    pub extra_points: usize,
    /// Frames to average over all points.
    pub frames: u64,
    /// Minimum time with the light on, in seconds.
    pub light_s: f64,
    /// Memory for the images and the results. If they do not fit as a whole, memory for processing some
    /// camera rows at a time.
    pub memory_bytes: u64,
    /// Memory that the daemon may use: its limit if there is one, otherwise what the system has available.
    pub memory_free_bytes: u64,
    /// Disk space for the session.
    pub disk_bytes: u64,
    /// Free disk space.
    pub disk_free_bytes: u64,
    /// The table of a sweep or film whose settings were chosen for the calibration in use, because the plan states none;
    /// `None` for other plans.
    #[serde(default)]
    pub settings: Option<String>,
    /// Why such settings are not taken, and those of an uncalibrated rig are instead; `None` if they are, or none were
    /// chosen.
    #[serde(default)]
    pub settings_refused: Option<String>,
    /// Counts above black of a white pixel under its own row, as sweeps and films take them; `None` for other plans.
    #[serde(default)]
    pub white_dn: Option<f64>,
    /// First and last relative row that a plane rig's plan covers; `None` on a dot rig.
    #[serde(default)]
    pub reach_rows: Option<(i32, i32)>,
    /// Condition number of the demultiplexing of a middle camera row, including its prior; `None` on a dot rig.
    #[serde(default)]
    pub condition: Option<f64>,
    /// Expected error of a sweep or film and better settings; `None` for other plans, or if a warning says why.
    #[serde(default)]
    pub advice: Option<PlanAdvice>,
    /// Details if the plan is a film.
    #[serde(default)]
    pub film: Option<FilmCheck>,
    /// Details if the plan consists of batches.
    #[serde(default)]
    pub batches: Option<BatchesCheck>,
    /// Details if the plan measures a mirror's response.
    #[serde(default)]
    pub response: Option<ResponseCheck>,
    /// Warnings for the operator; none of them prevents the run.
    pub warnings: Vec<String>,
}

/// What an operator has to do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Question {
    /// The task.
    pub text: String,
    /// Whether the run waits until `continue` says that it is done; otherwise the run goes on by itself, or is over.
    pub wants_answer: bool,
}

/// For people at a terminal.
impl fmt::Display for Question {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let answer = if self.wants_answer { ", then `raysweep continue`" } else { "" };
        write!(to, "{}{answer}", self.text)
    }
}

/// Parameters of `run`.
#[derive(Debug, Clone, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunParams {
    /// The plan's TOML text.
    pub plan: String,
    /// Who runs it.
    #[serde(default)]
    pub operator: Option<String>,
    /// What is in front of the camera.
    #[serde(default)]
    pub sample: Option<String>,
    /// Free text.
    #[serde(default)]
    pub note: Option<String>,
    /// Labels for finding the session.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Whether the run is cancelled when the connection over which this came is closed, however that happens: for runs
    /// that are of no use without their client, and would leave the light on.
    #[serde(default)]
    pub attached: bool,
}

/// Parameters of `resume`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ResumeParams {
    /// The session's folder, or its name in the daemon's data folder.
    pub session: PathBuf,
}

/// Result of `run` and `resume`: the run has started.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Started {
    /// The session's folder.
    pub session: PathBuf,
}

/// One entry of `sessions`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SessionInfo {
    /// The session's folder.
    pub session: PathBuf,
    /// The plan's name.
    pub name: String,
    /// When it was created (RFC 3339).
    pub created: String,
    /// Sweep points stored.
    pub stored: usize,
    /// Sweep points planned.
    pub points: usize,
    /// Whether `resume` would add to what is stored, or end what did not come to its end, by the ledger alone: damage is
    /// not looked for. Also true during its run.
    #[serde(default)]
    pub can_resume: bool,
    /// `complete`, `cancelled` or `faulted`; `unfinished` if no run has ended; `unreadable`.
    pub state: String,
    /// Kind of the plan; empty if it is unreadable.
    #[serde(default)]
    pub kind: String,
    /// Who ran it.
    #[serde(default)]
    pub operator: Option<String>,
    /// What was in front of the camera.
    #[serde(default)]
    pub sample: Option<String>,
    /// Its tags.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Reasons why the results of its latest run may be worse than they look.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// One entry of `calibrations`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CalibrationInfo {
    /// Folder of the session that measured it; of the calibration in use the data folder's `calibration`, if that session
    /// is gone or cannot be read.
    pub session: PathBuf,
    /// When it was measured (RFC 3339); empty if it cannot be read.
    pub made: String,
    /// Maker, model and serial number of the camera.
    pub camera: String,
    /// Whether runs use it.
    pub in_use: bool,
    /// Why it cannot be used; `None` if it is sound.
    pub problem: Option<String>,
}

/// Parameters of `use_calibration`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct UseCalibrationParams {
    /// Folder of a session of kind `calibration`, or its name in the daemon's data folder.
    pub session: PathBuf,
}

/// What `subscribe` streams, as notifications of the method `event`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// The daemon has entered another state.
    State {
        /// The new state.
        state: RunState,
        /// The session, if any.
        session: Option<PathBuf>,
    },
    /// A point was stored or given up.
    Progress(Progress),
    /// An attempt at a point failed and will be repeated. In a film: a frame was lost, which is not repeated.
    Lost {
        /// Position of the point in the order of acquisition.
        point: u32,
        /// Counted from 0; in a film, the cycle.
        attempt: u32,
        /// What became of its triggers.
        counts: Counts,
    },
    /// Statistics of the VSYNC line so far: once per second and at the end of a pass.
    Vsync(VsyncStats),
    /// The light transport was estimated during a film.
    Film(FilmEstimate),
    /// A batch of a flying dot was stored.
    Batch(BatchStored),
    /// The viewfinder has a new picture.
    Viewfinder(Box<ViewfinderValues>),
    /// An operator has to do something. Obsolete with the next state of the run.
    Ask(Question),
    /// A live estimate from the points stored so far is in the live file.
    Live {
        /// Sequence number of its last image in the live file.
        sequence: u64,
        /// Sweep points used.
        points: usize,
        /// Computing time of the estimate.
        seconds: f64,
    },
    /// A run has ended.
    Finished {
        /// The session's folder.
        session: PathBuf,
        /// `complete`, `cancelled` or `faulted`.
        state: String,
        /// Why it faulted.
        error: Option<String>,
        /// The report, if one was made.
        report: Option<PathBuf>,
        /// Sweep points or film cycles stored.
        stored: usize,
        /// Sweep points missing.
        missing: usize,
        /// Whether the session cannot be resumed, or would come to the same end.
        #[serde(default)]
        is_final: bool,
        /// Summary of the film, if the run was a film.
        #[serde(default)]
        film: Option<FilmSummary>,
        /// Reasons why the results may be worse than they look.
        #[serde(default)]
        warnings: Vec<String>,
        /// What the run found, beside its products, in a sentence each.
        #[serde(default)]
        found: Vec<String>,
        /// Seconds from the end of the last frame's exposure to the transport on disk; `None` if no transport
        /// was computed.
        #[serde(default)]
        final_s: Option<f64>,
        /// Seconds from the first frame with light to the end of the last, without the probe and the dark
        /// points.
        #[serde(default)]
        light_s: Option<f64>,
        /// Whether `light_s` is time of a simulated rig, which does not wait for the clock on the wall.
        #[serde(default)]
        simulated_time: bool,
    },
    /// Events were dropped because the subscriber read too slowly.
    Skipped {
        /// Number of dropped events.
        events: u64,
    },
}

/// Stable error codes; the number is the `code` of the JSON-RPC error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    /// Not JSON.
    ParseError = -32700,
    /// JSON, but not a JSON-RPC 2.0 request.
    InvalidRequest = -32600,
    /// No such method.
    MethodNotFound = -32601,
    /// A parameter is missing, unknown or of the wrong type.
    InvalidParams = -32602,
    /// A bug in the daemon.
    Internal = -32603,
    /// The plan is invalid, or this rig cannot run it.
    InvalidPlan = 1,
    /// A run is in progress.
    Busy = 2,
    /// No run is in progress, or its state does not allow this.
    NotRunning = 3,
    /// The caller is an observer.
    Forbidden = 4,
    /// No such session, or not one that can be resumed.
    NoSession = 5,
    /// A device failed.
    Device = 6,
    /// The disk failed or is too small.
    Storage = 7,
    /// The message is longer than allowed.
    TooLong = 8,
    /// Too many clients.
    TooManyClients = 9,
}

/// An error in the form of a JSON-RPC error object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, thiserror::Error)]
#[error("{message}")]
pub struct RpcError {
    /// [`ErrorCode`] as a number.
    pub code: i64,
    /// What happened: field, value, what is allowed, what to do.
    pub message: String,
    /// Details for programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub data: Option<Box<ErrorData>>,
}

/// Machine-readable details of an error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ErrorData {
    /// The code's name.
    pub name: ErrorCode,
    /// The offending field, for example `sweep.delay_us.count`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// Byte range (from, to) in the plan's text that the error is about.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub span: Option<(usize, usize)>,
    /// Everything that is wrong with a plan, in the order of its text; `field` and `span` are those of the first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub mistakes: Vec<Mistake>,
    /// What to do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub help: Option<String>,
}

/// One mistake in a plan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Mistake {
    /// Field, value, what is allowed, what to do.
    pub message: String,
    /// The offending field.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// Byte range (from, to) in the plan's text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub span: Option<(usize, usize)>,
}

impl RpcError {
    /// An error with a code and a message only.
    pub fn new(code: ErrorCode, message: impl Into<String>) -> Self {
        let data = ErrorData { name: code, field: None, span: None, mistakes: Vec::new(), help: None };
        Self { code: code as i64, message: message.into(), data: Some(Box::new(data)) }
    }

    /// Adds the field that the error is about.
    #[must_use]
    pub fn of_field(mut self, field: impl Into<String>) -> Self {
        if let Some(data) = &mut self.data {
            data.field = Some(field.into());
        }
        self
    }

    /// Adds what to do.
    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        if let Some(data) = &mut self.data {
            data.help = Some(help.into());
        }
        self
    }

    /// The name of the error's code, if it is one of [`ErrorCode`].
    pub fn name(&self) -> Option<ErrorCode> {
        self.data.as_ref().map(|data| data.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use RunState::{Armed, Draining, Faulted, Idle, Paused, Preparing, Running};

    #[test]
    fn every_state_can_end_and_no_state_skips_draining() {
        let all = [Idle, Preparing, Armed, Running, Paused, Draining, Faulted];
        for state in [Preparing, Armed, Running, Paused] {
            assert!(state.may_become(Draining) && state.may_become(Faulted), "{state:?}");
            // Only a run that was refused before it started leaves no trace.
            assert_eq!(state.may_become(Idle), state == Preparing, "{state:?}");
        }
        for state in all {
            assert!(!state.may_become(state), "{state:?} to itself");
            assert_eq!(state.may_become(Preparing), matches!(state, Idle | Faulted));
        }
    }
}
