use ndarray::{Array2, Array3};
use rayon::prelude::*;

use super::holes::fill_holes;
use crate::dots::calibrate::Centroids;
use crate::dots::error::{check_range, check_shape};
use crate::dots::{Batch, DotsError};

/// The scene as seen from the mirror and lit from the camera.
#[derive(Debug, Clone, PartialEq)]
pub struct DualImage {
    /// `[height, width, channels]`; 1 is the calibration plane.
    pub image: Array3<f32>,
    /// Which pixels contain a dot, `[height, width]`; the others are interpolated.
    pub known: Array2<bool>,
}

/// The total light of each column, with the blocks' means outside the mask, averaged over the channels. For the
/// calibration plane, this is the divisor of [`dual`].
pub fn column_energies(batch: &Batch) -> Vec<f64> {
    let channels = batch.shape().channels() as f64;
    energies_of_channels(batch).iter().map(|energy| energy.iter().sum::<f64>() / channels).collect()
}

fn energies_of_channels(batch: &Batch) -> Vec<[f64; 3]> {
    (0..batch.dots()).into_par_iter().map(|dot| batch.column(dot).energy()).collect()
}

/// Dual image by Helmholtz reciprocity: the pixel at each dot's position on the calibration plane gets the light of
/// the dot's whole column, divided by that on the plane (`plane_energies`, from [`column_energies`] of the plane's
/// batch). Holes are filled. Both are sums over the same pixels, so their number cancels. `size` is (height, width);
/// the frame is scaled to it.
///
/// Dots without a centroid or without light on the plane are left out. Dots that share a pixel are averaged.
///
/// # Errors
/// [`DotsError::Shape`] if the numbers of centroids or energies differ from the number of dots,
/// [`DotsError::OutOfRange`] for an image without pixels.
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
