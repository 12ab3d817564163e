//! Light onto the sensor: which part of the scene's transport falls into an exposure.
//!
//! Light is integrated in time, row by row as the projector draws them, continuously within a row (finer than any
//! grid of steps). Nothing here knows of demultiplexing or of its matrix: a recovery proves itself against this.

use ndarray::{Array2, Array3, Axis, s};
use rayon::prelude::*;
use raysweep_core::{Mosaic, Raster};

use crate::SimError;
use crate::config::{Beam, RowTable, SimProjector, Spot};
use crate::keyed::{Purpose, keyed, uniform};
use crate::scene::Scene;

/// A scene under a raster projector, prepared so that an exposure costs two look-ups a camera row.
pub struct Optics {
    /// Start of each drawn row's light after the VSYNC edge, and the last row's end: the scene's rows and those beside
    /// them whose beam reaches it.
    row_starts_us: Vec<f64>,
    /// Light of the drawn rows above `v`, `[t, v, s]` with one entry of v more than rows are drawn.
    cumulative: Array3<f32>,
    /// Light that arrives at one moment of its row, if the spot's flight is simulated.
    flashes: Option<Flashes>,
}

/// Direct light under a flying spot.
struct Flashes {
    /// Direct light of each pixel, `[t, s]`.
    direct: Array2<f32>,
    /// Projector column 0..1 that each pixel sees, `[t, s]`.
    column: Array2<f32>,
    /// Rows away from the pixel's own and the share of the beam that they send.
    beam: Vec<(isize, f32)>,
    bidirectional: bool,
    /// Row of the projector that is drawn first.
    first_drawn: usize,
    /// Drawn row that is scene row 0.
    scene_offset: usize,
    /// What each drawn row shows.
    pattern: Vec<f32>,
}

impl Optics {
    /// Prepares `scene` under `pattern`, a weight for each of the projector's rows.
    ///
    /// # Errors
    /// When the scene does not fit the projector or the row table folds back in time.
    pub fn new(
        scene: &Scene,
        raster: &Raster,
        first_row: usize,
        projector: &SimProjector,
        pattern: &[f32],
        seed: u64,
        mosaic: Mosaic,
    ) -> Result<Self, SimError> {
        let transport = filtered(scene, mosaic);
        let (rows, height, width) = transport.dim();
        let table = row_table(raster, &projector.row_table, seed)?;
        let beam = beam_weights(&projector.beam)?;
        let beam_rows = beam.iter().map(|(offset, _)| offset.unsigned_abs()).max().unwrap_or(0);
        let first_drawn = first_row.saturating_sub(beam_rows);
        let end_drawn = (first_row + rows + beam_rows).min(raster.rows);
        let scene_offset = first_row - first_drawn;
        let row_starts_us = table[first_drawn..=end_drawn].to_vec();
        let pattern = pattern[first_drawn..end_drawn].to_vec();

        let direct = match projector.spot {
            Spot::Uniform => None,
            Spot::OneWay | Spot::Bidirectional => Some(Array2::from_shape_fn((height, width), |(t, s)| {
                if t < rows { transport[[t, t, s]] } else { 0.0 }
            })),
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
                        // Direct light under a flying spot is not spread over its row's time.
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
            bidirectional: projector.spot == Spot::Bidirectional,
            first_drawn,
            scene_offset,
            pattern,
        });
        Ok(Self { row_starts_us, cumulative, flashes })
    }

    /// Adds to `light` what camera row `t` receives of one frame of the projector between `from_us` and `to_us` after
    /// that frame's edge.
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

    /// How many rows, and which part of the next, have been drawn by `time_us`.
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

/// A place between two entries of the cumulative light.
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

/// The transport as the sensor's pixels see it, `[V, H, W]`: through a Bayer mosaic or, on a monochrome
/// sensor, the mean of the colours.
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
        // Blue lies diagonally from red, green beside both.
        let channel = (first_t ^ red_t) + (first_s ^ red_s);
        seen.slice_mut(s![.., first_t..;2, first_s..;2])
            .assign(&transport.index_axis(Axis(3), channel).slice(s![.., first_t..;2, first_s..;2]));
    }
    seen
}

/// Projector row of the scene's first: as given, or such that the scene is a window in the middle of the frame, as far
/// as the camera's rows, `row_pitch` projector rows each, allow.
///
/// # Errors
/// When scene or camera do not fit.
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
            // The sweep as a whole keeps its place: only its inside is bent.
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

/// The rows that a row's beam reaches and the share that each gets; the shares sum to 1.
fn beam_weights(beam: &Beam) -> Result<Vec<(isize, f32)>, SimError> {
    let weights: Vec<(isize, f64)> = match *beam {
        Beam::Ideal => vec![(0, 1.0)],
        Beam::Gaussian { sigma_rows } if sigma_rows > 0.0 && sigma_rows <= 100.0 => {
            let reach = (5.0 * sigma_rows).ceil() as isize;
            (-reach..=reach).map(|d| (d, (-(d as f64 / sigma_rows).powi(2) / 2.0).exp())).collect()
        }
        Beam::FlatTop { up_rows, down_rows }
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
