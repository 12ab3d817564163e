//! Conversions between the two time units of the code: integer nanoseconds on a clock, microseconds in settings.

/// Nanoseconds, rounded to the nearest, of a duration in microseconds.
pub fn ns_from_us(us: f64) -> i64 {
    (us * 1_000.0).round() as i64
}

/// Microseconds of a duration in nanoseconds.
pub fn us_from_ns(ns: i64) -> f64 {
    ns as f64 / 1_000.0
}
