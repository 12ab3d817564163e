//! raysweep-transport
