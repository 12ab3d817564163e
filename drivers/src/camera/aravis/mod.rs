//! GenICam cameras, GigE Vision and USB3 Vision, through libaravis.
//!
//! Two threads share a camera. The *owner*, a thread of the driver, holds the control channel: it opens the camera,
//! sets it, reads its clock, and opens it again when it has stopped answering. The caller of [`AravisCamera`] holds
//! the stream of frames. libaravis' calls to a dead camera can block for seconds; this way they block only the owner.
//!
//! The configuration is part of every build, so that a rig file can be read without the library; the rest requires
//! the feature `aravis`.

mod config;

pub use config::{AravisConfig, ConfigFault, Region, TimestampAt};

#[cfg(feature = "aravis")]
mod chunks;
#[cfg(feature = "aravis")]
mod driver;
#[cfg(feature = "aravis")]
mod features;
#[cfg(feature = "aravis")]
mod file;
#[cfg(feature = "aravis")]
mod frames;
#[cfg(feature = "aravis")]
mod ids;
#[cfg(feature = "aravis")]
mod library;
#[cfg(feature = "aravis")]
mod losses;
#[cfg(feature = "aravis")]
mod network;
#[cfg(feature = "aravis")]
mod owner;
#[cfg(feature = "aravis")]
mod promise;
#[cfg(feature = "aravis")]
mod sequencer;
#[cfg(feature = "aravis")]
mod settings;
#[cfg(feature = "aravis")]
mod setup;

#[cfg(feature = "aravis")]
pub use driver::{AravisCamera, RigFacts};
#[cfg(feature = "aravis")]
pub use file::{Refused, load_features, save_features};
#[cfg(feature = "aravis")]
pub use library::{Found, discover};
