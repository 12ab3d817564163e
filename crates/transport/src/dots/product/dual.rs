use ndarray::{Array2, Array3};

use crate::dots::calibrate::Centroids;
use crate::dots::error::{check_range, check_shape};
use crate::dots::{Batch, DotsError};

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
    let mut of_block = vec![0; batch.shape().blocks()];
    let channels = batch.shape().channels() as f64;
    (0..batch.dots())
        .map(|dot| batch.column(dot).energy(&mut of_block).iter().sum::<f64>() / channels)
        .collect()
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
    let mut sums = Array3::<f64>::zeros((height, width, channels));
    let mut counts = Array2::<u32>::zeros((height, width));
    let mut of_block = vec![0; shape.blocks()];
    for (dot, (xy, &plane)) in centroids.xy.iter().zip(plane_energies).enumerate() {
        let Some([x, y]) = xy.filter(|_| plane > 0.0) else { continue };
        let scaled =
            |at: f64, from: usize, to: usize| (((at + 0.5) * to as f64 / from as f64) as usize).min(to - 1);
        let at = [scaled(y, shape.height(), height), scaled(x, shape.width(), width)];
        let energy = batch.column(dot).energy(&mut of_block);
        for channel in 0..channels {
            sums[[at[0], at[1], channel]] += energy[channel] / plane;
        }
        counts[at] += 1;
    }
    let known = counts.mapv(|count| count > 0);
    let mut image = Array3::from_shape_fn(sums.dim(), |(row, column, channel)| {
        (sums[[row, column, channel]] / f64::from(counts[[row, column]].max(1))) as f32
    });
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
    let pixels = height * width;
    let mut values: Vec<f32> = image.iter().copied().collect();
    let mut is_filled: Vec<bool> = known.iter().copied().collect();
    let neighbours = |pixel: usize| {
        let (row, column) = (pixel / width, pixel % width);
        let sideways = [(column > 0).then(|| pixel - 1), (column + 1 < width).then_some(pixel + 1)];
        let upright = [(row > 0).then(|| pixel - width), (row + 1 < height).then_some(pixel + width)];
        sideways.into_iter().chain(upright).flatten()
    };
    // In each step only the rim of what is filled: every pixel is reached once.
    let mut queued = is_filled.clone();
    let mut rim: Vec<usize> = (0..pixels)
        .filter(|&pixel| !is_filled[pixel] && neighbours(pixel).any(|near| is_filled[near]))
        .collect();
    let (mut next, mut means) = (Vec::new(), Vec::new());
    while !rim.is_empty() {
        rim.iter().for_each(|&pixel| queued[pixel] = true);
        means.clear();
        for &pixel in &rim {
            for channel in 0..channels {
                let filled = neighbours(pixel).filter(|&near| is_filled[near]);
                let (sum, count) = filled.fold((0.0, 0.0), |(sum, count), near| {
                    (sum + values[near * channels + channel], count + 1.0)
                });
                means.push(sum / count);
            }
        }
        for (&pixel, means) in rim.iter().zip(means.chunks_exact(channels)) {
            values[pixel * channels..][..channels].copy_from_slice(means);
            is_filled[pixel] = true;
        }
        next.clear();
        for &pixel in &rim {
            for near in neighbours(pixel) {
                if !queued[near] {
                    queued[near] = true;
                    next.push(near);
                }
            }
        }
        std::mem::swap(&mut rim, &mut next);
    }
    image.iter_mut().zip(values).for_each(|(place, value)| *place = value);
}
