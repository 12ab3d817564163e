//! A typical value of a map.

/// Median of the finite values; 0 if there are none.
pub(super) fn median(values: impl Iterator<Item = f32>) -> f64 {
    let mut values: Vec<f32> = values.filter(|value| value.is_finite()).collect();
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).map_or(0.0, |&value| f64::from(value))
}
