use rayon::prelude::*;

use crate::dots::batch::Word;
use crate::dots::column::bits;
use crate::dots::error::check_range;
use crate::dots::{Batch, DotsError, FrameShape};

/// The pixels that each dot covers: its column, binarised.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Footprints {
    shape: FrameShape,
    /// Start of each dot's words, `[dots + 1]`.
    offsets: Vec<u32>,
    words: Vec<u32>,
    masks: Vec<u32>,
}

impl Footprints {
    /// The pixels of each column that reach at least `level` times its largest value, by luminance for colours. 0.5
    /// gives a dot's width at half its height.
    ///
    /// # Errors
    /// [`DotsError::OutOfRange`] for a level outside 0..=1 or equal to 0.
    pub fn new(batch: &Batch, level: f64) -> Result<Self, DotsError> {
        check_range("level", level, level > 0.0 && level <= 1.0, "above 0 and at most 1, as 0.5")?;
        let channels = batch.shape().channels();
        let of_dots: Vec<Vec<(u32, u32)>> = (0..batch.dots())
            .into_par_iter()
            .map(|dot| {
                let column = batch.column(dot);
                let least = level as f32 * brightest(column.values(), channels);
                // A column without light has no footprint.
                let words = column.words().filter(|_| least > 0.0).map(|Word { word, mask, values }| {
                    let above = bits(mask).zip(values.chunks_exact(channels));
                    let above = above
                        .fold(0, |mask, (bit, value)| mask | u32::from(luminance(value) >= least) << bit);
                    (word as u32, above)
                });
                words.filter(|(_, mask)| *mask != 0).collect()
            })
            .collect();
        let mut footprints =
            Self { shape: batch.shape(), offsets: vec![0], words: Vec::new(), masks: Vec::new() };
        for words in of_dots {
            footprints.words.extend(words.iter().map(|(word, _)| word));
            footprints.masks.extend(words.iter().map(|(_, mask)| mask));
            footprints.offsets.push(footprints.words.len() as u32);
        }
        Ok(footprints)
    }

    /// Shape of the frames.
    pub fn shape(&self) -> FrameShape {
        self.shape
    }

    /// Number of dots.
    pub fn dots(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Words of a dot with their masks, ascending.
    pub(crate) fn words(&self, dot: usize) -> impl Iterator<Item = (usize, u32)> + '_ {
        let range = self.offsets[dot] as usize..self.offsets[dot + 1] as usize;
        self.words[range.clone()].iter().zip(&self.masks[range]).map(|(&word, &mask)| (word as usize, mask))
    }
}

/// Largest luminance of pixels `[pixels, channels]`; at least 0.
fn brightest(values: &[f32], channels: usize) -> f32 {
    let larger = |most: f32, light: f32| if light > most { light } else { most };
    // In parallel lanes: in a single maximum, each comparison would wait for the previous one.
    let mut most = [0.0; 8];
    for pixels in values.chunks(8 * channels) {
        for (most, pixel) in most.iter_mut().zip(pixels.chunks_exact(channels)) {
            *most = larger(*most, luminance(pixel));
        }
    }
    most.into_iter().fold(0.0, larger)
}

/// Luminance of a pixel's values: the value itself, or (R + 2 G + B) / 4.
pub(crate) fn luminance(value: &[f32]) -> f32 {
    match value {
        [red, green, blue] => (red + 2.0 * green + blue) / 4.0,
        _ => value.iter().sum(),
    }
}
