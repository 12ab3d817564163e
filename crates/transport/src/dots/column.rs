use std::ops::Range;

use super::shape::WORD_PX;

/// The outcome of Algorithm 1 for one frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ColumnOutcome {
    /// Number of discs taken; 0 if nothing exceeded the noise of the background.
    pub discs: u32,
    /// Whether it stopped at the limit on discs, so that some light may remain.
    pub capped: bool,
}

/// The light transport of one dot: individual pixels in discs around its brightest points, and for all other pixels
/// the mean of each block. In counts above the background, times the flat field's gain; may be negative.
///
/// The arrays keep their memory when the column is overwritten.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SparseColumn {
    /// The words of 32 pixels that have pixels in the mask, ascending: pixel index / 32.
    pub words: Vec<u32>,
    /// The pixels of each word: bit `b` is pixel `32 word + b`.
    pub masks: Vec<u32>,
    /// Their values in the order of the bits, `[pixels, channels]`.
    pub values: Vec<f32>,
    /// Mean of each block's pixels outside the mask, `[block rows, block columns, channels]`; 0 where there are none.
    pub residual: Vec<f32>,
    /// Outcome of the denoising.
    pub outcome: ColumnOutcome,
}

impl SparseColumn {
    /// The pixels of the mask in ascending order, without allocating memory.
    pub fn pixels(&self) -> impl Iterator<Item = usize> {
        self.words
            .iter()
            .zip(&self.masks)
            .flat_map(|(&word, &mask)| bits(mask).map(move |bit| word as usize * WORD_PX + bit))
    }

    pub(crate) fn clear(&mut self) {
        self.words.clear();
        self.masks.clear();
        self.values.clear();
        self.residual.clear();
        self.outcome = ColumnOutcome::default();
    }
}

/// The positions of a mask's set bits, lowest first.
pub(crate) fn bits(mut mask: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = (mask != 0).then(|| mask.trailing_zeros() as usize)?;
        mask &= mask - 1;
        Some(bit)
    })
}

/// The runs of set bits of a mask, lowest first; a row of a disc is mostly one run per word.
pub(crate) fn runs(mask: u32) -> impl Iterator<Item = Range<usize>> {
    // Wider than the mask, so that a run that includes the last bit ends.
    let mut rest = u64::from(mask);
    std::iter::from_fn(move || {
        let start = (rest != 0).then(|| rest.trailing_zeros())?;
        let end = start + (rest >> start).trailing_ones();
        rest &= !0 << end;
        Some(start as usize..end as usize)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_and_bits_are_those_of_the_mask() {
        for mask in [0, 1, 1 << 31, u32::MAX, 0b1011_0111, 0xf000_000f, 0xaaaa_aaaa] {
            let expected: Vec<usize> = (0..32).filter(|bit| mask >> bit & 1 == 1).collect();
            assert_eq!(bits(mask).collect::<Vec<_>>(), expected);
            assert_eq!(runs(mask).flatten().collect::<Vec<_>>(), expected);
        }
        assert_eq!(runs(0b1011_0111).collect::<Vec<_>>(), [0..3, 4..6, 7..8]);
    }
}
