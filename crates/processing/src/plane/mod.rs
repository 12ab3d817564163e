//! Shared by the procedures of the plane rig: points, stages, and the model that turns counts into light.

pub(crate) mod colour;
pub mod manifest;
mod processing;
mod products;
pub mod report;
mod task;

pub use self::processing::Processing;
pub(crate) use self::products::{append_argument, mask_bits, planned_products};
pub(crate) use self::task::unit_of;
pub use self::task::{KnownCalibration, KnownRig, PlaneTask, check_mosaic, place};
