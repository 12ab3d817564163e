use ndarray::{Array2, ArrayView2, Axis};
use rayon::prelude::*;

use super::linearity::LightLevel;
use super::{
    Estimate, ImagesError, ROUNDING_DN2, SensorNoise, check_frames, check_shape, is_usable, mean_image,
    median, median_of_variance,
};

/// Gain and read noise from the variance over frames as a function of the mean.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotonTransfer {
    /// Electrons per DN.
    pub electrons_per_dn: Estimate,
    /// Noise of one reading in the dark, without rounding.
    pub read_noise_e: Estimate,
    /// Signal above the dark image and variance over frames, in DN and DN^2, of each group of pixels.
    pub groups: Vec<[f64; 2]>,
}

impl PhotonTransfer {
    /// The noise of one frame.
    pub fn noise(&self) -> SensorNoise {
        SensorNoise { electrons_per_dn: self.electrons_per_dn.value, read_noise_e: self.read_noise_e.value }
    }
}

/// Number of groups of similarly bright pixels that a level is divided into.
const GROUPS: usize = 16;
/// Smallest number of pixels in a group.
const MIN_PIXELS: usize = 64;
/// Above this share of full scale, noise is cut off at full scale.
const HIGHEST_SHARE: f32 = 0.9;
/// Fewest pixels for the non-uniformity.
const MIN_TRIPLES: usize = 1000;

/// Fits variance = read noise^2 + signal / electrons_per_dn to levels of light, at least two of them different.
///
/// Each frame is first scaled to the level's mean image, so that light that changes from frame to frame does not count
/// as noise. Pixels of one level are grouped by signal, and groups are weighted by 1 / variance of their variance, as
/// predicted by the fit. Pixels near full scale are left out, as are those masked in `usable`.
///
/// # Errors
/// [`ImagesError::TooFew`] for levels of fewer than 3 frames or too few pixels; [`ImagesError::NoShotNoise`];
/// [`ImagesError::Shape`].
pub fn photon_transfer(
    levels: &[LightLevel],
    full_scale_dn: f32,
    usable: Option<ArrayView2<bool>>,
) -> Result<PhotonTransfer, ImagesError> {
    let mut groups = Vec::new();
    for level in levels {
        level.check(3)?;
        if let Some(usable) = usable {
            check_shape("usable", "[t, s]", usable.shape(), &level.frames.shape()[1..])?;
        }
        groups.extend(groups_of(level, full_scale_dn, usable));
    }
    if groups.len() < 2 {
        return Err(ImagesError::TooFew {
            what: "groups of pixels below full scale",
            given: groups.len(),
            needed: 2,
            cure: "take frames of white and of greys that do not saturate: close the aperture, or darken the room if its lamps alone fill the pixels",
        });
    }
    fit(&groups)
}

/// Pixels of one level with similar signal.
#[derive(Debug, Clone, Copy)]
struct Group {
    signal_dn: f64,
    variance_dn2: f64,
    /// Degrees of freedom of the variance.
    degrees: f64,
}

fn groups_of(level: &LightLevel, full_scale_dn: f32, usable: Option<ArrayView2<bool>>) -> Vec<Group> {
    let n = level.frames.len_of(Axis(0));
    let mean = mean_image(level.frames);
    let signal = &mean - &level.dark_dn;
    let kept = |t: usize, s: usize| is_usable(usable, t, s) && mean[[t, s]] < HIGHEST_SHARE * full_scale_dn;
    let factors: Vec<f32> = (0..n).into_par_iter().map(|frame| level.factor(frame, &signal, kept)).collect();
    let mut pixels: Vec<(f32, f32)> = (0..signal.nrows())
        .into_par_iter()
        .flat_map_iter(|t| {
            let (factors, signal, kept) = (&factors, &signal, &kept);
            (0..signal.ncols()).filter(move |&s| kept(t, s)).map(move |s| {
                let samples = level.frames.slice(ndarray::s![.., t, s]);
                let squares = samples.iter().zip(factors).map(|(sample, factor)| {
                    (sample - level.dark_dn[[t, s]] - factor * signal[[t, s]]).powi(2)
                });
                (signal[[t, s]], squares.sum::<f32>() / (n - 1) as f32)
            })
        })
        .collect();
    pixels.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let size = pixels.len().div_ceil(GROUPS).max(MIN_PIXELS);
    let groups = pixels.chunks(size).filter(|group| group.len() >= MIN_PIXELS / 2);
    groups.map(|group| Group::new(group, n - 1)).collect()
}

impl Group {
    fn new(pixels: &[(f32, f32)], degrees: usize) -> Self {
        let mut variances: Vec<f64> = pixels.iter().map(|&(_, variance)| f64::from(variance)).collect();
        let typical = median(&mut variances).unwrap_or(0.0) / median_of_variance(degrees);
        // Pixels that blink would raise the mean; chance reaches this variance in less than one pixel in 1000.
        let most = typical * (1.0 + 20.0 * (2.0 / degrees as f64).sqrt());
        let kept: Vec<_> = pixels.iter().filter(|&&(_, variance)| f64::from(variance) <= most).collect();
        let mean = |value: fn(&(f32, f32)) -> f32| {
            kept.iter().map(|p| f64::from(value(p))).sum::<f64>() / kept.len() as f64
        };
        Self { signal_dn: mean(|p| p.0), variance_dn2: mean(|p| p.1), degrees: (degrees * kept.len()) as f64 }
    }
}

/// The line through the groups.
fn fit(groups: &[Group]) -> Result<PhotonTransfer, ImagesError> {
    let (mut offset, mut slope) =
        (groups.iter().map(|g| g.variance_dn2).sum::<f64>() / groups.len() as f64, 0.0);
    let mut covariance = [0.0; 3];
    for _ in 0..10 {
        let [mut w, mut wx, mut wxx, mut wy, mut wxy] = [0.0; 5];
        for group in groups {
            let (x, y) = (group.signal_dn, group.variance_dn2 - ROUNDING_DN2);
            let expected: f64 = offset + slope * x + ROUNDING_DN2;
            let weight = group.degrees / (2.0 * expected.max(ROUNDING_DN2).powi(2));
            w += weight;
            wx += weight * x;
            wxx += weight * x * x;
            wy += weight * y;
            wxy += weight * x * y;
        }
        let spread = w * wxx - wx * wx;
        slope = (w * wxy - wx * wy) / spread;
        offset = (wy - slope * wx) / w;
        covariance = [wxx / spread, -wx / spread, w / spread];
    }
    if slope.is_nan() || slope <= 0.0 {
        return Err(ImagesError::NoShotNoise { fall: -slope });
    }
    // If the groups do not lie on a line, because the sensor's response is curved, the line is less certain.
    let misfit: f64 = groups
        .iter()
        .map(|group| {
            let expected = offset + slope * group.signal_dn + ROUNDING_DN2;
            (group.variance_dn2 - expected).powi(2) * group.degrees / (2.0 * expected.powi(2))
        })
        .sum();
    let scale = (misfit / (groups.len() as f64 - 2.0).max(1.0)).max(1.0);
    let [of_offset, both, of_slope] = covariance.map(|entry| entry * scale);
    let read_dn = offset.max(0.0).sqrt();
    // Derivatives of sqrt(offset) / slope; at a read noise below rounding, that of the square root has no meaning.
    let by_offset = 1.0 / (2.0 * read_dn.max(ROUNDING_DN2.sqrt()) * slope);
    let by_slope = -read_dn / slope.powi(2);
    let read_variance =
        by_offset.powi(2) * of_offset + 2.0 * by_offset * by_slope * both + by_slope.powi(2) * of_slope;
    Ok(PhotonTransfer {
        electrons_per_dn: Estimate { value: 1.0 / slope, sd: of_slope.sqrt() / slope.powi(2) },
        read_noise_e: Estimate { value: read_dn / slope, sd: read_variance.max(0.0).sqrt() },
        groups: groups.iter().map(|group| [group.signal_dn, group.variance_dn2]).collect(),
    })
}

/// Photo response non-uniformity: standard deviation of the pixels' sensitivities as a share of their mean, from the
/// mean of `frames` white images, dark image subtracted.
///
/// A pixel is compared with the mean of its left and right neighbours. That removes shading and the brightness of
/// projector rows; texture of the board remains, so the result is an upper bound.
///
/// # Errors
/// [`ImagesError::TooFew`] for fewer than 1000 lit pixels with lit neighbours; [`ImagesError::OutOfRange`].
pub fn prnu(
    white_dn: ArrayView2<f32>,
    usable: Option<ArrayView2<bool>>,
    frames: usize,
    noise: SensorNoise,
) -> Result<Estimate, ImagesError> {
    noise.check()?;
    check_frames(frames, 1)?;
    let (rows, columns) = white_dn.dim();
    let mut squares = Vec::new();
    for t in 0..rows {
        for s in 1..columns.saturating_sub(1) {
            let [left, own, right] = [s - 1, s, s + 1].map(|s| f64::from(white_dn[[t, s]]));
            let around = (left + right) / 2.0;
            // Beyond a quarter it is an edge.
            let alike = around > 0.0 && (own / around - 1.0).abs() < 0.25;
            if alike && (s - 1..=s + 1).all(|s| is_usable(usable, t, s)) {
                let shot = 1.5 * noise.variance_dn2(around) / frames as f64 / around.powi(2);
                squares.push([(own / around - 1.0).powi(2) / 1.5, shot / 1.5]);
            }
        }
    }
    if squares.len() < MIN_TRIPLES {
        let cure = "use a larger window that is lit by white";
        let what = "lit pixels with lit neighbours";
        return Err(ImagesError::TooFew { what, given: squares.len(), needed: MIN_TRIPLES, cure });
    }
    let mut sorted: Vec<f64> = squares.iter().map(|[square, _]| *square).collect();
    let typical = median(&mut sorted).unwrap_or(0.0) / median_of_variance(1);
    // Dust and dead pixels lie beyond 5 standard deviations.
    let kept: Vec<f64> = squares
        .iter()
        .filter(|[square, _]| *square < 25.0 * typical)
        .map(|[square, shot]| square - shot)
        .collect();
    let n = kept.len() as f64;
    let variance = kept.iter().sum::<f64>() / n;
    let scatter = kept.iter().map(|square| (square - variance).powi(2)).sum::<f64>() / n;
    let value = variance.max(0.0).sqrt();
    // Each pixel takes part in three differences, which makes their squares 1.9 times less certain (correlations -2/3
    // and 1/6: 1 + 2 (4/9 + 1/36)).
    let sd = (1.94 * scatter / n).sqrt() / (2.0 * value.max(typical.sqrt() / 10.0));
    Ok(Estimate { value, sd })
}

impl LightLevel<'_> {
    /// Brightness of one frame relative to the level's mean image above the dark image.
    fn factor(&self, frame: usize, signal: &Array2<f32>, kept: impl Fn(usize, usize) -> bool) -> f32 {
        let frame = self.frames.index_axis(Axis(0), frame);
        let [mut product, mut square] = [0.0; 2];
        for ((t, s), &signal) in signal.indexed_iter() {
            if kept(t, s) {
                product += f64::from((frame[[t, s]] - self.dark_dn[[t, s]]) * signal);
                square += f64::from(signal * signal);
            }
        }
        if square > 0.0 { (product / square) as f32 } else { 1.0 }
    }
}
