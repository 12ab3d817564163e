//! How bright a picture is.

use ndarray::{ArrayView2, s};

/// Bars of the histogram.
const BARS: usize = 64;
/// A pixel is underexposed below this share of the range from black to saturation.
const UNDEREXPOSED: f64 = 0.02;

/// The scale of the camera's counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CountScale {
    /// Counts without light.
    pub black_dn: f64,
    /// Counts from which on a pixel is saturated.
    pub saturation_dn: f64,
    /// Largest count.
    pub full_dn: u16,
}

impl CountScale {
    /// Counts below which a pixel is underexposed.
    pub fn underexposed_dn(&self) -> f64 {
        self.black_dn + UNDEREXPOSED * (self.saturation_dn - self.black_dn)
    }
}

/// Shares of the pixels by their brightness.
#[derive(Debug, Clone, PartialEq)]
pub struct Levels {
    /// Share of saturated pixels.
    pub saturated: f64,
    /// Share of underexposed pixels.
    pub underexposed: f64,
    /// Mean count.
    pub mean_dn: f64,
    /// Largest count.
    pub brightest_dn: u16,
    /// Number of pixels in each of 64 equal ranges of counts.
    pub histogram: Vec<u64>,
}

impl Levels {
    /// The levels of an image that is not empty.
    pub fn of(image: ArrayView2<u16>, scale: &CountScale) -> Self {
        // Counts are few, and everything follows from how often each occurs.
        let mut occurs = vec![0_u32; usize::from(scale.full_dn) + 1];
        for row in image.rows() {
            for &count in row {
                occurs[usize::from(count.min(scale.full_dn))] += 1;
            }
        }
        let pixels = image.len() as f64;
        let (mut saturated, mut underexposed, mut sum, mut brightest_dn) = (0, 0, 0, 0);
        let mut histogram = vec![0; BARS];
        for (count, &pixels) in occurs.iter().enumerate().filter(|(_, pixels)| **pixels > 0) {
            let (pixels, dn) = (u64::from(pixels), count as f64);
            saturated += if dn >= scale.saturation_dn { pixels } else { 0 };
            underexposed += if dn < scale.underexposed_dn() { pixels } else { 0 };
            sum += pixels * count as u64;
            histogram[count * BARS / occurs.len()] += pixels;
            brightest_dn = count as u16;
        }
        Self {
            saturated: saturated as f64 / pixels,
            underexposed: underexposed as f64 / pixels,
            mean_dn: sum as f64 / pixels,
            brightest_dn,
            histogram,
        }
    }
}

/// A part of an image: first row, row after the last, first column, column after the last.
pub fn region_of<T>(image: ArrayView2<'_, T>, [top, bottom, left, right]: [usize; 4]) -> ArrayView2<'_, T> {
    image.slice_move(s![top..bottom, left..right])
}

/// A line of counts, averaged to at most `most` values.
pub fn cut(line: ndarray::ArrayView1<u16>, most: usize) -> Vec<f32> {
    let chunk = line.len().div_ceil(most).max(1);
    let mean = |values: ndarray::ArrayView1<u16>| {
        values.iter().map(|&dn| f32::from(dn)).sum::<f32>() / values.len() as f32
    };
    line.axis_chunks_iter(ndarray::Axis(0), chunk).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;

    #[test]
    fn pixels_are_counted_by_their_brightness() {
        let scale = CountScale { black_dn: 64.0, saturation_dn: 3972.15, full_dn: 4095 };
        // Underexposed below 64 + 78.163.
        let counts = [0, 64, 142, 143, 2000, 3972, 3973, 4095];
        let image = Array2::from_shape_vec((2, 4), counts.to_vec()).unwrap();
        let levels = Levels::of(image.view(), &scale);
        assert_eq!((levels.saturated, levels.underexposed, levels.brightest_dn), (0.25, 0.375, 4095));
        let sum: u16 = 64 + 142 + 143 + 2000;
        assert_eq!(levels.mean_dn, (f64::from(sum) + 3972.0 + 3973.0 + 4095.0) / 8.0);
        let bars: Vec<(usize, u64)> =
            levels.histogram.into_iter().enumerate().filter(|(_, pixels)| *pixels > 0).collect();
        assert_eq!(bars, [(0, 1), (1, 1), (2, 2), (31, 1), (62, 2), (63, 1)]);
    }

    #[test]
    fn cuts_are_means_of_neighbours() {
        let line = ndarray::Array1::from_vec(vec![1_u16, 3, 5, 7, 9]);
        assert_eq!(cut(line.view(), 3), [2.0, 6.0, 9.0]);
        assert_eq!(cut(line.view(), 8), [1.0, 3.0, 5.0, 7.0, 9.0]);
        let image = Array2::from_shape_fn((4, 5), |(t, s)| 10 * t + s);
        assert_eq!(region_of(image.view(), [1, 3, 2, 4]), ndarray::arr2(&[[12, 13], [22, 23]]));
    }
}
