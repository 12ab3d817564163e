use std::ops::Range;
use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView1, ArrayView2, ArrayViewMut1, Axis};
use rayon::prelude::*;

use super::super::PlaneError;
use super::super::error::check_shape;
use super::super::model::{PLACE_STEPS, RowTiming, Shares, Transport, collected};

/// How a projector's rows spread in a relit image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RelitBeam {
    /// As those of the rig do: the image that the camera would see.
    #[default]
    AsLit,
    /// Not at all: each row lights only itself, as in the transport.
    Ideal,
}

/// The image `[t, s]` for a projector that shows each of its rows with one weight, shape `[projector_rows]`:
/// `sum over v of weights[v] T(v, t, s)`, 1.0 for a white surface under its own row at weight 1. With
/// [`RelitBeam::AsLit`], `weights` are first spread by the beam or by the pixels' measured responses: a pixel's light
/// from row `v` has the weight `sum over d of k(d) weights[v + d]`.
///
/// Rows outside the transport's reach are unknown and contribute nothing, so all rows at weight 1 give
/// [`Transport::total`] with an ideal beam.
///
/// # Errors
/// [`PlaneError::Shape`] if the weights do not fit the projector's rows, or the transport does not fit the camera's.
pub fn relight(
    timing: &RowTiming,
    transport: &Transport,
    weights: ArrayView1<f64>,
    beam: RelitBeam,
) -> Result<Array2<f32>, PlaneError> {
    check_shape("transport", "its camera rows", &[transport.t.len_of(Axis(1))], &[timing.camera_rows()])?;
    relight_rows(timing, 0, transport, weights, beam)
}

/// [`relight`] for a `transport` that contains only the camera rows starting at `first_row`.
///
/// # Errors
/// [`PlaneError::Shape`] if the weights do not fit the projector's rows; [`PlaneError::Rows`] for rows that do not
/// exist in the camera.
pub fn relight_rows(
    timing: &RowTiming,
    first_row: usize,
    transport: &Transport,
    weights: ArrayView1<f64>,
    beam: RelitBeam,
) -> Result<Array2<f32>, PlaneError> {
    let (_, rows, columns) = transport.t.dim();
    let (end, camera_rows) = (first_row + rows, timing.camera_rows());
    if end > camera_rows {
        return Err(PlaneError::Rows { row: end - 1, camera_rows });
    }
    let lit = LitRows::new(timing, columns, weights, beam)?;
    let mut image = Array2::zeros((rows, columns));
    image.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(at, mut image_row)| {
        let profiles = transport.t.index_axis(Axis(1), at);
        for class in lit.classes(first_row + at) {
            class.relight(image_row.view_mut(), profiles, transport.u_min);
        }
    });
    Ok(image)
}

/// What is not known of the light of a relit image.
#[derive(Debug, Clone, PartialEq)]
pub struct RelitUnknowns {
    /// Pixels `[t, s]` some of whose lit rows are only a lower bound.
    pub is_bound: Array2<bool>,
    /// Those some of whose lit rows lie beyond the transport's reach, so that their light is missing.
    pub is_beyond: Array2<bool>,
}

/// Rows with a smaller share of the largest weight are not counted as lit: the tails of a beam.
const LEAST_WEIGHT: f64 = 1e-3;

impl RelitUnknowns {
    /// Those of [`relight_rows`] with the same arguments.
    ///
    /// # Errors
    /// As [`relight_rows`].
    pub fn of(
        timing: &RowTiming,
        first_row: usize,
        transport: &Transport,
        weights: ArrayView1<f64>,
        beam: RelitBeam,
    ) -> Result<Self, PlaneError> {
        let (_, rows, columns) = transport.t.dim();
        let lit = LitRows::new(timing, columns, weights, beam)?;
        let least = LEAST_WEIGHT * lit.weights.iter().fold(0.0, |most: f64, weight| most.max(*weight));
        let known = transport.u_min..=transport.u_max();
        let mut is_bound = Array2::from_elem((rows, columns), false);
        let mut is_beyond = is_bound.clone();
        for at in 0..rows {
            for class in lit.classes(first_row + at) {
                let rows_of = 0..timing.projector_rows() as i64;
                let lit_rows =
                    rows_of.map(|v| (v - class.own_row) as i32).filter(|&u| class.weight(u) > least);
                let (within, beyond): (Vec<i32>, Vec<i32>) = lit_rows.partition(|u| known.contains(u));
                for &column in &class.columns {
                    let bounds = transport.lower_bounds.get(&[at, column]);
                    is_bound[[at, column]] = bounds
                        .is_some_and(|bounds| within.iter().any(|u| bounds[(u - transport.u_min) as usize]));
                    is_beyond[[at, column]] = !beyond.is_empty();
                }
            }
        }
        Ok(Self { is_bound, is_beyond })
    }
}

/// A projector's rows, lit with one weight each.
pub(super) struct LitRows<'a> {
    timing: &'a RowTiming,
    columns: usize,
    /// Spread by the beam where pixels have no response of their own.
    weights: Arc<Array1<f64>>,
    beam: RelitBeam,
}

/// Pixels of a camera row that look at the same projector row with the same response.
#[derive(Clone)]
pub(super) struct LitClass {
    /// Ascending.
    pub columns: Vec<usize>,
    /// The projector row that they look at.
    pub own_row: i64,
    /// By which the weights are spread; `None` if they are as they are to be used.
    shares: Option<Shares>,
    weights: Arc<Array1<f64>>,
}

impl LitClass {
    /// The same for pixels that look at another row.
    pub fn at(&self, own_row: i64) -> Self {
        Self { own_row, ..self.clone() }
    }

    /// What the light of relative row `u` counts for.
    pub fn weight(&self, u: i32) -> f64 {
        let v = self.own_row + i64::from(u);
        match &self.shares {
            Some(shares) => collected(self.weights.view(), shares, v),
            None => usize::try_from(v).ok().and_then(|v| self.weights.get(v)).copied().unwrap_or(0.0),
        }
    }

    /// Puts the light of its pixels into a row of the image. `profiles`, `[reach, columns]`, begin at `u_min`.
    fn relight(&self, mut image_row: ArrayViewMut1<f32>, profiles: ArrayView2<f32>, u_min: i32) {
        // In f64, because the light of thousands of dim rows adds up next to a bright one.
        let mut sums = vec![0.0_f64; self.columns.len()];
        for (u, light) in (u_min..).zip(profiles.outer_iter()) {
            let weight = self.weight(u);
            if weight != 0.0 {
                let of_pixels = sums.iter_mut().zip(&self.columns);
                of_pixels.for_each(|(sum, &column)| *sum += weight * f64::from(light[column]));
            }
        }
        self.columns.iter().zip(sums).for_each(|(&column, sum)| image_row[column] = sum as f32);
    }
}

impl<'a> LitRows<'a> {
    /// Those of `weights`, `[projector rows]`, for an image with this number of columns.
    pub fn new(
        timing: &'a RowTiming,
        columns: usize,
        weights: ArrayView1<f64>,
        beam: RelitBeam,
    ) -> Result<Self, PlaneError> {
        check_shape("weights", "[projector rows]", &[weights.len()], &[timing.projector_rows()])?;
        timing.check_columns(columns)?;
        let weights = match beam {
            RelitBeam::AsLit if timing.response().is_none() => {
                Array1::from(timing.beam().spread(weights.to_vec()))
            }
            RelitBeam::AsLit | RelitBeam::Ideal => weights.to_owned(),
        };
        Ok(Self { timing, columns, weights: Arc::new(weights), beam })
    }

    /// The class of the pixel in the middle of the image.
    pub fn typical(&self) -> LitClass {
        self.classes_of(self.timing.camera_rows() / 2, self.columns / 2..self.columns / 2 + 1).swap_remove(0)
    }

    /// The classes of camera row `t`.
    pub fn classes(&self, t: usize) -> Vec<LitClass> {
        self.classes_of(t, 0..self.columns)
    }

    fn classes_of(&self, t: usize, columns: Range<usize>) -> Vec<LitClass> {
        let weights = || self.weights.clone();
        let Some(response) = self.timing.response() else {
            let (columns, own_row) = (columns.collect(), self.timing.camera().own_row(t) as i64);
            return vec![LitClass { columns, own_row, shares: None, weights: weights() }];
        };
        let classes = response.classes(t, columns, PLACE_STEPS).into_iter();
        classes
            .map(|class| LitClass {
                columns: class.columns,
                own_row: class.own_row,
                shares: (self.beam == RelitBeam::AsLit).then_some(class.shares),
                weights: weights(),
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, s};

    use super::super::super::{Beam, FIRST_RESPONSE_ROW, PixelResponse, Shares};
    use super::*;

    /// A projector of 8 rows whose rows 2..6 the camera sees, with `T(v, t, s) = 1 + 100 v + 10 t + s` for |u| <= 2.
    fn scene() -> (RowTiming, Transport) {
        let timing = RowTiming::new(8, 20.0, 200.0).unwrap().window(2, 4).unwrap();
        let light = |(index, t, s): (usize, usize, usize)| (1 + 100 * (index + t) + 10 * t + s) as f32;
        let t = Array3::from_shape_fn((5, 4, 3), light);
        (timing, Transport::measured(t, -2, Array2::from_elem((5, 4), true)))
    }

    #[test]
    fn all_rows_give_the_total_to_the_bit() {
        let (timing, transport) = scene();
        let image = relight(&timing, &transport, Array1::ones(8).view(), RelitBeam::default()).unwrap();
        assert_eq!(image, transport.total());
    }

    #[test]
    fn one_row_gives_its_slice_and_rows_out_of_reach_are_dark() {
        let (timing, transport) = scene();
        for v in 0..8_usize {
            let weights = Array1::from_shape_fn(8, |row| if row == v { 0.5 } else { 0.0 });
            let image = relight(&timing, &transport, weights.view(), RelitBeam::default()).unwrap();
            for ((t, s), &light) in image.indexed_iter() {
                let within_reach = v.abs_diff(2 + t) <= 2;
                let expected = if within_reach { 0.5 * (1 + 100 * v + 10 * t + s) as f32 } else { 0.0 };
                assert_eq!(light, expected, "row {v} at ({t}, {s})");
            }
        }
    }

    #[test]
    fn some_rows_are_relit_as_in_the_whole() {
        let (timing, transport) = scene();
        let weights = Array1::from_shape_fn(8, |row| (row * row) as f64);
        let whole = relight(&timing, &transport, weights.view(), RelitBeam::default()).unwrap();
        let t = transport.t.slice(s![.., 1..3, ..]).to_owned();
        let exists = transport.exists.slice(s![.., 1..3]).to_owned();
        let rows = Transport::measured(t, transport.u_min, exists);
        let part = relight_rows(&timing, 1, &rows, weights.view(), RelitBeam::default()).unwrap();
        assert_eq!(part, whole.slice(s![1..3, ..]));
        let beyond = relight_rows(&timing, 3, &rows, weights.view(), RelitBeam::default());
        assert_eq!(beyond.unwrap_err(), PlaneError::Rows { row: 4, camera_rows: 4 });
    }

    #[test]
    fn unknown_light_counts_only_where_it_is_lit() {
        let (timing, mut transport) = scene();
        // The light of projector row 4 in the pixel in row 1, whose own row is 3.
        transport.lower_bounds.insert([1, 2], vec![false, false, false, true, false]);
        for v in 0..8_usize {
            let weights = Array1::from_shape_fn(8, |row| if row == v { 0.5 } else { 0.0 });
            let found = RelitUnknowns::of(&timing, 0, &transport, weights.view(), RelitBeam::Ideal).unwrap();
            for ((t, s), &is_bound) in found.is_bound.indexed_iter() {
                assert_eq!(is_bound, (v, t, s) == (4, 1, 2), "row {v} at ({t}, {s})");
                assert_eq!(found.is_beyond[[t, s]], v.abs_diff(2 + t) > 2, "row {v} at ({t}, {s})");
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let (timing, transport) = scene();
        let other = timing.clone().window(0, 3).unwrap();
        assert!(matches!(
            relight(&timing, &transport, Array1::ones(4).view(), RelitBeam::default()),
            Err(PlaneError::Shape { array: "weights", .. })
        ));
        assert!(matches!(
            relight(&other, &transport, Array1::ones(8).view(), RelitBeam::default()),
            Err(PlaneError::Shape { array: "transport", .. })
        ));
    }

    #[test]
    fn rows_spread_as_the_rig_spreads_them_or_not_at_all() {
        let (timing, transport) = scene();
        let beam = timing.with_beam(Beam::Gaussian { sigma_rows: 0.7 }).unwrap();
        let places = Array2::from_shape_fn((4, 3), |(t, _)| 2.0 + t as f32);
        // The whole light of a row goes to the next one.
        let down: Shares = std::array::from_fn(|d| f64::from(u8::from(d as i32 == 1 - FIRST_RESPONSE_ROW)));
        let measured = beam.clone().with_response(PixelResponse::with_beam(places, &down).unwrap()).unwrap();
        let row = |v: usize| Array1::from_shape_fn(8, |row| f64::from(u8::from(row == v)));
        let relit = |timing: &RowTiming, weights: &Array1<f64>, beam| {
            relight(timing, &transport, weights.view(), beam).unwrap()
        };
        let spread = Array1::from(Beam::Gaussian { sigma_rows: 0.7 }.spread(row(4).to_vec()));
        let ideal = relit(&beam, &row(4), RelitBeam::Ideal);
        assert_eq!(relit(&beam, &row(4), RelitBeam::AsLit), relit(&beam, &spread, RelitBeam::Ideal));
        assert_eq!(relit(&measured, &row(4), RelitBeam::Ideal), ideal);
        assert_eq!(relit(&measured, &row(5), RelitBeam::AsLit), ideal);
    }
}
