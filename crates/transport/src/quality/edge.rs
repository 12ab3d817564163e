use ndarray::{ArrayView1, ArrayView2};

/// Samples per pixel of the edge's profile, as in the standard.
const OVERSAMPLING: f64 = 4.0;

/// Upper limit of the correction for the finite difference; larger values would only amplify noise.
const MOST_CORRECTION: f64 = 10.0;

/// Why an image does not show a slanted edge.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EdgeError {
    /// Too few pixels.
    #[error(
        "the image of the edge is {rows} x {columns} pixels, but must be at least 8 x 16: choose a larger region"
    )]
    TooSmall {
        /// Number of rows.
        rows: usize,
        /// Number of columns.
        columns: usize,
    },
    /// A row without an edge.
    #[error(
        "row {row} of the image has no edge: choose a region that an edge crosses from the top to the bottom"
    )]
    NoEdge {
        /// The first such row.
        row: usize,
    },
    /// The tilt of the edge does not suit sampling between pixels.
    #[error(
        "the edge moves by {shift_px:.2} pixels from the first row to the last, but must by 1 to its height / 2: \
         tilt it by about 5 degrees from the vertical"
    )]
    Slant {
        /// Shift of the edge from the first row to the last.
        shift_px: f64,
    },
}

/// Modulation transfer across an edge.
#[derive(Debug, Clone, PartialEq)]
pub struct EdgeResponse {
    /// Spatial frequencies in cycles/pixel, from 0 to Nyquist's 0.5.
    pub cycles_per_px: Vec<f64>,
    /// Remaining contrast at each frequency, 1 at 0.
    pub mtf: Vec<f64>,
}

impl EdgeResponse {
    /// The frequency at which half of the contrast remains, in cycles/pixel; `None` if more remains up to Nyquist's.
    pub fn mtf50(&self) -> Option<f64> {
        let below = self.mtf.iter().position(|&mtf| mtf < 0.5)?;
        let (f0, f1) = (self.cycles_per_px[below - 1], self.cycles_per_px[below]);
        let (m0, m1) = (self.mtf[below - 1], self.mtf[below]);
        Some(f0 + (f1 - f0) * (m0 - 0.5) / (m0 - m1))
    }
}

/// Modulation transfer function by the slanted-edge method (ISO 12233 e-SFR; Burns 2000), from a linear image
/// `[rows, columns]` of an edge about 5 degrees off the vertical.
///
/// # Errors
/// [`EdgeError`] if there is no such edge.
pub fn slanted_edge(image: ArrayView2<f32>) -> Result<EdgeResponse, EdgeError> {
    let (rows, columns) = image.dim();
    if rows < 8 || columns < 16 {
        return Err(EdgeError::TooSmall { rows, columns });
    }
    // Found in the whole row first, then again near the line fitted to the rows' edges.
    let mut line = (columns as f64 / 2.0, 0.0);
    for width_px in [4 * columns, columns / 2] {
        let places = image.rows().into_iter().enumerate();
        let places = places.map(|(row, values)| {
            edge_in(values, line.0 + line.1 * row as f64, width_px as f64).ok_or(EdgeError::NoEdge { row })
        });
        line = fitted(&places.collect::<Result<Vec<f64>, _>>()?);
    }
    let shift_px = line.1 * (rows - 1) as f64;
    if !(1.0..=rows as f64 / 2.0).contains(&shift_px.abs()) {
        return Err(EdgeError::Slant { shift_px });
    }

    // Distances perpendicular to the edge, which sample the profile between the pixels.
    let across = 1.0 / line.1.hypot(1.0);
    let distance = |row: usize, column: usize| (column as f64 - line.0 - line.1 * row as f64) * across;
    let reach = (0..rows)
        .map(|row| (-distance(row, 0)).min(distance(row, columns - 1)))
        .fold(f64::INFINITY, f64::min);
    let half = (reach * OVERSAMPLING) as isize;
    let mut profile = vec![(0.0, 0_u32); (2 * half + 1) as usize];
    for ((row, column), &value) in image.indexed_iter() {
        let at = (distance(row, column) * OVERSAMPLING).round() as isize + half;
        if let Some((sum, count)) = usize::try_from(at).ok().and_then(|at| profile.get_mut(at)) {
            (*sum, *count) = (*sum + f64::from(value), *count + 1);
        }
    }
    let spread = line_spread(&means(&profile));

    let period_px = spread.len() as f64 / OVERSAMPLING;
    let (mut cycles_per_px, mut mtf) = (Vec::new(), Vec::new());
    let total = modulus(&spread, 0.0);
    for step in 0..=(period_px / 2.0) as usize {
        let frequency = step as f64 / period_px;
        // The difference of samples two apart acts as a filter itself.
        let phase = 2.0 * std::f64::consts::PI * frequency / OVERSAMPLING;
        let correction = if step == 0 { 1.0 } else { (phase / phase.sin()).min(MOST_CORRECTION) };
        cycles_per_px.push(frequency);
        mtf.push(correction * modulus(&spread, frequency / OVERSAMPLING) / total);
    }
    Ok(EdgeResponse { cycles_per_px, mtf })
}

/// Position of a row's edge: the centroid of its differences, in a Hamming window around `expected`.
fn edge_in(row: ArrayView1<f32>, expected: f64, width_px: f64) -> Option<f64> {
    let (mut weight, mut place) = (0.0, 0.0);
    for (column, pair) in row.windows(2).into_iter().enumerate() {
        let at = column as f64 + 0.5;
        let from_middle = ((at - expected) / width_px).clamp(-0.5, 0.5);
        let window = 0.54 + 0.46 * (2.0 * std::f64::consts::PI * from_middle).cos();
        let difference = window * (f64::from(pair[1]) - f64::from(pair[0]));
        weight += difference;
        place += difference * at;
    }
    let place = place / weight;
    (place.is_finite() && place > 0.0 && place < row.len() as f64 - 1.0).then_some(place)
}

/// The line through `places` at 0, 1, ...: its value at 0 and its slope.
fn fitted(places: &[f64]) -> (f64, f64) {
    let count = places.len() as f64;
    let (middle, mean) = ((count - 1.0) / 2.0, places.iter().sum::<f64>() / count);
    let from_middle = |row: usize| row as f64 - middle;
    let covariance: f64 =
        places.iter().enumerate().map(|(row, place)| from_middle(row) * (place - mean)).sum();
    let slope = covariance / (0..places.len()).map(|row| from_middle(row).powi(2)).sum::<f64>();
    (mean - slope * middle, slope)
}

/// Means of the samples; an empty bin gets the mean of the previous one.
fn means(profile: &[(f64, u32)]) -> Vec<f64> {
    let first =
        profile.iter().find(|(_, count)| *count > 0).map_or(0.0, |(sum, count)| sum / f64::from(*count));
    let means = profile.iter().scan(first, |last, &(sum, count)| {
        if count > 0 {
            *last = sum / f64::from(count);
        }
        Some(*last)
    });
    means.collect()
}

/// Differences of the profile in a Hamming window around the largest one.
fn line_spread(profile: &[f64]) -> Vec<f64> {
    let spread: Vec<f64> = profile.windows(3).map(|three| (three[2] - three[0]) / 2.0).collect();
    let (sum, place) = spread
        .iter()
        .enumerate()
        .fold((0.0, 0.0), |(sum, place), (at, value)| (sum + value.abs(), place + at as f64 * value.abs()));
    let middle = place / sum;
    let half = middle.max(spread.len() as f64 - middle);
    let window = |at: f64| 0.54 + 0.46 * (std::f64::consts::PI * (at - middle) / half).cos();
    spread.iter().enumerate().map(|(at, value)| value * window(at as f64)).collect()
}

/// Magnitude of the Fourier coefficient at a frequency in cycles/sample.
fn modulus(values: &[f64], frequency: f64) -> f64 {
    let (mut real, mut imaginary) = (0.0, 0.0);
    for (at, value) in values.iter().enumerate() {
        let (sin, cos) = (2.0 * std::f64::consts::PI * frequency * at as f64).sin_cos();
        (real, imaginary) = (real + value * cos, imaginary + value * sin);
    }
    real.hypot(imaginary)
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;

    /// An edge with this slope, blurred by a Gaussian, sampled at 16 points per side in each pixel.
    fn edge(slope: f64, sigma_px: f64) -> Array2<f32> {
        // A logistic approximation of the Gaussian's integral would bias the tails, so it is summed numerically.
        let step = |distance: f64| {
            let points = (-40..=40).map(|point| f64::from(point) / 10.0);
            let (above, all) = points.fold((0.0, 0.0), |(above, all), point| {
                let weight = (-0.5 * point * point).exp();
                (above + if point * sigma_px < distance { weight } else { 0.0 }, all + weight)
            });
            above / all
        };
        Array2::from_shape_fn((64, 64), |(row, column)| {
            let points = (0..16 * 16).map(|point| {
                let (x, y) = ((point % 16) as f64 / 16.0 - 0.47, (point / 16) as f64 / 16.0 - 0.47);
                step((column as f64 + x - 30.0 - slope * (row as f64 + y)) / slope.hypot(1.0))
            });
            (100.0 + 900.0 * points.sum::<f64>() / 256.0) as f32
        })
    }

    #[test]
    fn a_gaussian_blur_has_its_transfer_function() {
        for sigma_px in [0.8, 2.0] {
            let response = slanted_edge(edge(0.09, sigma_px).view()).unwrap();
            let pi = std::f64::consts::PI;
            for (&f, &mtf) in response.cycles_per_px.iter().zip(&response.mtf) {
                let pixel = if f == 0.0 { 1.0 } else { (pi * f).sin() / (pi * f) };
                let expected = (-2.0 * (pi * sigma_px * f).powi(2)).exp() * pixel;
                assert!(
                    (mtf - expected).abs() < 0.03,
                    "sigma {sigma_px}, {f} cycles/px: {mtf}, not {expected}"
                );
            }
            assert_eq!(response.cycles_per_px.last().map(|last| (last * 10.0).round()), Some(5.0));
        }
    }

    #[test]
    fn half_contrast_lies_where_the_gaussian_has_it() {
        let mtf50 = slanted_edge(edge(-0.08, 3.0).view()).unwrap().mtf50().unwrap();
        let expected = (2.0_f64.ln() / 2.0).sqrt() / (std::f64::consts::PI * 3.0);
        assert!((mtf50 / expected - 1.0).abs() < 0.04, "{mtf50} {expected}");
    }

    #[test]
    fn what_is_no_slanted_edge_is_refused() {
        assert!(matches!(slanted_edge(Array2::zeros((64, 64)).view()), Err(EdgeError::NoEdge { row: 0 })));
        assert!(matches!(
            slanted_edge(Array2::zeros((4, 64)).view()),
            Err(EdgeError::TooSmall { rows: 4, .. })
        ));
        assert!(matches!(slanted_edge(edge(0.0, 1.0).view()), Err(EdgeError::Slant { .. })));
    }
}
