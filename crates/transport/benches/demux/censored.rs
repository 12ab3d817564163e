//! Time for a pixel with saturated samples: the corner with highlights, solved with and without.

use std::error::Error;
use std::time::Instant;

use ndarray::{Array3, s};
use raysweep_transport::plane::{Demux, Prior};

use super::scene::{Case, paper_sweep};

/// Light above which samples are clipped; a camera whose white level is 61 % of its range.
const LIMIT: f32 = 1.6;
/// Direct light of the highlights.
const HIGHLIGHT: f32 = 5.0;
/// Every so many rows and columns has one: 64 pixels.
const SPACING_PX: usize = 16;

/// Prints the additional time for each pixel with saturated samples, on all threads.
pub fn print() -> Result<(), Box<dyn Error>> {
    let Case { timing, settings, mut stack, repetitions, .. } = paper_sweep()?;
    let demux = Demux::new(timing.clone(), settings.clone(), Prior::SPLIT)?;
    let seconds = |stack: &Array3<f32>, valid: Option<&Array3<bool>>| {
        let mut least = f64::INFINITY;
        for _ in 0..repetitions {
            let began = Instant::now();
            demux.solve(stack.view(), valid.map(|valid| valid.view()))?;
            least = least.min(began.elapsed().as_secs_f64());
        }
        Ok::<_, Box<dyn Error>>(least)
    };
    let without = seconds(&stack, None)?;
    let mut pixels = 0;
    for t in (0..stack.dim().1).step_by(SPACING_PX) {
        for s in (0..stack.dim().2).step_by(SPACING_PX) {
            pixels += 1;
            for (n, setting) in settings.iter().enumerate() {
                let seen = timing.weights(t, setting)[timing.camera().first_row + t] as f32;
                let mut samples = stack.slice_mut(s![.., t, s]);
                samples[n] = (samples[n] + HIGHLIGHT * seen).min(LIMIT);
            }
        }
    }
    let valid = stack.mapv(|light| light < LIMIT);
    let with = seconds(&stack, Some(&valid))?;
    let each_us = (with - without) / f64::from(pixels) * 1e6;
    println!(
        "\nsaturated samples: {pixels} pixels of 128x128, V=189: {without:.3} s without, {with:.3} s with, {each_us:.0} us each"
    );
    Ok(())
}
