//! The bench socket: serves all devices of a simulated rig except the camera to a daemon in another process. Pictures
//! travel over the camera's network connection; the VSYNC edges that triggered them, and commands to the projector, go
//! over a Unix socket, one JSON message per line. Times are nanoseconds of `CLOCK_MONOTONIC`, which all processes of a
//! machine share.

mod remote;
mod server;

use raysweep_core::{DeviceErrorKind, Pattern, Subject};
use serde::{Deserialize, Serialize};

pub use remote::{BenchProbe, RemoteProjector, RemoteVsync, remote_subject};
pub use server::{BenchError, BenchServer};

use crate::gige::{Faults, WireTruth};
use crate::line::LineTruth;

/// Maximum line length for either side: enough for a pattern of many thousand rows.
const MAX_LINE: u64 = 1 << 20;

/// Requests of a client.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Request {
    /// Subscribe to all further edges; the connection then accepts no other requests.
    Edges,
    /// Show a pattern.
    Show(Pattern),
    /// Switch the light off.
    Blank,
    /// Place something in front of the camera.
    Place(Subject),
    /// Get the ground truth so far.
    Truth,
    /// Get the current faults.
    Faults,
    /// Set the faults from now on; faults that are left out are switched off.
    SetFaults(Faults),
}

/// Messages from the bench.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Reply {
    /// An edge of the VSYNC line, as seen by its monitor.
    Edge { seq: u64, host_ns: i64 },
    /// Earliest time at which the light shows what was requested.
    Shown { not_before_ns: i64 },
    /// It is in front of the camera.
    Placed(Subject),
    /// The answer to [`Request::Truth`].
    Truth(Truth),
    /// The active faults.
    Faults(Faults),
    /// Why the request failed.
    Error { kind: DeviceErrorKind, message: String },
}

/// Ground truth of the line and the wire, for tests only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Truth {
    /// The VSYNC line.
    pub line: LineTruth,
    /// The camera's network connection.
    pub wire: WireTruth,
}
