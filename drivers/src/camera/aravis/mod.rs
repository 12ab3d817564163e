//! GenICam cameras, GigE Vision and USB3 Vision, through libaravis.
//!
//! Two threads share a camera. The *owner*, a thread of the driver's, holds the control channel: it opens the camera,
//! sets it and asks it for its time. Whoever calls [`AravisCamera`] holds the stream of frames and decides when a lost
//! camera is opened again. So a call that a dead camera blocks for seconds, as libaravis' calls do, costs nobody but
//! the owner its time.

mod chunks;
mod driver;
mod facts;
mod features;
mod file;
mod frames;
mod ids;
mod library;
mod losses;
mod network;
mod owner;
mod promise;
mod sequencer;
mod settings;
mod setup;

pub use driver::{AravisCamera, RigFacts};
pub use facts::facts;
pub use file::{RefusedLine, load_features, save_features};
pub use library::{FoundCamera, discover, version};
pub use network::SocketBuffer;
pub use raysweep_config::rig::aravis::{AravisConfig, SensorRegion, TimestampAt};
