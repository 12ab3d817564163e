//! raysweep-core
