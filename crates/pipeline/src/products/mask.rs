//! The mask beside each product and transport: what is known of each of its values.

use std::collections::BTreeMap;
use std::ops::{Range, RangeInclusive};

use ndarray::{Array2, Array3, ArrayView3, Axis, s};
use raysweep_transport::plane::{PlaneError, Transport};

use super::spec::ProductKind;
use crate::stack::SweepStack;

/// The light is measured.
pub const MEASURED: u8 = 1;
/// The light is only known to be at least the value: samples that see it saturate.
pub const BOUND_ONLY: u8 = 2;
/// A stage replaced the pixel in some image.
pub const HOT_PIXEL_FILLED: u8 = 4;
/// Rows that the product asks for lie outside of the sweep's reach, and their light is missing.
pub const OUTSIDE_REACH: u8 = 8;
/// No exposure tells the rows `|u| <= 2` apart, which the product separates: the prior alone does.
pub const NO_EDGE: u8 = 16;

/// Rows as near as this to the pixel's own are told apart only by edges of exposures.
pub(super) const NEAR_ROWS: RangeInclusive<i32> = -2..=2;

/// Bits of each value of camera rows `rows` of a transport, `[u, t, s]`.
pub fn of_transport(transport: &Transport, rows: Range<usize>) -> Array3<u8> {
    let (depth, _, columns) = transport.t.dim();
    let mut bits = Array3::from_shape_fn((depth, rows.len(), columns), |(u, t, s)| {
        let row = rows.start + t;
        let known = if transport.exists[[u, row]] { MEASURED } else { OUTSIDE_REACH };
        let is_near = NEAR_ROWS.contains(&(transport.u_min + u as i32));
        known | if is_near && transport.no_edge[[row, s]] { NO_EDGE } else { 0 }
    });
    for (&[t, s], bounds) in transport.lower_bounds.range([rows.start, 0]..[rows.end, 0]) {
        let of_pixel = bits.slice_mut(s![.., t - rows.start, s]);
        for (bits, _) in of_pixel.into_iter().zip(bounds).filter(|(_, is_bound)| **is_bound) {
            *bits = *bits & !MEASURED | BOUND_ONLY;
        }
    }
    // Nothing is known of a pixel whose samples do not count, and which is dark: a calibration has not measured it.
    for (t, row) in rows.enumerate() {
        let is_unmeasured = |s: &usize| {
            transport.saturated[[row, *s]]
                && !transport.lower_bounds.contains_key(&[row, *s])
                && transport.t.slice(s![.., row, *s]).iter().all(|light| *light == 0.0)
        };
        for s in (0..columns).filter(is_unmeasured) {
            bits.slice_mut(s![.., t, s]).mapv_inplace(|bits| bits & OUTSIDE_REACH);
        }
    }
    bits
}

/// The transport whose values and bits, both `[u, t, s]`, were stored. Of the pixels with samples that saturate, it names
/// those some of whose light is only a bound.
pub fn stored_transport(t: Array3<f32>, u_min: i32, bits: ArrayView3<'_, u8>) -> Transport {
    let (depth, rows, columns) = t.dim();
    let mut no_edge = Array2::from_elem((rows, columns), false);
    let mut lower_bounds = BTreeMap::<[usize; 2], Vec<bool>>::new();
    for ((u, t, s), bits) in bits.indexed_iter() {
        if bits & BOUND_ONLY != 0 {
            lower_bounds.entry([t, s]).or_insert_with(|| vec![false; depth])[u] = true;
        }
        no_edge[[t, s]] |= bits & NO_EDGE != 0;
    }
    Transport {
        exists: Array2::from_shape_fn((depth, rows), |(u, t)| {
            bits.slice(s![u, t, ..]).iter().all(|bits| bits & OUTSIDE_REACH == 0)
        }),
        saturated: Array2::from_shape_fn((rows, columns), |(t, s)| lower_bounds.contains_key(&[t, s])),
        no_edge,
        t,
        u_min,
        lower_bounds,
    }
}

/// Bits of a product's pixels, `[t, s]`, for the camera rows starting at `first_row`, to which stack and transport
/// belong.
pub(super) fn of(
    kind: &ProductKind,
    first_row: usize,
    stack: &SweepStack,
    transport: &Transport,
) -> Result<Array2<u8>, PlaneError> {
    let relit = kind.relit().map(|relit| relit.unknowns(&stack.timing, first_row, transport)).transpose()?;
    let (_, height, width) = transport.t.dim();
    let rows = kind.rows();
    let is_lit = |u: i32| rows.iter().any(|rows| rows.contains(&u));
    let near = NEAR_ROWS.filter(|&u| is_lit(u)).count();
    let separates = near > 0 && (near < NEAR_ROWS.count() || kind.tells_each_band());
    // Rows without end mean those within the reach.
    let asked = |u: i32| {
        rows.iter().any(|rows| *rows.start() > i32::MIN && *rows.end() < i32::MAX && rows.contains(&u))
    };
    let measured =
        stack.valid.as_ref().map(|valid| valid.map_axis(Axis(0), |valid| valid.iter().any(|v| *v)));
    let saturates = match kind {
        ProductKind::Captured(captured) => captured.saturates(stack),
        _ => None,
    };
    let at = |map: &Option<Array2<bool>>, pixel, absent| map.as_ref().map_or(absent, |map| map[pixel]);
    Ok(Array2::from_shape_fn((height, width), |pixel| {
        let (t, s) = pixel;
        let is_bound = match (kind, &relit) {
            (ProductKind::Regular, _) => !at(&stack.regular_valid, pixel, true),
            (ProductKind::Captured(_), _) => at(&saturates, pixel, false),
            (_, Some(relit)) => relit.is_bound[pixel],
            _ => rows.iter().any(|rows| transport.is_bound([t, s], rows.clone())),
        };
        let beyond = [transport.u_min - 1, transport.u_max() + 1];
        let is_outside = match &relit {
            Some(relit) => relit.is_beyond[pixel],
            None => beyond.iter().any(|&u| asked(u) && stack.timing.row_exists(u, first_row + t)),
        };
        [
            (at(&measured, pixel, true) && !is_bound, MEASURED),
            (is_bound, BOUND_ONLY),
            (at(&stack.filled, pixel, false), HOT_PIXEL_FILLED),
            (is_outside, OUTSIDE_REACH),
            (separates && transport.no_edge[pixel], NO_EDGE),
        ]
        .into_iter()
        .fold(0, |mask, (is_set, bit)| if is_set { mask | bit } else { mask })
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_known_of_a_transport_is_read_back() {
        let t = Array3::from_shape_fn(
            (9, 4, 5),
            |(u, t, s)| if (t, s) == (1, 1) { 0.0 } else { (u + t + s + 1) as f32 },
        );
        let exists = Array2::from_shape_fn((9, 4), |(u, t)| u + t >= 2);
        let mut transport = Transport::measured(t, -4, exists);
        for pixel in [[0, 3], [3, 0], [1, 1]] {
            transport.saturated[pixel] = true;
        }
        transport.lower_bounds.insert([0, 3], (0..9).map(|u| u == 4).collect());
        transport.lower_bounds.insert([3, 0], (0..9).map(|u| u > 5).collect());
        transport.no_edge[[2, 2]] = true;
        let bits = of_transport(&transport, 0..4);
        assert_eq!(
            (bits[[4, 0, 3]], bits[[3, 0, 3]], bits[[0, 0, 0]]),
            (BOUND_ONLY, MEASURED, OUTSIDE_REACH)
        );
        assert_eq!((bits[[4, 2, 2]], bits[[1, 2, 2]]), (MEASURED | NO_EDGE, MEASURED));
        assert_eq!((bits[[4, 1, 1]], bits[[0, 1, 1]]), (0, OUTSIDE_REACH), "nothing is known of it");
        assert_eq!(of_transport(&transport, 2..4), bits.slice(s![.., 2.., ..]));
        let back = stored_transport(transport.t.clone(), -4, bits.view());
        transport.saturated[[1, 1]] = false;
        assert_eq!(back, transport);
    }
}
