//! Seeded albedo: printed pages and smooth noise.

use ndarray::Array3;
use rand_distr::{Distribution, StandardUniform};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;

const PAPER: [f32; 3] = [0.84, 0.82, 0.77];
const INK: [f32; 3] = [0.09, 0.09, 0.10];
/// Height of a line of text and of the gap below it, in rows.
const TEXT_ROWS: usize = 3;
const LINE_PITCH_ROWS: usize = 5;

/// Source of one scene's seeded random choices.
pub(super) struct Dice(Xoshiro256PlusPlus);

impl Dice {
    pub(super) fn new(seed: u64) -> Self {
        Self(Xoshiro256PlusPlus::seed_from_u64(seed))
    }

    /// Uniform in `from..to`.
    pub(super) fn between(&mut self, from: f64, to: f64) -> f64 {
        let unit: f64 = StandardUniform.sample(&mut self.0);
        from + (to - from) * unit
    }

    fn count(&mut self, from: usize, to: usize) -> usize {
        self.between(from as f64, to as f64 + 1.0) as usize
    }
}

/// A printed page: paragraphs of text and coloured pictures on paper, `[rows, columns, 3]` linear RGB albedo.
pub(crate) fn printed_page(rows: usize, columns: usize, seed: u64) -> Array3<f32> {
    let mut dice = Dice::new(seed);
    let mut page = Array3::from_shape_fn((rows, columns, 3), |(y, x, c)| {
        PAPER[c] * (0.97 + 0.03 * noise(seed, x as f64 / 3.0, y as f64 / 3.0) as f32)
    });
    let margin = (columns / 16).max(1);
    let right = columns.saturating_sub(margin).max(margin);
    let mut row = margin + dice.count(0, 3);
    let mut picture = dice.between(0.0, 1.0) < 0.5;
    while row < rows {
        if picture {
            let height = (columns * dice.count(32, 44) / 100).max(2);
            paint_picture(
                &mut page,
                row..(row + height).min(rows),
                margin..right,
                dice.count(0, 1 << 20) as u64,
            );
            row += height + LINE_PITCH_ROWS;
        } else {
            for _ in 0..dice.count(5, 8) {
                print_line(&mut page, row, margin..right, &mut dice);
                row += LINE_PITCH_ROWS;
            }
            row += LINE_PITCH_ROWS;
        }
        picture = !picture;
    }
    page
}

fn print_line(page: &mut Array3<f32>, row: usize, columns: std::ops::Range<usize>, dice: &mut Dice) {
    let last_row = page.dim().0;
    let mut x = columns.start;
    while x < columns.end {
        let word = dice.count(3, 11);
        for column in x..(x + word).min(columns.end) {
            for y in row..(row + TEXT_ROWS).min(last_row) {
                let ink = dice.between(0.15, 1.0) as f32;
                for c in 0..3 {
                    page[[y, column, c]] += ink * (INK[c] - page[[y, column, c]]);
                }
            }
        }
        x += word + dice.count(2, 3);
    }
}

/// Paints hills under a sky with a sun.
fn paint_picture(
    page: &mut Array3<f32>,
    rows: std::ops::Range<usize>,
    columns: std::ops::Range<usize>,
    seed: u64,
) {
    let (height, width) = (rows.len() as f64, columns.len() as f64);
    let mut dice = Dice::new(seed);
    let sun = (dice.between(0.15, 0.85), dice.between(0.15, 0.4), dice.between(0.08, 0.16));
    for y in rows.clone() {
        for x in columns.clone() {
            let (u, v) = ((x - columns.start) as f64 / width, (y - rows.start) as f64 / height);
            let hill = |k: u64, base: f64| base + 0.25 * noise(seed.wrapping_add(k), 3.0 * u, 0.0);
            let sun_distance = ((u - sun.0).powi(2) + ((v - sun.1) * height / width).powi(2)).sqrt();
            let colour = if v > hill(2, 0.62) {
                [0.16, 0.34, 0.10]
            } else if v > hill(1, 0.42) {
                [0.36, 0.50, 0.24]
            } else if sun_distance < 0.6 * sun.2 {
                [0.86, 0.70, 0.22]
            } else {
                [0.30 + 0.4 * v, 0.48 + 0.3 * v, 0.74]
            };
            let grain = 0.8 + 0.4 * noise(seed.wrapping_add(3), x as f64 / 1.7, y as f64 / 1.7);
            for c in 0..3 {
                page[[y, x, c]] = (colour[c] * grain).min(0.88) as f32;
            }
        }
    }
}

/// Smooth noise in 0..1 over a unit lattice (value noise).
pub(crate) fn noise(seed: u64, x: f64, y: f64) -> f64 {
    let (x0, y0) = (x.floor(), y.floor());
    let fade = |f: f64| f * f * (3.0 - 2.0 * f);
    let (fx, fy) = (fade(x - x0), fade(y - y0));
    let corner = |dx: f64, dy: f64| lattice(seed, (x0 + dx) as i64, (y0 + dy) as i64);
    let top = corner(0.0, 0.0) + fx * (corner(1.0, 0.0) - corner(0.0, 0.0));
    let bottom = corner(0.0, 1.0) + fx * (corner(1.0, 1.0) - corner(0.0, 1.0));
    top + fy * (bottom - top)
}

/// SplitMix64's finaliser applied to the lattice point: random values without a stored table.
fn lattice(seed: u64, x: i64, y: i64) -> f64 {
    let mut z = seed
        .wrapping_add((x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15))
        .wrapping_add((y as u64).wrapping_mul(0xd1b5_4a32_d192_ed03));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn albedo_stays_physical_at_any_size() {
        for (rows, columns) in [(8, 8), (16, 40), (128, 128), (300, 33)] {
            for seed in 0..4 {
                let page = printed_page(rows, columns, seed);
                assert!(page.iter().all(|&a| (0.02..=0.9).contains(&a)), "{rows}x{columns}, seed {seed}");
            }
        }
        assert_eq!(printed_page(40, 40, 1), printed_page(40, 40, 1));
        assert_ne!(printed_page(40, 40, 1), printed_page(40, 40, 2));
    }

    #[test]
    fn noise_is_continuous_and_within_bounds() {
        for k in 0..1000 {
            let x = f64::from(k) * 0.013 - 5.0;
            let (a, b) = (noise(3, x, 0.3), noise(3, x + 1e-6, 0.3));
            assert!((0.0..=1.0).contains(&a) && (a - b).abs() < 1e-5);
        }
    }
}
