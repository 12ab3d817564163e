//! What a pattern lights of a scene: the rows that the projector draws, and the scene's transport under each kind of them.

use ndarray::{Array3, ArrayView4, Axis, s};
use raysweep_core::{Mosaic, PROJECTOR_COLUMNS, Pattern};

use crate::error::SimError;
use crate::lens::DefocusDisc;
use crate::scene::{Scene, SceneError};

/// A pattern as the rows that the projector draws, of which many are alike.
pub struct DrawnRows {
    /// Weights of the columns of each kind of row; `None`: the same for all.
    pub kinds: Vec<Option<Vec<f32>>>,
    /// The kind of each row, and its weight.
    pub kind_of: Vec<usize>,
    pub weights: Vec<f32>,
}

impl DrawnRows {
    pub fn new(pattern: &Pattern, rows: usize, disc: Option<&DefocusDisc>) -> Result<Self, SimError> {
        let blurred =
            |columns: Vec<f32>| disc.map_or_else(|| columns.clone(), |disc| disc.blur_line(&columns));
        if let Some(weights) = pattern.row_weights(rows)? {
            return Ok(Self { kinds: vec![None], kind_of: vec![0; rows], weights });
        }
        let weights = vec![1.0; rows];
        if let Some(columns) = pattern.column_weights(PROJECTOR_COLUMNS)? {
            return Ok(Self { kinds: vec![Some(blurred(columns))], kind_of: vec![0; rows], weights });
        }
        let pixels = pattern.pixel_weights((PROJECTOR_COLUMNS, rows))?.ok_or(SimError::Picture)?;
        let (mut different, mut kind_of): (Vec<&[f32]>, Vec<usize>) = (Vec::new(), Vec::new());
        for row in pixels.chunks(PROJECTOR_COLUMNS) {
            let known = different.iter().position(|known| *known == row);
            kind_of.push(known.unwrap_or_else(|| {
                different.push(row);
                different.len() - 1
            }));
        }
        let kinds = different.into_iter().map(|row| Some(blurred(row.to_vec()))).collect();
        Ok(Self { kinds, kind_of, weights })
    }
}

/// The transport `[V, H, W]` of a scene whose rows are lit with the columns' weights of each kind.
pub fn transports(
    scene: &Scene,
    kinds: &[Option<Vec<f32>>],
    mosaic: Mosaic,
) -> Result<Vec<Array3<f32>>, SimError> {
    let mut made: Vec<Array3<f32>> = Vec::new();
    for kind in kinds {
        let Some(columns) = kind else {
            made.push(filtered(scene.transport.view(), mosaic));
            continue;
        };
        // A checkerboard has two kinds of rows, which together are white.
        let is_rest = |other: &&Option<Vec<f32>>| {
            let other = other.iter().flatten();
            other.clone().count() > 0 && other.zip(columns).all(|(a, b)| a + b == 1.0)
        };
        let rest = kinds[..made.len()].iter().position(|other| is_rest(&other));
        made.push(match rest {
            Some(rest) => {
                (filtered(scene.transport.view(), mosaic) - &made[rest]).mapv(|light| light.max(0.0))
            }
            None => {
                let images = scene.under_columns(columns).map_err(|error| match error {
                    SceneError::RowsOnly { .. } => SimError::AlongRows,
                    other => other.into(),
                })?;
                filtered(images.view(), mosaic)
            }
        });
    }
    Ok(made)
}

/// The transport as seen by the sensor's pixels, `[V, H, W]`: through a Bayer mosaic or, on a monochrome sensor, the
/// mean of the colours.
fn filtered(transport: ArrayView4<'_, f32>, mosaic: Mosaic) -> Array3<f32> {
    let channels = transport.dim().3;
    if channels == 1 {
        return transport.index_axis(Axis(3), 0).to_owned();
    }
    let Some((red_s, red_t)) = mosaic.red() else {
        return transport.sum_axis(Axis(3)) / channels as f32;
    };
    let (rows, height, width, _) = transport.dim();
    let mut seen = Array3::zeros((rows, height, width));
    for (first_t, first_s) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
        // Blue is diagonal to red; green is adjacent to both.
        let channel = (first_t ^ red_t) + (first_s ^ red_s);
        seen.slice_mut(s![.., first_t..;2, first_s..;2])
            .assign(&transport.index_axis(Axis(3), channel).slice(s![.., first_t..;2, first_s..;2]));
    }
    seen
}
