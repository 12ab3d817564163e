//! The simulated dot rig: a mirror moves a spot of light over a scene, and a camera triggered by the mirror's sample
//! clock takes one frame per position.
//!
//! A [`DotsRig`] opens devices that implement the traits of `raysweep-core` and offer no more than real devices do.
//! Frames are taken only while a path is playing, starting at its first sample, so their contents do not depend on
//! virtual time. Random effects in a frame are keyed by the path and the frame's number in it.

mod beam;
mod bench;
mod camera;
mod mirror;
mod rig;
mod scan;
mod scene;
mod view;
mod world;

pub use bench::DotsSetup;
pub use rig::{DotsDevices, DotsRig, DotsRigError};
pub use scene::{BUILTIN_NAMES, DotSceneError};
pub use world::{DotsTruth, FrameFate, FrameTruth};
