//! Light on the sensor: the part of the scene's transport that falls into an exposure.
//!
//! Light is integrated in time, row by row as the projector draws, continuously within a row (finer than any time
//! grid). This code shares nothing with demultiplexing or its matrix, so that it can serve as an independent check.

use ndarray::{Array2, Array3, Axis, s};
use rayon::prelude::*;
use raysweep_core::{Mosaic, Raster};

use crate::error::SimError;
use crate::keyed::{Purpose, keyed, uniform};
use crate::scene::Scene;
use raysweep_config::sim::{RowTable, SimBeam, SimProjector, SimSpot};

/// A scene under a raster projector, prepared so that an exposure takes two look-ups per camera row.
pub struct RasterOptics {
    /// Start of each drawn row's light after the VSYNC edge, and the last row's end. Drawn rows are the scene's rows
    /// and those next to them whose beam reaches it.
    row_starts_us: Vec<f64>,
    /// Summed light of the drawn rows before `v`, `[t, v, s]`, with one more v than drawn rows.
    cumulative: Array3<f32>,
    /// Direct light that arrives at one instant within its row, if the moving spot is simulated.
    flashes: Option<Flashes>,
}

/// Direct light of a moving spot.
struct Flashes {
    /// Direct light of each pixel, `[t, s]`.
    direct: Array2<f32>,
    /// Projector column 0..1 that each pixel sees, `[t, s]`.
    column: Array2<f32>,
    /// Offset in rows from the pixel's own row, and the fraction of the beam that arrives from there.
    beam: Vec<(isize, f32)>,
    bidirectional: bool,
    /// Projector row of the first drawn row.
    first_drawn: usize,
    /// Drawn row that corresponds to scene row 0.
    scene_offset: usize,
    /// Weight of each drawn row in the pattern.
    pattern: Vec<f32>,
}

impl RasterOptics {
    /// Prepares `scene` under `pattern`, which has one weight per projector row, drawn at the times of the row table.
    ///
    /// # Errors
    /// When the beam's profile is out of range.
    pub fn new(
        scene: &Scene,
        mosaic: Mosaic,
        first_row: usize,
        projector: &SimProjector,
        row_table: &[f64],
        pattern: &[f32],
    ) -> Result<Self, SimError> {
        let transport = filtered(scene, mosaic);
        let (rows, height, width) = transport.dim();
        let beam = beam_weights(&projector.beam)?;
        let beam_rows = beam.iter().map(|(offset, _)| offset.unsigned_abs()).max().unwrap_or(0);
        let first_drawn = first_row.saturating_sub(beam_rows);
        let end_drawn = (first_row + rows + beam_rows).min(pattern.len());
        let scene_offset = first_row - first_drawn;
        let row_starts_us = row_table[first_drawn..=end_drawn].to_vec();
        let pattern = pattern[first_drawn..end_drawn].to_vec();

        let direct = match projector.spot {
            SimSpot::Uniform => None,
            SimSpot::OneWay | SimSpot::Bidirectional => {
                Some(Array2::from_shape_fn((height, width), |(t, s)| {
                    if t < rows { transport[[t, t, s]] } else { 0.0 }
                }))
            }
        };
        let mut cumulative = Array3::<f32>::zeros((height, pattern.len() + 1, width));
        cumulative.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut light)| {
            let mut sum = vec![0.0_f64; width];
            for (v, &shown) in pattern.iter().enumerate() {
                for &(offset, share) in &beam {
                    let lit = v.checked_add_signed(offset).and_then(|lit| lit.checked_sub(scene_offset));
                    let Some(lit) = lit.filter(|&lit| lit < rows) else { continue };
                    let weight = f64::from(share * shown);
                    for (s, sum) in sum.iter_mut().enumerate() {
                        // Direct light of a moving spot is not spread over the row's dwell.
                        if direct.is_none() || lit != t {
                            *sum += weight * f64::from(transport[[lit, t, s]]);
                        }
                    }
                }
                light.row_mut(v + 1).iter_mut().zip(&sum).for_each(|(light, &sum)| *light = sum as f32);
            }
        });

        let flashes = direct.map(|direct| Flashes {
            direct,
            column: scene.projector_column.clone().unwrap_or_else(|| {
                Array2::from_shape_fn((height, width), |(_, s)| (s as f32 + 0.5) / width as f32)
            }),
            beam,
            bidirectional: projector.spot == SimSpot::Bidirectional,
            first_drawn,
            scene_offset,
            pattern,
        });
        Ok(Self { row_starts_us, cumulative, flashes })
    }

    /// Adds to `light` what camera row `t` receives from one projector frame between `from_us` and `to_us` after that
    /// frame's edge.
    pub fn expose_row(&self, t: usize, from_us: f64, to_us: f64, light: &mut [f32]) {
        let (from, to) = (self.rows_drawn(from_us), self.rows_drawn(to_us));
        if to > from {
            let rows = self.cumulative.index_axis(Axis(0), t);
            let (a, b) = (Between::at(from, rows.nrows()), Between::at(to, rows.nrows()));
            let at = |edge: &Between, s: usize| {
                let (above, below) = (rows[[edge.row, s]], rows[[edge.row + 1, s]]);
                above + edge.share * (below - above)
            };
            light.iter_mut().enumerate().for_each(|(s, light)| *light += at(&b, s) - at(&a, s));
        }
        if let Some(flashes) = &self.flashes {
            flashes.expose_row(&self.row_starts_us, t, from_us, to_us, light);
        }
    }

    /// Number of rows drawn by `time_us`, with the fraction of the row in progress.
    fn rows_drawn(&self, time_us: f64) -> f64 {
        let starts = &self.row_starts_us;
        let begun = starts.partition_point(|&start| start <= time_us);
        if begun == 0 {
            return 0.0;
        }
        if begun == starts.len() {
            return (starts.len() - 1) as f64;
        }
        let row = begun - 1;
        row as f64 + (time_us - starts[row]) / (starts[row + 1] - starts[row])
    }
}

/// A position between two entries of the cumulative light.
struct Between {
    row: usize,
    share: f32,
}

impl Between {
    fn at(position: f64, entries: usize) -> Self {
        let row = (position as usize).min(entries - 2);
        Self { row, share: (position - row as f64) as f32 }
    }
}

impl Flashes {
    fn expose_row(&self, row_starts_us: &[f64], t: usize, from_us: f64, to_us: f64, light: &mut [f32]) {
        for &(offset, share) in &self.beam {
            let drawn = (t + self.scene_offset).checked_add_signed(-offset);
            let Some(v) = drawn.filter(|&v| v + 1 < row_starts_us.len()) else { continue };
            let (start_us, dwell_us) = (row_starts_us[v], row_starts_us[v + 1] - row_starts_us[v]);
            if start_us + dwell_us <= from_us || start_us >= to_us {
                continue;
            }
            let backwards = self.bidirectional && (self.first_drawn + v) % 2 == 1;
            let weight = share * self.pattern[v];
            for (s, light) in light.iter_mut().enumerate() {
                let column = f64::from(self.column[[t, s]]);
                let moment_us = start_us + dwell_us * if backwards { 1.0 - column } else { column };
                if (from_us..to_us).contains(&moment_us) {
                    *light += weight * self.direct[[t, s]];
                }
            }
        }
    }
}

/// The transport as seen by the sensor's pixels, `[V, H, W]`: through a Bayer mosaic or, on a monochrome sensor, the
/// mean of the colours.
fn filtered(scene: &Scene, mosaic: Mosaic) -> Array3<f32> {
    let transport = &scene.transport;
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

/// Projector row of the scene's first row: `given`, or a value that centres the scene in the frame as far as the
/// camera's rows, `row_pitch` projector rows each, allow.
///
/// # Errors
/// When the scene or the camera rows do not fit.
pub fn first_scene_row(
    raster: &Raster,
    scene: &Scene,
    row_pitch: f64,
    given: Option<usize>,
) -> Result<usize, SimError> {
    let (scene_rows, (camera_height, _)) = (scene.rows(), scene.size());
    let camera_rows = ((camera_height - 1) as f64 * row_pitch).round() as usize + 1;
    let spare = |rows: usize| raster.rows.saturating_sub(rows);
    let first_row = given.unwrap_or_else(|| (spare(scene_rows) / 2).min(spare(camera_rows)));
    if first_row + scene_rows > raster.rows {
        return Err(SimError::SceneRows { scene_rows, first_row, projector_rows: raster.rows });
    }
    if first_row + camera_rows > raster.rows {
        return Err(SimError::CameraRows { camera_rows, first_row, projector_rows: raster.rows });
    }
    Ok(first_row)
}

/// Start of each projector row's light after the VSYNC edge, and the last row's end: `[rows + 1]`.
pub fn row_table(raster: &Raster, table: &RowTable, seed: u64) -> Result<Vec<f64>, SimError> {
    let sweep_us = raster.rows as f64 * raster.row_time_us;
    let linear = |row: usize| raster.first_row_us + row as f64 * raster.row_time_us;
    let starts: Vec<f64> = match *table {
        RowTable::Linear => (0..=raster.rows).map(linear).collect(),
        RowTable::Quadratic { percent } => (0..=raster.rows)
            .map(|row| {
                let x = row as f64 / raster.rows as f64;
                linear(row) - percent / 100.0 * sweep_us * 4.0 * x * (1.0 - x)
            })
            .collect(),
        RowTable::Kinked { pieces, amplitude_us } => {
            let pieces = pieces.clamp(1, raster.rows);
            let mut random = keyed(seed, Purpose::RowTable, &[]);
            let mut knots: Vec<f64> =
                (0..=pieces).map(|_| amplitude_us * (2.0 * uniform(&mut random) - 1.0)).collect();
            // The sweep keeps its start and end; only times in between are shifted.
            (knots[0], knots[pieces]) = (0.0, 0.0);
            (0..=raster.rows)
                .map(|row| {
                    let x = row as f64 / raster.rows as f64 * pieces as f64;
                    let piece = (x as usize).min(pieces - 1);
                    let share = x - piece as f64;
                    linear(row) + knots[piece] * (1.0 - share) + knots[piece + 1] * share
                })
                .collect()
        }
    };
    if starts.is_sorted_by(|a, b| a < b) { Ok(starts) } else { Err(SimError::RowTable) }
}

/// Row offsets that a row's beam reaches and the fraction of light at each; the fractions sum to 1.
fn beam_weights(beam: &SimBeam) -> Result<Vec<(isize, f32)>, SimError> {
    let weights: Vec<(isize, f64)> = match *beam {
        SimBeam::Ideal => vec![(0, 1.0)],
        SimBeam::Gaussian { sigma_rows } if sigma_rows > 0.0 && sigma_rows <= 100.0 => {
            let reach = (5.0 * sigma_rows).ceil() as isize;
            (-reach..=reach).map(|d| (d, (-(d as f64 / sigma_rows).powi(2) / 2.0).exp())).collect()
        }
        SimBeam::FlatTop { up_rows, down_rows }
            if up_rows >= 0.0
                && down_rows >= 0.0
                && up_rows + down_rows > 0.0
                && up_rows + down_rows <= 500.0 =>
        {
            let overlap =
                |d: isize| ((d as f64 + 0.5).min(down_rows) - (d as f64 - 0.5).max(-up_rows)).max(0.0);
            (-(up_rows.ceil() as isize) - 1..=down_rows.ceil() as isize + 1)
                .map(|d| (d, overlap(d)))
                .filter(|&(_, share)| share > 0.0)
                .collect()
        }
        _ => return Err(SimError::Beam),
    };
    let total: f64 = weights.iter().map(|(_, share)| share).sum();
    Ok(weights.into_iter().map(|(d, share)| (d, (share / total) as f32)).collect())
}
