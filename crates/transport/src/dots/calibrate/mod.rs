//! Calibration from images of the calibration plane: the dots' positions, footprints and overlaps, and the geometry
//! of mirror and camera.

mod centroid;
mod confusion;
mod footprint;
mod fundamental;
mod spread;

pub use centroid::{Centroids, Drift};
pub use confusion::Confusion;
pub use footprint::Footprints;
pub(crate) use footprint::luminance;
pub use fundamental::{Correspondence, Fundamental, LEAST_RATIO, mirror_plane};
pub use spread::PointSpreads;
