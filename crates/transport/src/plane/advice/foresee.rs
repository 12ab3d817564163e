use ndarray::{Array1, Array2, ArrayView1, Axis};

use super::super::solve::pivot::{Start, minimise};
use super::super::solve::quadratic::Quadratic;
use super::super::{PlaneError, Prior, RowModel, RowTiming, Setting, SimdLevel, Slot, SlotKind, reach};
use super::family::{FamilyPixel, PIXELS_PER_SCENE, family};
use super::random::Random;

/// Noise of the camera, in the units of the transport: 1 is the light that a white pixel collects in one row time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Standard deviation of a dark sample of one frame, quantisation included.
    pub read: f64,
    /// Variance of one frame's sample per unit of light: the reciprocal of the electrons that a white pixel collects
    /// per row.
    pub gain: f64,
    /// Frames averaged per setting.
    pub frames: u32,
    /// Number of frames averaged in the dark image that is subtracted from all images of one exposure, which
    /// therefore share its noise; `None` if no dark image is subtracted.
    pub dark_frames: Option<u32>,
}

impl Noise {
    /// Standard deviation of the mean of the frames when `light` is collected.
    fn deviation(&self, light: f64) -> f64 {
        ((self.read.powi(2) + self.gain * light.max(0.0)) / f64::from(self.frames.max(1))).sqrt()
    }

    /// Standard deviation of the dark image.
    fn dark_deviation(&self) -> f64 {
        self.dark_frames.map_or(0.0, |frames| self.read / f64::from(frames.max(1)).sqrt())
    }

    /// Images `[pixels, settings]` with noise added.
    pub(super) fn added(&self, settings: &[Setting], light: &Array2<f64>, draw: u64) -> Array2<f64> {
        let mut noisy = light.clone();
        for (pixel, mut samples) in noisy.rows_mut().into_iter().enumerate() {
            let mut random = Random::new(draw << 32 | pixel as u64);
            let mut darks: Vec<(f64, f64)> = Vec::new();
            for (sample, setting) in samples.iter_mut().zip(settings) {
                let dark = match darks.iter().find(|(exposure_us, _)| *exposure_us == setting.exposure_us) {
                    Some((_, dark)) => *dark,
                    None => {
                        let dark = self.dark_deviation() * random.normal();
                        darks.push((setting.exposure_us, dark));
                        dark
                    }
                };
                *sample += self.deviation(*sample) * random.normal() - dark;
            }
        }
        noisy
    }
}

/// How well the rig is known: standard deviations of what the model takes for exact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibrated {
    /// Time between trigger and exposure, the same for all frames.
    pub latency_us: f64,
    /// Edge of a single frame's exposure: jitter that nothing measures.
    pub edge_us: f64,
    /// Length of the exposure.
    pub exposure_us: f64,
    /// Place of the pixel's own row, in projector rows.
    pub place_rows: f64,
}

impl Calibrated {
    /// All is known exactly.
    pub const EXACTLY: Self = Self { latency_us: 0.0, edge_us: 0.0, exposure_us: 0.0, place_rows: 0.0 };

    /// The settings that differ from the model's, with their indices, if one parameter is off by a standard
    /// deviation: for latency and place, for the exposure, for each edge near the own row, and for all other edges.
    fn wrong_settings(
        &self,
        settings: &[Setting],
        row_time_us: f64,
        frames: u32,
    ) -> Vec<Vec<(usize, Setting)>> {
        let Calibrated { latency_us, edge_us, exposure_us, place_rows } = *self;
        let changed = |index: usize, late_us: f64, longer_us: f64| {
            let Setting { delays_us, exposure_us } = &settings[index];
            let delays_us = delays_us.iter().map(|delay_us| delay_us + late_us).collect();
            (index, Setting { delays_us, exposure_us: exposure_us + longer_us })
        };
        // All light of a pixel whose place is off arrives at other times, as with another latency.
        let late_us = latency_us.hypot(place_rows * row_time_us);
        let mean_edge_us = edge_us / f64::from(frames.max(1)).sqrt();
        let mut wrong = Vec::new();
        if late_us > 0.0 {
            wrong.push((0..settings.len()).map(|index| changed(index, late_us, 0.0)).collect());
        }
        if exposure_us > 0.0 {
            wrong.push((0..settings.len()).map(|index| changed(index, 0.0, exposure_us)).collect());
        }
        if mean_edge_us > 0.0 {
            let is_near = |&index: &usize| {
                let Setting { delays_us, exposure_us } = &settings[index];
                let edge_us = (delays_us[0].abs() - exposure_us / 2.0).abs();
                edge_us < NEAR_ROWS * row_time_us
            };
            let (near, far): (Vec<usize>, Vec<usize>) = (0..settings.len()).partition(is_near);
            wrong.extend(near.into_iter().map(|index| vec![changed(index, mean_edge_us, 0.0)]));
            let late_us = |index: usize| mean_edge_us * Random::new(index as u64).normal();
            wrong.push(far.into_iter().map(|index| changed(index, late_us(index), 0.0)).collect());
        }
        wrong
    }
}

/// Median and 10 to 90 % range of a quantity over the scenes of the family.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// 10 % of the scenes lie below.
    pub low: f64,
    /// Half of the scenes lie below.
    pub median: f64,
    /// 90 % of the scenes lie below.
    pub high: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[(share * (values.len() - 1) as f64).round() as usize];
        Self { low: at(0.1), median: at(0.5), high: at(0.9) }
    }
}

/// Predicted relative error of the transport: for each scene of the family the median over pixels of
/// `||estimate - T|| / ||T||`, norms over the rows within the reach.
///
/// The parts are those of the same pixels; a pixel's total is the square root of the sum of their squares.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictedError {
    /// All parts together.
    pub total: Spread,
    /// Read noise, shot noise and noise of the dark images.
    pub noise: Spread,
    /// What remains without noise: rows that the settings do not tell apart are divided by the prior.
    pub bias: Spread,
    /// Errors of the calibration.
    pub calibration: Spread,
    /// The total if the rows `|u| <= 2` count as one: what remains where their division is not known.
    pub band: Spread,
}

/// Rows up to this distance are one band where direct light cannot be told from its neighbours.
const DIRECT_BAND_ROWS: i32 = 2;

/// The rig and the method for which errors are predicted.
#[derive(Debug, Clone, Copy)]
pub struct Conditions<'a> {
    /// Timing, beam and response of the rig.
    pub timing: &'a RowTiming,
    /// The prior with which transports are estimated.
    pub prior: Prior,
    /// How well the timing is known.
    pub calibrated: Calibrated,
}

/// Number of noise patterns over which the variance of an estimate is averaged.
const DRAWS: u64 = 2;

/// Edges up to this many rows from the pixel's own row matter so much that their errors are propagated one by one.
const NEAR_ROWS: f64 = 4.0;

impl Conditions<'_> {
    /// Predicts the error of a transport estimated from `settings`, one delay each, for a pixel in the middle of the
    /// image.
    ///
    /// Every pixel of the family is photographed through the forward model and solved, as the pixels of a run will
    /// be: without noise, which gives the bias; with noise; and with light that arrives at other times than the model
    /// says, by one standard deviation of each parameter. Differences from the first solution are the parts that
    /// noise and calibration add.
    ///
    /// # Errors
    /// Those of [`reach`]; [`PlaneError::NotConvex`].
    pub fn foresee(&self, settings: &[Setting], noise: &Noise) -> Result<PredictedError, PlaneError> {
        let pixels = Pixels::new(self.timing, &self.prior, settings, self.timing.camera_rows() / 2)?;
        let light = pixels.light(settings, self.timing);
        let whole = pixels.solve_all(&light, None);
        let free = whole.mapv(|light| light > 0.0);
        let unspoilt = whole.select(Axis(1), &pixels.own_slots);
        let solve =
            |light: &Array2<f64>| pixels.solve_all(light, Some(&free)).select(Axis(1), &pixels.own_slots);
        let bias = vec![&unspoilt - &pixels.truth];
        let draws = (0..DRAWS).map(|draw| solve(&noise.added(settings, &light, draw)) - &unspoilt);
        let draws: Vec<Array2<f64>> = draws.map(|error| error / (DRAWS as f64).sqrt()).collect();
        let wrong = self.calibrated.wrong_settings(settings, self.timing.row_time_us(), noise.frames);
        let wrong = wrong.iter().map(|changed| {
            let mut light = light.clone();
            for (index, setting) in changed {
                light.column_mut(*index).assign(&pixels.light_of(setting, self.timing));
            }
            solve(&light) - &unspoilt
        });
        let [random, bias, calibration] = [draws, bias, wrong.collect()].map(Errors);
        let all = [&random, &bias, &calibration];
        Ok(PredictedError {
            total: pixels.over_scenes(&all, Division::Rows),
            noise: pixels.over_scenes(&[&random], Division::Rows),
            bias: pixels.over_scenes(&[&bias], Division::Rows),
            calibration: pixels.over_scenes(&[&calibration], Division::Rows),
            band: pixels.over_scenes(&all, Division::DirectBand),
        })
    }
}

/// Independent errors of the estimates of all pixels, each `[pixels, own slots]`; their squares add up.
struct Errors(Vec<Array2<f64>>);

/// What errors and light are counted by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Division {
    /// Each row by itself.
    Rows,
    /// Rows up to [`DIRECT_BAND_ROWS`] away as one.
    DirectBand,
}

/// The pixels of the family, and the problem that each of them poses.
#[derive(Debug)]
pub(super) struct Pixels {
    /// Light of each projector row, `[pixels, projector rows]`.
    transport: Array2<f64>,
    camera_row: usize,
    pub slots: Vec<Slot>,
    weights: Array2<f64>,
    pub quadratic: Quadratic,
    /// Slots within the reach.
    pub own_slots: Vec<usize>,
    /// Those of `own_slots` within the direct band.
    direct_band: Vec<usize>,
    /// Light in these slots, `[pixels, own slots]`.
    pub truth: Array2<f64>,
}

impl Pixels {
    /// The family as seen by the pixels of a camera row.
    pub fn new(
        timing: &RowTiming,
        prior: &Prior,
        settings: &[Setting],
        camera_row: usize,
    ) -> Result<Self, PlaneError> {
        let RowModel { slots, weights } =
            RowModel::typical(timing, settings, &reach(timing, settings)?, camera_row);
        let quadratic = Quadratic::new(weights.view(), &slots, prior)?;
        let profiles: Vec<FamilyPixel> = family().concat();
        let own_slots: Vec<usize> =
            (0..slots.len()).filter(|&slot| slots[slot].kind == SlotKind::Own).collect();
        let is_direct = |&place: &usize| slots[own_slots[place]].u.abs() <= DIRECT_BAND_ROWS;
        let direct_band = (0..own_slots.len()).filter(is_direct).collect();
        let truth = Array2::from_shape_fn((profiles.len(), own_slots.len()), |(pixel, slot)| {
            profiles[pixel].light(slots[own_slots[slot]].u)
        });
        let (_, own_row) = timing.typical_weights(camera_row, &settings[0]);
        let transport = Array2::from_shape_fn((profiles.len(), timing.projector_rows()), |(pixel, v)| {
            profiles[pixel].light(v as i32 - own_row as i32)
        });
        Ok(Self { transport, camera_row, slots, weights, quadratic, own_slots, direct_band, truth })
    }

    /// Noise-free images, `[pixels, settings]`.
    pub fn light(&self, settings: &[Setting], timing: &RowTiming) -> Array2<f64> {
        let mut light = Array2::zeros((self.transport.nrows(), settings.len()));
        for (mut light, setting) in light.columns_mut().into_iter().zip(settings) {
            light.assign(&self.light_of(setting, timing));
        }
        light
    }

    /// The light of each pixel with a setting; rows beyond the reach send light, too.
    fn light_of(&self, setting: &Setting, timing: &RowTiming) -> Array1<f64> {
        let (weights, _) = timing.typical_weights(self.camera_row, setting);
        self.transport.dot(&Array1::from(weights))
    }

    /// Estimates of all slots, `[pixels, slots]`; the search starts from the free slots of similar estimates.
    pub fn solve_all(&self, light: &Array2<f64>, near: Option<&Array2<bool>>) -> Array2<f64> {
        let linear = self.quadratic.linear(self.weights.view(), light.view());
        let runs = vec![PIXELS_PER_SCENE; light.nrows() / PIXELS_PER_SCENE];
        let start = near.map_or(Start::Runs(&runs), |free| Start::Free(free.view()));
        minimise(SimdLevel::best(), &self.quadratic, linear, &start)
    }

    /// Squared norm of each pixel's rows.
    fn squares(&self, rows: &Array2<f64>, division: Division) -> Array1<f64> {
        let all = (rows * rows).sum_axis(Axis(1));
        match division {
            Division::Rows => all,
            Division::DirectBand => {
                let band = rows.select(Axis(1), &self.direct_band);
                all - (&band * &band).sum_axis(Axis(1)) + band.sum_axis(Axis(1)).mapv(|sum| sum * sum)
            }
        }
    }

    /// The relative error over the scenes: for each the root of the median of its pixels' squares.
    fn over_scenes(&self, errors: &[&Errors], division: Division) -> Spread {
        let mut squares = Array1::zeros(self.truth.nrows());
        for error in errors.iter().flat_map(|errors| &errors.0) {
            squares += &self.squares(error, division);
        }
        squares /= &self.squares(&self.truth, division);
        let scene = |squares: ArrayView1<f64>| {
            let mut squares = squares.to_vec();
            squares.sort_by(f64::total_cmp);
            squares[squares.len() / 2].sqrt()
        };
        Spread::of(squares.axis_chunks_iter(Axis(0), PIXELS_PER_SCENE).map(scene).collect())
    }
}
