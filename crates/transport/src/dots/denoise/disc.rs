use std::ops::Range;

use crate::dots::FrameShape;

/// A disc: all pixels strictly nearer to the centre than its radius.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Disc {
    /// Half-widths of the disc's rows, by distance from the centre's row.
    reach: Vec<usize>,
}

impl Disc {
    pub fn new(radius_px: f64) -> Self {
        let within =
            |down: usize, right: usize| (down * down + right * right) as f64 <= below(radius_px * radius_px);
        let reach = (0..)
            .take_while(|&down| within(down, 0))
            .map(|down| (0..).take_while(|&right| within(down, right)).count() - 1);
        Self { reach: reach.collect() }
    }

    /// The pixels of the disc around `centre`, row by row from the top, clipped at the frame's borders.
    pub fn rows_around(&self, shape: FrameShape, centre: usize) -> impl Iterator<Item = Range<usize>> + '_ {
        let (row, column) = (centre / shape.width(), centre % shape.width());
        let reach = self.reach.len() - 1;
        let rows = row.saturating_sub(reach)..=(row + reach).min(shape.height() - 1);
        rows.map(move |at| {
            let reach = self.reach[at.abs_diff(row)];
            let columns = column.saturating_sub(reach)..(column + reach + 1).min(shape.width());
            at * shape.width() + columns.start..at * shape.width() + columns.end
        })
    }
}

/// The largest integer below `value`.
fn below(value: f64) -> f64 {
    value.ceil() - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_disc_holds_what_is_strictly_nearer_than_the_radius() {
        let shape = FrameShape::new(64, 64, 1).unwrap();
        for radius_px in [0.5, 1.0, 1.1, 2.0, 5.0, 16.0, 20.3] {
            for (row, column) in [(0, 0), (30, 31), (63, 5), (10, 63)] {
                let inside = |pixel: &usize| {
                    let (down, right) = (pixel / 64, pixel % 64);
                    let squared = (row as f64 - down as f64).powi(2) + (column as f64 - right as f64).powi(2);
                    squared.sqrt() < radius_px
                };
                let disc: Vec<usize> =
                    Disc::new(radius_px).rows_around(shape, row * 64 + column).flatten().collect();
                let expected: Vec<usize> = (0..64 * 64).filter(inside).collect();
                assert_eq!(disc, expected, "radius {radius_px} at ({row}, {column})");
            }
        }
    }
}
