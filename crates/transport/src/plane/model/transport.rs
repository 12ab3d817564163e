use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use ndarray::{Array2, Array3, ArrayView3, Axis, s};

/// Plane-to-ray transport by relative row, as [`super::super::Demux`] estimates it.
#[derive(Debug, Clone, PartialEq)]
pub struct Transport {
    /// `T[u, t, s]`, shape `[U, camera_rows, columns]`: light from the projector row that lies `u_min + index` rows
    /// below the pixel's own; 1.0 for a white surface under its own row. 0 if the projector has no such row.
    pub t: Array3<f32>,
    /// Relative row of index 0 of `t`.
    pub u_min: i32,
    /// Whether the projector has the row, shape `[U, camera_rows]`.
    pub exists: Array2<bool>,
    /// Pixels `[t, s]` some of whose samples saturate.
    pub saturated: Array2<bool>,
    /// Rows whose light is only known to be at least what `t` says, because each sample that sees them saturates: for
    /// each pixel `[t, s]` that has some, `[U]`.
    pub lower_bounds: BTreeMap<[usize; 2], Vec<bool>>,
    /// Pixels `[t, s]` in which no exposure begins or ends near the pixel's own row, so that nothing but the prior
    /// tells the rows `|u| <= 2` apart.
    pub no_edge: Array2<bool>,
}

impl Transport {
    /// A transport no part of which is only a bound or only the prior's word.
    pub fn measured(t: Array3<f32>, u_min: i32, exists: Array2<bool>) -> Self {
        let (_, rows, columns) = t.dim();
        let none = Array2::from_elem((rows, columns), false);
        Self { t, u_min, exists, saturated: none.clone(), lower_bounds: BTreeMap::new(), no_edge: none }
    }

    /// Relative row of the last index of `t`.
    pub fn u_max(&self) -> i32 {
        self.u_min + self.t.len_of(Axis(0)) as i32 - 1
    }

    /// Whether some light of a pixel from these relative rows is only a lower bound.
    pub fn is_bound(&self, pixel: [usize; 2], rows: RangeInclusive<i32>) -> bool {
        let mut known = *rows.start().max(&self.u_min)..=*rows.end().min(&self.u_max());
        self.lower_bounds.get(&pixel).is_some_and(|bounds| known.any(|u| bounds[(u - self.u_min) as usize]))
    }

    /// Light from the relative rows `u` in `rows`, `[t, s]`; rows outside the reach contribute nothing.
    pub fn band(&self, rows: RangeInclusive<i32>) -> Array2<f32> {
        let from = (i64::from(*rows.start()) - i64::from(self.u_min)).max(0) as usize;
        let to = (i64::from(*rows.end()) - i64::from(self.u_min) + 1).clamp(0, self.t.len_of(Axis(0)) as i64);
        sum_rows(self.t.slice(s![from.min(to as usize)..to as usize, .., ..]))
    }

    /// Epipolar image: light from the pixel's own row and its nearest neighbours, `|u| <= (width_rows - 1) / 2`.
    /// Width 1 is `u = 0` alone; an even width is treated as the next smaller odd one.
    pub fn epipolar(&self, width_rows: u32) -> Array2<f32> {
        let half = half_width(width_rows);
        self.band(-half..=half)
    }

    /// All light within the reach that is not part of [`Self::epipolar`] of the same width.
    pub fn non_epipolar(&self, width_rows: u32) -> Array2<f32> {
        let half = half_width(width_rows);
        self.band(i32::MIN..=-half - 1) + self.band(half + 1..=i32::MAX)
    }

    /// All light within the reach: the model's prediction for an exposure of one whole period.
    pub fn total(&self) -> Array2<f32> {
        sum_rows(self.t.view())
    }
}

fn half_width(width_rows: u32) -> i32 {
    (width_rows.saturating_sub(1) / 2) as i32
}

/// Sum over the first axis, in f64, because the light of thousands of dim rows adds up next to a bright one.
fn sum_rows(rows: ArrayView3<f32>) -> Array2<f32> {
    let sum = rows.fold_axis(Axis(0), 0.0_f64, |sum, &value| sum + f64::from(value));
    sum.mapv(|sum| sum as f32)
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3};

    use super::*;

    #[test]
    fn bands_split_the_total() {
        // u = -2..=3 have the values 1, 10, 100, ...
        let t = Array3::from_shape_fn((6, 1, 2), |(u, _, s)| (s + 1) as f32 * 10_f32.powi(u as i32));
        let transport = Transport::measured(t, -2, Array2::from_elem((6, 1), true));
        let first = |image: Array2<f32>| image[[0, 0]];
        assert_eq!(transport.u_max(), 3);
        assert_eq!(first(transport.total()), 111_111.0);
        assert_eq!(transport.total()[[0, 1]], 222_222.0);
        assert_eq!(first(transport.epipolar(1)), 100.0);
        assert_eq!(first(transport.epipolar(2)), 100.0);
        assert_eq!(first(transport.epipolar(3)), 1_110.0);
        assert_eq!(first(transport.epipolar(u32::MAX)), 111_111.0);
        assert_eq!(first(transport.non_epipolar(1)), 111_011.0);
        assert_eq!(first(transport.non_epipolar(3)), 110_001.0);
        assert_eq!(first(transport.band(1..=2)), 11_000.0);
        assert_eq!(first(transport.band(3..=9)), 100_000.0);
        assert_eq!(first(transport.band(4..=9)), 0.0);
        assert_eq!(first(transport.band(-9..=-3)), 0.0);
        #[expect(clippy::reversed_empty_ranges)]
        let empty = transport.band(2..=1);
        assert_eq!(first(empty), 0.0);
    }
}
