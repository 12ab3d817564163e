//! Passes over raw counts minus background: first over the whole frame, then over the segments that a disc has
//! touched.

use super::lanes::Lanes;
use crate::dots::background::NARROW_LIMIT;
use crate::dots::column::bits;
use crate::dots::shape::WORD_PX;
use crate::dots::{Background, Correction, FrameShape};

/// Words per segment: 1024 consecutive pixels, whatever the frame's width. Segments that follow memory are read
/// faster than tiles.
pub(super) const SEGMENT_WORDS: usize = 32;

/// The maximum of a segment with no pixels left.
pub(super) const NOTHING: i32 = i32::MIN;

/// The results of the first pass. Its arrays belong to the scratch memory.
#[derive(Debug, Clone, Default)]
pub(super) struct Survey {
    /// Largest difference in each segment.
    pub maxima: Vec<i32>,
    /// Sum of differences in each block.
    pub block_sums: Vec<i32>,
    /// Sum of squared differences.
    pub squares: u64,
    /// Sums of column pairs within a row of blocks, `[word columns]`.
    lanes: Vec<[i32; 16]>,
}

impl Survey {
    pub fn new(shape: FrameShape) -> Self {
        Self {
            maxima: vec![NOTHING; shape.words().div_ceil(SEGMENT_WORDS)],
            block_sums: vec![0; shape.blocks()],
            squares: 0,
            lanes: vec![[0; 16]; shape.word_columns()],
        }
    }
}

/// Raw counts minus background of one frame, without hot pixels.
pub(super) trait CountDifferences {
    /// Visits each pixel once. Returns false if the counts exceed what the implementation supports.
    fn survey(&self, survey: &mut Survey) -> bool;

    /// Largest difference of a segment's pixels that are not taken.
    fn largest(&self, segment: usize, taken: &[u32]) -> i32;

    /// The first pixel of a segment that is not taken and has this difference.
    fn find(&self, segment: usize, difference: i32, taken: &[u32]) -> Option<usize>;
}

fn words_of(segment: usize, words: usize) -> std::ops::Range<usize> {
    segment * SEGMENT_WORDS..words.min((segment + 1) * SEGMENT_WORDS)
}

/// Differences in 16 bits, for counts below 2^12.
pub(super) struct NarrowCounts<'a, L> {
    lanes: L,
    raw: &'a [[u16; WORD_PX]],
    background: &'a [[u16; WORD_PX]],
    correction: &'a Correction,
}

impl<'a, L: Lanes> NarrowCounts<'a, L> {
    #[inline(always)]
    pub fn new(lanes: L, raw: &'a [u16], background: &'a Background, correction: &'a Correction) -> Self {
        let (raw, _) = raw.as_chunks();
        let (background, _) = background.counts.as_chunks();
        Self { lanes, raw, background, correction }
    }

    #[inline(always)]
    fn difference(&self, word: usize) -> L::I16 {
        self.lanes.subtract(self.lanes.load(&self.raw[word]), self.lanes.load(&self.background[word]))
    }

    /// The largest lane; [`NOTHING`] if only hot pixels can have its value.
    #[inline(always)]
    fn largest_lane(&self, largest: L::I16) -> i32 {
        let largest = self.lanes.to_array(largest).into_iter().fold(i16::MIN, i16::max).into();
        if largest <= -i32::from(NARROW_LIMIT) { NOTHING } else { largest }
    }

    /// Subtracts the hot pixels from the sums.
    fn leave_out_hot(&self, survey: &mut Survey) {
        let shape = self.correction.shape();
        for &pixel in self.correction.hot() {
            let (word, bit) = (pixel as usize / WORD_PX, pixel as usize % WORD_PX);
            let difference = i32::from(self.raw[word][bit]) - i32::from(self.background[word][bit]);
            survey.block_sums[shape.block_of(word, bit)] -= difference;
            survey.squares -= u64::from((difference * difference) as u32);
        }
    }
}

impl<L: Lanes> CountDifferences for NarrowCounts<'_, L> {
    #[inline(always)]
    fn survey(&self, survey: &mut Survey) -> bool {
        let (lanes, columns) = (self.lanes, survey.lanes.len());
        let shape = self.correction.shape();
        let words_of_row = columns * shape.block_px();
        let mut seen = lanes.all(0);
        let mut largest = lanes.all(i16::MIN);
        let mut squares = lanes.load_sums(&[0; 16]);
        survey.squares = 0;
        let mut word = 0;
        let rows = self.raw.chunks(words_of_row).zip(self.background.chunks(words_of_row));
        for ((raw, background), sums) in rows.zip(survey.block_sums.chunks_mut(shape.block_columns())) {
            survey.lanes.fill([0; 16]);
            let (mut raw, mut background) = (raw, background);
            while !raw.is_empty() {
                // To the end of the row or of the segment, whichever comes first.
                let column = word % columns;
                let run = (columns - column).min(SEGMENT_WORDS - word % SEGMENT_WORDS);
                let (raw_run, raw_rest) = raw.split_at(run);
                let (background_run, background_rest) = background.split_at(run);
                let pairs = raw_run.iter().zip(background_run).zip(&mut survey.lanes[column..column + run]);
                for ((raw, background), sums) in pairs {
                    let raw = lanes.load(raw);
                    let difference = lanes.subtract(raw, lanes.load(background));
                    seen = lanes.or(seen, raw);
                    largest = lanes.max(largest, difference);
                    squares = lanes.add(squares, lanes.pair_squares(difference));
                    *sums = lanes.to_sums(lanes.add(lanes.load_sums(sums), lanes.pair_sums(difference)));
                }
                (raw, background, word) = (raw_rest, background_rest, word + run);
                if word % SEGMENT_WORDS == 0 || word == self.raw.len() {
                    survey.maxima[(word - 1) / SEGMENT_WORDS] = self.largest_lane(largest);
                    // 64 squares of at most 8191 fit into each lane, unsigned.
                    let of_segment = lanes.to_sums(squares).into_iter().map(|sum| u64::from(sum as u32));
                    survey.squares += of_segment.sum::<u64>();
                    largest = lanes.all(i16::MIN);
                    squares = lanes.load_sums(&[0; 16]);
                }
            }
            let pairs = survey.lanes.as_flattened().chunks_exact(shape.block_px() / 2);
            for (sum, pairs) in sums.iter_mut().zip(pairs) {
                *sum = pairs.iter().sum();
            }
        }
        let seen = lanes.to_array(seen).into_iter().fold(0, |seen, lane| seen | lane as u16);
        let fits = seen < NARROW_LIMIT;
        if fits {
            self.leave_out_hot(survey);
        }
        fits
    }

    #[inline(always)]
    fn largest(&self, segment: usize, taken: &[u32]) -> i32 {
        let words = words_of(segment, self.raw.len());
        let largest = words.fold(self.lanes.all(i16::MIN), |largest, word| {
            self.lanes.max_except(largest, self.difference(word), taken[word])
        });
        self.largest_lane(largest)
    }

    #[inline(always)]
    fn find(&self, segment: usize, difference: i32, taken: &[u32]) -> Option<usize> {
        words_of(segment, self.raw.len()).find_map(|word| {
            let equal = self.lanes.equal(self.difference(word), difference as i16) & !taken[word];
            (equal != 0).then(|| word * WORD_PX + equal.trailing_zeros() as usize)
        })
    }
}

/// Differences of any counts, a pixel at a time.
pub(super) struct Wide<'a> {
    pub raw: &'a [u16],
    pub background: &'a Background,
    pub correction: &'a Correction,
}

impl Wide<'_> {
    fn sound(&self, word: usize, taken: u32) -> impl Iterator<Item = (usize, i32)> {
        bits(!(self.correction.hot_masks()[word] | taken)).map(move |bit| {
            let pixel = word * WORD_PX + bit;
            (pixel, i32::from(self.raw[pixel]) - i32::from(self.background.counts[pixel]))
        })
    }
}

impl CountDifferences for Wide<'_> {
    fn survey(&self, survey: &mut Survey) -> bool {
        let shape = self.correction.shape();
        survey.block_sums.fill(0);
        survey.maxima.fill(NOTHING);
        survey.squares = 0;
        for word in 0..shape.words() {
            let largest = &mut survey.maxima[word / SEGMENT_WORDS];
            for (pixel, difference) in self.sound(word, 0) {
                *largest = difference.max(*largest);
                survey.block_sums[shape.block_of(word, pixel % WORD_PX)] += difference;
                survey.squares += i64::from(difference).pow(2) as u64;
            }
        }
        true
    }

    fn largest(&self, segment: usize, taken: &[u32]) -> i32 {
        let words = words_of(segment, taken.len());
        words
            .flat_map(|word| self.sound(word, taken[word]))
            .map(|(_, difference)| difference)
            .max()
            .unwrap_or(NOTHING)
    }

    fn find(&self, segment: usize, difference: i32, taken: &[u32]) -> Option<usize> {
        let mut pixels = words_of(segment, taken.len()).flat_map(|word| self.sound(word, taken[word]));
        pixels.find(|&(_, of_pixel)| of_pixel == difference).map(|(pixel, _)| pixel)
    }
}
