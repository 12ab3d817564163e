//! `mix`: all four objects in one image, one per quarter.
//!
//! The quarters do not illuminate each other, and each uses half of the projector's columns.

use super::object::{Object, Panel};
use super::size::SceneSize;
use super::{ball, candle, groove, slab};

type Build = fn(SceneSize, &[usize], u64) -> Object;

const QUARTERS: [[Build; 2]; 2] = [[groove::build, ball::build], [slab::build, candle::build]];

pub(super) fn build(size: SceneSize, bands: &[usize], seed: u64) -> Vec<Panel> {
    let mut panels = Vec::new();
    for (i, builds) in QUARTERS.iter().enumerate() {
        for (j, build) in builds.iter().enumerate() {
            let (top, left) = (size.rows * i / 2, size.columns * j / 2);
            let quarter =
                SceneSize { rows: size.rows * (i + 1) / 2 - top, columns: size.columns * (j + 1) / 2 - left };
            panels.push(Panel {
                row: top,
                column: left,
                projector_columns: 0.5 * j as f64..0.5 * (j + 1) as f64,
                // Each quarter has its own print.
                object: build(quarter, bands, seed.wrapping_mul(4).wrapping_add((2 * i + j) as u64)),
            });
        }
    }
    panels
}
