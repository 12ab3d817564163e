//! The simulated dot rig: a mirror moves one spot of light over a scene, and a camera that the mirror's sample clock
//! triggers takes a frame of each place.
//!
//! A [`DotsRig`] opens devices that implement the traits of `raysweep-core` and carry nothing that real devices lack.
//! Frames come only while a path is played, from its first sample on, so that virtual time decides nothing about what is
//! in them. What is random in a frame is keyed by the path that is played and the frame's number in it.

mod beam;
mod camera;
mod config;
mod mirror;
mod rig;
mod scan;
mod scene;
mod view;
mod world;

pub use config::{DotsConfig, SimDot, SimDotCamera, SimDotSensor, SimMirror};
pub use rig::{DotsDevices, DotsError, DotsRig, DotsSetup};
pub use scene::{BUILTIN_NAMES, DotSceneError};
pub use world::{DotsTruth, FrameFate, FrameTruth, SubjectSwitch};
