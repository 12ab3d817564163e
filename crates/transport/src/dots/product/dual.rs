use ndarray::{Array2, Array3, Axis};
use rayon::prelude::*;

use crate::dots::calibrate::Centroids;
use crate::dots::error::{check_range, check_shape};
use crate::dots::{Batch, DotsError};

/// Pixels of a rim that are filled together.
const RIM_PX: usize = 4096;

/// The scene as the mirror would see it, lit from the camera.
#[derive(Debug, Clone, PartialEq)]
pub struct DualImage {
    /// `[height, width, channels]`; 1 is the calibration plane.
    pub image: Array3<f32>,
    /// Which pixels are dots of their own, `[height, width]`; the others are filled in.
    pub known: Array2<bool>,
}

/// All light of each column, those outside the mask by their blocks' means; the mean of the channels. On the
/// calibration plane, what [`dual`] divides by.
pub fn column_energies(batch: &Batch) -> Vec<f64> {
    let channels = batch.shape().channels() as f64;
    energies_of_channels(batch).iter().map(|energy| energy.iter().sum::<f64>() / channels).collect()
}

fn energies_of_channels(batch: &Batch) -> Vec<[f64; 3]> {
    let of_block = || vec![0; batch.shape().blocks()];
    let dots = (0..batch.dots()).into_par_iter();
    dots.map_init(of_block, |of_block, dot| batch.column(dot).energy(of_block)).collect()
}

/// Dual image by Helmholtz reciprocity: each dot's place on the calibration plane has the light of its whole column,
/// over what the plane gave there (`plane_energies`, by [`column_energies`] of the plane's batch), holes filled. Both
/// are sums over the same pixels, whose number drops out. `size` is (height, width); the frame is scaled to it.
///
/// Dots without a centroid or without light on the plane are left out; those that share a pixel are averaged.
///
/// # Errors
/// [`DotsError::Shape`] if centroids or energies are not those of the batch's dots, [`DotsError::OutOfRange`] for an
/// image without pixels.
pub fn dual(
    batch: &Batch,
    centroids: &Centroids,
    plane_energies: &[f64],
    size: (usize, usize),
) -> Result<DualImage, DotsError> {
    let (shape, (height, width)) = (batch.shape(), size);
    check_shape("centroids", "[dots]", &[centroids.xy.len()], &[batch.dots()])?;
    check_shape("plane_energies", "[dots]", &[plane_energies.len()], &[batch.dots()])?;
    check_range("dual image's pixels", (height * width) as f64, height * width > 0, "at least 1")?;
    let channels = shape.channels();
    let mut image = Array3::<f32>::zeros((height, width, channels));
    let mut counts = Array2::<u32>::zeros((height, width));
    let mut places = Vec::with_capacity(batch.dots());
    let energies = energies_of_channels(batch);
    for ((xy, &plane), energy) in centroids.xy.iter().zip(plane_energies).zip(energies) {
        let Some([x, y]) = xy.filter(|_| plane > 0.0) else { continue };
        let scaled =
            |at: f64, from: usize, to: usize| (((at + 0.5) * to as f64 / from as f64) as usize).min(to - 1);
        let at = [scaled(y, shape.height(), height), scaled(x, shape.width(), width)];
        counts[at] += 1;
        places.push((at, energy.map(|energy| energy / plane)));
    }
    for (at, light) in places {
        for (channel, light) in light.iter().enumerate().take(channels) {
            image[[at[0], at[1], channel]] += (light / f64::from(counts[at])) as f32;
        }
    }
    let known = counts.mapv(|count| count > 0);
    fill_holes(&mut image, &known);
    Ok(DualImage { image, known })
}

/// Fills the pixels of an image `[height, width, channels]` that are not known, from the known ones outwards: each has
/// the mean of its horizontal and vertical neighbours that were known or filled a step before. Without any known pixel
/// the image stays as it is.
///
/// # Panics
/// If `known` is not of the image's height and width.
pub fn fill_holes(image: &mut Array3<f32>, known: &Array2<bool>) {
    let (height, width, channels) = image.dim();
    assert_eq!(known.dim(), (height, width), "known must be as large as the image");
    // With a border that is never filled, so that every pixel has four neighbours. What is not filled is NaN.
    let stride = width + 2;
    let row_of = |row: usize| (row + 1) * stride + 1..(row + 1) * stride + 1 + width;
    let mut values = vec![f32::NAN; (height + 2) * stride * channels];
    let mut is_open = vec![false; (height + 2) * stride];
    for (row, (known, pixels)) in known.outer_iter().zip(image.outer_iter()).enumerate() {
        is_open[row_of(row)].iter_mut().zip(known).for_each(|(is_open, known)| *is_open = !known);
        let values = values[row_of(row).start * channels..].chunks_exact_mut(channels);
        for ((values, pixel), _) in values.zip(pixels.outer_iter()).zip(known).filter(|(_, known)| **known) {
            values.iter_mut().zip(pixel).for_each(|(value, &light)| *value = light);
        }
    }
    let neighbours = |pixel: usize| [pixel - 1, pixel + 1, pixel - stride, pixel + stride];
    let at_rim = |&pixel: &usize| {
        is_open[pixel] && neighbours(pixel).iter().any(|near| !values[near * channels].is_nan())
    };
    let mean_near = |pixel: usize, channel: usize, values: &[f32]| {
        let (mut sum, mut count) = (0.0, 0.0);
        for near in neighbours(pixel) {
            let value = values[near * channels + channel];
            let is_filled = !value.is_nan();
            sum += if is_filled { value } else { 0.0 };
            count += if is_filled { 1.0 } else { 0.0 };
        }
        sum / count
    };
    // In each step only the rim of what is filled: every pixel is reached once.
    let rows = (0..height).into_par_iter();
    let mut rim: Vec<usize> = rows.flat_map_iter(|row| row_of(row).filter(at_rim)).collect();
    rim.iter().for_each(|&pixel| is_open[pixel] = false);
    let (mut next, mut means) = (Vec::new(), Vec::new());
    while !rim.is_empty() {
        means.resize(rim.len() * channels, 0.0);
        let parts = means.par_chunks_mut(RIM_PX * channels).zip(rim.par_chunks(RIM_PX));
        parts.for_each(|(means, rim)| {
            for (means, &pixel) in means.chunks_exact_mut(channels).zip(rim) {
                means
                    .iter_mut()
                    .enumerate()
                    .for_each(|(channel, mean)| *mean = mean_near(pixel, channel, &values));
            }
        });
        next.clear();
        for (&pixel, means) in rim.iter().zip(means.chunks_exact(channels)) {
            values[pixel * channels..][..channels].copy_from_slice(means);
            next.extend(neighbours(pixel).into_iter().filter(|&near| std::mem::take(&mut is_open[near])));
        }
        std::mem::swap(&mut rim, &mut next);
    }
    // Where nothing is known, nothing was filled.
    if known.iter().any(|&known| known) {
        image.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(row, mut pixels)| {
            let values = &values[row_of(row).start * channels..row_of(row).end * channels];
            pixels.iter_mut().zip(values).for_each(|(pixel, &value)| *pixel = value);
        });
    }
}
