//! What the calibration plane tells of the dots: where they land, what they cover, how they overlap, and how the mirror
//! sees the camera.

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
