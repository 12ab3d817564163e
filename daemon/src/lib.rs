//! raysweepd
