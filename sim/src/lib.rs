//! Simulated rigs.
