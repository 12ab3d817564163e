use ndarray::{Array1, Array2, ArrayView1, Axis};
use rayon::prelude::*;

use super::super::PlaneError;
use super::super::error::check_shape;
use super::super::model::{RowTiming, Transport};

/// The image `[t, s]` for a projector that shows each of its rows with one weight, shape `[projector_rows]`:
/// `sum over v of weights[v] T(v, t, s)`, 1.0 for a white surface under its own row at weight 1.
///
/// Rows outside the transport's reach are unknown and contribute nothing, so all rows at weight 1 give
/// [`Transport::total`].
///
/// # Errors
/// [`PlaneError::Shape`] if the weights do not fit the projector's rows, or the transport does not fit the camera's.
pub fn relight(
    timing: &RowTiming,
    transport: &Transport,
    weights: ArrayView1<f64>,
) -> Result<Array2<f32>, PlaneError> {
    check_shape("transport", "its camera rows", &[transport.t.len_of(Axis(1))], &[timing.camera_rows()])?;
    relight_rows(timing, 0, transport, weights)
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
) -> Result<Array2<f32>, PlaneError> {
    check_shape("weights", "[projector rows]", &[weights.len()], &[timing.projector_rows()])?;
    let (_, rows, columns) = transport.t.dim();
    timing.check_columns(columns)?;
    let (end, camera_rows) = (first_row + rows, timing.camera_rows());
    if end > camera_rows {
        return Err(PlaneError::Rows { row: end - 1, camera_rows });
    }

    let weight_of = |v: i64| usize::try_from(v).ok().and_then(|v| weights.get(v)).copied().unwrap_or(0.0);
    let mut image = Array2::zeros((rows, columns));
    image.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(at, mut image_row)| {
        let profiles = transport.t.index_axis(Axis(1), at);
        // In f64, because the light of thousands of dim rows adds up next to a bright one.
        let mut sum = Array1::<f64>::zeros(columns);
        if let Some(response) = timing.response() {
            let own_rows = response.own_rows(first_row + at, columns);
            for ((sum, profile), own_row) in sum.iter_mut().zip(profiles.columns()).zip(own_rows) {
                let lit = (own_row + i64::from(transport.u_min)..).zip(profile);
                *sum = lit.map(|(v, &light)| weight_of(v) * f64::from(light)).sum();
            }
        } else {
            let own_row = timing.camera().own_row(first_row + at) as i64;
            for (v, light) in (own_row + i64::from(transport.u_min)..).zip(profiles.outer_iter()) {
                let weight = weight_of(v);
                if weight != 0.0 {
                    sum.zip_mut_with(&light, |sum, &light| *sum += weight * f64::from(light));
                }
            }
        }
        image_row.zip_mut_with(&sum, |pixel, &sum| *pixel = sum as f32);
    });
    Ok(image)
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, s};

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
        let image = relight(&timing, &transport, Array1::ones(8).view()).unwrap();
        assert_eq!(image, transport.total());
    }

    #[test]
    fn one_row_gives_its_slice_and_rows_out_of_reach_are_dark() {
        let (timing, transport) = scene();
        for v in 0..8_usize {
            let weights = Array1::from_shape_fn(8, |row| if row == v { 0.5 } else { 0.0 });
            let image = relight(&timing, &transport, weights.view()).unwrap();
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
        let whole = relight(&timing, &transport, weights.view()).unwrap();
        let t = transport.t.slice(s![.., 1..3, ..]).to_owned();
        let exists = transport.exists.slice(s![.., 1..3]).to_owned();
        let rows = Transport::measured(t, transport.u_min, exists);
        let part = relight_rows(&timing, 1, &rows, weights.view()).unwrap();
        assert_eq!(part, whole.slice(s![1..3, ..]));
        let beyond = relight_rows(&timing, 3, &rows, weights.view());
        assert_eq!(beyond.unwrap_err(), PlaneError::Rows { row: 4, camera_rows: 4 });
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let (timing, transport) = scene();
        let other = timing.clone().window(0, 3).unwrap();
        assert!(matches!(
            relight(&timing, &transport, Array1::ones(4).view()),
            Err(PlaneError::Shape { array: "weights", .. })
        ));
        assert!(matches!(
            relight(&other, &transport, Array1::ones(8).view()),
            Err(PlaneError::Shape { array: "transport", .. })
        ));
    }
}
