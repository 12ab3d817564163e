//! Calibration from images of the calibration plane: the dots' positions, footprints and overlaps, and the geometry
//! of mirror and camera.

mod centroid;
mod confusion;
mod footprint;
mod fundamental;
mod places;
mod robust;
mod spread;

pub use centroid::{Centroids, Drift};
pub use confusion::Confusion;
pub use footprint::Footprints;
pub(crate) use footprint::luminance;
pub use fundamental::{EpipolarFit, Fundamental, LEAST_PARALLAX};
pub use places::Extension;
pub use spread::PointSpreads;
