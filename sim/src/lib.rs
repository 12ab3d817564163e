//! Simulated rigs: scenes, projector, camera, sensor and VSYNC line under one clock, with seeded faults.
//!
//! A [`PlaneRig`] opens devices that implement the traits of `raysweep-core` and offer no more than real devices
//! do. All random numbers are keyed by their purpose (point, attempt, frame), so the same seed gives the same bits
//! for any number of threads and wherever a run was interrupted.

pub mod bench;
mod devices;
pub mod dots;
mod drawn;
mod error;
pub mod gige;
mod keyed;
mod lens;
mod line;
pub mod mirror;
pub mod optics;
mod rig;
pub mod scene;
mod sensor;
mod shown;
mod stored_float;
mod subject;
pub mod triggerbox;
mod truth;
pub mod usb;
mod wire;
mod world;

pub use devices::{BenchDevices, PlaneDevices, TruthProbe};
pub use error::SimError;
pub use line::LineTruth;
pub use rig::{LensControl, LensOf, PlaneRig};
pub use subject::SubjectSwitch;
pub use truth::PlaneTruth;
pub use wire::WireDevices;
pub use world::PlaneSetup;
