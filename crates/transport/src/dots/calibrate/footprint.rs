use crate::dots::batch::Word;
use crate::dots::column::bits;
use crate::dots::error::check_range;
use crate::dots::{Batch, DotsError, FrameShape};

/// The pixels that each dot covers: its column, binarised.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Footprints {
    shape: FrameShape,
    /// Where each dot's words begin, `[dots + 1]`.
    offsets: Vec<u32>,
    words: Vec<u32>,
    masks: Vec<u32>,
}

impl Footprints {
    /// The pixels of each column that have at least `level` of its largest value; colours count by their luminance.
    /// 0.5 gives a dot's width at half its height.
    ///
    /// # Errors
    /// [`DotsError::OutOfRange`] for a level that is not above 0 and at most 1.
    pub fn new(batch: &Batch, level: f64) -> Result<Self, DotsError> {
        check_range("level", level, level > 0.0 && level <= 1.0, "above 0 and at most 1, as 0.5")?;
        let channels = batch.shape().channels();
        let mut footprints =
            Self { shape: batch.shape(), offsets: vec![0], words: Vec::new(), masks: Vec::new() };
        for dot in 0..batch.dots() {
            let column = batch.column(dot);
            let least = level as f32 * column.pixels().map(|(_, value)| luminance(value)).fold(0.0, f32::max);
            for Word { word, mask, values } in column.words() {
                let above = bits(mask).zip(values.chunks_exact(channels));
                // A column without light has no footprint.
                let above = above.filter(|(_, value)| least > 0.0 && luminance(value) >= least);
                let mask = above.fold(0_u32, |mask, (bit, _)| mask | 1 << bit);
                if mask != 0 {
                    footprints.words.push(word as u32);
                    footprints.masks.push(mask);
                }
            }
            footprints.offsets.push(footprints.words.len() as u32);
        }
        Ok(footprints)
    }

    /// Size of the frames.
    pub fn shape(&self) -> FrameShape {
        self.shape
    }

    /// How many dots.
    pub fn dots(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Words of a dot with their masks, ascending.
    pub(crate) fn words(&self, dot: usize) -> impl Iterator<Item = (usize, u32)> + '_ {
        let range = self.offsets[dot] as usize..self.offsets[dot + 1] as usize;
        self.words[range.clone()].iter().zip(&self.masks[range]).map(|(&word, &mask)| (word as usize, mask))
    }
}

/// Luminance of a pixel's values: itself, or (R + 2 G + B) / 4.
pub(crate) fn luminance(value: &[f32]) -> f32 {
    match value {
        [red, green, blue] => (red + 2.0 * green + blue) / 4.0,
        _ => value.iter().sum(),
    }
}
