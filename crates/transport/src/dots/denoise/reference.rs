//! The simplest possible implementation of Algorithm 1, which [`Denoiser`](super::Denoiser) must equal.

use super::rule::false_alarm_sigmas;
use super::{DenoiseSettings, StopRule};
use crate::dots::background::luminance;
use crate::dots::error::check_shape;
use crate::dots::shape::WORD_PX;
use crate::dots::{Background, ColumnOutcome, Correction, DotsError, NoiseFloor, SparseColumn};

/// Denoises one raw frame, `[height, width, channels]`: for every disc the whole frame is searched again.
///
/// # Errors
/// As [`Denoiser::column`](super::Denoiser::column).
pub fn column(
    frame: &[u16],
    correction: &Correction,
    background: &Background,
    floor: NoiseFloor,
    settings: &DenoiseSettings,
) -> Result<SparseColumn, DotsError> {
    let shape = correction.shape();
    let (width, channels) = (shape.width(), shape.channels());
    check_shape("frame", "[values]", &[frame.len()], &[shape.values()])?;
    let is_hot = |pixel: usize| correction.hot().contains(&(pixel as u32));
    let difference = |pixel: usize| {
        let raw = match channels {
            1 => frame[pixel],
            _ => luminance([frame[3 * pixel], frame[3 * pixel + 1], frame[3 * pixel + 2]]),
        };
        i64::from(raw) - i64::from(background.counts[pixel])
    };
    // `None` for hot pixels, and later for pixels that are taken.
    let mut left: Vec<Option<i64>> =
        (0..shape.pixels()).map(|pixel| (!is_hot(pixel)).then(|| difference(pixel))).collect();
    let mut taken = vec![false; shape.pixels()];
    let patch = match &settings.stop {
        StopRule::Printed { patch, .. } => NoiseFloor::of_frame(frame, correction, background, patch)?,
        StopRule::FalseAlarms { .. } => floor,
    };

    let mut outcome = ColumnOutcome::default();
    loop {
        let mut brightest: Option<(usize, i64)> = None;
        for (pixel, value) in left.iter().enumerate() {
            if let Some(value) = *value
                && brightest.is_none_or(|(_, most)| value > most)
            {
                brightest = Some((pixel, value));
            }
        }
        let Some((centre, most)) = brightest else { break };
        let done = match &settings.stop {
            StopRule::FalseAlarms { per_frame } => {
                let sigmas = false_alarm_sigmas(*per_frame, shape.pixels());
                (most as f64) < floor.mean + sigmas * floor.sigma
            }
            StopRule::Printed { tolerance, .. } => outcome.discs > 0 && equals(&left, patch, *tolerance),
        };
        if done {
            break;
        }
        if outcome.discs == settings.max_discs {
            outcome.capped = true;
            break;
        }
        outcome.discs += 1;
        for pixel in 0..shape.pixels() {
            let down = (pixel / width) as f64 - (centre / width) as f64;
            let right = (pixel % width) as f64 - (centre % width) as f64;
            if down * down + right * right < settings.radius_px * settings.radius_px {
                (left[pixel], taken[pixel]) = (None, true);
            }
        }
    }

    let mut column = SparseColumn { outcome, ..SparseColumn::default() };
    for (word, pixels) in taken.chunks(WORD_PX).enumerate() {
        let mask = pixels.iter().enumerate().fold(0, |mask, (bit, &taken)| mask | u32::from(taken) << bit);
        if mask != 0 {
            column.words.push(word as u32);
            column.masks.push(mask);
        }
    }
    let of_taken = (0..shape.values()).filter(|value| taken[value / channels]);
    let value = |value: usize| correction.value(frame, &background.mean, value / channels, value % channels);
    column.values = of_taken.map(value).collect();
    for block in 0..shape.blocks() {
        let side = shape.block_px();
        let (top, first) = (block / shape.block_columns() * side, block % shape.block_columns() * side);
        let rows = top..shape.height().min(top + side);
        let pixels = rows.flat_map(|row| (first..first + side).map(move |column| row * width + column));
        let outside: Vec<usize> = pixels.filter(|&pixel| !is_hot(pixel) && !taken[pixel]).collect();
        for channel in 0..channels {
            let above = |pixel: &usize| {
                f64::from(frame[pixel * channels + channel])
                    - f64::from(background.mean[pixel * channels + channel])
            };
            let sum: f64 = outside.iter().map(above).sum();
            let gain = f64::from(correction.block_gain()[block * channels + channel]);
            column.residual.push((gain * sum / outside.len().max(1) as f64) as f32);
        }
    }
    Ok(column)
}

/// Whether the rest has the statistics of the patch, within `tolerance` standard deviations of the patch.
fn equals(left: &[Option<i64>], patch: NoiseFloor, tolerance: f64) -> bool {
    let values: Vec<i64> = left.iter().flatten().copied().collect();
    let rest = NoiseFloor::of_sums(
        values.len(),
        values.iter().sum(),
        values.iter().map(|value| value * value).sum(),
    );
    (rest.mean - patch.mean).abs() <= tolerance * patch.sigma
        && (rest.sigma - patch.sigma).abs() <= tolerance * patch.sigma
}
