use super::column::bits;
use super::error::check_shape;
use super::shape::WORD_PX;
use super::{ColumnOutcome, DotsError, FrameShape, SparseColumn};

/// The columns of one batch in the layout in which they are stored: each field is one array of a file.
///
/// In Python, with the arrays loaded under their names:
///
/// ```python
/// bits = np.unpackbits(masks.view(np.uint8).reshape(-1, 4), axis=1, bitorder="little").astype(bool)
/// pixel = (words[:, None].astype(np.int64) * 32 + np.arange(32))[bits]
/// first = np.concatenate([[0], np.cumsum(bits.sum(1))])[word_offsets]
/// sparse = scipy.sparse.csr_matrix((values[:, 0], pixel, first), shape=(len(word_offsets) - 1, height * width))
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BatchArrays {
    /// Start of each dot's words, `[dots + 1]`; the last entry is the number of words.
    pub word_offsets: Vec<u64>,
    /// See [`SparseColumn::words`], `[words]`.
    pub words: Vec<u32>,
    /// See [`SparseColumn::masks`], `[words]`.
    pub masks: Vec<u32>,
    /// See [`SparseColumn::values`], `[pixels, channels]`.
    pub values: Vec<f32>,
    /// See [`SparseColumn::residual`], `[dots, block rows, block columns, channels]`.
    pub residual: Vec<f32>,
    /// Number of discs taken from each dot's frame, `[dots]`.
    pub discs: Vec<u32>,
    /// Whether each dot's frame reached the limit on discs, `[dots]`.
    pub capped: Vec<bool>,
}

impl BatchArrays {
    /// Appends the column of another dot.
    pub fn push(&mut self, column: &SparseColumn) {
        if self.word_offsets.is_empty() {
            self.word_offsets.push(0);
        }
        self.words.extend_from_slice(&column.words);
        self.masks.extend_from_slice(&column.masks);
        self.values.extend_from_slice(&column.values);
        self.residual.extend_from_slice(&column.residual);
        self.word_offsets.push(self.words.len() as u64);
        self.discs.push(column.outcome.discs);
        self.capped.push(column.outcome.capped);
    }

    /// Appends the dots of another batch.
    pub(crate) fn append(&mut self, mut other: Self) {
        if self.word_offsets.is_empty() {
            self.word_offsets.push(0);
        }
        let words = self.words.len() as u64;
        self.word_offsets.extend(other.word_offsets.iter().skip(1).map(|offset| words + offset));
        self.words.append(&mut other.words);
        self.masks.append(&mut other.masks);
        self.values.append(&mut other.values);
        self.residual.append(&mut other.residual);
        self.discs.append(&mut other.discs);
        self.capped.append(&mut other.capped);
    }
}

/// The light transport of one scan: one column per dot, validated once and indexed for the products.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    shape: FrameShape,
    arrays: BatchArrays,
    /// Number of pixels before each word, `[words + 1]`.
    starts: Vec<u32>,
    /// Start of the words of each dot in each band, `[bands + 1, dots]`.
    bands: Vec<u32>,
}

/// Counts to report for every batch.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct BatchCounts {
    /// Dots of the batch.
    pub dots: usize,
    /// Dots whose frames contain nothing above the noise of the background.
    pub empty: usize,
    /// Dots whose frames reached the limit on discs.
    pub capped: usize,
}

impl Batch {
    /// Validates and indexes columns, fresh or read from a file.
    ///
    /// # Errors
    /// [`DotsError::Shape`] for arrays that do not fit each other, [`DotsError::Damaged`] for words out of order or
    /// outside the frame, masks without pixels, and values that are not finite.
    pub fn new(shape: FrameShape, mut arrays: BatchArrays) -> Result<Self, DotsError> {
        if arrays.word_offsets.is_empty() {
            arrays.word_offsets.push(0);
        }
        let dots = arrays.word_offsets.len() - 1;
        let words = arrays.words.len();
        check_shape("masks", "[words]", &[arrays.masks.len()], &[words])?;
        check_shape("discs", "[dots]", &[arrays.discs.len()], &[dots])?;
        check_shape("capped", "[dots]", &[arrays.capped.len()], &[dots])?;
        let residual = dots * shape.blocks() * shape.channels();
        check_shape("residual", "[all values]", &[arrays.residual.len()], &[residual])?;
        let damaged = |problem, index| Err(DotsError::Damaged { problem, index });
        let bounds = (arrays.word_offsets[0], arrays.word_offsets[dots]);
        if bounds != (0, words as u64) {
            return damaged("word_offsets do not run from 0 to the number of words", dots);
        }
        if let Some(dot) = arrays.word_offsets.windows(2).position(|pair| pair[0] > pair[1]) {
            return damaged("word_offsets fall", dot);
        }

        let mut starts = Vec::with_capacity(words + 1);
        let mut pixels = 0_usize;
        starts.push(0);
        for (index, &mask) in arrays.masks.iter().enumerate() {
            if mask == 0 {
                return damaged("a mask is empty", index);
            }
            pixels += mask.count_ones() as usize;
            starts.push(u32::try_from(pixels).map_err(|_too_many| DotsError::Damaged {
                problem: "the batch has more than 2^32 pixels",
                index,
            })?);
        }
        check_shape("values", "[pixels x channels]", &[arrays.values.len()], &[pixels * shape.channels()])?;
        for (values, problem) in
            [(&arrays.values, "a value is not finite"), (&arrays.residual, "a residual is not finite")]
        {
            if let Some(index) = values.iter().position(|value| !value.is_finite()) {
                return damaged(problem, index);
            }
        }

        let mut bands = vec![0; (shape.bands() + 1) * dots];
        for dot in 0..dots {
            let (first, end) = (arrays.word_offsets[dot] as usize, arrays.word_offsets[dot + 1] as usize);
            let of_dot = &arrays.words[first..end];
            if let Some(at) = of_dot.windows(2).position(|pair| pair[0] >= pair[1]) {
                return damaged("a dot's words do not ascend", first + at);
            }
            if of_dot.last().is_some_and(|&last| last as usize >= shape.words()) {
                return damaged("a word lies beyond the frame", end - 1);
            }
            let mut at = 0;
            for band in 0..=shape.bands() {
                at += of_dot[at..].iter().take_while(|&&word| (word as usize) < band * shape.width()).count();
                bands[band * dots + dot] = (first + at) as u32;
            }
        }
        Ok(Self { shape, arrays, starts, bands })
    }

    /// Shape of the frames of the batch.
    pub fn shape(&self) -> FrameShape {
        self.shape
    }

    /// Number of dots.
    pub fn dots(&self) -> usize {
        self.arrays.discs.len()
    }

    /// The arrays as they are stored.
    pub fn arrays(&self) -> &BatchArrays {
        &self.arrays
    }

    /// How many frames were empty or capped.
    pub fn counts(&self) -> BatchCounts {
        BatchCounts {
            dots: self.dots(),
            empty: self.arrays.discs.iter().filter(|&&discs| discs == 0).count(),
            capped: self.arrays.capped.iter().filter(|&&capped| capped).count(),
        }
    }

    /// Size of the stored arrays in bytes.
    pub fn bytes(&self) -> usize {
        let BatchArrays { word_offsets, words, masks, values, residual, discs, capped } = &self.arrays;
        8 * word_offsets.len()
            + 4 * (words.len() + masks.len() + values.len() + residual.len() + discs.len())
            + capped.len()
    }

    /// One dot's column.
    ///
    /// # Panics
    /// If the dot does not exist.
    pub fn column(&self, dot: usize) -> Column<'_> {
        let words = self.arrays.word_offsets[dot] as usize..self.arrays.word_offsets[dot + 1] as usize;
        let residual = self.shape.blocks() * self.shape.channels();
        Column { batch: self, words, residual: &self.arrays.residual[dot * residual..][..residual] }
    }

    /// The dots with pixels in a band, in ascending order, each with its words in this band.
    pub(crate) fn in_band(&self, band: usize) -> impl Iterator<Item = (usize, Column<'_>)> {
        let offsets = &self.bands[band * self.dots()..(band + 2) * self.dots()];
        let (first, end) = offsets.split_at(self.dots());
        let words = first.iter().zip(end).enumerate().filter(|(_, (first, end))| first < end);
        words.map(|(dot, (&first, &end))| {
            (dot, Column { words: first as usize..end as usize, ..self.column(dot) })
        })
    }

    /// How a dot's frame was denoised.
    ///
    /// # Panics
    /// If the dot does not exist.
    pub fn outcome(&self, dot: usize) -> ColumnOutcome {
        ColumnOutcome { discs: self.arrays.discs[dot], capped: self.arrays.capped[dot] }
    }
}

/// A dot's column in a batch, or its words in one band.
#[derive(Debug, Clone)]
pub struct Column<'a> {
    batch: &'a Batch,
    words: std::ops::Range<usize>,
    residual: &'a [f32],
}

/// 32 pixels of a column.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Word<'a> {
    /// Index of the word in the frame.
    pub word: usize,
    /// Bit mask of the pixels that are in the column.
    pub mask: u32,
    /// Their values, `[pixels, channels]`.
    pub values: &'a [f32],
}

impl<'a> Column<'a> {
    pub(crate) fn words(&self) -> impl Iterator<Item = Word<'a>> + use<'a> {
        let Batch { arrays, starts, shape, .. } = self.batch;
        let (range, channels) = (self.words.clone(), shape.channels());
        let words = arrays.words[range.clone()].iter().zip(&arrays.masks[range.clone()]);
        words.zip(starts[range.start..=range.end].windows(2)).map(move |((&word, &mask), pixels)| Word {
            word: word as usize,
            mask,
            values: &arrays.values[pixels[0] as usize * channels..pixels[1] as usize * channels],
        })
    }

    /// The words in parts that lie in one block each; each comes with its block.
    pub(crate) fn parts(&self) -> impl Iterator<Item = (usize, Word<'a>)> + use<'a> {
        let shape = self.batch.shape;
        self.words().flat_map(move |Word { word, mask, mut values }| {
            shape.blocks_of_word(word, mask).map(move |(block, mask)| {
                let (of_part, rest) = values.split_at(mask.count_ones() as usize * shape.channels());
                values = rest;
                (block, Word { word, mask, values: of_part })
            })
        })
    }

    /// The pixels of the mask with their values, each `[channels]`.
    pub fn pixels(&self) -> impl Iterator<Item = (usize, &'a [f32])> + use<'a> {
        let channels = self.batch.shape.channels();
        self.words().flat_map(move |word| {
            bits(word.mask).map(move |bit| word.word * WORD_PX + bit).zip(word.values.chunks_exact(channels))
        })
    }

    /// The values of all pixels of the mask, `[pixels, channels]`.
    pub(crate) fn values(&self) -> &'a [f32] {
        let Batch { starts, arrays, shape, .. } = self.batch;
        let (first, end) = (starts[self.words.start] as usize, starts[self.words.end] as usize);
        &arrays.values[first * shape.channels()..end * shape.channels()]
    }

    /// Number of pixels in the mask.
    pub fn pixel_count(&self) -> usize {
        (self.batch.starts[self.words.end] - self.batch.starts[self.words.start]) as usize
    }

    /// Mean of each block's pixels outside the mask, `[block rows, block columns, channels]`.
    pub fn residual(&self) -> &'a [f32] {
        self.residual
    }

    /// The total light of the column, one sum per channel. Pixels outside the mask count with their blocks' means.
    pub(crate) fn energy(&self) -> [f64; 3] {
        let shape = self.batch.shape;
        let channels = shape.channels();
        let mut energy = sum_of_channels(self.values(), channels);
        // First as if each mean applied to a whole block, then without the pixels that have values of their own.
        for (row, means) in self.residual.chunks_exact(shape.block_columns() * channels).enumerate() {
            let pixels = shape.pixels_of_block(row * shape.block_columns()) as f64;
            let sums = sum_of_channels(means, channels);
            energy.iter_mut().zip(sums).for_each(|(energy, sum)| *energy += pixels * sum);
        }
        let range = self.words.clone();
        let words = self.batch.arrays.words[range.clone()].iter().zip(&self.batch.arrays.masks[range]);
        for (&word, mask) in words {
            for (block, mask) in shape.blocks_of_word(word as usize, *mask) {
                let means = &self.residual[block * channels..][..channels];
                let pixels = f64::from(mask.count_ones());
                energy.iter_mut().zip(means).for_each(|(energy, &mean)| *energy -= pixels * f64::from(mean));
            }
        }
        energy
    }
}

/// Sums of values with interleaved channels.
fn sum_of_channels(values: &[f32], channels: usize) -> [f64; 3] {
    /// A multiple of every supported number of channels.
    const LANES: usize = 12;
    // In parallel lanes: in a single sum, each addition would wait for the previous one.
    let mut partial = [0.0; LANES];
    let (whole, rest) = values.as_chunks::<LANES>();
    whole.iter().for_each(|lanes| (0..LANES).for_each(|lane| partial[lane] += f64::from(lanes[lane])));
    rest.iter().zip(&mut partial).for_each(|(&value, partial)| *partial += f64::from(value));
    let mut sums = [0.0; 3];
    partial.iter().enumerate().for_each(|(lane, partial)| sums[lane % channels] += partial);
    sums
}
