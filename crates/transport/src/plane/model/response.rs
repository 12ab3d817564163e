use std::collections::BTreeMap;

use ndarray::{Array1, Array2, Array3, ArrayView1, ArrayView2, ArrayView3, s};

use super::super::PlaneError;
use super::super::error::check_shape;

/// Number of drawn rows that a measured response covers.
pub const RESPONSE_ROWS: usize = 16;

/// Row of index 0 of a response, relative to the pixel's own row: a response covers rows -7 to 8.
pub const FIRST_RESPONSE_ROW: i32 = -7;

/// Steps of a pixel's place per projector row: pixels within one step share a model.
pub(in super::super) const PLACE_STEPS: f32 = 32.0;

/// Where each pixel looks, and how its direct light is divided among the rows drawn around that place (its line spread
/// function over projector rows), as a calibration measured it.
///
/// With it, relative rows count from the pixel's own row, the drawn row nearest to its place, and `T(u)` is the light
/// that the pixel would receive from the place `u` rows below its own. Light that leaves the projector towards one
/// place is divided among drawn rows in the same proportions everywhere near the pixel, so
///
/// ```text
/// A'(i, u) = sum over d of k(d) S_i(own row + d + u)
/// ```
///
/// where `S_i(v)` is the share of row `v`'s dwell that falls inside exposure `i`. Direct light lies at `u = 0` by
/// definition, whatever the shape of the beam and wherever the pixel looks between two rows. Row `own row + d` of a
/// projector whose beam spreads light downwards reaches the pixel from above: `k` is large at negative `d`.
///
/// Pixels of one camera row that look at the same fraction of a row, to 1/32, are solved with the mean of their
/// responses, so that a response may change from top to bottom of the image, but not from left to right.
#[derive(Debug, Clone, PartialEq)]
pub struct PixelResponse {
    /// `[t, s]`, in projector rows; one column stands for all.
    places: Array2<f32>,
    /// `k(d)`, `[RESPONSE_ROWS, t, s]` with the same columns; its sum over `d` is 1.
    shares: Array3<f32>,
}

/// The shares of the rows drawn around a pixel's own row in its direct light; they sum to 1.
pub type Shares = [f64; RESPONSE_ROWS];

/// Pixels of one camera row that look at nearly the same place between rows, and therefore share a model.
#[derive(Debug, Clone, PartialEq)]
pub(in super::super) struct ResponseClass {
    /// The pixels' own row.
    pub own_row: i64,
    /// The mean of their responses.
    pub shares: Shares,
    /// Ascending.
    pub columns: Vec<usize>,
}

impl PixelResponse {
    /// A response from the place of each pixel, `[t, s]` in projector rows (one column stands for all), and the shares of the rows `-7..=8` around
    /// the place's nearest row in the pixel's direct light, `[RESPONSE_ROWS, t, s]`.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if the arrays do not fit each other; [`PlaneError::OutOfRange`] for a place that is not
    /// finite, or shares that do not add up to 1 within 2 %.
    pub fn new(places: Array2<f32>, shares: Array3<f32>) -> Result<Self, PlaneError> {
        let (rows, columns) = places.dim();
        check_shape("place", "[camera rows, at least 1 column]", &[columns.max(1)], &[columns])?;
        check_shape(
            "response",
            "[16, camera rows, columns]",
            shares.shape(),
            &[RESPONSE_ROWS, rows, columns],
        )?;
        let refused = |field, value: f32, allowed| {
            Err(PlaneError::OutOfRange { field, value: f64::from(value), allowed })
        };
        // Beyond this, rows could not be counted in f32.
        if let Some(&place) = places.iter().find(|place| !(-1e5..1e5).contains(*place)) {
            return refused(
                "place",
                place,
                "finite: a calibration gives every pixel a place, also where it was unlit",
            );
        }
        let sums = shares.sum_axis(ndarray::Axis(0));
        if let Some(&sum) = sums.iter().find(|sum| !(0.98..1.02).contains(*sum)) {
            return refused(
                "response",
                sum,
                "shares that add up to 1 in every pixel: calibrate the rig again",
            );
        }
        Ok(Self { places, shares })
    }

    /// The response of pixels that look at these places, `[t, s]` in projector rows, through a beam with the shares
    /// `beam` around its own row: a pixel between two rows divides its light between them.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn with_beam(places: Array2<f32>, beam: &Shares) -> Result<Self, PlaneError> {
        let (rows, columns) = places.dim();
        let shares = Array3::from_shape_fn((RESPONSE_ROWS, rows, columns), |(d, t, s)| {
            let fraction = f64::from(places[[t, s]] - places[[t, s]].round());
            let neighbour = if fraction < 0.0 { d.checked_add(1) } else { d.checked_sub(1) };
            let beside = neighbour.and_then(|d| beam.get(d)).copied().unwrap_or(0.0);
            ((1.0 - fraction.abs()) * beam[d] + fraction.abs() * beside) as f32
        });
        Self::new(places, shares)
    }

    /// Where each pixel looks, `[t, s]` in projector rows.
    pub fn places(&self) -> ArrayView2<'_, f32> {
        self.places.view()
    }

    /// The share of each drawn row around the own row in a pixel's direct light, `[RESPONSE_ROWS, t, s]`.
    pub fn shares(&self) -> ArrayView3<'_, f32> {
        self.shares.view()
    }

    /// Number of camera rows and columns.
    pub fn size(&self) -> (usize, usize) {
        self.places.dim()
    }

    /// The projector row nearest to the place of each of `columns` pixels of camera row `t`, from which its relative rows count.
    pub fn own_rows(&self, t: usize, columns: usize) -> impl Iterator<Item = i64> {
        (0..columns).map(move |s| self.places[[t, self.column(s)]].round() as i64)
    }

    fn column(&self, s: usize) -> usize {
        s.min(self.places.ncols() - 1)
    }

    /// Some columns of camera row `t` by the place that they see, in classes of `1 / steps` of a row.
    pub(in super::super) fn classes(
        &self,
        t: usize,
        columns: impl Iterator<Item = usize>,
        steps: f32,
    ) -> Vec<ResponseClass> {
        let mut by_step: BTreeMap<(i64, i32), Vec<usize>> = BTreeMap::new();
        for column in columns {
            let place = self.places[[t, self.column(column)]];
            let step = ((place - place.round()) * steps).round() as i32;
            by_step.entry((place.round() as i64, step)).or_default().push(column);
        }
        let class = |((own_row, _), columns): ((i64, i32), Vec<usize>)| {
            let mean = |d: usize| {
                let sum: f64 = columns.iter().map(|&s| f64::from(self.shares[[d, t, self.column(s)]])).sum();
                sum / columns.len() as f64
            };
            ResponseClass { own_row, shares: std::array::from_fn(mean), columns }
        };
        by_step.into_iter().map(class).collect()
    }
}

/// `A'` of a pixel with this response for one projector row: light of the row `lit`, collected while the rows around it
/// are drawn. `drawn` is the share of each projector row's dwell inside the exposure.
pub(in super::super) fn collected(drawn: ArrayView1<f64>, shares: &Shares, lit: i64) -> f64 {
    let of_row = |(d, share): (usize, &f64)| {
        let row = usize::try_from(lit + d as i64 + i64::from(FIRST_RESPONSE_ROW)).ok()?;
        drawn.get(row).map(|drawn| share * drawn)
    };
    shares.iter().enumerate().filter_map(of_row).sum()
}

/// [`collected`] for the `len` rows that begin with `first`: `[len]`, with the same sums in the same order, but row by
/// row of the response instead of lit row by lit row, which takes a tenth of the time.
pub(in super::super) fn collected_rows(
    drawn: ArrayView1<f64>,
    shares: &Shares,
    first: i64,
    len: usize,
) -> Array1<f64> {
    let mut light = Array1::zeros(len);
    for (d, &share) in shares.iter().enumerate() {
        // Lit row `first + n` collects from drawn row `n - before`.
        let before = -(first + d as i64 + i64::from(FIRST_RESPONSE_ROW));
        let from = before.clamp(0, len as i64) as usize;
        let end = (before + drawn.len() as i64).clamp(from as i64, len as i64) as usize;
        if from < end {
            let drawn = drawn.slice(s![(from as i64 - before) as usize..(end as i64 - before) as usize]);
            light.slice_mut(s![from..end]).scaled_add(share, &drawn);
        }
    }
    light
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ideal() -> Shares {
        std::array::from_fn(|d| f64::from(u8::from(d as i32 == -FIRST_RESPONSE_ROW)))
    }

    #[test]
    fn a_pixel_between_rows_divides_its_light() {
        let places = Array2::from_shape_vec((1, 3), vec![10.0, 10.25, 9.75]).unwrap();
        let response = PixelResponse::with_beam(places, &ideal()).unwrap();
        let of = |s: usize| -> Vec<f32> { (6..9).map(|d| response.shares()[[d, 0, s]]).collect() };
        assert_eq!((of(0), of(1), of(2)), (vec![0., 1., 0.], vec![0., 0.75, 0.25], vec![0.25, 0.75, 0.]));
        assert_eq!(response.own_rows(0, 3).collect::<Vec<_>>(), [10, 10, 10]);
    }

    #[test]
    fn classes_share_places() {
        let places = Array2::from_shape_vec((1, 4), vec![10.0, 10.01, 10.5, 10.1]).unwrap();
        let response = PixelResponse::with_beam(places, &ideal()).unwrap();
        let columns = |steps: f32| -> Vec<Vec<usize>> {
            response.classes(0, 0..4, steps).into_iter().map(|class| class.columns).collect()
        };
        assert_eq!(columns(32.0), [vec![0, 1], vec![3], vec![2]]);
        assert_eq!(columns(2.0), [vec![0, 1, 3], vec![2]]);
    }

    #[test]
    fn light_is_collected_from_the_rows_drawn_around_the_lit_one() {
        let mut shares = [0.0; RESPONSE_ROWS];
        // Half of the light while the row itself is drawn, the rest one and two rows later.
        (shares[7], shares[8], shares[9]) = (0.5, 0.3, 0.2);
        let drawn = ndarray::array![0.0, 1.0, 0.0, 1.0];
        let light = |lit: i64| collected(drawn.view(), &shares, lit);
        assert_eq!([-1, 0, 1, 2, 3].map(light), [0.2, 0.3, 0.7, 0.3, 0.5]);
    }

    #[test]
    fn rows_together_collect_what_each_does_alone() {
        let shares: Shares = std::array::from_fn(|d| 0.01 * (d as f64 + 1.0).sqrt());
        for rows in [1, 5, 16, 40] {
            let drawn = Array1::from_shape_fn(rows, |v| ((v * 7 + 3) % 11) as f64 / 11.0);
            for (first, len) in [(-12, 60), (0, rows), (3, 2), (rows as i64 + 20, 4), (-40, 10)] {
                let expected: Vec<f64> =
                    (first..first + len as i64).map(|lit| collected(drawn.view(), &shares, lit)).collect();
                let found = collected_rows(drawn.view(), &shares, first, len);
                assert_eq!(found.to_vec(), expected, "{rows} rows, from {first}");
            }
        }
    }

    #[test]
    fn what_is_no_response_is_refused() {
        let places = |place: f32| Array2::from_elem((1, 1), place);
        assert!(PixelResponse::with_beam(places(f32::NAN), &ideal()).is_err());
        assert!(PixelResponse::with_beam(places(1.0), &[0.1; RESPONSE_ROWS]).is_err());
        assert!(matches!(
            PixelResponse::new(places(1.0), Array3::zeros((3, 1, 1))),
            Err(PlaneError::Shape { array: "response", .. })
        ));
    }
}
