//! The protocol on the daemon's socket: JSON-RPC 2.0, one message per line, and a small blocking client.
//!
//! [`Method`] lists all methods; `describe` returns them with JSON Schemas. A request is one line of at most
//! [`MAX_MESSAGE_BYTES`]; answers and events are one line each, of any length.

mod advice;
mod client;
mod doctor;
pub mod live;
mod messages;
mod methods;
mod rpc;
mod viewfinder;

pub use advice::{
    BetterPlan, DesignParams, DesignReport, ErrorRange, ExpectedError, NoiseEstimate, NoiseSource,
    PlanAdvice, RigAccuracy,
};
pub use client::{Client, ClientError, Subscription};
pub use doctor::{DoctorCheck, DoctorParams, DoctorReport, Grade};
pub use messages::*;
pub use methods::{Description, Empty, ErrorInfo, LimitsInfo, Method, MethodInfo, Role, describe};
pub use rpc::{EventNotice, Id, Incoming, Outcome, Request, Response, params};
pub use viewfinder::{FocusScore, FocusTrend, RowAlignment, SeenDot, ViewfinderParams, ViewfinderValues};

/// Maximum length of a request, without its line feed.
pub const MAX_MESSAGE_BYTES: usize = 1 << 20;

/// Maximum number of connected clients.
pub const MAX_CLIENTS: usize = 64;

/// Maximum number of connections of one user.
pub const MAX_CLIENTS_PER_USER: usize = 16;

/// Number of connections that only operators may take.
pub const CLIENTS_OF_OPERATORS: usize = 16;
