//! The bench socket: what of a simulated rig is no camera, for a daemon in another process. The camera's wire carries
//! pictures; the VSYNC edges that triggered it and the projector that lights its scene go over a Unix socket, one JSON
//! message a line. Times are nanoseconds of `CLOCK_MONOTONIC`, which all processes of a machine share.

mod remote;
mod server;

use raysweep_core::{DeviceErrorKind, Pattern};
use serde::{Deserialize, Serialize};

pub use remote::{BenchProbe, RemoteProjector, RemoteVsync};
pub use server::{BenchError, BenchServer};

use crate::gige::{Faults, WireTruth};
use crate::line::LineTruth;

/// Longest line that either side takes: a pattern of many thousand rows.
const MAX_LINE: u64 = 1 << 20;

/// What a client asks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Request {
    /// Tell every edge from now on; the connection is good for nothing else then.
    Edges,
    /// Show a pattern.
    Show(Pattern),
    /// Light off.
    Blank,
    /// What really happened so far.
    Truth,
    /// What goes wrong at present.
    Faults,
    /// What goes wrong from now on; what is left out goes right.
    SetFaults(Faults),
}

/// What the bench says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Reply {
    /// An edge of the VSYNC line, as its watcher saw it.
    Edge { seq: u64, host_ns: i64 },
    /// From when on what was asked for is in the light.
    Shown { not_before_ns: i64 },
    /// The answer to [`Request::Truth`].
    Truth(Truth),
    /// The faults in force.
    Faults(Faults),
    /// Why it cannot be done.
    Error { kind: DeviceErrorKind, message: String },
}

/// What really happened, on the line and on the wire, for tests alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Truth {
    /// On the VSYNC line.
    pub line: LineTruth,
    /// On the camera's wire.
    pub wire: WireTruth,
}
