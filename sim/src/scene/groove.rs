//! `v-groove`: two printed diffuse walls that meet in a horizontal concave edge, so that light
//! bounces between rows.
//!
//! Radiosity over patches: B = Phi + rho H, H = F B, with Phi the first reflection of the projected light. Patches are
//! fine near the edge and coarser away from it. Light is distributed from pixels to patches, and read back, by the same
//! linear interpolation, so that the transport is smooth in both of its rows. The print is averaged over a patch for
//! the bounces and kept sharp where the camera looks. Neglected: light that leaves the walls and returns from anything
//! else.

use std::f64::consts::PI;
use std::ops::Range;

use ndarray::{Array1, Array2, Array3, ArrayView1, ArrayViewMut1, ArrayViewMut3, ArrayViewMut4, Axis};
use rayon::prelude::*;

use super::form_factor::exchange;
use super::object::{Direct, Indirect, Object};
use super::projector::{PatternPart, ProjectorFrame};
use super::size::SceneSize;
use super::texture::{Dice, printed_page};

/// Maximum number of patches along the edge.
const PATCH_COLUMNS: usize = 32;
/// Growth rate of patches with the distance from the edge, up to [`LARGEST_PATCH`] of a wall.
const PATCH_GROWTH: f64 = 0.25;
const LARGEST_PATCH: f64 = 1.0 / 16.0;
/// Light that is left unbounced, as a fraction of the light that bounces.
const REMAINDER: f64 = 1e-6;
/// Projector rows per work item; fixed, so that the sums do not depend on the number of threads.
const BLOCK_ROWS: usize = 16;

/// One wall. Patches are numbered `ring * columns + column`, with rings counted from the edge outwards.
#[derive(Debug)]
struct Wall {
    /// Ring boundaries as distances from the edge, in camera rows.
    rings: Vec<f64>,
    /// Cosine of the wall's tilt: camera rows per unit of length up the wall.
    tilt_cos: f64,
}

impl Wall {
    fn new(rows: usize, tilt: f64) -> Self {
        let rows = rows as f64;
        let mut rings = vec![0.0];
        let mut at = 0.0;
        loop {
            let step = (PATCH_GROWTH * at).clamp(1.0, (LARGEST_PATCH * rows).max(1.0));
            at += step;
            // Avoid a sliver: the last patch is extended instead.
            if rows - at < 0.5 * step {
                rings.push(rows);
                break;
            }
            rings.push(at);
        }
        Self { rings, tilt_cos: tilt.cos() }
    }

    fn len(&self) -> usize {
        self.rings.len() - 1
    }

    /// Extent of a ring along the wall, in pixels.
    fn extent(&self, ring: usize) -> Range<f64> {
        self.rings[ring] / self.tilt_cos..self.rings[ring + 1] / self.tilt_cos
    }
}

/// Linear interpolation between two neighbouring patch centres.
#[derive(Debug, Clone, Copy)]
struct Between {
    nodes: [usize; 2],
    weights: [f32; 2],
}

impl Between {
    fn new(centres: &[f64], at: f64) -> Self {
        let upper = centres.partition_point(|&centre| centre < at);
        if upper == 0 || upper == centres.len() {
            let node = upper.min(centres.len() - 1);
            return Self { nodes: [node, node], weights: [1.0, 0.0] };
        }
        let share = (at - centres[upper - 1]) / (centres[upper] - centres[upper - 1]);
        Self { nodes: [upper - 1, upper], weights: [(1.0 - share) as f32, share as f32] }
    }
}

/// The groove's light after the first reflection.
#[derive(Debug)]
struct Bounces {
    /// First camera row of the lower wall.
    edge_row: usize,
    /// For each camera row, its position between rings of its wall; for each camera column, between patch columns.
    rows: Vec<Between>,
    columns: Vec<Between>,
    patch_columns: usize,
    /// `[receiver, sender]`: form factors onto the upper wall and onto the lower wall.
    onto: [Array2<f32>; 2],
    /// Per wall: 1 / patch area, and pixel area on the wall, in pixels.
    inverse_areas: [Array1<f32>; 2],
    pixel_areas: [f32; 2],
    /// Per wall, mean albedo `[channel, patch]`.
    patch_albedo: [Array2<f32>; 2],
    /// Albedo `[row, column, channel]`.
    albedo: Array3<f32>,
    /// First reflection: its value under white light and the projector columns that it comes from.
    direct: Direct,
    bounces: usize,
}

pub(super) fn build(size: SceneSize, bands: &[usize], seed: u64) -> Object {
    let SceneSize { rows, columns } = size;
    let mut dice = Dice::new(seed);
    let edge_row = ((rows as f64 * dice.between(0.46, 0.54)).round() as usize).clamp(2, rows - 2);
    let tilts = [dice.between(0.74, 0.84), dice.between(0.74, 0.84)];
    let print = printed_page(rows, columns, seed);
    let albedo = Array3::from_shape_fn((rows, columns, bands.len()), |(y, x, c)| print[[y, x, bands[c]]]);

    let tilt_of = |row: usize| tilts[usize::from(row >= edge_row)];
    let depth = |row: usize| (row as f64 + 0.5 - edge_row as f64).abs() * tilt_of(row).tan();
    let frame = ProjectorFrame::covering(columns, depth(0).max(depth(rows - 1)));
    let mut direct = Direct::new(size, bands.len(), |row, x| frame.column(x, depth(row)));
    for ((row, column, channel), value) in direct.value.indexed_iter_mut() {
        *value = albedo[[row, column, channel]] * tilt_of(row).cos() as f32;
    }
    let bounces = Bounces::new(edge_row, tilts, albedo, direct.clone());
    Object { direct, indirect: Box::new(bounces) }
}

impl Bounces {
    fn new(edge_row: usize, tilts: [f64; 2], albedo: Array3<f32>, direct: Direct) -> Self {
        let (rows, columns, channels) = albedo.dim();
        let walls = [Wall::new(edge_row, tilts[0]), Wall::new(rows - edge_row, tilts[1])];
        let patch_columns = columns.div_ceil(4).min(PATCH_COLUMNS);
        let patch_width = columns as f64 / patch_columns as f64;
        let centres = |bounds: &[f64]| bounds.windows(2).map(|b| 0.5 * (b[0] + b[1])).collect::<Vec<_>>();
        let ring_centres = [centres(&walls[0].rings), centres(&walls[1].rings)];
        let column_centres: Vec<f64> = (0..patch_columns).map(|k| (k as f64 + 0.5) * patch_width).collect();

        let opening = PI - tilts[0] - tilts[1];
        let onto = form_factors(&walls, opening, patch_columns, patch_width);
        let area = |wall: &Wall, patch: usize| {
            let extent = wall.extent(patch / patch_columns);
            patch_width * (extent.end - extent.start)
        };
        let inverse_areas = [0, 1].map(|w| {
            let wall: &Wall = &walls[w];
            Array1::from_shape_fn(wall.len() * patch_columns, |patch| 1.0 / area(wall, patch) as f32)
        });
        let mut scene = Self {
            edge_row,
            rows: (0..rows)
                .map(|row| {
                    let wall = usize::from(row >= edge_row);
                    let distance = (row as f64 + 0.5 - edge_row as f64).abs();
                    Between::new(&ring_centres[wall], distance)
                })
                .collect(),
            columns: (0..columns).map(|x| Between::new(&column_centres, x as f64 + 0.5)).collect(),
            patch_columns,
            pixel_areas: [0, 1].map(|w| (1.0 / walls[w].tilt_cos) as f32),
            patch_albedo: [0, 1].map(|w| Array2::zeros((channels, walls[w].len() * patch_columns))),
            onto,
            inverse_areas,
            albedo,
            direct,
            bounces: 0,
        };
        scene.patch_albedo = scene.mean_albedo();
        scene.bounces = scene.bounces_needed();
        scene
    }

    fn wall_of(&self, row: usize) -> usize {
        usize::from(row >= self.edge_row)
    }

    /// Patches that share the pixel (row, column), with their weights, which sum to 1.
    fn patches(&self, row: usize, column: usize) -> impl Iterator<Item = (usize, f32)> {
        let (r, c, width) = (self.rows[row], self.columns[column], self.patch_columns);
        (0..4).map(move |k| {
            let (i, j) = (k / 2, k % 2);
            (r.nodes[i] * width + c.nodes[j], r.weights[i] * c.weights[j])
        })
    }

    fn mean_albedo(&self) -> [Array2<f32>; 2] {
        let (rows, columns, channels) = self.albedo.dim();
        let mut sums = [0, 1].map(|w| Array2::<f32>::zeros((channels, self.inverse_areas[w].len())));
        let mut weights = [0, 1].map(|w| Array1::<f32>::zeros(self.inverse_areas[w].len()));
        for row in 0..rows {
            let wall = self.wall_of(row);
            for column in 0..columns {
                for (patch, weight) in self.patches(row, column) {
                    weights[wall][patch] += weight;
                    for channel in 0..channels {
                        sums[wall][[channel, patch]] += weight * self.albedo[[row, column, channel]];
                    }
                }
            }
        }
        let [upper, lower] = sums;
        let mean =
            |sums: Array2<f32>, weights: &Array1<f32>| sums / &weights.mapv(|w| w.max(f32::MIN_POSITIVE));
        [mean(upper, &weights[0]), mean(lower, &weights[1])]
    }

    /// Number of bounces until the geometric bound on the remaining light is below [`REMAINDER`].
    fn bounces_needed(&self) -> usize {
        let kept = [0, 1].map(|w| {
            let received = self.onto[w].sum_axis(Axis(1));
            let kept = self.patch_albedo[w].outer_iter().flat_map(|albedo| (&albedo * &received).to_vec());
            kept.fold(0.0_f32, f32::max)
        });
        let kept = f64::from(kept[0].max(kept[1])).clamp(1e-3, 0.99);
        ((REMAINDER * (1.0 - kept)).ln() / kept.ln()).ceil() as usize
    }

    /// Irradiance `[case, patch]` on both walls after all bounces, from the initial exitance `[case, patch]`.
    fn irradiance(&self, channel: usize, first: &[Array2<f32>; 2]) -> [Array2<f32>; 2] {
        let receive = |exitance: &[Array2<f32>; 2]| {
            [exitance[1].dot(&self.onto[0].t()), exitance[0].dot(&self.onto[1].t())]
        };
        let mut exitance = first.clone();
        for _ in 0..self.bounces {
            let [upper, lower] = receive(&exitance);
            exitance = [
                upper * self.patch_albedo[0].row(channel) + &first[0],
                lower * self.patch_albedo[1].row(channel) + &first[1],
            ];
        }
        receive(&exitance)
    }

    /// Distributes the first reflection of one row, lit per column by `lit`, over its wall's patches.
    fn reflect(
        &self,
        row: usize,
        channel: usize,
        lit: impl Fn(usize) -> f32,
        exitance: &mut ArrayViewMut1<f32>,
    ) {
        let wall = self.wall_of(row);
        for column in 0..self.columns.len() {
            let flux = lit(column) * self.direct.value[[row, column, channel]] * self.pixel_areas[wall];
            for (patch, weight) in self.patches(row, column) {
                exitance[patch] += weight * flux * self.inverse_areas[wall][patch];
            }
        }
    }

    /// Adds the camera's view of the `irradiance` on each wall's patches.
    fn add_seen(&self, irradiance: [ArrayView1<f32>; 2], channel: usize, image: &mut ArrayViewMut3<f32>) {
        for row in 0..self.rows.len() {
            let on_wall = &irradiance[self.wall_of(row)];
            for column in 0..self.columns.len() {
                let here: f32 =
                    self.patches(row, column).map(|(patch, weight)| weight * on_wall[patch]).sum();
                image[[row, column, channel]] += self.albedo[[row, column, channel]] * here;
            }
        }
    }

    /// Zero exitance arrays `[case, patch]` for both walls.
    fn dark(&self, cases: usize) -> [Array2<f32>; 2] {
        [0, 1].map(|w| Array2::zeros((cases, self.inverse_areas[w].len())))
    }
}

/// Form factors `[receiver, sender]` onto the upper wall and onto the lower wall.
///
/// Both are derived from one table of exchange areas, so that reciprocity A_i F_ij = A_j F_ji holds exactly.
fn form_factors(walls: &[Wall; 2], opening: f64, patch_columns: usize, patch_width: f64) -> [Array2<f32>; 2] {
    let pairs: Vec<(usize, usize)> =
        (0..walls[0].len()).flat_map(|i| (0..walls[1].len()).map(move |j| (i, j))).collect();
    // The walls look the same from each patch column, so only the distance between columns matters.
    let areas: Vec<Vec<f64>> = pairs
        .par_iter()
        .map(|&(i, j)| {
            let (a, b) = (walls[0].extent(i), walls[1].extent(j));
            let shifted = |k: usize| k as f64 * patch_width..(k + 1) as f64 * patch_width;
            (0..patch_columns).map(|k| exchange(opening, (&a, &shifted(0)), (&b, &shifted(k)))).collect()
        })
        .collect();
    let table = |receiver: usize| {
        let sender = 1 - receiver;
        let shape = (walls[receiver].len() * patch_columns, walls[sender].len() * patch_columns);
        Array2::from_shape_fn(shape, |(r, s)| {
            let (ring, other) = (r / patch_columns, s / patch_columns);
            let (i, j) = if receiver == 0 { (ring, other) } else { (other, ring) };
            let extent = walls[receiver].extent(ring);
            let distance = (r % patch_columns).abs_diff(s % patch_columns);
            let area = patch_width * (extent.end - extent.start);
            (areas[i * walls[1].len() + j][distance] / area) as f32
        })
    };
    [table(0), table(1)]
}

impl Indirect for Bounces {
    fn add_transport(&self, mut transport: ArrayViewMut4<f32>) {
        transport.axis_chunks_iter_mut(Axis(0), BLOCK_ROWS).into_par_iter().enumerate().for_each(
            |(block, mut images)| {
                let rows = block * BLOCK_ROWS..block * BLOCK_ROWS + images.len_of(Axis(0));
                for channel in 0..self.albedo.dim().2 {
                    let mut first = self.dark(rows.len());
                    for (case, row) in rows.clone().enumerate() {
                        let wall = &mut first[self.wall_of(row)];
                        self.reflect(row, channel, |_| 1.0, &mut wall.row_mut(case));
                    }
                    let [upper, lower] = self.irradiance(channel, &first);
                    for (case, mut image) in images.outer_iter_mut().enumerate() {
                        self.add_seen([upper.row(case), lower.row(case)], channel, &mut image);
                    }
                }
            },
        );
    }

    fn add_image(&self, pattern: &PatternPart, mut image: ArrayViewMut3<f32>) {
        for channel in 0..self.albedo.dim().2 {
            let mut first = self.dark(1);
            for row in 0..self.rows.len() {
                let lit = |column: usize| pattern.mean(row, self.direct.columns(row, column));
                self.reflect(row, channel, lit, &mut first[self.wall_of(row)].row_mut(0));
            }
            let [upper, lower] = self.irradiance(channel, &first);
            self.add_seen([upper.row(0), lower.row(0)], channel, &mut image);
        }
    }
}

#[cfg(test)]
mod tests;
