//! Formats what a viewfinder tells as text for people.

use std::fmt::Write;

use raysweep_proto::{FocusTrend, RowAlignment, SeenDot, ViewfinderValues};

/// What a viewfinder shows, in a line.
pub(super) fn line(values: &ViewfinderValues) -> String {
    let mut line = format!("{:<5}", values.picture.name());
    if let Some(focus) = &values.focus {
        let trend = match focus.trend {
            FocusTrend::Rising => "rising",
            FocusTrend::Falling => "falling",
            FocusTrend::Steady => "steady",
        };
        let _ = write!(line, "  focus {:.4}", focus.score);
        if focus.best > 0.0 {
            let _ = write!(line, ", {:.0} % of the best, {trend}", 100.0 * focus.score / focus.best);
        }
    }
    let (saturated, dark) = (100.0 * values.saturated, 100.0 * values.underexposed);
    let _ = write!(
        line,
        "  saturated {saturated:.2} %, dark {dark:.1} %, mean {:.0}, brightest {}",
        values.mean_dn, values.brightest_dn
    );
    if let Some(SeenDot { row, column, fwhm_px, peak_dn }) = &values.dot {
        let _ = write!(
            line,
            "  dot at row {row:.1}, column {column:.1}, {fwhm_px:.1} px wide, peak {peak_dn:.0}"
        );
    }
    line
}

/// A number of so many steps in one, so that what is printed as zero is not negative.
fn rounded(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps + 0.0
}

/// How the rows lie, and what to turn, in lines.
pub(super) fn alignment(found: &RowAlignment) -> String {
    let mut text = format!(
        "rows: shift {:+.2} rows, rotation {:+.3} degrees, magnification {:.4}; at most {:.2} rows off, {:.2} rms unexplained",
        rounded(found.shift_rows, 100.0),
        rounded(found.rotation_deg, 1000.0),
        found.magnification,
        found.worst_rows,
        found.residual_rows
    );
    match found.advice.is_empty() {
        true => text.push_str("\n  aligned to a tenth of a row"),
        false => found.advice.iter().for_each(|advice| {
            let _ = write!(text, "\n  {advice}");
        }),
    }
    text
}
