//! raysweep-proto
