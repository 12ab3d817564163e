//! raysweep-session
