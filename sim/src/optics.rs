//! Light on the sensor: the part of the scene's transport that falls into an exposure.
//!
//! Light is integrated in time, row by row as the projector draws, continuously within a row (finer than any time
//! grid). This code shares nothing with demultiplexing or its matrix, so that it can serve as an independent check.

use ndarray::{Array2, Array3, Axis, s};
use rayon::prelude::*;
use raysweep_config::sim::{RowTable, SimBeam, SimBoard, SimProjector, SimSpot};
use raysweep_core::{Mosaic, PROJECTOR_COLUMNS, Pattern, Raster};

use crate::drawn::{DrawnRows, transports};
use crate::error::SimError;
use crate::keyed::{Purpose, keyed, uniform};
use crate::lens::DefocusDisc;
use crate::scene::Scene;
use crate::truth::PlaneTruth;

/// What all subjects of a rig have in common: how the projector draws, and what the camera sees of it.
pub struct View<'a> {
    /// Timing, and where pixels look.
    pub truth: &'a PlaneTruth,
    /// SimBeam, spot and row table.
    pub projector: &'a SimProjector,
    /// Seed of the row table.
    pub seed: u64,
    /// Colours of the camera's pixels.
    pub mosaic: Mosaic,
    /// What the projector's lens makes of a point; `None`: a point.
    pub disc: Option<&'a DefocusDisc>,
}

/// A subject under a raster projector, prepared so that an exposure takes two look-ups per camera row.
pub struct RasterOptics {
    /// Start of each drawn row's light after the VSYNC edge, and the last row's end. Drawn rows of a scene are its
    /// rows and those next to them whose beam reaches it; those of a board are all.
    row_starts_us: Vec<f64>,
    /// Light that arrives evenly over its row.
    steady: Option<Steady>,
    /// Light that arrives at one instant within its row, if the moving spot is simulated.
    flashes: Option<Flashes>,
}

/// Light that arrives evenly over its row.
struct Steady {
    /// First drawn row of each camera row's window.
    first: Vec<usize>,
    /// Summed light of the window's rows before its `v`-th, `[t, v, s]`, with one more v than rows.
    cumulative: Array3<f32>,
}

/// Light of a moving spot.
struct Flashes {
    /// Start of each projector row's light after the VSYNC edge, and the last row's end.
    row_starts_us: Vec<f64>,
    own: OwnLight,
    /// Projector column 0..1 that each pixel sees, `[t, s]`.
    column: Array2<f32>,
    bidirectional: bool,
}

/// Light that reaches pixels from the places at which they look, by the projector row that sends it.
struct OwnLight {
    /// First projector row of each camera row's window.
    first: Vec<usize>,
    /// `[t, row of the window, s]`.
    light: Array3<f32>,
}

impl RasterOptics {
    /// Prepares `scene` under `pattern`.
    ///
    /// # Errors
    /// When the pattern does not fit the projector or the scene, or when rows would be drawn in a different order.
    pub fn of_scene(scene: &Scene, view: &View<'_>, pattern: &Pattern) -> Result<Self, SimError> {
        let &View { truth, projector, seed, mosaic, disc } = view;
        let raster = &truth.raster;
        let drawn = DrawnRows::new(pattern, raster.rows, disc)?;
        let mut transports = transports(scene, &drawn.kinds, mosaic)?;
        let (rows, height, width) = transports[0].dim();
        let table = row_table(raster, &projector.row_table, seed)?;
        let kernel = Kernel::new(&projector.beam, raster.rows)?.through(disc);

        let flashes = match projector.spot {
            SimSpot::Uniform => None,
            SimSpot::OneWay | SimSpot::Bidirectional => {
                let own_row = |transport: &mut Array3<f32>| {
                    let mut direct = Array2::<f32>::zeros((height, width));
                    for t in 0..height.min(rows) {
                        direct.row_mut(t).assign(&transport.slice(s![t, t, ..]));
                        // Direct light of a moving spot is not spread over the row's dwell.
                        transport.slice_mut(s![t, t, ..]).fill(0.0);
                    }
                    direct
                };
                let direct: Vec<Array2<f32>> = transports.iter_mut().map(own_row).collect();
                let unspread = &[(0, 1.0)];
                let own = OwnLight::new(view, &kernel, unspread, |row, t, s| {
                    drawn.weights[row] * direct[drawn.kind_of[row]][[t, s]]
                });
                let column = scene.projector_column.clone().unwrap_or_else(|| {
                    Array2::from_shape_fn((height, width), |(_, s)| (s as f32 + 0.5) / width as f32)
                });
                Some(Flashes::new(own, column, &table, projector.spot))
            }
        };

        let (transports, rows_up): (Vec<_>, Vec<_>) =
            transports.into_iter().map(|transport| shifted(transport, truth)).unzip();
        let (rows, rows_up) = (transports[0].len_of(Axis(0)), rows_up[0]);
        let first_row = truth.first_row.saturating_add_signed(-rows_up);
        let beam_rows = kernel.reach_rows();
        let first_drawn = first_row.saturating_sub(beam_rows);
        let end_drawn = (first_row + rows + beam_rows).min(raster.rows);
        let scene_offset = first_row - first_drawn;
        let mut cumulative = Array3::<f32>::zeros((height, end_drawn - first_drawn + 1, width));
        cumulative.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut light)| {
            let mut sum = vec![0.0_f64; width];
            for (v, row) in (first_drawn..end_drawn).enumerate() {
                let transport = &transports[drawn.kind_of[row]];
                for (offset, share) in kernel.of_row(row) {
                    let lit = v.checked_add_signed(offset).and_then(|lit| lit.checked_sub(scene_offset));
                    let Some(lit) = lit.filter(|&lit| lit < rows) else { continue };
                    let weight = f64::from(share * drawn.weights[row]);
                    for (s, sum) in sum.iter_mut().enumerate() {
                        *sum += weight * f64::from(transport[[lit, t, s]]);
                    }
                }
                light.row_mut(v + 1).iter_mut().zip(&sum).for_each(|(light, &sum)| *light = sum as f32);
            }
        });
        Ok(Self {
            row_starts_us: table[first_drawn..=end_drawn].to_vec(),
            steady: Some(Steady { first: vec![0; height], cumulative }),
            flashes,
        })
    }

    /// Prepares the board under `pattern`.
    ///
    /// # Errors
    /// When the pattern does not fit the projector, or when rows would be drawn in a different order.
    pub fn of_board(board: &SimBoard, view: &View<'_>, pattern: &Pattern) -> Result<Self, SimError> {
        let &View { truth, projector, seed, disc, .. } = view;
        let (raster, (_, width)) = (&truth.raster, truth.size());
        let table = row_table(raster, &projector.row_table, seed)?;
        let kernel = Kernel::new(&projector.beam, raster.rows)?.through(disc);
        let [left, right] = board.projector_columns;
        let column = |x: f64| left + (right - left) * x / width as f64;
        let seen: Array2<f32> = match pattern.row_weights(raster.rows)? {
            Some(weights) => Array2::from_shape_fn((raster.rows, width), |(v, _)| weights[v]),
            None => {
                let size = (PROJECTOR_COLUMNS, raster.rows);
                let mut weights = pattern.pixel_weights(size)?.ok_or(SimError::Picture)?;
                if let Some(disc) = disc {
                    weights = weights
                        .par_chunks(PROJECTOR_COLUMNS)
                        .flat_map_iter(|row| disc.blur_line(row))
                        .collect();
                }
                Array2::from_shape_fn((raster.rows, width), |(v, s)| {
                    let row = &weights[v * PROJECTOR_COLUMNS..][..PROJECTOR_COLUMNS];
                    mean_over(row, column(s as f64), column(s as f64 + 1.0))
                })
            }
        };
        let own = OwnLight::new(view, &kernel, &spread_inside(board), |row, _, s| seen[[row, s]]);
        if projector.spot != SimSpot::Uniform {
            let column = Array2::from_shape_fn(truth.size(), |(_, s)| column(s as f64 + 0.5) as f32);
            let flashes = Some(Flashes::new(own, column, &table, projector.spot));
            return Ok(Self { row_starts_us: table, steady: None, flashes });
        }
        let (height, window, width) = own.light.dim();
        let mut cumulative = Array3::<f32>::zeros((height, window + 1, width));
        for v in 0..window {
            let sum = &cumulative.slice(s![.., v, ..]) + &own.light.slice(s![.., v, ..]);
            cumulative.slice_mut(s![.., v + 1, ..]).assign(&sum);
        }
        Ok(Self {
            row_starts_us: table,
            steady: Some(Steady { first: own.first, cumulative }),
            flashes: None,
        })
    }

    /// Adds to `light` what camera row `t` receives from one projector frame between `from_us` and `to_us` after that
    /// frame's edge.
    pub fn expose_row(&self, t: usize, from_us: f64, to_us: f64, light: &mut [f32]) {
        let (from, to) = (self.rows_drawn(from_us), self.rows_drawn(to_us));
        if let Some(Steady { first, cumulative }) = &self.steady {
            let rows = cumulative.index_axis(Axis(0), t);
            let most = (rows.nrows() - 1) as f64;
            let within = |drawn: f64| (drawn - first[t] as f64).clamp(0.0, most);
            let (from, to) = (within(from), within(to));
            if to > from {
                let (a, b) = (Between::at(from, rows.nrows()), Between::at(to, rows.nrows()));
                let at = |edge: &Between, s: usize| {
                    let (above, below) = (rows[[edge.row, s]], rows[[edge.row + 1, s]]);
                    above + edge.share * (below - above)
                };
                light.iter_mut().enumerate().for_each(|(s, light)| *light += at(&b, s) - at(&a, s));
            }
        }
        if let Some(flashes) = &self.flashes {
            flashes.expose_row(t, from_us, to_us, light);
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
    fn new(own: OwnLight, column: Array2<f32>, row_starts_us: &[f64], spot: SimSpot) -> Self {
        let bidirectional = spot == SimSpot::Bidirectional;
        Self { row_starts_us: row_starts_us.to_vec(), own, column, bidirectional }
    }

    fn expose_row(&self, t: usize, from_us: f64, to_us: f64, light: &mut [f32]) {
        let sent = self.own.light.index_axis(Axis(0), t);
        for (v, sent) in sent.outer_iter().enumerate().rev() {
            let row = self.own.first[t] + v;
            let (start_us, end_us) = (self.row_starts_us[row], self.row_starts_us[row + 1]);
            if end_us <= from_us || start_us >= to_us {
                continue;
            }
            let backwards = self.bidirectional && row % 2 == 1;
            for (s, light) in light.iter_mut().enumerate() {
                let column = f64::from(self.column[[t, s]]);
                let moment_us =
                    start_us + (end_us - start_us) * if backwards { 1.0 - column } else { column };
                if (from_us..to_us).contains(&moment_us) {
                    *light += sent[s];
                }
            }
        }
    }
}

impl OwnLight {
    /// Light of pixels that send on `sent` (projector row, t, s) of that at their places. A pixel sees one row's height about its place, and `inside` the subject light spreads over rows.
    fn new(
        view: &View<'_>,
        kernel: &Kernel,
        inside: &[(isize, f32)],
        sent: impl Fn(usize, usize, usize) -> f32 + Sync,
    ) -> Self {
        let &View { truth, .. } = view;
        let (rows, (height, width)) = (truth.raster.rows, truth.size());
        let reach = kernel.reach_rows() + inside.iter().map(|(d, _)| d.unsigned_abs()).max().unwrap_or(0);
        // Places change linearly along a camera row.
        let places = |t| (truth.place(t, 0), truth.place(t, width - 1));
        let span = |t| {
            let (left, right) = places(t);
            (left.min(right).floor(), left.max(right).floor() + 1.0)
        };
        let spans = (0..height).map(|t| span(t).1 - span(t).0);
        let window = (spans.fold(0.0, f64::max) as usize + 1 + 2 * reach).min(rows);
        let first_of = |t: usize| ((span(t).0 - reach as f64).max(0.0) as usize).min(rows - window);
        let mut light = Array3::zeros((height, window, width));
        light.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut light)| {
            for s in 0..width {
                let seen = Seen::new(truth.place(t, s), inside);
                for v in 0..window {
                    let row = first_of(t) + v;
                    let mut sum = 0.0;
                    for (offset, share) in kernel.of_row(row) {
                        sum += share * seen.share(row as isize + offset) * sent(row, t, s);
                    }
                    light[[v, s]] = sum;
                }
            }
        });
        Self { first: (0..height).map(first_of).collect(), light }
    }
}

/// The shares of lit rows in the light of a pixel.
struct Seen {
    first: isize,
    shares: Vec<f32>,
}

impl Seen {
    /// A pixel that sees one row's height about `place`, of a subject inside which light spreads over rows.
    fn new(place: f64, inside: &[(isize, f32)]) -> Self {
        let (above, below) = split(place);
        let own = place.floor() as isize;
        let first = own + inside.iter().map(|&(d, _)| d).min().unwrap_or(0);
        let last = own + 1 + inside.iter().map(|&(d, _)| d).max().unwrap_or(0);
        let mut shares = vec![0.0; (last - first + 1) as usize];
        for &(d, share) in inside {
            let at = (own + d - first) as usize;
            shares[at] += above * share;
            shares[at + 1] += below * share;
        }
        Self { first, shares }
    }

    fn share(&self, row: isize) -> f32 {
        usize::try_from(row - self.first).ok().and_then(|at| self.shares.get(at)).copied().unwrap_or(0.0)
    }
}

/// The shares of the rows above and below a place, of a pixel that sees one row's height.
fn split(place: f64) -> (f32, f32) {
    let below = (place - place.floor()) as f32;
    (1.0 - below, below)
}

/// The transport of pixels that look further down than in the scene, and the number of rows that it begins above the
/// scene's first.
fn shifted(transport: Array3<f32>, truth: &PlaneTruth) -> (Array3<f32>, isize) {
    let (rows, height, width) = transport.dim();
    let corners = [(0, 0), (0, width - 1), (height - 1, 0), (height - 1, width - 1)];
    let shifts = corners.map(|(t, s)| truth.shift_rows(t, s));
    let up = -shifts.iter().fold(0.0, |a: f64, &b| a.min(b.floor())) as isize;
    let down = shifts.iter().fold(0.0, |a: f64, &b| a.max(b.ceil())) as isize;
    if (up, down) == (0, 0) {
        return (transport, 0);
    }
    let mut seen = Array3::zeros((rows + (up + down) as usize, height, width));
    seen.axis_iter_mut(Axis(1)).into_par_iter().enumerate().for_each(|(t, mut seen)| {
        for s in 0..width {
            let shift = truth.shift_rows(t, s);
            let ((above, below), first) = (split(shift), (shift.floor() as isize + up) as usize);
            for v in 0..rows {
                let light = transport[[v, t, s]];
                seen[[first + v, s]] += above * light;
                if below > 0.0 {
                    seen[[first + v + 1, s]] += below * light;
                }
            }
        }
    });
    (seen, up)
}

/// Mean of a row's weights between two of its columns, 0..1 over its width.
fn mean_over(row: &[f32], from: f64, to: f64) -> f32 {
    let place = |column: f64| (column * row.len() as f64).clamp(0.0, row.len() as f64);
    let (from, to) = (place(from.min(to)), place(from.max(to)));
    let cells = from as usize..(to.ceil() as usize).min(row.len());
    let overlap = |cell: usize| (to.min(cell as f64 + 1.0) - from.max(cell as f64)).max(0.0);
    let sum: f64 = cells.map(|cell| overlap(cell) * f64::from(row[cell])).sum();
    if to > from { (sum / (to - from)) as f32 } else { row[(from as usize).min(row.len() - 1)] }
}

/// Row offsets over which light spreads inside the board, and the shares; they sum to 1. The spread is exponential to
/// both sides.
fn spread_inside(board: &SimBoard) -> Vec<(isize, f32)> {
    let &SimBoard { scatter_rows, scatter_share, .. } = board;
    if scatter_rows == 0.0 || scatter_share == 0.0 {
        return vec![(0, 1.0)];
    }
    // Shares q^|d| have the variance 2 q / (1 - q)^2.
    let variance = scatter_rows.powi(2);
    let q = (variance + 1.0 - (2.0 * variance + 1.0).sqrt()) / variance;
    let reach = (1e-6_f64.ln() / q.ln()).ceil() as isize;
    let scattered = |d: isize| q.powi(d.unsigned_abs() as i32);
    let total: f64 = (-reach..=reach).map(scattered).sum();
    (-reach..=reach)
        .map(|d| {
            let stays = if d == 0 { 1.0 - scatter_share } else { 0.0 };
            (d, (stays + scatter_share * scattered(d) / total) as f32)
        })
        .collect()
}

/// Projector row of the scene's first row: `given`, or a value that centres the camera's rows, `row_pitch` projector rows
/// each, in the frame as far as the scene allows.
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
    let first_row = given.unwrap_or_else(|| (spare(camera_rows) / 2).min(spare(scene_rows)));
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
    let bent = |row: usize, percent: f64| {
        let x = row as f64 / raster.rows as f64;
        let linear_us = raster.first_row_us + row as f64 * raster.row_time_us;
        linear_us - percent / 100.0 * sweep_us * 4.0 * x * (1.0 - x)
    };
    let starts: Vec<f64> = match *table {
        RowTable::Linear => (0..=raster.rows).map(|row| bent(row, 0.0)).collect(),
        RowTable::Quadratic { percent } => (0..=raster.rows).map(|row| bent(row, percent)).collect(),
        RowTable::Kinked { pieces, amplitude_us, percent } => {
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
                    bent(row, percent) + knots[piece] * (1.0 - share) + knots[piece + 1] * share
                })
                .collect()
        }
    };
    if starts.is_sorted_by(|a, b| a < b) { Ok(starts) } else { Err(SimError::RowTable) }
}

/// How the light of each row spreads over its neighbours.
struct Kernel {
    offsets: Vec<isize>,
    /// Share of each offset in the light of the first row and of the last; each sums to 1.
    ends: [Vec<f32>; 2],
    rows: usize,
}

impl Kernel {
    fn new(beam: &SimBeam, rows: usize) -> Result<Self, SimError> {
        let even = |weights: Vec<(isize, f64)>| {
            let (offsets, weights): (Vec<_>, Vec<_>) = weights.into_iter().unzip();
            (offsets, weights.clone(), weights)
        };
        let (offsets, top, bottom) = match beam {
            SimBeam::Ideal => even(vec![(0, 1.0)]),
            &SimBeam::Gaussian { sigma_rows } if sigma_rows > 0.0 && sigma_rows <= 100.0 => {
                let reach = (5.0 * sigma_rows).ceil() as isize;
                even((-reach..=reach).map(|d| (d, (-(d as f64 / sigma_rows).powi(2) / 2.0).exp())).collect())
            }
            &SimBeam::FlatTop { up_rows, down_rows }
                if up_rows >= 0.0
                    && down_rows >= 0.0
                    && up_rows + down_rows > 0.0
                    && up_rows + down_rows <= 500.0 =>
            {
                let overlap =
                    |d: isize| ((d as f64 + 0.5).min(down_rows) - (d as f64 - 0.5).max(-up_rows)).max(0.0);
                even(
                    (-(up_rows.ceil() as isize) - 1..=down_rows.ceil() as isize + 1)
                        .map(|d| (d, overlap(d)))
                        .filter(|&(_, share)| share > 0.0)
                        .collect(),
                )
            }
            SimBeam::Kernel { rows, weights, to } => {
                let to = to.as_ref().unwrap_or(weights);
                let is_sound = |weights: &Vec<f64>| {
                    weights.len() == rows.len()
                        && weights.iter().all(|weight| (0.0..=1e6).contains(weight))
                        && weights.iter().sum::<f64>() > 0.0
                };
                let are_rows = rows.is_sorted_by(|a, b| a < b) && rows.iter().all(|d| d.abs() <= 500);
                if !(are_rows && is_sound(weights) && is_sound(to)) {
                    return Err(SimError::Kernel);
                }
                (rows.iter().map(|&d| d as isize).collect(), weights.clone(), to.clone())
            }
            _ => return Err(SimError::Beam),
        };
        let shares = |weights: Vec<f64>| {
            let total: f64 = weights.iter().sum();
            weights.into_iter().map(|share| (share / total) as f32).collect()
        };
        Ok(Self { offsets, ends: [shares(top), shares(bottom)], rows })
    }

    /// The same light through a lens that is not in focus.
    fn through(self, disc: Option<&DefocusDisc>) -> Self {
        let Some(disc) = disc else { return self };
        let profile: Vec<(isize, f64)> = disc.profile().collect();
        let beam = self.reach_rows() as isize;
        let lens = profile.iter().map(|(offset, _)| offset.abs()).max().unwrap_or(0);
        let offsets: Vec<isize> = (-beam - lens..=beam + lens).collect();
        let spread = |shares: &Vec<f32>| {
            let mut spread = vec![0.0; offsets.len()];
            for (offset, share) in self.offsets.iter().zip(shares) {
                for (further, part) in &profile {
                    spread[(offset + further + beam + lens) as usize] += share * *part as f32;
                }
            }
            spread
        };
        Self { ends: self.ends.each_ref().map(spread), offsets, rows: self.rows }
    }

    /// The most rows over which a row's light spreads to either side.
    fn reach_rows(&self) -> usize {
        self.offsets.iter().map(|offset| offset.unsigned_abs()).max().unwrap_or(0)
    }

    /// Row offsets that the beam of a row reaches and the fraction of light at each; the fractions sum to 1.
    fn of_row(&self, row: usize) -> impl Iterator<Item = (isize, f32)> {
        let down = row as f32 / (self.rows.saturating_sub(1)).max(1) as f32;
        let shares =
            self.ends[0].iter().zip(&self.ends[1]).map(move |(top, bottom)| top + down * (bottom - top));
        self.offsets.iter().copied().zip(shares)
    }
}
