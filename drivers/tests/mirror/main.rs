//! The mirror drivers with simulated controllers on pseudo-terminals.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod conformance;
#[path = "../suite/hung.rs"]
mod hung;
mod mishaps;
#[path = "../suite/noise.rs"]
mod noise;
mod parsers;
mod playzerx_script;
mod points;
mod rig;
mod scripts;
mod stream;
#[path = "../suite/mirror.rs"]
mod suite;
mod ways_out;

use hung::HUNG;
