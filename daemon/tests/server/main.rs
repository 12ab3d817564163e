//! The socket and the command line, over a real Unix socket with a fake daemon behind it.
#![expect(clippy::unwrap_used, reason = "a helper of a test fails the test")]

mod command;
mod docs;
mod fake;
mod malformed;
#[path = "../process/mod.rs"]
mod process;
mod sessions;
mod socket;
mod terminal;
