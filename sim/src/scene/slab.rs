//! `slab`: stripes of measured translucent media in a black frame, flat and facing the camera.
//!
//! Each stripe diffuses light according to its medium's dipole. Light that reaches a stripe's border is absorbed by the
//! frame. Scale: 0.5 mm per row at any size, so that profiles at 128 rows and 720 rows agree.

use std::ops::Range;

use ndarray::{Array2, Array3, s};
use rayon::prelude::*;

use super::dipole::{Dipole, MEASURED, Material, fresnel_transmittance};
use super::object::{Direct, Object};
use super::projector::{ProjectorFrame, ROW_PITCH_MM, projector_cos};
use super::quadrature::offset_rule;
use super::size::SceneSize;
use super::texture::noise;
use super::translucent::TranslucentStrip;

/// Albedo of the matte reflection at the surface \[A\].
const SURFACE_ALBEDO: f32 = 0.03;
const FRAME_ALBEDO: f32 = 0.04;

/// Name and camera columns of each medium of the scene `slab`, left to right.
///
/// A scene too narrow for all five media contains only the first ones.
pub fn slab_materials(columns: usize) -> Vec<(&'static str, Range<usize>)> {
    stripes(columns).map(|(material, columns)| (material.name, columns)).collect()
}

fn stripes(columns: usize) -> impl Iterator<Item = (&'static Material, Range<usize>)> {
    let count = MEASURED.len().min(columns / 4).max(1);
    let frame = (columns / 64).max(1);
    MEASURED[..count].iter().enumerate().map(move |(k, material)| {
        (material, columns * k / count + frame / 2..columns * (k + 1) / count - frame.div_ceil(2))
    })
}

pub(super) fn build(size: SceneSize, bands: &[usize], seed: u64) -> Object {
    let SceneSize { rows, columns } = size;
    let frame = ProjectorFrame::covering(columns, 0.0);
    let mut direct = Direct::new(size, bands.len(), |_, x| frame.column(x, 0.0));
    direct.value.fill(FRAME_ALBEDO);
    let strips = stripes(columns)
        .enumerate()
        .map(|(k, (material, columns))| {
            direct.value.slice_mut(s![.., columns.clone(), ..]).fill(SURFACE_ALBEDO);
            let grain = grain(rows, columns.len(), seed.wrapping_add(k as u64));
            let transmitted = |cos| fresnel_transmittance(cos, material.refraction) as f32;
            TranslucentStrip {
                column: columns.start,
                kernel: bands
                    .iter()
                    .map(|&band| flat_kernel(&material.dipole(band), rows, columns.len()))
                    .collect(),
                entry: &grain * transmitted(projector_cos()),
                cell_columns: columns
                    .map(|x| (frame.column(x as f64, 0.0), frame.column(x as f64 + 1.0, 0.0)))
                    .collect(),
                exit: grain * transmitted(1.0),
            }
        })
        .collect::<Vec<_>>();
    Object { direct, indirect: Box::new(strips) }
}

/// Uneven transmittance of the surface: 0.8 to 1.
fn grain(rows: usize, columns: usize, seed: u64) -> Array2<f32> {
    Array2::from_shape_fn((rows, columns), |(y, x)| {
        let (x, y) = (x as f64, y as f64);
        // Ridges of noise look like veins.
        let vein = (2.0 * noise(seed, x / 9.0 + y / 23.0, y / 14.0) - 1.0).abs();
        let fine = noise(seed ^ 0x5eed, x / 1.5, y / 1.5);
        (0.80 + 0.16 * (3.0 * vein).min(1.0) + 0.04 * fine) as f32
    })
}

/// Kernel `[lag, camera column, cell]` of a flat medium whose cells are the pixels themselves.
fn flat_kernel(dipole: &Dipole, rows: usize, columns: usize) -> Array3<f32> {
    let by_offset: Vec<Vec<f32>> = (0..rows)
        .into_par_iter()
        .map(|lag| (0..columns).map(|offset| pixel_to_pixel(dipole, lag as f64, offset as f64)).collect())
        .collect();
    Array3::from_shape_fn((rows, columns, columns), |(lag, s, cell)| by_offset[lag][s.abs_diff(cell)])
}

/// Mean exitance of a pixel per unit irradiance on another pixel, integrated over both areas.
fn pixel_to_pixel(dipole: &Dipole, rows: f64, columns: f64) -> f32 {
    let rule = offset_rule(rows.hypot(columns));
    let mut sum = 0.0;
    for (dy, wy) in rule {
        for (dx, wx) in rule {
            let r_mm = ROW_PITCH_MM * (rows + dy).hypot(columns + dx);
            sum += wy * wx * dipole.reflectance_per_mm2(r_mm);
        }
    }
    (sum * ROW_PITCH_MM * ROW_PITCH_MM) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The total light returned by a wide slab equals the medium's diffuse albedo.
    #[test]
    fn kernel_keeps_the_energy_of_the_dipole() {
        // Diffuse reflectance of whole milk, ketchup and marble (green) from the closed form.
        for (material, albedo) in [(&MEASURED[3], 0.88087), (&MEASURED[4], 0.006337), (&MEASURED[0], 0.79096)]
        {
            let dipole = material.dipole(1);
            let reach = 160_i32;
            let mut sum = 0.0;
            for y in -reach..=reach {
                for x in -reach..=reach {
                    sum += f64::from(pixel_to_pixel(&dipole, y.abs().into(), x.abs().into()));
                }
            }
            assert!((sum / albedo - 1.0).abs() < 0.01, "{}: {sum} {albedo}", material.name);
        }
    }

    #[test]
    fn stripes_lie_side_by_side() {
        for columns in [8, 16, 33, 128, 720] {
            let stripes = slab_materials(columns);
            assert!(stripes.iter().all(|(_, range)| !range.is_empty() && range.end <= columns));
            assert!(stripes.windows(2).all(|pair| pair[0].1.end < pair[1].1.start + 1));
        }
        assert_eq!(slab_materials(128).len(), 5);
    }
}
