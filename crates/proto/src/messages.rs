//! Parameters, results and events. Field names are stable; times are seconds or, where `_us` says so, microseconds.

use std::path::PathBuf;

use raysweep_core::{ClockQuality, Counts, FilmSummary, SettingsLatency, VsyncStats};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

use crate::SweepAdvice;

/// What the daemon is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RunState {
    /// Nothing; ready for a run.
    Idle,
    /// Opening devices and the session.
    Preparing,
    /// The camera is armed, no point has begun.
    Armed,
    /// Acquiring.
    Running,
    /// Holding between two points.
    Paused,
    /// Acquisition is over; results are being made and written.
    Draining,
    /// The last run ended with an error; ready for another.
    Faulted,
}

impl RunState {
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

/// How far a run is.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Progress {
    /// Points stored, of this run and of those before it that it resumes.
    pub points_stored: usize,
    /// Points that the run needs: the sweep's, its dark images and the regular image.
    pub points_planned: usize,
    /// Where this run's triggers have gone so far.
    #[schemars(schema_with = "counts_schema")]
    pub counts: Counts,
    /// Seconds since the run began.
    pub elapsed_s: f64,
    /// Seconds that it will still take at its present pace, if that can be said yet.
    pub left_s: Option<f64>,
    /// Frames averaged per second.
    pub frames_per_s: f64,
}

/// `core` knows no schemas, so those of its accounts are written out here.
fn counts_schema(_: &mut SchemaGenerator) -> Schema {
    let frames = json_schema!({ "type": "integer", "minimum": 0 });
    json_schema!({
        "type": "object",
        "description": "Frames: expected = averaged + settling + cancelled + sum of lost.",
        "properties": {
            "expected": frames,
            "averaged": frames,
            "settling": frames,
            "cancelled": frames,
            "lost": { "type": "object", "description": "Frames by cause.", "additionalProperties": frames },
        },
        "required": ["expected", "averaged", "settling", "cancelled", "lost"],
    })
}

fn vsync_schema(_: &mut SchemaGenerator) -> Schema {
    let edges = json_schema!({ "type": "integer", "minimum": 0 });
    json_schema!({
        "type": ["object", "null"],
        "properties": {
            "edges": edges,
            "missed": edges,
            "false_edges": edges,
            "period_us": { "type": "number" },
            "jitter_us": { "type": "number", "description": "Standard deviation of edges from the line through their neighbours." },
            "jitter_p99_us": { "type": "number" },
            "allan_1s": { "type": ["number", "null"], "description": "Allan deviation over one second." },
        },
        "required": ["edges", "missed", "false_edges", "period_us", "jitter_us"],
    })
}

fn clock_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({
        "type": ["object", "null"],
        "description": "The fit of a device's clock to the host's, null where the host stamps.",
        "properties": {
            "residual_us": { "type": "number" },
            "rate_ppm": { "type": "number" },
            "round_trips": { "type": "integer", "minimum": 0 },
        },
        "required": ["residual_us", "rate_ppm", "round_trips"],
    })
}

fn latency_schema(_: &mut SchemaGenerator) -> Schema {
    let frames = json_schema!({ "type": "integer", "minimum": 0 });
    json_schema!({
        "type": ["object", "null"],
        "properties": { "min_frames": frames, "max_frames": frames },
        "required": ["min_frames", "max_frames"],
    })
}

fn film_schema(_: &mut SchemaGenerator) -> Schema {
    let cycles = json_schema!({ "type": "integer", "minimum": 0 });
    json_schema!({
        "type": ["object", "null"],
        "description": "A film's account: cycles planned = stored + incomplete + those not taken.",
        "properties": {
            "cycles_planned": cycles,
            "cycles_stored": cycles,
            "cycles_incomplete": cycles,
            "transports": cycles,
            "transports_missing": cycles,
            "sliding_estimates": cycles,
            "cycles_per_s": { "type": ["number", "null"] },
            "latency_ms": {
                "type": ["object", "null"],
                "description": "Percentiles p50, p95, p99 and max: from the end of a cycle's last exposure to its transport.",
                "additionalProperties": { "type": "number" },
            },
        },
        "required": [
            "cycles_planned", "cycles_stored", "cycles_incomplete", "transports", "transports_missing",
            "sliding_estimates", "cycles_per_s", "latency_ms",
        ],
    })
}

/// An estimate of the light transport during a film; the images themselves are not in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FilmEstimate {
    /// The cycle that its newest frame belongs to, counted from 0.
    pub cycle: u32,
    /// Whether it is made of the newest frame of each setting rather than of one cycle: published, not stored.
    pub sliding: bool,
    /// Start of its oldest exposure, in seconds after that of the film's first.
    pub start_s: f64,
    /// From the end of its newest exposure to its publication; nothing on a virtual clock.
    pub latency_ms: Option<f64>,
    /// Time that the solver took.
    pub solve_ms: f64,
    /// Mean over all pixels of the light from the pixel's own projector row, 1 = white.
    pub epipolar: f64,
    /// The same of the light from all other rows.
    pub non_epipolar: f64,
    /// The film so far.
    #[schemars(schema_with = "film_schema")]
    pub film: FilmSummary,
}

/// What `check` says of a film.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FilmCheck {
    /// Settings of a cycle.
    pub settings: usize,
    /// Cycles.
    pub cycles: usize,
    /// VSYNC periods that a cycle takes on this camera.
    pub periods_per_cycle: u32,
    /// Light transports a second, at the most.
    pub transports_per_s: f64,
    /// Disk space that a minute takes, uncompressed.
    pub disk_bytes_per_minute: u64,
    /// What the pace hangs on.
    pub reason: String,
}

/// A batch of a flying dot was stored; its floodlit image is in the live file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BatchStored {
    /// Its index in `dots.zarr`.
    pub batch: usize,
    /// The calibration plane that it shows, from 0; nothing: the scene.
    pub plane: Option<usize>,
    /// Start of its first exposure, in seconds after that of the run's first batch.
    pub start_s: f64,
    /// Dots of the scene without a frame.
    pub missing: usize,
    /// Dots in whose frames nothing stood out of the background.
    pub empty: usize,
    /// Dots whose frames ended at the cap on discs.
    pub capped: usize,
    /// Frames that came twice.
    pub duplicates: u64,
    /// Mean over all pixels of the floodlit image, in counts.
    pub floodlit: f64,
    /// Of that image in the live file, where there is one.
    pub sequence: Option<u64>,
}

/// What `check` says of a plan of batches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BatchesCheck {
    /// Batches of the scene.
    pub scene: u32,
    /// Batches of each calibration plane.
    pub planes: Vec<u32>,
    /// Frames of a batch.
    pub dots: u32,
    /// Frames a second.
    pub camera_rate_hz: f64,
    /// Seconds of a batch.
    pub batch_s: f64,
    /// Frames without light before the first batch.
    pub dark_frames: u32,
    /// Samples of the mirror's path.
    pub samples: usize,
    /// Samples a second.
    pub rate_hz: f64,
    /// What the camera sends.
    pub raw_bytes_per_s: u64,
    /// What a batch takes on the disk.
    pub disk_bytes_per_batch: u64,
}

/// What `check` says of a plan of a mirror's chirps, one of each axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ResponseCheck {
    /// Where a chirp begins and ends.
    pub band_hz: [f64; 2],
    /// Its amplitude, of the mirror.
    pub amplitude_deg: f64,
    /// Seconds of a chirp.
    pub chirp_s: f64,
    /// Seconds after it.
    pub rest_s: f64,
    /// Frames of each axis.
    pub frames: usize,
    /// Frames a second.
    pub camera_rate_hz: f64,
    /// Frames without light before the first chirp.
    pub dark_frames: u32,
    /// Samples of the mirror's path.
    pub samples: usize,
    /// Samples a second.
    pub rate_hz: f64,
}

/// `status`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Status {
    /// Version of the daemon.
    pub version: String,
    /// Kind of the rig.
    pub rig: String,
    /// What the daemon is doing.
    pub state: RunState,
    /// What an operator is to do before `continue`, where the run is held for that.
    #[serde(default)]
    pub question: Option<String>,
    /// The session of the present or the last run.
    pub session: Option<PathBuf>,
    /// How far that run is, or was.
    pub progress: Option<Progress>,
    /// Its VSYNC line, renewed once a second.
    #[schemars(schema_with = "vsync_schema")]
    pub vsync: Option<VsyncStats>,
    /// How well the clock of the device that watches the line is known.
    #[serde(default)]
    #[schemars(schema_with = "clock_schema")]
    pub vsync_clock: Option<ClockQuality>,
    /// The film, where the run is one.
    #[serde(default)]
    #[schemars(schema_with = "film_schema")]
    pub film: Option<FilmSummary>,
    /// How many frames later than the next the camera's settings take effect, as the run's probe found it.
    #[serde(default)]
    #[schemars(schema_with = "latency_schema")]
    pub settings_latency: Option<SettingsLatency>,
    /// Why the last run faulted.
    pub error: Option<String>,
    /// The file with the newest live images, if there is one; `describe` has its layout.
    #[serde(default)]
    pub live: Option<PathBuf>,
    /// The mirror, where the rig has ever moved one.
    #[serde(default)]
    pub mirror: Option<MirrorStatus>,
}

/// A mirror and its light.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct MirrorStatus {
    /// Whether it is at the origin with the light off.
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

/// Result of `check`: what a plan would do, before anything moves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CheckReport {
    /// Points of the sweep; of a film, its cycles.
    pub points: usize,
    /// Further points: dark images and the regular image.
    pub extra_points: usize,
    /// Frames to average over all points.
    pub frames: u64,
    /// Shortest time that the light takes.
    pub light_s: f64,
    /// Memory for the images and the results; where it does not suffice to make them in one piece, for some camera rows
    /// at a time.
    pub memory_bytes: u64,
    /// Memory that the daemon may use for it: what it is limited to, or else what the system can still give.
    pub memory_free_bytes: u64,
    /// Disk space for the session.
    pub disk_bytes: u64,
    /// Disk space that is free.
    pub disk_free_bytes: u64,
    /// First and last relative row that the sweep reaches.
    pub reach_rows: (i32, i32),
    /// Condition number of the demultiplexing of a camera row in the middle, with its prior.
    pub condition: f64,
    /// What error to expect of a sweep, and what to do better; nothing where a warning says why, and for films.
    #[serde(default)]
    pub advice: Option<SweepAdvice>,
    /// Where the plan is a film.
    #[serde(default)]
    pub film: Option<FilmCheck>,
    /// Where the plan is one of batches; reach and condition then mean nothing.
    #[serde(default)]
    pub batches: Option<BatchesCheck>,
    /// Where the plan is one of a mirror's chirps; reach and condition then mean nothing.
    #[serde(default)]
    pub response: Option<ResponseCheck>,
    /// What an operator should know; none of it stops the run.
    pub warnings: Vec<String>,
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
    /// What stands before the camera.
    #[serde(default)]
    pub sample: Option<String>,
    /// Anything else.
    #[serde(default)]
    pub note: Option<String>,
    /// Words to find the session by.
    #[serde(default)]
    pub tags: Vec<String>,
}

/// Parameters of `resume`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ResumeParams {
    /// The session's folder, or its name within the daemon's data folder.
    pub session: PathBuf,
}

/// Result of `run` and `resume`: the run has begun.
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
    /// When it was made (RFC 3339).
    pub created: String,
    /// Points of the sweep that are stored.
    pub stored: usize,
    /// Points of the sweep.
    pub points: usize,
    /// `complete`, `cancelled`, `faulted`; `unfinished` where no run has ended; `unreadable`.
    pub state: String,
}

/// What `subscribe` streams, as notifications of method `event`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// The daemon went to another state.
    State {
        /// The new state.
        state: RunState,
        /// The session it concerns.
        session: Option<PathBuf>,
    },
    /// A point was stored or given up.
    Progress(Progress),
    /// An attempt at a point failed; the point is taken again. In a film a frame is lost, and is not.
    Lost {
        /// Ordinal of the point in the order of acquisition.
        point: u32,
        /// Counted from 0; in a film the cycle.
        attempt: u32,
        /// Where its triggers went.
        #[schemars(schema_with = "counts_schema")]
        counts: Counts,
    },
    /// The VSYNC line so far: once a second and at the end of a pass.
    Vsync(#[schemars(schema_with = "vsync_schema")] VsyncStats),
    /// The light transport was estimated during a film.
    Film(FilmEstimate),
    /// A batch of a flying dot was stored.
    Batch(BatchStored),
    /// The run waits for an operator, who is to do this; where the run is over, nobody waits.
    Ask {
        /// What to do.
        text: String,
    },
    /// A running estimate is in the live file, made from the points stored so far.
    Live {
        /// Of its last image in the live file.
        sequence: u64,
        /// Points of the sweep that went into it.
        points: usize,
        /// How long the estimate took.
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
        /// Points of the sweep, or cycles of the film, stored.
        stored: usize,
        /// Points of the sweep missing.
        missing: usize,
        /// How the film went, where the run was one.
        #[serde(default)]
        #[schemars(schema_with = "film_schema")]
        film: Option<FilmSummary>,
        /// What makes the results worse than they look.
        #[serde(default)]
        warnings: Vec<String>,
        /// Seconds from the end of the last frame's exposure to the transport on disk; nothing where none was made.
        #[serde(default)]
        final_s: Option<f64>,
        /// Seconds from the first frame with light to the end of the last: without the probe and the dark points.
        #[serde(default)]
        light_s: Option<f64>,
    },
    /// This many events were left out because the subscriber read too slowly.
    Skipped {
        /// How many.
        events: u64,
    },
}

/// Stable codes of what can go wrong; the number is the JSON-RPC error's `code`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    /// Not JSON.
    ParseError = -32700,
    /// JSON, but not a JSON-RPC 2.0 request.
    InvalidRequest = -32600,
    /// No such method.
    MethodNotFound = -32601,
    /// Parameters of the wrong shape.
    InvalidParams = -32602,
    /// A defect of the daemon.
    Internal = -32603,
    /// The plan cannot be read or makes no sense.
    InvalidPlan = 1,
    /// A run is under way.
    Busy = 2,
    /// No run is under way, or not in a state for this.
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

/// An error as a JSON-RPC error object carries it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, thiserror::Error)]
#[error("{message}")]
pub struct RpcError {
    /// [`ErrorCode`] as a number.
    pub code: i64,
    /// What happened: field, value, what is allowed, what to do.
    pub message: String,
    /// More, for programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub data: Option<ErrorData>,
}

/// What a program may want to know of an error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ErrorData {
    /// The code by name.
    pub name: ErrorCode,
    /// The offending field, `sweep.delay_us.count` for example.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// Bytes from..to of the plan's text that the error is about.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub span: Option<(usize, usize)>,
    /// What to do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub help: Option<String>,
}

impl RpcError {
    /// An error with its code and nothing more.
    pub fn new(code: ErrorCode, message: impl Into<String>) -> Self {
        let data = ErrorData { name: code, field: None, span: None, help: None };
        Self { code: code as i64, message: message.into(), data: Some(data) }
    }

    /// The same, about a field of what was sent.
    #[must_use]
    pub fn of_field(mut self, field: impl Into<String>) -> Self {
        if let Some(data) = &mut self.data {
            data.field = Some(field.into());
        }
        self
    }

    /// The same, with what to do.
    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        if let Some(data) = &mut self.data {
            data.help = Some(help.into());
        }
        self
    }

    /// The error's code by name, if it is one of ours.
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
            // Only a run that was refused before it began leaves no trace.
            assert_eq!(state.may_become(Idle), state == Preparing, "{state:?}");
        }
        for state in all {
            assert!(!state.may_become(state), "{state:?} to itself");
            assert_eq!(state.may_become(Preparing), matches!(state, Idle | Faulted));
        }
    }
}
