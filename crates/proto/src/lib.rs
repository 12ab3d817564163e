//! What travels over the daemon's socket: JSON-RPC 2.0, one message a line, and a small blocking client.
//!
//! [`Method`] is the one table of what can be asked; `describe` returns it with JSON Schemas. A request is one line of
//! at most [`MAX_MESSAGE_BYTES`]; answers and events are one line each, of any length.

mod advice;
mod client;
pub mod live;
mod messages;
mod methods;
mod rpc;

pub use advice::{BetterSweep, ExpectedError, NoiseEstimate, NoiseSource, SweepAdvice};
pub use client::{Client, ClientError, Subscription};
pub use messages::*;
pub use methods::{Description, Empty, ErrorInfo, LimitsInfo, Method, MethodInfo, Role, describe};
pub use rpc::{EventNotice, Id, Incoming, Outcome, Request, Response, params};

/// The longest request, without its line feed.
pub const MAX_MESSAGE_BYTES: usize = 1 << 20;

/// How many clients may be connected at once.
pub const MAX_CLIENTS: usize = 32;
