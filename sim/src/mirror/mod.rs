//! Mirror controllers on a pseudo-terminal, with the mirror behind them: they speak the real wire to the real drivers,
//! drain by the host's clock, and keep the truth about what the mirror was told for tests.

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
pub use playzerx::{PlayzerXConfig, PlayzerXController};
pub use pty::{Controller, Link, MirrorPty, Pty, Run, WireFaults};
