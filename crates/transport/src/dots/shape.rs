use std::ops::Range;

use super::DotsError;
use super::error::check_range;

/// Number of pixels in one word of a mask, and of rows in a band, of which products are computed in parallel.
pub const WORD_PX: usize = 32;

/// Sides that a residual's block may have, in pixels; each divides a word.
const BLOCK_SIDES_PX: [usize; 4] = [4, 8, 16, WORD_PX];

/// Most blocks in a row that a frame has by default. Finer blocks follow indirect light more closely, but average the
/// noise of fewer pixels, which adds up over all dots.
const MOST_BLOCKS: usize = 16;

/// Size of all frames of a rig: `[height, width, channels]`, row by row from the top, channels interleaved.
///
/// A monochrome camera has one channel. So has a Bayer mosaic, which is processed without demosaicing: products are
/// sums of columns, so they can be demosaiced afterwards. Demosaiced frames have the three channels R, G, B.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameShape {
    height: usize,
    width: usize,
    channels: usize,
    block_px: usize,
}

impl FrameShape {
    /// # Errors
    /// [`DotsError::OutOfRange`] unless the width is a multiple of 32, the height at least 1, and channels 1 or 3.
    pub fn new(height: usize, width: usize, channels: usize) -> Result<Self, DotsError> {
        let whole_words = width > 0 && width.is_multiple_of(WORD_PX);
        check_range("width", width as f64, whole_words, "a multiple of 32: set the camera's region so")?;
        check_range("height", height as f64, height > 0, "at least 1")?;
        check_range("channels", channels as f64, [1, 3].contains(&channels), "1 or 3 (R, G, B)")?;
        let pixels = height as f64 * width as f64;
        check_range("height x width", pixels, pixels < f64::from(u32::MAX), "below 2^32")?;
        let fits = |side: &usize| width / side <= MOST_BLOCKS;
        let block_px = BLOCK_SIDES_PX.into_iter().find(fits).unwrap_or(WORD_PX);
        Ok(Self { height, width, channels, block_px })
    }

    /// The same frames with residuals of another resolution, as stored data may have.
    ///
    /// # Errors
    /// [`DotsError::OutOfRange`] unless the blocks' side is 4, 8, 16 or 32 pixels.
    pub fn with_block_px(self, block_px: usize) -> Result<Self, DotsError> {
        check_range("block_px", block_px as f64, BLOCK_SIDES_PX.contains(&block_px), "4, 8, 16 or 32")?;
        Ok(Self { block_px, ..self })
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Values per pixel.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Pixels per frame.
    pub fn pixels(&self) -> usize {
        self.height * self.width
    }

    /// Values per frame.
    pub fn values(&self) -> usize {
        self.pixels() * self.channels
    }

    /// Words of 32 pixels per frame.
    pub fn words(&self) -> usize {
        self.pixels() / WORD_PX
    }

    /// Words in a row of pixels.
    pub(crate) fn word_columns(&self) -> usize {
        self.width / WORD_PX
    }

    /// Number of bands; the last one may be cut off by the end of the frame.
    pub(crate) fn bands(&self) -> usize {
        self.height.div_ceil(WORD_PX)
    }

    /// Number of rows and columns of pixels in a residual's block: the least with at most 16 blocks in a row, and
    /// at most 32, unless the data have others.
    pub fn block_px(&self) -> usize {
        self.block_px
    }

    /// Number of rows of blocks; the last row may be cut off by the end of the frame.
    pub fn block_rows(&self) -> usize {
        self.height.div_ceil(self.block_px)
    }

    /// Number of blocks in a row of blocks.
    pub fn block_columns(&self) -> usize {
        self.width / self.block_px
    }

    /// Blocks per frame.
    pub fn blocks(&self) -> usize {
        self.block_rows() * self.block_columns()
    }

    /// The block that contains one of the pixels of a word.
    pub(crate) fn block_of(&self, word: usize, bit: usize) -> usize {
        let (row, column) = (word / self.word_columns(), word % self.word_columns());
        row / self.block_px * self.block_columns() + (column * WORD_PX + bit) / self.block_px
    }

    /// The blocks that pixels of a word lie in, each with its share of the word's mask.
    pub(crate) fn blocks_of_word(
        &self,
        word: usize,
        mask: u32,
    ) -> impl Iterator<Item = (usize, u32)> + use<> {
        let (first, block_px) = (self.block_of(word, 0), self.block_px);
        let of_block = u32::MAX >> (WORD_PX - block_px);
        (0..WORD_PX / block_px)
            .map(move |block| (first + block, mask & of_block << (block * block_px)))
            .filter(|(_, mask)| *mask != 0)
    }

    /// Number of pixels in a block.
    pub(crate) fn pixels_of_block(&self, block: usize) -> usize {
        let first_row = block / self.block_columns() * self.block_px;
        self.block_px * self.block_px.min(self.height - first_row)
    }
}

/// A rectangle of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Region {
    /// Rows from the top.
    pub rows: Range<usize>,
    /// Columns from the left.
    pub columns: Range<usize>,
}

impl Region {
    /// The whole frame.
    pub fn whole(shape: FrameShape) -> Self {
        Self { rows: 0..shape.height, columns: 0..shape.width }
    }

    /// # Errors
    /// [`DotsError::OutOfRange`] if it is empty or reaches beyond the frame.
    pub fn check(&self, shape: FrameShape) -> Result<(), DotsError> {
        let within = |range: &Range<usize>, size: usize| range.start < range.end && range.end <= size;
        let (rows, columns) = (within(&self.rows, shape.height), within(&self.columns, shape.width));
        check_range("region.rows.end", self.rows.end as f64, rows, "above the start and within the frame")?;
        check_range(
            "region.columns.end",
            self.columns.end as f64,
            columns,
            "above the start and within the frame",
        )
    }

    /// The pixels, row by row.
    pub(crate) fn pixels(&self, shape: FrameShape) -> impl Iterator<Item = usize> + use<> {
        let columns = self.columns.clone();
        self.rows.clone().flat_map(move |row| columns.clone().map(move |column| row * shape.width + column))
    }
}
