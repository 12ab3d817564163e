use std::ops::Range;

use super::DotsError;
use super::error::check_range;

/// Number of pixels in one word of a mask, and number of rows and columns of a residual's block.
pub const BLOCK_PX: usize = 32;

/// Size of all frames of a rig: `[height, width, channels]`, row by row from the top, channels interleaved.
///
/// A monochrome camera has one channel. So has a Bayer mosaic, which is processed without demosaicing: products are
/// sums of columns, so they can be demosaiced afterwards. Demosaiced frames have the three channels R, G, B.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameShape {
    height: usize,
    width: usize,
    channels: usize,
}

impl FrameShape {
    /// # Errors
    /// [`DotsError::OutOfRange`] unless the width is a multiple of 32, the height at least 1, and channels 1 or 3.
    pub fn new(height: usize, width: usize, channels: usize) -> Result<Self, DotsError> {
        let whole_words = width > 0 && width.is_multiple_of(BLOCK_PX);
        check_range("width", width as f64, whole_words, "a multiple of 32: set the camera's region so")?;
        check_range("height", height as f64, height > 0, "at least 1")?;
        check_range("channels", channels as f64, [1, 3].contains(&channels), "1 or 3 (R, G, B)")?;
        let pixels = height as f64 * width as f64;
        check_range("height x width", pixels, pixels < f64::from(u32::MAX), "below 2^32")?;
        Ok(Self { height, width, channels })
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
        self.pixels() / BLOCK_PX
    }

    /// Number of rows of blocks; the last row may be cut off by the end of the frame.
    pub fn block_rows(&self) -> usize {
        self.height.div_ceil(BLOCK_PX)
    }

    /// Number of blocks in a row of blocks.
    pub fn block_columns(&self) -> usize {
        self.width / BLOCK_PX
    }

    /// Blocks per frame.
    pub fn blocks(&self) -> usize {
        self.block_rows() * self.block_columns()
    }

    /// The block that contains a word of 32 pixels.
    pub(crate) fn block_of_word(&self, word: usize) -> usize {
        // A row of blocks has 32 rows of width / 32 words.
        word / self.width * self.block_columns() + word % self.block_columns()
    }

    /// Number of pixels in a block.
    pub(crate) fn pixels_of_block(&self, block: usize) -> usize {
        let first_row = block / self.block_columns() * BLOCK_PX;
        BLOCK_PX * BLOCK_PX.min(self.height - first_row)
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
