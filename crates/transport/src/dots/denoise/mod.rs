//! Algorithm 1 of the paper, corrected: a frame becomes a sparse column in one pass over its raw counts.

mod counts;
mod disc;
mod lanes;
pub mod reference;
mod rule;

use pulp::NullaryFnOnce;
use rayon::prelude::*;

pub use rule::{DenoiseSettings, StopRule, false_alarm_sigmas};

use self::counts::{CountDifferences, NarrowCounts, Survey, Wide};
use self::disc::Disc;
use self::lanes::{Lanes, Portable};
use super::background::luminance;
use super::column::{bits, runs};
use super::error::check_shape;
use super::shape::WORD_PX;
use super::{Background, Batch, BatchArrays, ColumnOutcome, Correction, DotsError, NoiseFloor, SparseColumn};
use crate::plane::SimdLevel;

/// Number of frames that one thread takes at a time.
const FRAMES_AT_A_TIME: usize = 32;

/// Turns raw frames into sparse columns.
///
/// The brightest pixel above the background is found and the disc around it is taken out, until the [`StopRule`] is
/// met. The pixels taken form the column; the rest is kept as the mean of each block of pixels ([`FrameShape::block_px`](super::FrameShape::block_px)). Pixels that
/// were taken no longer count for maximum and statistics. Ties go to the first pixel in reading order. Values are raw
/// minus background times the flat field's gain. Hot pixels, which are never the maximum, get the mean of their
/// neighbours. Nothing is clamped at 0: the bias would add up over all dots.
///
/// Colour frames are searched by their luminance, (R + 2 G + B) / 4 in whole counts; values are kept per colour.
#[derive(Debug, Clone)]
pub struct Denoiser {
    correction: Correction,
    settings: DenoiseSettings,
    disc: Disc,
    /// `k` of [`StopRule::FalseAlarms`].
    sigmas: f64,
    level: SimdLevel,
}

/// Working memory of [`Denoiser::column`], to be reused from frame to frame.
#[derive(Debug, Clone)]
pub struct Scratch {
    survey: Survey,
    /// Mask of the pixels taken so far; all 0 between frames.
    taken: Vec<u32>,
    /// Words with pixels taken.
    touched: Vec<u32>,
    /// Luminance of a colour frame.
    luminance: Vec<u16>,
    /// Sum of the values taken from each block, background subtracted, `[blocks, channels]`.
    taken_sums: Vec<f64>,
    /// Number of sound pixels taken from each block.
    taken_pixels: Vec<u32>,
    /// Sums of colours over blocks, `[blocks, channels]`.
    colour_sums: Vec<i32>,
}

impl Denoiser {
    /// # Errors
    /// [`DotsError::OutOfRange`] for invalid settings.
    pub fn new(correction: Correction, settings: DenoiseSettings) -> Result<Self, DotsError> {
        settings.check()?;
        let shape = correction.shape();
        let sigmas = match &settings.stop {
            StopRule::FalseAlarms { per_frame } => false_alarm_sigmas(*per_frame, shape.pixels()),
            StopRule::Printed { patch, .. } => patch.check(shape).map(|()| 0.0)?,
        };
        let disc = Disc::new(settings.radius_px);
        Ok(Self { correction, settings, disc, sigmas, level: SimdLevel::best() })
    }

    /// Selects other instructions than the fastest; the result is the same.
    pub fn at_level(mut self, level: SimdLevel) -> Self {
        self.level = level;
        self
    }

    /// The correction of the sensor.
    pub fn correction(&self) -> &Correction {
        &self.correction
    }

    /// Scratch memory for one thread.
    pub fn scratch(&self) -> Scratch {
        let shape = self.correction.shape();
        let in_colour = |size: usize| if shape.channels() > 1 { size } else { 0 };
        Scratch {
            survey: Survey::new(shape),
            taken: vec![0; shape.words()],
            touched: Vec::with_capacity(shape.words()),
            luminance: vec![0; in_colour(shape.pixels())],
            taken_sums: vec![0.0; shape.blocks() * shape.channels()],
            taken_pixels: vec![0; shape.blocks()],
            colour_sums: vec![0; in_colour(shape.blocks() * shape.channels())],
        }
    }

    /// Denoises one raw frame, `[height, width, channels]`, into `column`. Does not allocate once `column` has held
    /// the largest column.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if the frame does not have the correction's shape.
    pub fn column(
        &self,
        frame: &[u16],
        background: &Background,
        floor: NoiseFloor,
        scratch: &mut Scratch,
        column: &mut SparseColumn,
    ) -> Result<(), DotsError> {
        let shape = self.correction.shape();
        check_shape("frame", "[values]", &[frame.len()], &[shape.values()])?;
        check_shape("background", "[values]", &[background.mean.len()], &[shape.values()])?;
        check_shape("scratch", "[words]", &[scratch.taken.len()], &[shape.words()])?;
        let task = FrameTask { denoiser: self, frame, background, floor, scratch, column };
        #[cfg(target_arch = "x86_64")]
        match (self.level, pulp::x86::V3::try_new(), pulp::x86::V4::try_new()) {
            (SimdLevel::Avx512, _, Some(simd)) => return simd.vectorize(OnLanes(simd, task)),
            (SimdLevel::Avx2, Some(simd), _) => return simd.vectorize(OnLanes(simd, task)),
            _ => {}
        }
        OnLanes(Portable, task).call()
    }

    /// Denoises the frames of one batch, in the order of their dots. The columns do not depend on the number of
    /// threads.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if a frame does not have the correction's shape.
    pub fn batch(
        &self,
        frames: &[&[u16]],
        background: &Background,
        floor: NoiseFloor,
    ) -> Result<Batch, DotsError> {
        let parts: Vec<BatchArrays> = frames
            .par_chunks(FRAMES_AT_A_TIME)
            .map_init(
                || (self.scratch(), SparseColumn::default()),
                |(scratch, column), frames| {
                    let mut part = BatchArrays::default();
                    for frame in frames {
                        self.column(frame, background, floor, scratch, column)?;
                        part.push(column);
                    }
                    Ok(part)
                },
            )
            .collect::<Result<_, DotsError>>()?;
        let mut arrays = BatchArrays::default();
        parts.into_iter().for_each(|part| arrays.append(part));
        Batch::new(self.correction.shape(), arrays)
    }
}

/// A frame to denoise.
struct FrameTask<'a> {
    denoiser: &'a Denoiser,
    frame: &'a [u16],
    background: &'a Background,
    floor: NoiseFloor,
    scratch: &'a mut Scratch,
    column: &'a mut SparseColumn,
}

/// A computation that runs with the instructions of `L` enabled.
struct OnLanes<'a, L>(L, FrameTask<'a>);

impl<L: Lanes> NullaryFnOnce for OnLanes<'_, L> {
    type Output = Result<(), DotsError>;

    #[inline(always)]
    fn call(self) -> Self::Output {
        let Self(lanes, mut task) = self;
        let correction = &task.denoiser.correction;
        let mut gray = std::mem::take(&mut task.scratch.luminance);
        if correction.shape().channels() == 3 {
            for (gray, pixel) in gray.iter_mut().zip(task.frame.as_chunks().0) {
                *gray = luminance(*pixel);
            }
        }
        let raw: &[u16] = if gray.is_empty() { task.frame } else { &gray };
        let narrow = NarrowCounts::new(lanes, raw, task.background, correction);
        let outcome = match task.background.narrow && narrow.survey(&mut task.scratch.survey) {
            true => task.take_discs(&narrow),
            false => {
                let wide = Wide { raw, background: task.background, correction };
                wide.survey(&mut task.scratch.survey);
                task.take_discs(&wide)
            }
        };
        task.scratch.luminance = gray;
        let outcome = outcome?;
        task.extract();
        task.column.outcome = outcome;
        Ok(())
    }
}

/// Mean and standard deviation of the rest of a frame.
struct Left {
    count: usize,
    sum: i64,
    squares: i64,
}

impl FrameTask<'_> {
    /// Takes discs until the stop rule is met.
    #[inline(always)]
    fn take_discs(&mut self, differences: &impl CountDifferences) -> Result<ColumnOutcome, DotsError> {
        let Self { denoiser, frame, background, floor, scratch, .. } = self;
        let shape = denoiser.correction.shape();
        let printed = match &denoiser.settings.stop {
            StopRule::FalseAlarms { .. } => None,
            StopRule::Printed { patch, tolerance } => {
                Some((NoiseFloor::of_frame(frame, &denoiser.correction, background, patch)?, *tolerance))
            }
        };
        // For the printed rule any maximum is high enough.
        let least = match printed {
            None => (floor.mean + denoiser.sigmas * floor.sigma).ceil().clamp(-65536.0, 65536.0) as i32,
            Some(_) => counts::NOTHING + 1,
        };
        let mut left = Left {
            count: shape.pixels() - denoiser.correction.hot().len(),
            sum: scratch.survey.block_sums.iter().map(|&sum| i64::from(sum)).sum(),
            squares: scratch.survey.squares as i64,
        };
        let mut outcome = ColumnOutcome::default();
        loop {
            let largest = scratch.survey.maxima.iter().fold(counts::NOTHING, |a, &b| a.max(b));
            if largest < least {
                return Ok(outcome);
            }
            if outcome.discs == denoiser.settings.max_discs {
                outcome.capped = true;
                return Ok(outcome);
            }
            let segment = scratch.survey.maxima.iter().position(|&maximum| maximum == largest);
            let Some(centre) = segment.and_then(|segment| differences.find(segment, largest, &scratch.taken))
            else {
                return Ok(outcome);
            };
            outcome.discs += 1;
            let Scratch { taken, touched, .. } = &mut **scratch;
            for row in denoiser.disc.rows_around(shape, centre) {
                take(row, taken, touched, |word, fresh| {
                    if printed.is_some() {
                        left.lose(word, fresh & !denoiser.correction.hot_masks()[word], |pixel| {
                            let raw = match shape.channels() {
                                1 => frame[pixel],
                                _ => {
                                    luminance([frame[3 * pixel], frame[3 * pixel + 1], frame[3 * pixel + 2]])
                                }
                            };
                            i64::from(raw) - i64::from(background.counts[pixel])
                        });
                    }
                });
            }
            let mut next = 0;
            for row in denoiser.disc.rows_around(shape, centre) {
                let pixels = counts::SEGMENT_WORDS * WORD_PX;
                for segment in next.max(row.start / pixels)..=(row.end - 1) / pixels {
                    // Maxima only decrease: a segment that was too low stays too low.
                    if scratch.survey.maxima[segment] >= least {
                        scratch.survey.maxima[segment] = differences.largest(segment, &scratch.taken);
                    }
                    next = segment + 1;
                }
            }
            if printed.is_some_and(|(patch, tolerance)| left.equals(patch, tolerance)) {
                return Ok(outcome);
            }
        }
    }

    /// Reads out the pixels taken and the rest, and clears the scratch memory.
    #[inline(always)]
    fn extract(&mut self) {
        let Self { denoiser, frame, background, scratch, column, .. } = self;
        let correction = &denoiser.correction;
        let shape = correction.shape();
        let channels = shape.channels();
        let Scratch { survey, taken, touched, taken_sums, taken_pixels, colour_sums, .. } = &mut **scratch;
        column.clear();
        taken_sums.fill(0.0);
        taken_pixels.fill(0);
        touched.sort_unstable();
        column.values.reserve(touched.len() * WORD_PX * channels);
        for &word in &*touched {
            let at = word as usize;
            let (mask, hot) = (taken[at], correction.hot_masks()[at]);
            column.words.push(word);
            column.masks.push(mask);
            taken[at] = 0;
            for (block, mask) in shape.blocks_of_word(at, mask) {
                taken_pixels[block] += (mask & !hot).count_ones();
                let sums = &mut taken_sums[block * channels..][..channels];
                if mask & hot == 0 {
                    for run in runs(mask) {
                        let run = (at * WORD_PX + run.start) * channels..(at * WORD_PX + run.end) * channels;
                        let (raw, mean) = (&frame[run.clone()], &background.mean[run.clone()]);
                        let above = raw.iter().zip(mean).map(|(&raw, mean)| f32::from(raw) - mean);
                        column
                            .values
                            .extend(above.zip(&correction.gain()[run]).map(|(above, gain)| above * gain));
                        add_run(sums, raw, mean);
                    }
                } else {
                    for bit in bits(mask) {
                        let pixel = at * WORD_PX + bit;
                        for (channel, sum) in sums.iter_mut().enumerate() {
                            column.values.push(correction.value(frame, &background.mean, pixel, channel));
                            if hot >> bit & 1 == 0 {
                                let value = pixel * channels + channel;
                                *sum += f64::from(frame[value]) - f64::from(background.mean[value]);
                            }
                        }
                    }
                }
            }
        }
        touched.clear();

        let sums: &[i32] = match channels {
            1 => &survey.block_sums,
            _ => {
                sum_colours(frame, correction, colour_sums);
                colour_sums
            }
        };
        let blocks = sums.iter().zip(&background.block_offset).zip(&*taken_sums).zip(correction.block_gain());
        column.residual.extend(blocks.enumerate().map(|(at, (((&sum, &offset), &taken), &gain))| {
            let left = background.block_sound[at / channels] - taken_pixels[at / channels];
            let sum = f64::from(sum) + offset - taken;
            if left == 0 { 0.0 } else { (sum / f64::from(left) * f64::from(gain)) as f32 }
        }));
    }
}

/// Marks the pixels of one row of a disc. Calls back for each word with the pixels that were not marked before.
#[inline(always)]
fn take(
    row: std::ops::Range<usize>,
    taken: &mut [u32],
    touched: &mut Vec<u32>,
    mut fresh: impl FnMut(usize, u32),
) {
    let words = row.start / WORD_PX..=(row.end - 1) / WORD_PX;
    for (word, taken) in words.clone().zip(&mut taken[words]) {
        let first = row.start.saturating_sub(word * WORD_PX);
        let count = (row.end - word * WORD_PX).min(WORD_PX) - first;
        let mask = (u32::MAX >> (WORD_PX - count)) << first;
        if *taken == 0 {
            touched.push(word as u32);
        }
        fresh(word, mask & !*taken);
        *taken |= mask;
    }
}

/// Adds `raw - mean` of consecutive pixels to their block's sums, `[channels]`.
///
/// Uses eight partial sums, so that all instruction levels give the same bits and most can add in parallel.
#[inline(always)]
fn add_run(sums: &mut [f64], raw: &[u16], mean: &[f32]) {
    if let [sum] = sums {
        let (raw, raw_rest) = raw.as_chunks::<8>();
        let (mean, mean_rest) = mean.as_chunks::<8>();
        let mut partial = [0.0; 8];
        for (raw, mean) in raw.iter().zip(mean) {
            for lane in 0..8 {
                partial[lane] += f64::from(raw[lane]) - f64::from(mean[lane]);
            }
        }
        for (lane, (&raw, &mean)) in raw_rest.iter().zip(mean_rest).enumerate() {
            partial[lane] += f64::from(raw) - f64::from(mean);
        }
        *sum += partial.iter().sum::<f64>();
    } else {
        for (raw, mean) in raw.chunks_exact(sums.len()).zip(mean.chunks_exact(sums.len())) {
            for ((sum, &raw), &mean) in sums.iter_mut().zip(raw).zip(mean) {
                *sum += f64::from(raw) - f64::from(mean);
            }
        }
    }
}

/// Sums of each colour over the sound pixels of each block, `[blocks, 3]`.
#[inline(always)]
fn sum_colours(frame: &[u16], correction: &Correction, sums: &mut [i32]) {
    let (pixels, _) = frame.as_chunks::<3>();
    let (sums, _) = sums.as_chunks_mut::<3>();
    sums.fill([0; 3]);
    for (word, &hot) in correction.hot_masks().iter().enumerate() {
        let shape = correction.shape();
        let of_word = &pixels[word * WORD_PX..(word + 1) * WORD_PX];
        let blocks = of_word.chunks_exact(shape.block_px()).zip(&mut sums[shape.block_of(word, 0)..]);
        for (of_block, sum) in blocks {
            for pixel in of_block {
                (0..3).for_each(|colour| sum[colour] += i32::from(pixel[colour]));
            }
        }
        for bit in bits(hot) {
            let sum = &mut sums[shape.block_of(word, bit)];
            (0..3).for_each(|colour| sum[colour] -= i32::from(of_word[bit][colour]));
        }
    }
}

impl Left {
    /// Removes pixels of a word from the statistics.
    #[inline(always)]
    fn lose(&mut self, word: usize, pixels: u32, difference: impl Fn(usize) -> i64) {
        for bit in bits(pixels) {
            let difference = difference(word * WORD_PX + bit);
            self.count -= 1;
            self.sum -= difference;
            self.squares -= difference * difference;
        }
    }

    /// Whether mean and standard deviation equal those of the patch, within `tolerance` standard deviations of the
    /// patch.
    fn equals(&self, patch: NoiseFloor, tolerance: f64) -> bool {
        if self.count == 0 {
            return true;
        }
        let left = NoiseFloor::of_sums(self.count, self.sum, self.squares);
        let allowed = tolerance * patch.sigma;
        (left.mean - patch.mean).abs() <= allowed && (left.sigma - patch.sigma).abs() <= allowed
    }
}
