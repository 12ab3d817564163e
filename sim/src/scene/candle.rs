//! `candle`: an upright wax cylinder in front of a dark printed page.
//!
//! Wax diffuses light according to the dipole model, over the straight distance between two points of the visible
//! surface. Neglected: the effect of curvature on diffusion, light through the rim, and light from the candle onto the
//! page. Scale: 0.5 mm per row.

use std::f64::consts::PI;

use ndarray::{Array2, Array3};
use rayon::prelude::*;

use super::dipole::{Dipole, WAX, fresnel_transmittance};
use super::object::{Direct, Object};
use super::projector::{PROJECTOR_TAN, ProjectorFrame, ROW_PITCH_MM, projector_cos};
use super::quadrature::{cell_rule, offset_rule};
use super::size::SceneSize;
use super::texture::{Dice, noise, printed_page};
use super::translucent::TranslucentStrip;

/// Albedo of the matte reflection at the wax surface \[A\].
const SURFACE_ALBEDO: f32 = 0.04;
/// Factor on the page's albedo: it is printed on dark paper.
const PAGE_DIMMING: f32 = 0.2;
/// Samples across a pixel: silhouettes are soft, and pixels near the limb see a long arc.
const SAMPLES: usize = 4;

struct Candle {
    axis_x: f64,
    axis_z: f64,
    radius: f64,
    top: f64,
    seed: u64,
}

impl Candle {
    fn angle(&self, x: f64) -> Option<f64> {
        let sin = (x - self.axis_x) / self.radius;
        (sin.abs() < 1.0).then(|| sin.asin())
    }

    fn point(&self, angle: f64) -> (f64, f64) {
        (self.axis_x + self.radius * angle.sin(), self.axis_z + self.radius * angle.cos())
    }

    /// Row at which the melted rim begins.
    fn rim(&self, angle: f64) -> f64 {
        let dip = noise(self.seed, 1.6 * angle + 40.0, 0.0)
            + 0.5 * noise(self.seed.wrapping_add(1), 4.0 * angle, 0.0);
        self.top + 0.15 * self.radius * dip
    }

    fn covers(&self, row: usize, angle: f64) -> bool {
        row as f64 + 0.5 >= self.rim(angle)
    }

    /// Unevenness of the wax: surface transmittance of 0.85 to 1, with vertical runs of drips.
    fn grain(&self, row: usize, angle: f64) -> f32 {
        let (x, y) = (angle * self.radius, row as f64);
        let drip = noise(self.seed.wrapping_add(2), x / 5.0, y / 40.0);
        let fine = noise(self.seed.wrapping_add(3), x / 2.0, y / 2.0);
        (0.85 + 0.11 * drip + 0.04 * fine) as f32
    }

    /// Whether the candle shadows the page at x.
    fn shades(&self, row: usize, x: f64) -> bool {
        let cos = projector_cos();
        let offset = (x - self.axis_x) * cos + self.axis_z * PROJECTOR_TAN * cos;
        offset.abs() < self.radius && self.covers(row, (offset / self.radius).asin() + PROJECTOR_TAN.atan())
    }
}

pub(super) fn build(size: SceneSize, bands: &[usize], seed: u64) -> Object {
    build_swung(size, bands, seed, 0.0)
}

/// The candle displaced sideways at `swing`, -1 to 1: by up to half a radius to either side.
pub(super) fn build_swung(size: SceneSize, bands: &[usize], seed: u64, swing: f64) -> Object {
    let SceneSize { rows, columns } = size;
    let mut dice = Dice::new(seed);
    let radius = 0.29 * rows.min(columns) as f64;
    let candle = Candle {
        axis_x: columns as f64 * dice.between(0.49, 0.53) + 0.5 * radius * swing,
        axis_z: 1.15 * radius,
        radius,
        top: rows as f64 * dice.between(0.12, 0.18),
        seed,
    };
    let frame = ProjectorFrame::covering(columns, candle.axis_z + radius);
    let direct = direct_light(&candle, &frame, size, bands);
    let strip = strip(&candle, &frame, size, bands);
    Object { direct, indirect: Box::new(vec![strip]) }
}

/// Angles on the wax seen by pixel (row, column), at most [`SAMPLES`] of them.
fn seen(candle: &Candle, row: usize, column: usize) -> impl Iterator<Item = f64> {
    samples(column).filter_map(|x| candle.angle(x)).filter(move |&angle| candle.covers(row, angle))
}

fn samples(column: usize) -> impl Iterator<Item = f64> {
    (0..SAMPLES).map(move |k| column as f64 + (k as f64 + 0.5) / SAMPLES as f64)
}

fn direct_light(candle: &Candle, frame: &ProjectorFrame, size: SceneSize, bands: &[usize]) -> Direct {
    let page = printed_page(size.rows, size.columns, candle.seed);
    let mut direct = Direct::new(size, bands.len(), |row, x| {
        let angle = candle.angle(x).filter(|&angle| candle.covers(row, angle));
        frame.column(x, angle.map_or(0.0, |angle| candle.point(angle).1))
    });
    for ((row, column, channel), value) in direct.value.indexed_iter_mut() {
        let wax: f64 = seen(candle, row, column).map(irradiance).sum();
        let bare = samples(column)
            .filter(|&x| !candle.angle(x).is_some_and(|angle| candle.covers(row, angle)))
            .filter(|&x| !candle.shades(row, x))
            .count();
        let albedo = PAGE_DIMMING * page[[row, column, bands[channel]]];
        *value = (SURFACE_ALBEDO * wax as f32 + albedo * bare as f32) / SAMPLES as f32;
    }
    direct
}

/// Irradiance on the cylinder under white light.
fn irradiance(angle: f64) -> f64 {
    cos_to_projector(angle).max(0.0) / projector_cos()
}

fn cos_to_projector(angle: f64) -> f64 {
    (angle - PROJECTOR_TAN.atan()).cos()
}

fn strip(candle: &Candle, frame: &ProjectorFrame, size: SceneSize, bands: &[usize]) -> TranslucentStrip {
    let first = (candle.axis_x - candle.radius).floor().max(0.0) as usize;
    let end = ((candle.axis_x + candle.radius).ceil() as usize).min(size.columns);
    let cells = ((PI * candle.radius).round() as usize).max(8);
    let cell_angle = PI / cells as f64;
    let first_angle = PROJECTOR_TAN.atan() - 0.5 * PI;
    let cell_centre = |cell: usize| first_angle + (cell as f64 + 0.5) * cell_angle;

    let transmitted = |cos: f64| fresnel_transmittance(cos, WAX.refraction);
    let entry = Array2::from_shape_fn((size.rows, cells), |(row, cell)| {
        let angle = cell_centre(cell);
        if !candle.covers(row, angle) {
            return 0.0;
        }
        (irradiance(angle) * transmitted(cos_to_projector(angle))) as f32 * candle.grain(row, angle)
    });
    let exit = Array2::from_shape_fn((size.rows, end - first), |(row, s)| {
        let sum: f32 = seen(candle, row, first + s)
            .map(|angle| transmitted(angle.cos()) as f32 * candle.grain(row, angle))
            .sum();
        sum / SAMPLES as f32
    });
    let column_at = |angle: f64| {
        let (x, z) = candle.point(angle);
        frame.column(x, z)
    };
    let centres: Vec<f64> = (0..cells).map(cell_centre).collect();
    TranslucentStrip {
        column: first,
        kernel: bands
            .iter()
            .map(|&band| {
                cylinder_kernel(&WAX.dipole(band), candle, size.rows, first..end, &centres, cell_angle)
            })
            .collect(),
        entry,
        cell_columns: centres
            .iter()
            .map(|&angle| (column_at(angle - 0.5 * cell_angle), column_at(angle + 0.5 * cell_angle)))
            .collect(),
        exit,
    }
}

/// `[lag, camera column, cell]`; cells are equal arcs, one row high.
fn cylinder_kernel(
    dipole: &Dipole,
    candle: &Candle,
    rows: usize,
    columns: std::ops::Range<usize>,
    cell_centres: &[f64],
    cell_angle: f64,
) -> Array3<f32> {
    let cell_area_mm2 = cell_angle * candle.radius * ROW_PITCH_MM * ROW_PITCH_MM;
    let angles: Vec<Vec<f64>> =
        columns.map(|column| samples(column).filter_map(|x| candle.angle(x)).collect()).collect();
    let lags: Vec<Vec<f32>> = (0..rows)
        .into_par_iter()
        .map(|lag| {
            let pixels = angles.iter().flat_map(|seen| cell_centres.iter().map(move |&cell| (seen, cell)));
            pixels
                .map(|(seen, cell)| {
                    let sum: f64 = seen
                        .iter()
                        .map(|&angle| {
                            let chord = |offset: f64| {
                                2.0 * candle.radius * (0.5 * (angle - cell + offset * cell_angle)).sin()
                            };
                            let distance = (lag as f64).hypot(chord(0.0));
                            let mut mean = 0.0;
                            for (dy, wy) in offset_rule(distance) {
                                for (da, wa) in cell_rule(distance) {
                                    let r_mm = ROW_PITCH_MM * (lag as f64 + dy).hypot(chord(*da));
                                    mean += wy * wa * dipole.reflectance_per_mm2(r_mm);
                                }
                            }
                            mean
                        })
                        .sum();
                    (sum * cell_area_mm2 / seen.len().max(1) as f64) as f32
                })
                .collect()
        })
        .collect();
    Array3::from_shape_fn((rows, angles.len(), cell_centres.len()), |(lag, s, cell)| {
        lags[lag][s * cell_centres.len() + cell]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A fat cylinder is nearly flat: the light returned by a cell sums to the wax's albedo.
    #[test]
    fn kernel_of_a_fat_cylinder_keeps_the_energy() {
        let candle = Candle { axis_x: 1000.0, axis_z: 0.0, radius: 1000.0, top: 0.0, seed: 0 };
        let cell_angle = 1.0 / candle.radius;
        let centres: Vec<f64> = (-250..=250).map(|k| f64::from(k) * cell_angle).collect();
        let kernel = cylinder_kernel(&WAX.dipole(1), &candle, 250, 1000..1001, &centres, cell_angle);
        let sum: f32 = kernel.indexed_iter().map(|((lag, ..), k)| if lag == 0 { *k } else { 2.0 * k }).sum();
        // Closed form for sigma_s' = 1.2, sigma_a = 0.002, eta = 1.44.
        assert!((sum / 0.79875 - 1.0).abs() < 0.01, "{sum}");
    }
}
