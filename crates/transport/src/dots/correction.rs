use ndarray::ArrayView3;

use super::column::bits;
use super::error::{check_range, check_shape};
use super::shape::WORD_PX;
use super::{DotsError, FrameShape};

/// How the sensor samples colour, which determines which neighbours may replace a hot pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sampling {
    /// Every pixel sees the same colours.
    Full,
    /// A mosaic of 2 x 2 colours: the next pixel of the same colour is two away.
    Bayer,
}

/// A hot pixel is replaced by the nearest ring with a sound pixel, up to this many pixels away, otherwise by 0.
const MAX_REPAIR_RINGS: isize = 8;

/// The sensor's flat field and hot pixels.
///
/// Both are applied to extracted pixels, not to frames: detection works on raw counts above the background, from
/// which the dark level cancels by itself.
#[derive(Debug, Clone, PartialEq)]
pub struct Correction {
    shape: FrameShape,
    gain: Vec<f32>,
    /// Gain of the mean of each block's sound pixels, `[blocks, channels]`: the harmonic mean of the pixels' gains,
    /// which is the factor that even light over the block requires. The arithmetic mean would be too large because of
    /// the gains' variance.
    block_gain: Vec<f32>,
    /// Hot pixels in each word.
    hot_masks: Vec<u32>,
    /// Hot pixels, ascending.
    hot: Vec<u32>,
    /// Start of each hot pixel's sound neighbours in `sources`, `[hot + 1]`.
    source_offsets: Vec<u32>,
    sources: Vec<u32>,
}

impl Correction {
    /// A perfect sensor.
    pub fn none(shape: FrameShape) -> Self {
        Self::build(shape, vec![1.0; shape.values()], &[], Sampling::Full)
    }

    /// From the flat field's gain, `[height, width, channels]`, which multiplies the counts, and a list of hot pixels
    /// as (row, column).
    ///
    /// # Errors
    /// [`DotsError::Shape`] if the gain does not have the frame's shape; [`DotsError::OutOfRange`] for a gain that is
    /// not positive and finite, or a hot pixel outside the frame.
    pub fn new(
        shape: FrameShape,
        gain: ArrayView3<f32>,
        hot: &[(usize, usize)],
        sampling: Sampling,
    ) -> Result<Self, DotsError> {
        let expected = [shape.height(), shape.width(), shape.channels()];
        check_shape("gain", "[height, width, channels]", gain.shape(), &expected)?;
        for &gain in &gain {
            let usable = gain > 0.0 && gain.is_finite();
            check_range(
                "gain",
                gain.into(),
                usable,
                "above 0 and finite; put pixels without light on the hot list",
            )?;
        }
        for &(row, column) in hot {
            check_range("hot pixel's row", row as f64, row < shape.height(), "a row of the frame")?;
            check_range(
                "hot pixel's column",
                column as f64,
                column < shape.width(),
                "a column of the frame",
            )?;
        }
        let mut hot: Vec<u32> =
            hot.iter().map(|(row, column)| (row * shape.width() + column) as u32).collect();
        hot.sort_unstable();
        hot.dedup();
        Ok(Self::build(shape, gain.iter().copied().collect(), &hot, sampling))
    }

    fn build(shape: FrameShape, gain: Vec<f32>, hot: &[u32], sampling: Sampling) -> Self {
        let mut hot_masks = vec![0_u32; shape.words()];
        for &pixel in hot {
            hot_masks[pixel as usize / WORD_PX] |= 1 << (pixel as usize % WORD_PX);
        }
        let (mut sources, mut source_offsets) = (Vec::new(), vec![0]);
        for &pixel in hot {
            sources.extend(sound_neighbours(shape, &hot_masks, pixel as usize, sampling));
            source_offsets.push(sources.len() as u32);
        }

        let channels = shape.channels();
        let mut sums = vec![0.0_f64; shape.blocks() * channels];
        let mut counts = vec![0_u32; shape.blocks()];
        for (word, &hot) in hot_masks.iter().enumerate() {
            for bit in bits(!hot) {
                let block = shape.block_of(word, bit);
                counts[block] += 1;
                let of_pixel = &gain[(word * WORD_PX + bit) * channels..][..channels];
                for (sum, &gain) in sums[block * channels..].iter_mut().zip(of_pixel) {
                    *sum += f64::from(gain).recip();
                }
            }
        }
        let block_gain = sums.iter().enumerate().map(|(at, &sum)| match counts[at / channels] {
            0 => 1.0,
            count => (f64::from(count) / sum) as f32,
        });
        let block_gain = block_gain.collect();
        Self { shape, gain, block_gain, hot_masks, hot: hot.to_vec(), source_offsets, sources }
    }

    /// Shape of the frames.
    pub fn shape(&self) -> FrameShape {
        self.shape
    }

    /// Gain of each value, `[height, width, channels]`.
    pub fn gain(&self) -> &[f32] {
        &self.gain
    }

    pub(crate) fn block_gain(&self) -> &[f32] {
        &self.block_gain
    }

    /// Hot pixels of each word of 32.
    pub(crate) fn hot_masks(&self) -> &[u32] {
        &self.hot_masks
    }

    /// Hot pixels, ascending.
    pub fn hot(&self) -> &[u32] {
        &self.hot
    }

    /// The corrected value of one channel of any pixel: counts above the background times gain; for a hot pixel the
    /// mean of its sound neighbours, or 0 if it has none.
    pub(crate) fn value(&self, frame: &[u16], background: &[f32], pixel: usize, channel: usize) -> f32 {
        let sound = |pixel: usize| {
            let at = pixel * self.shape.channels() + channel;
            (f32::from(frame[at]) - background[at]) * self.gain[at]
        };
        match self.hot.binary_search(&(pixel as u32)) {
            Err(_not_hot) => sound(pixel),
            Ok(at) => {
                let sources = self.source_offsets[at] as usize..self.source_offsets[at + 1] as usize;
                let count = sources.len().max(1) as f32;
                self.sources[sources].iter().map(|&pixel| sound(pixel as usize)).sum::<f32>() / count
            }
        }
    }
}

/// The sound pixels of the nearest ring around a hot pixel that contains any.
fn sound_neighbours(shape: FrameShape, hot_masks: &[u32], pixel: usize, sampling: Sampling) -> Vec<u32> {
    let step = match sampling {
        Sampling::Full => 1,
        Sampling::Bayer => 2,
    };
    let (row, column) = (pixel / shape.width(), pixel % shape.width());
    let sound = |down: isize, right: isize| {
        let row = row.checked_add_signed(down * step).filter(|&row| row < shape.height())?;
        let column = column.checked_add_signed(right * step).filter(|&column| column < shape.width())?;
        let pixel = row * shape.width() + column;
        (hot_masks[pixel / WORD_PX] >> (pixel % WORD_PX) & 1 == 0).then_some(pixel as u32)
    };
    (1..=MAX_REPAIR_RINGS)
        .map(|ring| {
            let offsets = (-ring..=ring).flat_map(|down| (-ring..=ring).map(move |right| (down, right)));
            let on_ring = offsets.filter(|(down, right)| down.abs().max(right.abs()) == ring);
            on_ring.filter_map(|(down, right)| sound(down, right)).collect::<Vec<_>>()
        })
        .find(|sources| !sources.is_empty())
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;

    use super::*;

    #[test]
    fn a_hot_pixel_has_the_mean_of_its_sound_neighbours_times_their_gain() {
        let shape = FrameShape::new(8, 32, 1).unwrap();
        let gain = Array3::from_shape_fn((8, 32, 1), |(row, ..)| if row < 4 { 1.0 } else { 2.0 });
        let hot = [(3, 5), (3, 6), (0, 0), (0, 1), (1, 0), (1, 1)];
        let correction = Correction::new(shape, gain.view(), &hot, Sampling::Full).unwrap();
        let mut frame: Vec<u16> = (0..256).map(|pixel| 100 + pixel as u16).collect();
        for (row, column) in hot {
            frame[row * 32 + column] = 4095;
        }
        let background = vec![50.0; 256];
        let raw = |row: u16, column: u16| f32::from(100 + row * 32 + column) - 50.0;
        // (3, 6) is hot as well, so seven neighbours remain, three of them in rows of gain 2.
        let above: f32 = [4, 5, 6].iter().map(|&column| raw(2, column)).sum();
        let below: f32 = [4, 5, 6].iter().map(|&column| 2.0 * raw(4, column)).sum();
        let expected = (above + raw(3, 4) + below) / 7.0;
        assert!((correction.value(&frame, &background, 3 * 32 + 5, 0) - expected).abs() < 1e-3);
        // The whole first ring around the corner is hot, so the second one is used.
        let ring: f32 =
            [(0, 2), (1, 2), (2, 0), (2, 1), (2, 2)].iter().map(|&(row, column)| raw(row, column)).sum();
        assert!((correction.value(&frame, &background, 0, 0) - ring / 5.0).abs() < 1e-3);
        assert_eq!(correction.value(&frame, &background, 5 * 32, 0), 2.0 * raw(5, 0));
    }

    #[test]
    fn a_mosaic_repairs_with_its_own_colour() {
        let shape = FrameShape::new(8, 32, 1).unwrap();
        let correction =
            Correction::new(shape, Array3::ones((8, 32, 1)).view(), &[(4, 4)], Sampling::Bayer).unwrap();
        // Even rows and columns see 10, all others 1000.
        let frame: Vec<u16> =
            (0..256).map(|at| if at / 32 % 2 == 0 && at % 2 == 0 { 10 } else { 1000 }).collect();
        assert_eq!(correction.value(&frame, &[0.0; 256], 4 * 32 + 4, 0), 10.0);
    }

    #[test]
    fn a_blocks_gain_gives_even_light_its_energy() {
        let shape = FrameShape::new(32, 64, 1).unwrap();
        // Pixels that respond half as much and one and a half times as much; the second block is hot.
        let response = |pixel: usize| if pixel.is_multiple_of(2) { 0.5 } else { 1.5 };
        let gain = Array3::from_shape_fn((32, 64, 1), |(row, column, _)| 1.0 / response(row * 64 + column));
        let hot: Vec<(usize, usize)> =
            (0..32).flat_map(|row| (32..64).map(move |column| (row, column))).collect();
        let correction = Correction::new(shape, gain.view(), &hot, Sampling::Full).unwrap();
        let counts: f32 = (0..32).map(|column| 100.0 * response(column)).sum::<f32>() / 32.0;
        assert_eq!(counts * correction.block_gain()[0], 100.0);
        assert_eq!(correction.block_gain()[1], 1.0);
    }

    #[test]
    fn gains_and_hot_pixels_that_cannot_be_are_refused() {
        let shape = FrameShape::new(8, 32, 1).unwrap();
        let refused = |gain: f32, hot: &[(usize, usize)]| {
            Correction::new(shape, Array3::from_elem((8, 32, 1), gain).view(), hot, Sampling::Full)
                .unwrap_err()
        };
        assert!(matches!(refused(0.0, &[]), DotsError::OutOfRange { field: "gain", .. }));
        assert!(matches!(refused(f32::NAN, &[]), DotsError::OutOfRange { field: "gain", .. }));
        assert!(matches!(refused(1.0, &[(8, 0)]), DotsError::OutOfRange { field: "hot pixel's row", .. }));
    }
}
