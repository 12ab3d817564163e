//! Which settings of a camera change what its pixels mean.

/// Whether a camera's feature or control of this name sets what a pixel counts of light.
pub(super) fn is_gain(name: &str) -> bool {
    name.to_ascii_lowercase().contains("gain")
}
