//! raysweep-pipeline
