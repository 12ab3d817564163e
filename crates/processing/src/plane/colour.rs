//! Images of a camera with a Bayer mosaic, in colour. The mosaic is solved as it is; only what is shown or written of the
//! light is demosaiced.

use demosaic::{Algorithm, CfaPattern, demosaic};
use ndarray::parallel::prelude::*;
use ndarray::{Array2, Array3, Array4, ArrayView2, ArrayView3, Axis, CowArray, Ix3, Ix4, s};
use raysweep_core::Mosaic;
use raysweep_pipeline::mask;

/// Pixels by which an image is continued beyond its edges, by reflection: as far as colours are interpolated from, and
/// even, which keeps the mosaic.
const MARGIN_PX: usize = 6;
/// Pixels around one over which the differences of its colours are evened out.
const MEDIAN_PX: usize = 2;
/// Pixels beside a saturated one whose colours are interpolated from it.
const REACH_PX: usize = 3 + MEDIAN_PX;
const GREEN: usize = 1;

/// What the values of an image are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Values {
    /// Light, which has edges that colours share.
    Light,
    /// How uncertain the light is: smooth, and never negative.
    Errors,
}

/// The names of an image's axes, of which the last is left out on a monochrome camera.
pub(crate) fn axes(mosaic: Mosaic) -> &'static [&'static str] {
    if mosaic.red().is_some() { &["t", "s", "rgb"] } else { &["t", "s"] }
}

/// An image `[t, s]` as `[t, s, channels]`: one channel as it is, or red, green and blue.
pub(crate) fn in_colour(
    image: ArrayView2<'_, f32>,
    mosaic: Mosaic,
    values: Values,
) -> CowArray<'_, f32, Ix3> {
    match pattern(mosaic) {
        None => CowArray::from(image.insert_axis(Axis(2))),
        Some(pattern) => CowArray::from(demosaiced(image, &pattern, values)),
    }
}

/// Images of light `[k, t, s]` as `[k, t, s, channels]`, as [`in_colour`].
pub(crate) fn sequence_in_colour(images: ArrayView3<'_, f32>, mosaic: Mosaic) -> CowArray<'_, f32, Ix4> {
    let Some(pattern) = pattern(mosaic) else { return CowArray::from(images.insert_axis(Axis(3))) };
    let (count, rows, columns) = images.dim();
    let mut all = Array4::zeros((count, rows, columns, 3));
    for (mut colours, image) in all.outer_iter_mut().zip(images.outer_iter()) {
        colours.assign(&demosaiced(image, &pattern, Values::Light));
    }
    CowArray::from(all)
}

/// The mask of an image in colour: where a colour is interpolated from a pixel of which only a bound or nothing is known, no
/// more is known of it.
pub(crate) fn mask_in_colour(bits: Array2<u8>, mosaic: Mosaic) -> Array2<u8> {
    if mosaic.red().is_none() {
        return bits;
    }
    let (rows, columns) = bits.dim();
    Array2::from_shape_fn((rows, columns), |(t, s)| {
        let near = |at: usize, end: usize| at.saturating_sub(REACH_PX)..(at + REACH_PX + 1).min(end);
        let around = bits.slice(s![near(t, rows), near(s, columns)]);
        let is_known = |bits: u8| bits & (mask::MEASURED | mask::BOUND_ONLY) != 0;
        let own = bits[[t, s]];
        match () {
            () if !is_known(own) => own,
            () if around.iter().any(|bits| bits & mask::BOUND_ONLY != 0) => {
                own & !mask::MEASURED | mask::BOUND_ONLY
            }
            () if !around.iter().all(|bits| is_known(*bits)) => own & !mask::MEASURED,
            () => own,
        }
    })
}

fn pattern(mosaic: Mosaic) -> Option<CfaPattern> {
    match mosaic {
        Mosaic::Mono => None,
        Mosaic::BayerRG => Some(CfaPattern::bayer_rggb()),
        Mosaic::BayerGR => Some(CfaPattern::bayer_grbg()),
        Mosaic::BayerGB => Some(CfaPattern::bayer_gbrg()),
        Mosaic::BayerBG => Some(CfaPattern::bayer_bggr()),
    }
}

/// Red, green and blue `[t, s, 3]`. Samples keep their values; the other colours of light follow along edges.
fn demosaiced(image: ArrayView2<'_, f32>, pattern: &CfaPattern, values: Values) -> Array3<f32> {
    let algorithm = match values {
        Values::Light => Algorithm::Ppg,
        Values::Errors => Algorithm::Bilinear,
    };
    let (rows, columns) = image.dim();
    // The nearest sample of the same colour stands for what lies beyond the image.
    let inside = |at: usize, end: usize| {
        let period = (2 * (end - 1)).max(1);
        let folded = at.abs_diff(MARGIN_PX) % period;
        folded.min(period - folded).min(end - 1)
    };
    let size = (rows + 2 * MARGIN_PX, columns + 2 * MARGIN_PX);
    let padded = Array2::from_shape_fn(size, |(t, s)| image[[inside(t, rows), inside(s, columns)]]);
    let mut planes = Array3::zeros((3, size.0, size.1));
    if let (Some(input), Some(output)) = (padded.as_slice(), planes.as_slice_mut()) {
        // Refused are only lengths that contradict the size.
        let _ = demosaic(input, size.1, size.0, pattern, algorithm, output);
    }
    match values {
        Values::Light => planes = without_fringes(padded.view(), planes.view(), pattern),
        Values::Errors => padded
            .indexed_iter()
            .for_each(|((t, s), sample)| planes[[pattern.color_at(t, s) as usize, t, s]] = *sample),
    }
    let within = s![.., MARGIN_PX..MARGIN_PX + rows, MARGIN_PX..MARGIN_PX + columns];
    planes.slice(within).permuted_axes([1, 2, 0]).as_standard_layout().into_owned()
}

/// Colours `[c, t, s]` whose differences to green are the medians of those around them (Freeman, US patent 4724395 of 1988):
/// where an edge is finer than the mosaic, its colours are guessed wrongly, and seldom by a majority.
fn without_fringes(
    samples: ArrayView2<'_, f32>,
    colours: ArrayView3<'_, f32>,
    pattern: &CfaPattern,
) -> Array3<f32> {
    let (_, rows, columns) = colours.dim();
    let green = colours.index_axis(Axis(0), GREEN);
    let differences = [0, 2].map(|channel| &colours.index_axis(Axis(0), channel) - &green);
    let mut made = Array3::zeros(colours.dim());
    made.axis_iter_mut(Axis(1)).into_par_iter().enumerate().for_each(|(t, mut row)| {
        let near = |at: usize, end: usize| at.saturating_sub(MEDIAN_PX)..(at + MEDIAN_PX + 1).min(end);
        let mut around = Vec::with_capacity((2 * MEDIAN_PX + 1).pow(2));
        for s in 0..columns {
            let mut median = |differences: &Array2<f32>| {
                around.clear();
                around.extend(differences.slice(s![near(t, rows), near(s, columns)]));
                let middle = around.len() / 2;
                *around.select_nth_unstable_by(middle, f32::total_cmp).1
            };
            let [red, blue] = [median(&differences[0]), median(&differences[1])];
            let over_green = [red, 0.0, blue];
            let sampled = pattern.color_at(t, s) as usize;
            let green = samples[[t, s]] - over_green[sampled];
            for (channel, over_green) in over_green.into_iter().enumerate() {
                row[[channel, s]] = if channel == sampled { samples[[t, s]] } else { green + over_green };
            }
        }
    });
    made
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOSAICS: [Mosaic; 4] = [Mosaic::BayerRG, Mosaic::BayerGR, Mosaic::BayerGB, Mosaic::BayerBG];

    /// The channel that a pixel sees.
    fn channel(mosaic: Mosaic, (t, s): (usize, usize)) -> usize {
        let (red_s, red_t) = mosaic.red().unwrap();
        ((t % 2) ^ red_t) + ((s % 2) ^ red_s)
    }

    #[test]
    fn samples_keep_their_values_and_even_light_its_colour() {
        for mosaic in MOSAICS {
            for (rows, columns) in [(1, 1), (2, 3), (7, 8), (16, 12)] {
                let colour = [0.25, 0.5, 1.0];
                let seen = Array2::from_shape_fn((rows, columns), |place| colour[channel(mosaic, place)]);
                let found = in_colour(seen.view(), mosaic, Values::Light);
                for ((t, s, c), value) in found.indexed_iter() {
                    // An image of one row or column has not all colours.
                    if c == channel(mosaic, (t, s)) || rows > 1 && columns > 1 {
                        assert_eq!(*value, colour[c], "{mosaic:?} {rows}x{columns}: {t} {s} {c}");
                    }
                }
            }
        }
        let grey = Array2::from_shape_fn((3, 4), |(t, s)| (4 * t + s) as f32);
        assert_eq!(in_colour(grey.view(), Mosaic::Mono, Values::Light).index_axis(Axis(2), 0), grey);
    }

    #[test]
    fn a_grey_scene_stays_grey_at_its_edges() {
        type Edge = (fn(usize, usize) -> bool, f32);
        let edges: [Edge; 5] = [
            (|_, s| s >= 20, 1e-6),
            (|t, _| t >= 15, 1e-6),
            // Edges that are no wider than a pixel, and a line of one pixel, are finer than the mosaic.
            (|t, s| t + s >= 36, 0.4),
            (|t, s| t + 2 * s >= 50, 0.4),
            (|t, s| t == 15 || s == 20, 0.4),
        ];
        for (is_bright, most) in edges {
            let seen = Array2::from_shape_fn((32, 40), |(t, s)| if is_bright(t, s) { 0.9 } else { 0.1 });
            for mosaic in MOSAICS {
                let found = in_colour(seen.view(), mosaic, Values::Light);
                let chroma = found.outer_iter().flat_map(|row| {
                    let spread = |colours: ndarray::ArrayView1<f32>| {
                        let most = colours.iter().fold(f32::MIN, |most, value| most.max(*value));
                        most - colours.iter().fold(f32::MAX, |least, value| least.min(*value))
                    };
                    row.outer_iter().map(spread).collect::<Vec<_>>()
                });
                let worst = chroma.fold(0.0, f32::max);
                assert!(worst < most * 0.8, "{mosaic:?}: {worst} of 0.8");
            }
        }
    }

    #[test]
    fn a_sample_changes_no_colour_beyond_the_reach_that_masks_have() {
        let texture = |t: usize, s: usize| ((7 * t + 3 * s + t * s) % 11) as f32 / 11.0;
        let before = Array2::from_shape_fn((24, 28), |(t, s)| texture(t, s));
        for mosaic in MOSAICS {
            let mut furthest = 0;
            for at in [[12, 13], [12, 14], [13, 13], [13, 14], [0, 0], [23, 1]] {
                for changed in [0.0, 0.5, 3.0] {
                    let mut after = before.clone();
                    after[at] = changed;
                    let [before, after] =
                        [&before, &after].map(|it| in_colour(it.view(), mosaic, Values::Light));
                    for ((t, s, _), _) in
                        before.indexed_iter().filter(|(place, value)| after[*place] != **value)
                    {
                        furthest = furthest.max(t.abs_diff(at[0]).max(s.abs_diff(at[1])));
                    }
                }
            }
            assert!((2..=REACH_PX).contains(&furthest), "{mosaic:?}: {furthest}");
        }
    }

    #[test]
    fn errors_keep_their_samples() {
        let sds = Array2::from_shape_fn((6, 8), |(t, s)| (8 * t + s) as f32);
        for mosaic in MOSAICS {
            let found = in_colour(sds.view(), mosaic, Values::Errors);
            for (place @ (t, s), sd) in sds.indexed_iter() {
                assert_eq!(found[[t, s, channel(mosaic, place)]], *sd);
            }
        }
    }

    #[test]
    fn nothing_is_known_beside_what_is_not_known() {
        let mut bits = Array2::from_elem((10, 14), mask::MEASURED);
        bits[[4, 4]] = 0;
        let spread = mask_in_colour(bits, Mosaic::BayerRG);
        assert_eq!((spread[[4, 4]], spread[[9, 0]], spread[[4, 10]]), (0, 0, mask::MEASURED));
    }

    #[test]
    fn what_is_interpolated_from_a_bound_is_no_more_than_a_bound() {
        let mut bits = Array2::from_elem((10, 14), mask::MEASURED | mask::NO_EDGE);
        bits[[4, 4]] = mask::BOUND_ONLY;
        let spread = mask_in_colour(bits.clone(), Mosaic::BayerRG);
        assert_eq!((spread[[9, 0]], spread[[4, 10]]), (mask::BOUND_ONLY | mask::NO_EDGE, bits[[4, 10]]));
        assert_eq!(mask_in_colour(bits.clone(), Mosaic::Mono), bits);
    }
}
