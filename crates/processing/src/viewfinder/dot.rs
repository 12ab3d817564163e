//! The dot of a dot rig.

use ndarray::{Array2, ArrayView2};

/// A dot stands this many standard deviations above the rest of the picture.
const SIGMAS: f64 = 8.0;
/// Standard deviation of a normal distribution over its median absolute deviation.
const SIGMA_PER_MAD: f64 = 1.4826;
/// Light above this share of the peak belongs to the dot.
const RIM: f64 = 0.1;
/// Mean of r^2 / (2 sigma^2) over the light of a Gaussian dot above the rim: 1 - ln(1/q) q / (1 - q).
const WITHIN_RIM: f64 = 0.744_16;
/// Full width at half maximum over the standard deviation of a Gaussian.
const FWHM_PER_SIGMA: f64 = 2.354_82;

/// A dot of light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LitDot {
    /// Row of its centroid, 0 at the centre of the first row.
    pub row: f64,
    /// Column of its centroid.
    pub column: f64,
    /// Full width at half maximum, as of a Gaussian dot.
    pub fwhm_px: f64,
    /// Counts above the background at its peak, averaged over 3 by 3 pixels.
    pub peak_dn: f64,
}

impl LitDot {
    /// The brightest dot of an image; `None` if nothing stands out, or too much.
    pub fn find(image: ArrayView2<u16>) -> Option<Self> {
        let (rows, columns) = image.dim();
        if rows < 3 || columns < 3 {
            return None;
        }
        let mut counts: Vec<u16> = image.iter().copied().collect();
        let middle = counts.len() / 2;
        let background = f64::from(*counts.select_nth_unstable(middle).1);
        let mut off: Vec<f64> = counts.iter().map(|&dn| (f64::from(dn) - background).abs()).collect();
        // Counts are whole: without noise they still scatter by rounding.
        let sigma = (SIGMA_PER_MAD * *off.select_nth_unstable_by(middle, f64::total_cmp).1).max(0.3);
        // A median over the neighbours would be safer from hot pixels, and a mean is enough: they are single.
        let smooth = Array2::from_shape_fn((rows - 2, columns - 2), |(t, s)| {
            let around = (0..9).map(|at| f64::from(image[[t + at / 3, s + at % 3]]) - background);
            let (sum, most) = around.fold((0.0, f64::MIN), |(sum, most), dn| (sum + dn, most.max(dn)));
            // Without its brightest pixel: a hot one does not count.
            (sum - most) / 8.0
        });
        let ((t, s), &peak) = smooth.indexed_iter().max_by(|(_, a), (_, b)| a.total_cmp(b))?;
        if peak < SIGMAS * sigma {
            return None;
        }
        let (t, s) = (t + 1, s + 1);
        let peak_dn =
            (0..9).map(|at| f64::from(image[[t + at / 3 - 1, s + at % 3 - 1]]) - background).sum::<f64>()
                / 9.0;
        let rim = (RIM * peak_dn).max(3.0 * sigma);
        let lit = connected(image, background + rim, (t, s));
        if 2 * lit.len() > rows * columns {
            return None;
        }
        let light = |&(t, s): &(usize, usize)| f64::from(image[[t, s]]) - background;
        let total: f64 = lit.iter().map(light).sum();
        let mean = |of: &dyn Fn(&(usize, usize)) -> f64| {
            lit.iter().map(|at| light(at) * of(at)).sum::<f64>() / total
        };
        let (row, column) = (mean(&|&(t, _)| t as f64), mean(&|&(_, s)| s as f64));
        let square = mean(&|&(t, s)| (t as f64 - row).powi(2) + (s as f64 - column).powi(2));
        let fwhm_px = FWHM_PER_SIGMA * (square / 2.0 / WITHIN_RIM).sqrt();
        Some(Self { row, column, fwhm_px, peak_dn })
    }
}

/// The pixels above a count that are connected with one of them.
fn connected(image: ArrayView2<u16>, above_dn: f64, from: (usize, usize)) -> Vec<(usize, usize)> {
    let (rows, columns) = image.dim();
    let mut seen = Array2::from_elem((rows, columns), false);
    let (mut found, mut ahead) = (Vec::new(), vec![from]);
    while let Some((t, s)) = ahead.pop() {
        if std::mem::replace(&mut seen[[t, s]], true) || f64::from(image[[t, s]]) < above_dn {
            continue;
        }
        found.push((t, s));
        let down = (t + 1 < rows).then(|| (t + 1, s));
        let right = (s + 1 < columns).then(|| (t, s + 1));
        let (up, left) = (t.checked_sub(1).map(|t| (t, s)), s.checked_sub(1).map(|s| (t, s)));
        ahead.extend([down, right, up, left].into_iter().flatten());
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(pixel: usize) -> f64 {
        ((pixel * 7919) % 101) as f64 / 10.0
    }

    fn gaussian(row: f64, column: f64, sigma: f64, peak_dn: f64) -> Array2<u16> {
        Array2::from_shape_fn((60, 80), |(t, s)| {
            let square = (t as f64 - row).powi(2) + (s as f64 - column).powi(2);
            (100.0 + noise(t * 80 + s) + peak_dn * (-square / (2.0 * sigma * sigma)).exp()).round() as u16
        })
    }

    #[test]
    fn a_dot_has_its_place_size_and_peak() {
        for (row, column, sigma) in [(20.3, 41.6, 2.0), (30.0, 12.5, 5.0), (44.8, 60.2, 1.2)] {
            let mut image = gaussian(row, column, sigma, 1500.0);
            image[[5, 5]] = 4000;
            let dot = LitDot::find(image.view()).unwrap();
            assert!((dot.row - row).abs() < 0.1 && (dot.column - column).abs() < 0.1, "{dot:?}");
            assert!((dot.fwhm_px / (2.3548 * sigma) - 1.0).abs() < 0.08, "{dot:?} of {sigma}");
            // Averaging over 3 by 3 pixels lowers a peak by about 2 / (3 sigma^2).
            assert!((0.6..1.02).contains(&(dot.peak_dn / 1500.0)), "{dot:?}");
        }
    }

    #[test]
    fn nothing_and_too_much_are_no_dot() {
        assert_eq!(LitDot::find(gaussian(20.0, 20.0, 2.0, 0.0).view()), None);
        let mut hot = gaussian(20.0, 20.0, 2.0, 0.0);
        hot[[7, 7]] = 4095;
        assert_eq!(LitDot::find(hot.view()), None);
        assert_eq!(LitDot::find(Array2::from_elem((60, 80), 4095).view()), None);
        assert_eq!(LitDot::find(Array2::from_elem((2, 80), 4095).view()), None);
    }
}
