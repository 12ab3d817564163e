use std::sync::atomic::{AtomicU32, Ordering};

use ndarray::{Array2, Array3, Axis};
use rayon::prelude::*;

/// Number of rows whose pixels are sorted together.
const BAND_ROWS: usize = 64;

/// Fills the unknown pixels of an image `[height, width, channels]` from the known ones outwards: each gets the mean
/// of its horizontal and vertical neighbours that were known or filled one step earlier. Without any known pixel the
/// image is left unchanged.
///
/// # Panics
/// If `known` does not have the image's height and width.
pub fn fill_holes(image: &mut Array3<f32>, known: &Array2<bool>) {
    let (height, width, channels) = image.dim();
    assert_eq!(known.dim(), (height, width), "known must be as large as the image");
    if !known.iter().any(|&known| known) {
        return;
    }
    // With a border that no step reaches, so that every pixel has four neighbours.
    let stride = width + 2;
    let steps = steps_from(known);
    // Atomic because the pixels of one step are written while those of the previous step, which are always others,
    // are read.
    let values: Vec<AtomicU32> =
        (0..steps.len() * channels).into_par_iter().map(|_| AtomicU32::new(0)).collect();
    let row_of = |row: usize| &values[((row + 1) * stride + 1) * channels..][..width * channels];
    image.axis_iter(Axis(0)).into_par_iter().enumerate().for_each(|(row, pixels)| {
        pixels
            .iter()
            .zip(row_of(row))
            .for_each(|(light, value)| value.store(light.to_bits(), Ordering::Relaxed));
    });
    let fill = |pixel: usize, step: u32| {
        let neighbours = [pixel - 1, pixel + 1, pixel - stride, pixel + stride];
        // All bits set for a filled neighbour, none for an unfilled one: branches here would be unpredictable.
        let mut mask = [0; 4];
        for (mask, near) in mask.iter_mut().zip(neighbours) {
            *mask = u32::from(steps[near] < step).wrapping_neg();
        }
        let count = mask.iter().map(|mask| mask & 1).sum::<u32>() as f32;
        for channel in 0..channels {
            let mut sum = 0.0;
            for (mask, near) in mask.iter().zip(neighbours) {
                sum += f32::from_bits(values[near * channels + channel].load(Ordering::Relaxed) & mask);
            }
            values[pixel * channels + channel].store((sum / count).to_bits(), Ordering::Relaxed);
        }
    };
    let bands: Vec<Band> = (stride..(height + 1) * stride)
        .into_par_iter()
        .step_by(BAND_ROWS * stride)
        .map(|first| Band::new(&steps, first..(first + BAND_ROWS * stride).min((height + 1) * stride)))
        .collect();
    let last = bands.iter().map(|band| band.ends.len() as u32).max().unwrap_or(0);
    for step in 1..last {
        bands.par_iter().for_each(|band| band.at(step).iter().for_each(|&pixel| fill(pixel as usize, step)));
    }
    image.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(row, mut pixels)| {
        let values = row_of(row).iter().map(|value| f32::from_bits(value.load(Ordering::Relaxed)));
        pixels.iter_mut().zip(values).for_each(|(pixel, value)| *pixel = value);
    });
}

/// Distance in horizontal and vertical steps from each pixel to the nearest known one, `[height + 2, width + 2]`;
/// `u32::MAX` on the border.
fn steps_from(known: &Array2<bool>) -> Vec<u32> {
    let (height, width) = known.dim();
    let stride = width + 2;
    let mut steps = vec![u32::MAX; (height + 2) * stride];
    for (row, known) in steps.chunks_exact_mut(stride).skip(1).zip(known.outer_iter()) {
        row[1..].iter_mut().zip(known).filter(|(_, known)| **known).for_each(|(steps, _)| *steps = 0);
    }
    // City-block distance, one axis at a time: first the nearest in the column, then the nearest in the row.
    let nearer = |steps: u32, beside: u32| steps.min(beside.saturating_add(1));
    for row in 1..height {
        let (above, below) = steps[row * stride..].split_at_mut(stride);
        below[..stride].iter_mut().zip(above).for_each(|(steps, above)| *steps = nearer(*steps, *above));
    }
    for row in (1..height).rev() {
        let (above, below) = steps[row * stride..].split_at_mut(stride);
        above.iter_mut().zip(below).for_each(|(steps, below)| *steps = nearer(*steps, *below));
    }
    steps.par_chunks_exact_mut(stride).skip(1).take(height).for_each(|row| {
        let row = &mut row[1..=width];
        (1..width).for_each(|at| row[at] = nearer(row[at], row[at - 1]));
        (1..width).rev().for_each(|at| row[at - 1] = nearer(row[at - 1], row[at]));
    });
    steps
}

/// The pixels of some rows, sorted by step.
struct Band {
    pixels: Vec<u32>,
    /// End of each step's pixels.
    ends: Vec<u32>,
}

impl Band {
    fn new(steps: &[u32], pixels: std::ops::Range<usize>) -> Self {
        let inside = || pixels.clone().filter(|&pixel| steps[pixel] != u32::MAX);
        let last = inside().map(|pixel| steps[pixel]).max().unwrap_or(0);
        let mut ends = vec![0; last as usize + 2];
        inside().for_each(|pixel| ends[steps[pixel] as usize + 1] += 1);
        (1..ends.len()).for_each(|step| ends[step] += ends[step - 1]);
        let mut sorted = vec![0; ends[last as usize + 1] as usize];
        // The start of each step moves to its end.
        for pixel in inside() {
            let place = &mut ends[steps[pixel] as usize];
            sorted[*place as usize] = pixel as u32;
            *place += 1;
        }
        ends.pop();
        Self { pixels: sorted, ends }
    }

    fn at(&self, step: u32) -> &[u32] {
        let step = step as usize;
        self.ends.get(step).map_or(&[], |&end| &self.pixels[self.ends[step - 1] as usize..end as usize])
    }
}
