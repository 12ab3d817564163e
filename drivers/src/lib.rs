//! Drivers for real devices behind the traits of `raysweep-core`. Whoever needs a C library does so behind a feature.

pub mod camera;
pub mod mirror;
