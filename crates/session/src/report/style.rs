//! What pictures and plots have in common.

/// Colours of series and of the corresponding markers: mid-tones that are visible on white and on black.
pub const PALETTE: [&str; 8] =
    ["#d9482b", "#2f7fc1", "#3c9d5d", "#a35bc4", "#c98a1b", "#20a0a0", "#d45d95", "#7d8794"];

/// Formats a value with three significant digits.
pub fn short(value: impl Into<f64>) -> String {
    let value = value.into();
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    let magnitude = value.abs().log10().floor() as i32;
    if !(-4..6).contains(&magnitude) {
        return format!("{value:.2e}");
    }
    let text = format!("{value:.*}", usize::try_from(2 - magnitude).unwrap_or(0));
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}
