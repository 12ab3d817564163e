//! A projector, a white board and a camera, simulated pixel by pixel: each drawn row sends its light evenly over its
//! dwell, and the camera counts electrons. It shares no code with the estimator.

use ndarray::{Array2, Array3, ArrayView2, s};
use rand_distr::{Distribution, Normal, Uniform};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_transport::plane::NoiseModel;
use raysweep_transport::plane::board::images::{ResponseChecks, Responses};
use raysweep_transport::plane::board::times::{BoardSetting, ExposureMode, Nominal};

pub const WHITE_DN: f64 = 2500.0;
pub const ELECTRONS_PER_DN: f64 = 1.66;
pub const READ_NOISE_ELECTRONS: f64 = 9.0;
const PERIOD_US: f64 = 50_000.0 / 3.0;
/// A drawn row reaches from half a row above its centre to 1.2 rows below it.
const BEAM_ABOVE: f64 = 0.5;
const BEAM_BELOW: f64 = 1.2;

#[derive(Debug, Clone, Copy)]
pub enum Jitter {
    Normal(f64),
    /// Half the range.
    Uniform(f64),
}

/// How the light of a row travels over the columns, in row times over the projector's width, on even and odd rows.
pub type Slopes = [f64; 2];

#[derive(Debug, Clone)]
pub struct Case {
    pub seed: u64,
    /// First row and number of rows that the camera sees.
    pub window: (usize, usize),
    pub columns: usize,
    pub row_time_us: f64,
    pub camera_row_time_us: f64,
    /// How much less the camera says, as a share of it.
    pub camera_row_error: f64,
    /// How much later than nominal all light is.
    pub latency_us: f64,
    pub mode_offset_us: f64,
    pub exposure_offset_us: f64,
    /// How early the middle of the sweep is, as a share of the sweep.
    pub bend: f64,
    pub kinks_us: f64,
    pub jitter: Jitter,
    /// Exposures are whole multiples of this.
    pub exposure_step_us: f64,
    /// Whether the delay acts on global exposures.
    pub global_delay_acts: bool,
    pub slopes: Slopes,
    /// Standard deviation of the brightness of drawn rows.
    pub unevenness: f64,
    /// Noise of a pixel in the picture of a row, as a share of its light; half of it in the black picture, of which there are
    /// more frames.
    pub picture_noise: f64,
}

impl Case {
    /// All 720 rows.
    pub fn full(seed: u64) -> Self {
        Self {
            seed,
            window: (0, 720),
            columns: 12,
            row_time_us: 22.22,
            camera_row_time_us: 22.31,
            camera_row_error: 0.002,
            latency_us: 8.0,
            mode_offset_us: 6.5,
            exposure_offset_us: 3.2,
            bend: 0.02,
            kinks_us: 20.0,
            jitter: Jitter::Normal(5.0),
            exposure_step_us: 0.0,
            global_delay_acts: true,
            slopes: [0.0, 0.0],
            unevenness: 0.01,
            picture_noise: 0.002,
        }
    }

    /// 128 rows in the middle of the raster.
    pub fn window(seed: u64) -> Self {
        Self { window: (296, 128), ..Self::full(seed) }
    }
}

/// What the rig is, and what it says of itself.
pub struct Rig {
    case: Case,
    /// True row starts.
    pub starts_us: Vec<f64>,
    /// Position of each pixel, in rows.
    centres: Array2<f64>,
    brightness: Vec<f64>,
    white_dn: Array2<f64>,
    /// White as it has been measured.
    white_map_dn: Array2<f64>,
    pub responses: Responses,
    random: Xoshiro256PlusPlus,
    pub jitters_us: Vec<f64>,
}

pub const PROJECTOR_ROWS: usize = 720;

impl Rig {
    pub fn new(case: Case) -> Self {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(case.seed);
        let unit = Normal::new(0.0, 1.0).unwrap();
        let even = Uniform::new(-1.0, 1.0).unwrap();
        // The sweep: a straight line, early in the middle, with a kink every 90 rows.
        let kinks: Vec<f64> = (0..=8).map(|_| case.kinks_us * even.sample(&mut random)).collect();
        let sweep_us = PROJECTOR_ROWS as f64 * case.row_time_us;
        let starts_us = (0..=PROJECTOR_ROWS)
            .map(|v| {
                let x = v as f64 / PROJECTOR_ROWS as f64;
                let piece = (v / 90).min(7);
                let within = v as f64 / 90.0 - piece as f64;
                let kink = kinks[piece] + within * (kinks[piece + 1] - kinks[piece]);
                v as f64 * case.row_time_us - case.bend * sweep_us * 4.0 * x * (1.0 - x)
                    + kink
                    + nominal_first_row_us()
                    + case.latency_us
            })
            .collect();
        let (first, rows) = case.window;
        let shape = (rows, case.columns);
        // Rotated by 0.9 rows over the image's width, and bent by 0.4.
        let centres = Array2::from_shape_fn(shape, |(t, s)| {
            let (y, x) = (t as f64 / rows as f64, (s as f64 + 0.5) / case.columns as f64 - 0.5);
            first as f64 + t as f64 + 0.3 + 0.9 * x + 0.4 * (3.0 * y).sin()
        });
        let brightness: Vec<f64> =
            (0..PROJECTOR_ROWS).map(|_| 1.0 + case.unevenness * unit.sample(&mut random)).collect();
        let white_dn = Array2::from_shape_fn(shape, |(t, s)| {
            let (y, x) = (t as f64 / rows as f64 - 0.5, s as f64 / case.columns as f64 - 0.5);
            let shade = 1.0 - 0.3 * (x * x + y * y);
            let light: f64 = seen_rows(centres[[t, s]]).map(|(v, share)| brightness[v] * share).sum();
            WHITE_DN * shade * light * (1.0 + 0.01 * unit.sample(&mut random))
        });
        // 32 frames of white.
        let white_map_dn = white_dn.mapv(|dn| {
            let electrons = dn * ELECTRONS_PER_DN;
            let noise = ((electrons + READ_NOISE_ELECTRONS.powi(2)) / 32.0).sqrt();
            (electrons + noise * unit.sample(&mut random)) / ELECTRONS_PER_DN
        });
        let lit = |t: usize, s: usize| seen_rows(centres[[t, s]]).map(|(_, share)| share).sum::<f64>() > 0.3;
        let place = Array2::from_shape_fn(shape, |(t, s)| {
            let centre = centres[[t, s]] - (BEAM_BELOW - BEAM_ABOVE) / 2.0;
            if lit(t, s) { centre as f32 } else { f32::NAN }
        });
        let pictures = PictureNoise { row: case.picture_noise, black: case.picture_noise / 2.0 };
        let errors = pictures.errors(shape, &mut random);
        let mut responses = pictures.unmeasured(&place);
        for ((t, s), &place) in place.indexed_iter().filter(|(_, place)| place.is_finite()) {
            let mut shares = [0.0; 16];
            for (v, share) in seen_rows(centres[[t, s]]) {
                shares[(v as i64 - place.round() as i64 + 7) as usize] += share;
            }
            shares.iter_mut().zip(errors.slice(s![.., t, s])).for_each(|(share, error)| *share += error);
            set_response(&mut responses, (t, s), &shares);
        }
        let jitters_us = Vec::new();
        Self { case, starts_us, centres, brightness, white_dn, white_map_dn, responses, random, jitters_us }
    }

    /// What is known before the calibration: no latency, an even sweep, a row time 0.2 % off.
    pub fn nominal(&self) -> Nominal {
        Nominal {
            projector_rows: PROJECTOR_ROWS,
            first_row_us: nominal_first_row_us(),
            row_time_us: self.case.row_time_us * 1.002,
            camera_row_time_us: self.case.camera_row_time_us * (1.0 - self.case.camera_row_error),
            period_us: PERIOD_US,
        }
    }

    /// The noise of a pixel of white, in shares of white.
    pub fn noise(&self) -> NoiseModel {
        let white_electrons = WHITE_DN * ELECTRONS_PER_DN;
        NoiseModel {
            read_variance: (READ_NOISE_ELECTRONS / white_electrons).powi(2),
            gain: 1.0 / white_electrons,
        }
    }

    /// Takes one frame of white.
    pub fn frame(&mut self, setting: BoardSetting) -> Array2<f32> {
        self.picture(setting, |_| true)
    }

    /// Takes one frame of a picture in which some rows are white.
    pub fn picture(&mut self, setting: BoardSetting, white: impl Fn(usize) -> bool) -> Array2<f32> {
        let jitter_us = match self.case.jitter {
            Jitter::Normal(sd_us) => Normal::new(0.0, sd_us).unwrap().sample(&mut self.random),
            Jitter::Uniform(half_us) => Uniform::new(-half_us, half_us).unwrap().sample(&mut self.random),
        };
        self.late_picture(setting, jitter_us, white)
    }

    pub fn late_picture(
        &mut self,
        setting: BoardSetting,
        late_us: f64,
        white: impl Fn(usize) -> bool,
    ) -> Array2<f32> {
        self.jitters_us.push(late_us);
        let case = &self.case;
        let exposure_us = match case.exposure_step_us > 0.0 {
            true => (setting.exposure_us / case.exposure_step_us).round() * case.exposure_step_us,
            false => setting.exposure_us,
        } + case.exposure_offset_us;
        let unit = Normal::new(0.0, 1.0).unwrap();
        Array2::from_shape_fn(self.centres.dim(), |(t, s)| {
            let opens_us = match setting.shutter {
                ExposureMode::Rolling => setting.delay_us + t as f64 * case.camera_row_time_us,
                ExposureMode::Global if case.global_delay_acts => setting.delay_us + case.mode_offset_us,
                ExposureMode::Global => case.mode_offset_us,
            };
            let closes_us = opens_us + exposure_us;
            let column = (s as f64 + 0.5) / case.columns as f64;
            let (mut light, mut full) = (0.0, 0.0);
            for (v, share) in seen_rows(self.centres[[t, s]]) {
                full += self.brightness[v] * share;
                if !white(v) {
                    continue;
                }
                let (mut from_us, mut to_us) = (self.starts_us[v] + late_us, self.starts_us[v + 1] + late_us);
                let slope = case.slopes[v % 2];
                if slope != 0.0 {
                    // A spot of a 50th of the width.
                    let x = if slope > 0.0 { column } else { 1.0 - column };
                    let (start_us, row_us) = (from_us, to_us - from_us);
                    from_us = start_us + row_us * (x - 0.01);
                    to_us = start_us + row_us * (x + 0.01);
                }
                for period in -1..=1 {
                    let shift_us = f64::from(period) * PERIOD_US;
                    let open_us = (to_us + shift_us).min(closes_us) - (from_us + shift_us).max(opens_us);
                    light += self.brightness[v] * share * open_us.max(0.0) / (to_us - from_us);
                }
            }
            if full == 0.0 {
                return 0.0;
            }
            let electrons = self.white_dn[[t, s]] * light / full * ELECTRONS_PER_DN;
            let noise = (electrons + READ_NOISE_ELECTRONS.powi(2)).sqrt();
            let dn = ((electrons + noise * unit.sample(&mut self.random)) / ELECTRONS_PER_DN).round();
            (dn / self.white_map_dn[[t, s]]) as f32
        })
    }

    pub fn case(&self) -> &Case {
        &self.case
    }
}

/// Noise of a single pixel in the pictures from which responses are made, as a share of its light. Each response is averaged
/// over 21 rows and 9 columns, fewer at the edges, so that neighbours err alike, and the black picture is subtracted from
/// all.
pub struct PictureNoise {
    pub row: f64,
    pub black: f64,
}

impl PictureNoise {
    /// Errors of all shares, `[16, t, s]`.
    fn errors(&self, shape: (usize, usize), random: &mut Xoshiro256PlusPlus) -> Array3<f64> {
        let unit = Normal::new(0.0, 1.0).unwrap();
        let mut averaged = |sd: f64| {
            let picture = Array2::from_shape_fn(shape, |_| sd * unit.sample(random));
            Array2::from_shape_fn(shape, |(t, s)| near(&picture, (t, s)).mean().unwrap())
        };
        let black = averaged(self.black);
        let mut errors = Array3::zeros((16, shape.0, shape.1));
        for mut errors in errors.outer_iter_mut() {
            errors.assign(&(averaged(self.row) - &black));
        }
        errors
    }

    /// Responses at these places that state this noise, and have no shares yet.
    fn unmeasured(&self, place: &Array2<f32>) -> Responses {
        let shape = place.dim();
        let of = |picture: usize| if picture < 16 { self.row } else { self.black };
        Responses {
            place: place.clone(),
            place_sd: Array2::zeros(shape),
            response: Array3::zeros((16, shape.0, shape.1)),
            response_sd: Array3::zeros((16, shape.0, shape.1)),
            picture_sd: Array3::from_shape_fn((17, shape.0, shape.1), |(picture, ..)| of(picture) as f32),
            checks: ResponseChecks {
                sum_of_phases: 1.0,
                two_peaks: 0.0,
                far_light: 0.0,
                place_rms_rows: 0.0,
            },
        }
    }

    /// Other pictures of the same board.
    pub fn measured_again(&self, responses: &Responses, seed: u64) -> Responses {
        let errors = self.errors(responses.place.dim(), &mut Xoshiro256PlusPlus::seed_from_u64(seed));
        let mut again = self.unmeasured(&responses.place);
        for (at, _) in responses.place.indexed_iter().filter(|(_, place)| place.is_finite()) {
            let shares = responses.response.slice(s![.., at.0, at.1]).mapv(f64::from)
                + errors.slice(s![.., at.0, at.1]);
            set_response(&mut again, at, shares.as_slice().unwrap());
        }
        again
    }
}

/// The pixels over which a response is averaged.
fn near<T>(image: &Array2<T>, (t, s): (usize, usize)) -> ArrayView2<'_, T> {
    let (rows, columns) = image.dim();
    let aside = 4.min(s).min(columns - 1 - s);
    image.slice(s![t.saturating_sub(10)..(t + 11).min(rows), s - aside..s + aside + 1])
}

fn set_response(responses: &mut Responses, (t, s): (usize, usize), shares: &[f64]) {
    let sum: f64 = shares.iter().sum();
    for (d, share) in shares.iter().enumerate() {
        responses.response[[d, t, s]] = (share / sum) as f32;
    }
}

fn nominal_first_row_us() -> f64 {
    180.0
}

/// The drawn rows that a pixel one row high sees, with their shares of its light.
fn seen_rows(centre: f64) -> impl Iterator<Item = (usize, f64)> {
    let near = (centre - 3.0) as i64..=(centre + 3.0) as i64;
    near.filter(|v| (0..PROJECTOR_ROWS as i64).contains(v)).filter_map(move |v| {
        let from = (v as f64 - BEAM_ABOVE).max(centre - 0.5);
        let to = (v as f64 + BEAM_BELOW).min(centre + 0.5);
        (to > from).then(|| (v as usize, (to - from) / (BEAM_ABOVE + BEAM_BELOW)))
    })
}
