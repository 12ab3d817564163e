use std::ops::{Range, RangeInclusive};

use ndarray::{Array2, Array3, ArrayView1, Axis};
use rayon::prelude::*;

use super::super::super::PlaneError;
use super::super::super::model::{FIRST_RESPONSE_ROW, PixelResponse, RESPONSE_ROWS};
use super::place::{PHASES, Phases, RowPlaces};
use super::{ImagesError, SensorNoise, WhiteMap, check_frames, check_shape, median};

/// The drawn rows of a response, relative to the row nearest to the pixel's place.
const ROWS: RangeInclusive<i32> = FIRST_RESPONSE_ROW..=FIRST_RESPONSE_ROW + RESPONSE_ROWS as i32 - 1;

/// The pictures from which a response is made: one for each of its rows, and the black one, which is subtracted from all.
pub(in super::super) const PICTURES: usize = RESPONSE_ROWS + 1;
/// A pixel's own row is at this index of its response.
const OWN: i32 = -FIRST_RESPONSE_ROW;
/// Counts are averaged over this many camera rows above and below.
pub(super) const REACH_ROWS: usize = 10;
/// Counts are averaged over at most this many columns to the left and right.
pub(super) const REACH_COLUMNS: usize = 4;
/// Pixels are averaged whose places differ by whole rows to within this.
const MOST_SHIFT_ROWS: f32 = 0.05;
/// The sum of the pictures may differ from white by this share.
const MOST_SUM_ERROR: f64 = 0.02;
/// Share of the pixels that may see two separate peaks.
const MOST_TWO_PEAKS: f64 = 0.05;
/// A second peak has this share of the first, and light between them falls to `VALLEY` of the second.
const SECOND_PEAK: f32 = 0.2;
const VALLEY: f32 = 0.7;
/// Rows within which light of a row is near.
const NEAR_ROWS: i32 = 6;
/// Second moment of a row that is lit evenly.
const ROW_MOMENT: f64 = 1.0 / 12.0;
/// Share of a row's light that may lie beyond [`NEAR_ROWS`].
const MOST_FAR_LIGHT: f64 = 0.01;

/// How each pixel responds to the projector's rows: the share of its direct light that each drawn row sends.
///
/// The response's centroid is the pixel's place: a shift of one against the other cannot be seen. At the border of the
/// projector's picture, rows that do not exist have no share, and the place is that of the complete response.
#[derive(Debug, Clone, PartialEq)]
pub struct Responses {
    /// Place in projector rows, `[t, s]`; NaN where unlit.
    pub place: Array2<f32>,
    /// Its standard deviation, `[t, s]`.
    pub place_sd: Array2<f32>,
    /// Share of row `round(place) + d` for each `d` from -7 to 8, `[16, t, s]`. Sums to 1; NaN where unlit.
    pub response: Array3<f32>,
    /// Its standard deviation, `[16, t, s]`.
    pub response_sd: Array3<f32>,
    /// Noise of the pictures from which it is averaged: the standard deviation of the pixel alone in the picture of each of
    /// these rows, and last in the black one, which is subtracted from all, as shares of its light, `[17, t, s]`. 0 for
    /// rows that do not exist.
    pub picture_sd: Array3<f32>,
    /// What the images say about projector and board.
    pub checks: ResponseChecks,
}

/// Figures that show whether the projector draws its picture row by row, and the board is sharp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResponseChecks {
    /// Median of the sum of the 16 pictures over white: 1.
    pub sum_of_phases: f64,
    /// Share of the pixels that see two separate peaks: 0.
    pub two_peaks: f64,
    /// Median share of a row's light beyond 6 rows: 0.
    pub far_light: f64,
    /// Root mean square difference of single pixels' places from the smooth map.
    pub place_rms_rows: f64,
}

impl ResponseChecks {
    /// Refuses a projector or a board that is of no use for calibration.
    ///
    /// # Errors
    /// [`ImagesError::SumOfPhases`] beyond 2 %, [`ImagesError::TwoPeaks`] above 5 % of the pixels,
    /// [`ImagesError::FarLight`] above 1 %.
    pub fn check(&self) -> Result<(), ImagesError> {
        // A NaN, for want of lit pixels, is refused too.
        let within = (self.sum_of_phases - 1.0).abs() <= MOST_SUM_ERROR;
        if !within {
            let (sum, limit) = (self.sum_of_phases, MOST_SUM_ERROR);
            return Err(ImagesError::SumOfPhases { pictures: PHASES, sum, limit });
        }
        if self.two_peaks > MOST_TWO_PEAKS {
            return Err(ImagesError::TwoPeaks { share: self.two_peaks, limit: MOST_TWO_PEAKS });
        }
        if self.far_light > MOST_FAR_LIGHT {
            return Err(ImagesError::FarLight { share: self.far_light, limit: MOST_FAR_LIGHT });
        }
        Ok(())
    }
}

impl Responses {
    /// The response for the forward model, which needs one in every pixel: an unlit pixel takes that of the nearest lit
    /// one, at a place that is farther down by as many rows as the pixel is.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] if no pixel is lit, or the shares of a pixel do not add up to 1.
    pub fn pixel_response(&self) -> Result<PixelResponse, PlaneError> {
        let lit: Vec<(usize, usize)> = self
            .place
            .indexed_iter()
            .filter(|(_, place)| place.is_finite())
            .map(|(pixel, _)| pixel)
            .collect();
        let (mut places, mut shares) = (self.place.clone(), self.response.clone());
        let unlit = self.place.indexed_iter().filter(|(_, place)| !place.is_finite());
        for ((t, s), _) in unlit {
            let distance =
                |&&(lit_t, lit_s): &&(usize, usize)| lit_t.abs_diff(t).pow(2) + lit_s.abs_diff(s).pow(2);
            let Some(&(lit_t, lit_s)) = lit.iter().min_by_key(distance) else { break };
            places[[t, s]] = self.place[[lit_t, lit_s]] + (t as f32 - lit_t as f32);
            shares.slice_mut(ndarray::s![.., t, s]).assign(&self.response.slice(ndarray::s![
                ..,
                lit_t,
                lit_s
            ]));
        }
        PixelResponse::new(places, shares)
    }

    /// Averages the counts of each row over pixels with the same fraction of a row, within 10 camera rows and 4 columns to
    /// either side, and divides by their sum. A line removes what is left of a difference in place between camera rows.
    /// Standard deviations are those of the scatter between the camera rows, so that they contain the unevenness of the
    /// projector's rows as well as noise.
    ///
    /// # Errors
    /// [`ImagesError::Shape`], [`ImagesError::TooFew`] if no pixel has neighbours to average with. The checks are
    /// separate: see [`ResponseChecks::check`].
    pub fn new(
        phases: &Phases,
        white: &WhiteMap,
        places: &RowPlaces,
        projector_rows: usize,
    ) -> Result<Self, ImagesError> {
        let shape = places.place.dim();
        let (rows, columns) = shape;
        check_frames(phases.frames, 1)?;
        check_shape("phases", "[pictures, t, s]", phases.images.shape(), &[PHASES, rows, columns])?;
        check_shape("white_dn", "[t, s]", white.white_dn.shape(), &[rows, columns])?;
        let window = Window {
            light: by_pixel(phases),
            place: &places.place,
            noise: white.noise,
            frames: [phases.frames, white.black_frames],
            projector_rows,
        };
        let mut place = Array2::from_elem(shape, f32::NAN);
        let mut place_sd = place.clone();
        let mut response = Array3::from_elem((PHASES, rows, columns), f32::NAN);
        let mut response_sd = response.clone();
        let mut picture_sd = Array3::from_elem((PICTURES, rows, columns), f32::NAN);
        place
            .axis_iter_mut(Axis(0))
            .into_par_iter()
            .zip(place_sd.axis_iter_mut(Axis(0)))
            .zip(response.axis_iter_mut(Axis(1)).into_par_iter().zip(response_sd.axis_iter_mut(Axis(1))))
            .zip(picture_sd.axis_iter_mut(Axis(1)))
            .enumerate()
            .for_each(
                |(t, (((mut place, mut place_sd), (mut response, mut response_sd)), mut picture_sd))| {
                    for s in 0..columns {
                        if let Some(pixel) = window.pixel(t, s) {
                            place[s] = pixel.place;
                            place_sd[s] = pixel.place_sd;
                            response.column_mut(s).assign(&ArrayView1::from(&pixel.response));
                            response_sd.column_mut(s).assign(&ArrayView1::from(&pixel.response_sd));
                            picture_sd.column_mut(s).assign(&ArrayView1::from(&pixel.picture_sd));
                        }
                    }
                },
            );
        if place.iter().all(|place| place.is_nan()) {
            let what = "lit pixels with lit neighbours";
            let cure = "fill the view with the board";
            return Err(ImagesError::TooFew { what, given: 0, needed: 1, cure });
        }
        let checks = ResponseChecks {
            sum_of_phases: sum_of_phases(&window, white),
            place_rms_rows: places.rms,
            ..checks(&response)
        };
        Ok(Self { place, place_sd, response, response_sd, picture_sd, checks })
    }

    /// Standard deviation of the width of a response relative to itself: the median over the lit pixels. The shares are
    /// taken as independent.
    pub fn width_sd(&self) -> f64 {
        let relative = |(t, s): (usize, usize)| {
            let (shares, sds) =
                (self.response.slice(ndarray::s![.., t, s]), self.response_sd.slice(ndarray::s![.., t, s]));
            let moment = |power: i32| -> f64 {
                shares.iter().zip(ROWS).map(|(&share, d)| f64::from(share) * f64::from(d).powi(power)).sum()
            };
            let (centroid, variance) = (moment(1), self.second_moment(t, s));
            let of_row = |(&sd, d): (&f32, i32)| {
                (f64::from(sd) * ((f64::from(d) - centroid).powi(2) - variance)).powi(2)
            };
            // The width is the root of the variance.
            sds.iter().zip(ROWS).map(of_row).sum::<f64>().sqrt() / (2.0 * variance)
        };
        self.median_of(relative)
    }

    /// By how much light that spreads inside the board with this second moment, in rows^2, widens a response, relative to
    /// itself: the median over the lit pixels. A response is at least as wide as a row.
    pub fn widened_by(&self, moment: f64) -> f64 {
        self.median_of(|(t, s)| moment / (2.0 * self.second_moment(t, s).max(ROW_MOMENT)))
    }

    fn median_of(&self, of_pixel: impl Fn((usize, usize)) -> f64) -> f64 {
        let values = ndarray::indices(self.place.dim()).into_iter().map(of_pixel);
        median(&mut values.filter(|value| value.is_finite()).collect::<Vec<_>>()).unwrap_or(0.0)
    }

    /// Second central moment of a pixel's response, in rows^2; NaN where unlit.
    pub(super) fn second_moment(&self, t: usize, s: usize) -> f64 {
        let [mut first, mut second] = [0.0; 2];
        for (&share, d) in self.response.slice(ndarray::s![.., t, s]).iter().zip(ROWS) {
            first += f64::from(share) * f64::from(d);
            second += f64::from(share) * f64::from(d).powi(2);
        }
        second - first * first
    }
}

/// The pictures with the light of one pixel together, `[t, s]`.
fn by_pixel(phases: &Phases) -> Array2<[f32; PHASES]> {
    let (_, rows, columns) = phases.images.dim();
    let mut light = Array2::from_elem((rows, columns), [0.0; PHASES]);
    light.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut light)| {
        for (phase, image) in phases.images.axis_iter(Axis(0)).enumerate() {
            light.iter_mut().zip(image.row(t)).for_each(|(light, &image)| light[phase] = image);
        }
    });
    light
}

/// What a pixel's response is averaged from.
struct Window<'a> {
    /// `[t, s]`.
    light: Array2<[f32; PHASES]>,
    place: &'a Array2<f32>,
    noise: SensorNoise,
    /// Number of frames in the picture of each row, and in the black one.
    frames: [usize; 2],
    projector_rows: usize,
}

struct Pixel {
    place: f32,
    place_sd: f32,
    response: [f32; PHASES],
    response_sd: [f32; PHASES],
    picture_sd: [f32; PICTURES],
}

/// Mean counts of one camera row's pixels, by relative row.
#[derive(Clone, Copy)]
struct RowMean {
    counts: [f64; PHASES],
    pixels: f64,
    /// Mean of what their places differ by from a whole number of rows.
    shift_rows: f64,
    /// Projector row that corresponds to the pixel's own.
    own_row: i32,
}

impl Window<'_> {
    fn pixel(&self, t: usize, s: usize) -> Option<Pixel> {
        let place = self.place[[t, s]];
        if place.is_nan() {
            return None;
        }
        let own_row = place.round() as i32;
        let empty = RowMean { counts: [0.0; PHASES], pixels: 0.0, shift_rows: 0.0, own_row };
        let mut means = [empty; 2 * REACH_ROWS + 1];
        let mut used = 0;
        for row in near_rows(t, self.place.nrows()) {
            if let Some(mean) = self.row(row, s, place) {
                means[used] = mean;
                used += 1;
            }
        }
        // A line through two camera rows leaves no scatter to judge by.
        (used > 2).then(|| self.average(&means[..used], own_row)).flatten()
    }

    /// The pixels of a camera row whose places differ from `place` by as many whole rows as that in column `s`.
    fn row(&self, t: usize, s: usize, place: f32) -> Option<RowMean> {
        let places = self.place.row(t);
        let steps = (places[s] - place).round();
        // NaN, which stands for an unlit pixel, fails.
        let shift = |column: usize| {
            Some(places[column] - place - steps).filter(|shift| shift.abs() <= MOST_SHIFT_ROWS)
        };
        let mut by_phase = [0.0_f32; PHASES];
        let (mut pixels, mut shifts) = (0, 0.0);
        let mut add = |column: usize, shift: f32| {
            shifts += shift;
            pixels += 1;
            by_phase.iter_mut().zip(&self.light[[t, column]]).for_each(|(sum, light)| *sum += light);
        };
        add(s, shift(s)?);
        for [left, right] in column_pairs(s, places.len()) {
            if let (Some(of_left), Some(of_right)) = (shift(left), shift(right)) {
                add(left, of_left);
                add(right, of_right);
            }
        }
        let own_row = place.round() as i32 + steps as i32;
        let n = f64::from(pixels);
        Some(RowMean {
            counts: std::array::from_fn(|index| f64::from(by_phase[phase(own_row + index as i32 - OWN)]) / n),
            pixels: n,
            shift_rows: f64::from(shifts) / n,
            own_row,
        })
    }

    fn exists(&self, row: i32) -> bool {
        (0..self.projector_rows as i32).contains(&row)
    }

    /// Counts of each relative row at the pixel's own place, by a line over the shift, as shares of their sum.
    fn average(&self, means: &[RowMean], own_row: i32) -> Option<Pixel> {
        // At the border of the picture, a relative row is averaged over those pixels only for which it is drawn.
        let drawn = |row: &RowMean, index: usize| self.exists(row.own_row + index as i32 - OWN);
        let mut sums = [[0.0; 5]; PHASES];
        for row in means {
            let (n, x) = (row.pixels, row.shift_rows);
            for (index, sum) in sums.iter_mut().enumerate().filter(|(index, _)| drawn(row, *index)) {
                let y = row.counts[index];
                let terms = [1.0, x, x * x, y, x * y];
                sum.iter_mut().zip(terms).for_each(|(sum, term)| *sum += n * term);
            }
        }
        let lines = sums.map(Line::new);
        let total: f64 = lines.iter().map(|line| line.counts).sum();
        if total.is_nan() || total <= 0.0 {
            return None;
        }
        let share = lines.map(|line| line.counts / total);
        let centroid: f64 = share.iter().zip(ROWS).map(|(share, d)| share * f64::from(d)).sum();
        // What each camera row contributes to the deviation of each share, and of the centroid.
        let (mut squares, mut centroid_square) = ([0.0; PHASES], 0.0);
        for row in means {
            let mut deviation = [0.0; PHASES];
            for index in (0..PHASES).filter(|&index| drawn(row, index)) {
                deviation[index] = lines[index].deviation(row, index) / total;
            }
            let common: f64 = deviation.iter().sum();
            let mut moment = 0.0;
            for (index, d) in ROWS.enumerate() {
                squares[index] += (deviation[index] - share[index] * common).powi(2);
                moment += deviation[index] * (f64::from(d) - centroid);
            }
            centroid_square += moment * moment;
        }
        // Few rows underestimate the scatter half of the time: the factor makes 68 % of the errors smaller (Student).
        let degrees = (means.len() - 2) as f64;
        let factor = ((degrees + 2.0) / degrees).sqrt() * (1.0 + 0.55 / degrees);
        let place = f64::from(own_row) + centroid;
        // The response refers to the row nearest to the new place.
        let moved = (place as f32).round() as i32 - own_row;
        let turned = |values: &[f64; PHASES]| -> [f64; PHASES] {
            std::array::from_fn(|index| values[phase(index as i32 + moved)])
        };
        let mut response = turned(&share);
        for (share, d) in response.iter_mut().zip(ROWS) {
            if !self.exists(own_row + moved + d) {
                *share = 0.0;
            }
        }
        let kept: f64 = response.iter().sum();
        Some(Pixel {
            place: place as f32,
            place_sd: (factor * centroid_square.sqrt()) as f32,
            response: response.map(|share| (share / kept) as f32),
            response_sd: turned(&squares).map(|square| (factor * square.sqrt() / kept) as f32),
            picture_sd: std::array::from_fn(|picture| {
                self.picture_sd(&response, picture, own_row + moved, total)
            }),
        })
    }

    /// Noise of a pixel alone in one picture of its response about `own_row`, as a share of its light of `total_dn`.
    fn picture_sd(&self, shares: &[f64; PHASES], picture: usize, own_row: i32, total_dn: f64) -> f32 {
        let [frames, black_frames] = self.frames;
        let variance_dn2 = match shares.get(picture) {
            Some(share) if self.exists(own_row + picture as i32 - OWN) => {
                self.noise.variance_dn2(share * total_dn) / frames as f64
            }
            Some(_) => 0.0,
            None => self.noise.variance_dn2(0.0) / black_frames as f64,
        };
        (variance_dn2.sqrt() / total_dn) as f32
    }
}

/// A slope takes shifts of this many rows to be determined; below, it counts as 0.
const LEAST_SPREAD_ROWS: f64 = 0.01;

/// Counts of one relative row as a line over the shift.
#[derive(Clone, Copy)]
struct Line {
    /// At shift 0.
    counts: f64,
    per_row: f64,
    /// Sums over the camera rows of 1, shift and shift^2, weighted with their pixels, and the determinant.
    sums: [f64; 3],
    determinant: f64,
}

impl Line {
    /// From the weighted sums of 1, x, x^2, y, xy.
    fn new([n, x, xx, y, xy]: [f64; 5]) -> Self {
        let xx = xx + n * LEAST_SPREAD_ROWS.powi(2);
        let determinant = n * xx - x * x;
        let (mut counts, mut per_row) = (0.0, 0.0);
        if determinant > 0.0 {
            counts = (xx * y - x * xy) / determinant;
            per_row = (n * xy - x * y) / determinant;
        }
        Self { counts, per_row, sums: [n, x, xx], determinant }
    }

    /// What the deviation of one camera row from the line adds to the counts at shift 0.
    fn deviation(&self, row: &RowMean, index: usize) -> f64 {
        let [_, x, xx] = self.sums;
        let weight = row.pixels * (xx - row.shift_rows * x) / self.determinant;
        weight * (row.counts[index] - self.counts - self.per_row * row.shift_rows)
    }
}

/// The camera rows that are averaged with one.
pub(in super::super) fn near_rows(row: usize, rows: usize) -> Range<usize> {
    row.saturating_sub(REACH_ROWS)..(row + REACH_ROWS + 1).min(rows)
}

/// The columns that are averaged with one, in pairs of which both or neither is used: a board that is turned against the
/// camera moves a mean over one side.
pub(in super::super) fn column_pairs(column: usize, columns: usize) -> impl Iterator<Item = [usize; 2]> {
    let reach = REACH_COLUMNS.min(column).min(columns - 1 - column);
    (1..=reach).map(move |away| [column - away, column + away])
}

/// The picture in which a row is lit.
fn phase(row: i32) -> usize {
    row.rem_euclid(PHASES as i32) as usize
}

fn sum_of_phases(window: &Window, white: &WhiteMap) -> f64 {
    let pixels = white.white_dn.indexed_iter().filter(|(at, _)| !window.place[*at].is_nan());
    let ratios = pixels.map(|((t, s), &white)| {
        let sum: f32 = window.light[[t, s]].iter().sum();
        f64::from(sum / white)
    });
    let mut ratios: Vec<f64> = ratios.filter(|ratio| ratio.is_finite()).collect();
    median(&mut ratios).unwrap_or(f64::NAN)
}

/// Shares of pixels with two peaks, and of far light.
fn checks(response: &Array3<f32>) -> ResponseChecks {
    let mut far = Vec::new();
    let mut two_peaks = 0;
    for shares in response.lanes(Axis(0)) {
        if shares[0].is_nan() {
            continue;
        }
        let beyond = shares.iter().zip(ROWS).filter(|(_, d)| d.abs() > NEAR_ROWS);
        far.push(beyond.map(|(&share, _)| f64::from(share)).sum());
        two_peaks += usize::from(has_two_peaks(shares));
    }
    let two_peaks = two_peaks as f64 / far.len().max(1) as f64;
    let far_light = median(&mut far).unwrap_or(f64::NAN);
    ResponseChecks { sum_of_phases: f64::NAN, two_peaks, far_light, place_rms_rows: f64::NAN }
}

/// Whether there is a second maximum with less light between it and the first.
fn has_two_peaks(shares: ArrayView1<f32>) -> bool {
    let Some(first) = (0..PHASES).max_by(|&a, &b| shares[a].total_cmp(&shares[b])) else { return false };
    rises_again(shares, first, first + 1..PHASES) || rises_again(shares, first, (0..first).rev())
}

/// Whether light rises again from a valley on the way from the brightest row outwards.
fn rises_again(shares: ArrayView1<f32>, first: usize, mut outwards: impl Iterator<Item = usize>) -> bool {
    let mut lowest = shares[first];
    outwards.any(|index| {
        lowest = lowest.min(shares[index]);
        shares[index] > SECOND_PEAK * shares[first] && lowest < VALLEY * shares[index]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unlit_pixels_take_the_response_of_the_nearest_lit_one() {
        let place =
            Array2::from_shape_vec((2, 3), vec![10.2, 10.3, f32::NAN, 11.2, f32::NAN, f32::NAN]).unwrap();
        let response =
            Array3::from_shape_fn((RESPONSE_ROWS, 2, 3), |(d, t, s)| match place[[t, s]].is_finite() {
                true => f32::from(u8::from(d == 7 + s)),
                false => f32::NAN,
            });
        let checks =
            ResponseChecks { sum_of_phases: 1.0, two_peaks: 0.0, far_light: 0.0, place_rms_rows: 0.0 };
        let (place_sd, response_sd) = (place.clone(), response.clone());
        let picture_sd = Array3::zeros((PICTURES, 2, 3));
        let responses = Responses { place, place_sd, response, response_sd, picture_sd, checks };
        let filled = responses.pixel_response().unwrap();
        assert_eq!(filled.places().as_slice().unwrap(), [10.2, 10.3, 10.3, 11.2, 11.3, 11.3]);
        assert_eq!(filled.shares()[[8, 0, 2]], 1.0);
        assert_eq!(filled.shares()[[8, 1, 2]], 1.0);
    }
}
