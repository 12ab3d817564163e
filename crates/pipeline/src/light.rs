//! Whether the projector's light reaches the camera at all: a lens cap or a dark projector leaves images that nothing
//! but their brightness tells from those of a scene.

use std::fmt;

use ndarray::ArrayView2;

/// An image is lit if its mean exceeds the dark image's by this many standard errors.
const LEAST_SIGMAS: f64 = 5.0;
/// It must also exceed it by this share of a white pixel's light: the dark level of a camera drifts by less, and a
/// scene of black velvet reflects more.
const LEAST_SHARE: f64 = 2e-4;

/// Standard deviation of a normal distribution whose median absolute deviation is 1.
const SIGMAS_PER_MEDIAN_DEVIATION: f64 = 1.4826;

/// By how much an image is brighter than the dark one, averaged over its pixels, in counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenLight {
    /// The mean difference.
    pub mean_dn: f64,
    /// Its standard error without any light, from the median deviation of the pixels' differences, which the light of a
    /// small object does not increase.
    pub error_dn: f64,
    /// The light of a white pixel's own row.
    pub white_dn: f64,
}

impl SeenLight {
    /// Compares an image with light and one without, both in counts, where the latter is below `saturation_dn`; `None`
    /// if it is nowhere, so that nothing can be seen. `white_dn` is a white pixel's light.
    pub fn between(
        lit: ArrayView2<f32>,
        dark: ArrayView2<f32>,
        white_dn: f64,
        saturation_dn: f64,
    ) -> Option<Self> {
        let pairs = lit.iter().zip(&dark).filter(|&(_, &dark)| f64::from(dark) < saturation_dn);
        let mut values: Vec<f64> = pairs.map(|(&lit, &dark)| f64::from(lit) - f64::from(dark)).collect();
        let pixels = values.len() as f64;
        let mean_dn = values.iter().sum::<f64>() / pixels;
        let middle = upper_median(&mut values)?;
        values.iter_mut().for_each(|value| *value = (*value - middle).abs());
        let scatter_dn = SIGMAS_PER_MEDIAN_DEVIATION * upper_median(&mut values)?;
        Some(Self { mean_dn, error_dn: scatter_dn / pixels.sqrt(), white_dn })
    }

    /// The smallest mean difference that counts as light.
    pub fn least_dn(&self) -> f64 {
        (LEAST_SIGMAS * self.error_dn).max(LEAST_SHARE * self.white_dn)
    }

    /// Whether there is certainly too little light, which no averaging over more frames would show to be enough.
    pub fn is_surely_none(&self) -> bool {
        self.mean_dn + LEAST_SIGMAS * self.error_dn < LEAST_SHARE * self.white_dn
    }

    /// Whether there is light.
    pub fn is_light(&self) -> bool {
        self.mean_dn > self.least_dn()
    }
}

/// The middle value, of two the larger one; `None` without any.
fn upper_median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

impl fmt::Display for SeenLight {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (mean, error, white) = (self.mean_dn, self.error_dn, self.white_dn);
        write!(
            f,
            "on average {mean:+.3} ± {error:.3} counts more with light than without, at least {:.3} are needed, and white gives {white:.0}",
            self.least_dn()
        )
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;
    use crate::regularity::tests::Normal;

    /// Noise of two counts about a dark level of 64.
    fn dark(seed: u64) -> Array2<f32> {
        let mut normal = Normal::new(seed);
        Array2::from_shape_simple_fn((128, 128), || (64.0 + 2.0 * normal.next()) as f32)
    }

    fn seen(lit: &Array2<f32>) -> SeenLight {
        SeenLight::between(lit.view(), dark(1).view(), 200.0, 255.0).unwrap()
    }

    #[test]
    fn noise_and_a_drifting_dark_level_are_no_light() {
        for seed in 2..40 {
            assert!(!seen(&dark(seed)).is_light(), "{}", seen(&dark(seed)));
        }
        assert!(!seen(&(dark(2) + 0.03)).is_light());
        // A projector that was lit only while it should have been dark.
        assert!(!seen(&(dark(2) - 40.0)).is_light());
    }

    #[test]
    fn a_dim_scene_and_a_small_bright_object_are_light() {
        assert!(seen(&(dark(2) + 0.5)).is_light());
        let mut object = dark(2);
        object.slice_mut(ndarray::s![60..66, 60..66]).mapv_inplace(|dn| dn + 60.0);
        assert!(seen(&object).is_light(), "{}", seen(&object));
    }

    #[test]
    fn what_few_frames_cannot_tell_from_darkness_is_left_open() {
        // A white pixel gives 200 counts: 0.04 are needed, and the error of one frame is 0.02 to 0.03.
        let of = |mean_dn, error_dn| SeenLight { mean_dn, error_dn, white_dn: 200.0 };
        assert!(of(0.0, 0.005).is_surely_none() && of(-40.0, 0.02).is_surely_none());
        assert!(!of(0.0, 0.02).is_surely_none() && !of(0.0, 0.02).is_light(), "it may be either");
        assert!(!of(0.05, 0.0).is_surely_none() && of(0.05, 0.0).is_light());
    }

    #[test]
    fn the_figures_are_the_mean_and_its_error_by_the_median_deviation() {
        // Differences of 7, 9, 11 and 13; from the upper median 11 they deviate by 4, 2, 0 and 2.
        let lit = ndarray::arr2(&[[10.0, 12.0], [14.0, 16.0]]);
        let dark = Array2::from_elem((2, 2), 3.0);
        let seen = SeenLight::between(lit.view(), dark.view(), 100.0, 255.0).unwrap();
        assert_eq!((seen.mean_dn, seen.error_dn), (10.0, 1.4826));
        assert_eq!(seen.least_dn(), 5.0 * 1.4826);
    }

    #[test]
    fn where_the_dark_image_saturates_nothing_can_be_seen() {
        let (lit, mut dark) = (Array2::from_elem((2, 2), 255.0), Array2::from_elem((2, 2), 255.0));
        assert_eq!(SeenLight::between(lit.view(), dark.view(), 100.0, 255.0), None);
        dark[[0, 1]] = 5.0;
        let seen = SeenLight::between(lit.view(), dark.view(), 100.0, 255.0).unwrap();
        assert_eq!((seen.mean_dn, seen.error_dn, seen.is_light()), (250.0, 0.0, true));
    }
}
