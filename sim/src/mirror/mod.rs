//! Simulated mirror controllers on a pseudo-terminal, each with its mirror. They speak the real serial protocols to the
//! real drivers, play samples by the host's clock, and record the ground truth for tests.

mod mechanics;
mod mti;
mod optotune;
mod plant;
mod playzerx;
mod pty;

pub use mechanics::{Mechanics, MechanicsConfig};
pub use mti::MtiController;
pub use optotune::OptotuneController;
pub use plant::{Held, MirrorTruth, Plant};
pub use playzerx::{PlayzerXController, PlayzerXControllerConfig};
pub use pty::{Controller, MirrorPty, Pty, Run, SerialLink, WireFaults, run_as_soon_as_awake};
