//! The mirrors' drivers against simulated controllers on pseudo-terminals.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod parsers;
mod points;
mod rig;
mod stream;
mod ways_out;
