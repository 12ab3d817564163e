//! Linear images as 8-bit PNG pictures with a stated tone map.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use maud::{Markup, html};
use ndarray::{Array2, Array3, ArrayView1, ArrayView2, ArrayView3, Axis, s};

use super::style::{PALETTE, short};
use crate::{Error, Result};

/// Maximum side length of a picture, so that a page stays within a few megabytes.
const PICTURE_MAX_PX: usize = 1024;
/// Maximum side length of a picture in a contact sheet.
const THUMBNAIL_MAX_PX: usize = 160;
/// Maximum side length of an animation, which has many pictures.
const ANIMATION_MAX_PX: usize = 400;
/// Pictures smaller than this are shown enlarged, with visible square pixels.
const PIXELATED_MAX_PX: usize = 512;
/// Frame rate of an animation.
const ANIMATION_FRAMES_PER_S: u16 = 12;
/// More samples do not improve a percentile noticeably.
const PERCENTILE_SAMPLES: usize = 1 << 20;

/// How linear values become grey levels: `white` and above is white, 0 and below is black; in between, the
/// sRGB transfer function applies (IEC 61966-2-1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToneMap {
    /// The value that is shown as white.
    pub white: f32,
}

impl ToneMap {
    /// The tone map in which `percent` of all pixels of these images are not overexposed. `white` is 1 if it
    /// would otherwise be 0 or if there are no finite values.
    pub fn percentile(images: &[ArrayView2<f32>], percent: f64) -> ToneMap {
        let mut samples = ToneSamples::new(images.iter().map(|image| image.len()).sum());
        images.iter().for_each(|image| samples.add(image.view()));
        samples.percentile(percent)
    }

    fn level(self, value: f32) -> u8 {
        let linear = (value / self.white).clamp(0.0, 1.0);
        let encoded =
            if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
        // The conversion turns NaN into 0, which is black.
        (encoded * 255.0).round() as u8
    }
}

/// Collects samples for a [`ToneMap`] of images that are not all in memory at once.
#[derive(Debug, Clone)]
pub struct ToneSamples {
    /// One pixel in `step` is sampled.
    step: usize,
    /// Pixels to skip in the next image before its first sample.
    skip: usize,
    values: Vec<f32>,
}

impl ToneSamples {
    /// Prepares for images with this total number of pixels.
    pub fn new(pixels: usize) -> ToneSamples {
        ToneSamples { step: pixels.div_ceil(PERCENTILE_SAMPLES).max(1), skip: 0, values: Vec::new() }
    }

    /// Samples the next image.
    pub fn add(&mut self, image: ArrayView2<f32>) {
        let values = image.iter().copied().skip(self.skip).step_by(self.step);
        self.values.extend(values.filter(|value| value.is_finite()));
        self.skip = (self.skip + self.step - image.len() % self.step) % self.step;
    }

    /// [`ToneMap::percentile`] of all images, approximated from the samples.
    pub fn percentile(&mut self, percent: f64) -> ToneMap {
        if self.values.is_empty() {
            return ToneMap { white: 1.0 };
        }
        let rank = (percent.clamp(0.0, 100.0) / 100.0 * (self.values.len() - 1) as f64).round() as usize;
        let (_, &mut white, _) = self.values.select_nth_unstable_by(rank, f32::total_cmp);
        ToneMap { white: if white > 0.0 { white } else { 1.0 } }
    }
}

/// A numbered cross at a pixel, in the colour of the series at the same position in a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Marker {
    /// The label beside the cross.
    pub label: String,
    /// Camera row t of the pixel.
    pub row: usize,
    /// Camera column s of the pixel.
    pub column: usize,
}

/// A picture, ready to be shown.
#[derive(Debug, Clone)]
pub struct Picture {
    levels: Array3<u8>,
    size: (usize, usize),
    reduction: usize,
    tone_map: ToneMap,
    caption: String,
    markers: Vec<Marker>,
    /// Pixels of the image that are hatched, as runs along rows: row, first column, length.
    hatched: Vec<[usize; 3]>,
    /// The remaining pictures of an animation.
    next: Vec<Picture>,
}

impl Picture {
    /// A grey picture of a linear image `[t, s]`.
    pub fn grey(image: ArrayView2<f32>, tone_map: ToneMap) -> Picture {
        Picture::new(image.insert_axis(Axis(2)), tone_map, PICTURE_MAX_PX)
    }

    /// A colour picture of a linear image `[t, s, 3]` with sRGB primaries.
    pub fn rgb(image: ArrayView3<f32>, tone_map: ToneMap) -> Picture {
        Picture::new(image, tone_map, PICTURE_MAX_PX)
    }

    /// A grey or colour picture of a linear image `[t, s, channels]` with one or three channels.
    pub fn coloured(image: ArrayView3<f32>, tone_map: ToneMap) -> Picture {
        Picture::new(image, tone_map, PICTURE_MAX_PX)
    }

    /// A grey or colour picture of a linear image `[t, s, channels]` with one or three channels, with all of its pixels.
    pub fn unreduced(image: ArrayView3<f32>, tone_map: ToneMap) -> Picture {
        Picture::new(image, tone_map, usize::MAX)
    }

    /// A grey picture for a contact sheet.
    pub fn thumbnail(image: ArrayView2<f32>, tone_map: ToneMap) -> Picture {
        Picture::small(image.insert_axis(Axis(2)), tone_map)
    }

    /// A grey or colour picture of a linear image `[t, s, channels]` with one or three channels, as small as a thumbnail.
    pub fn small(image: ArrayView3<f32>, tone_map: ToneMap) -> Picture {
        Picture::new(image, tone_map, THUMBNAIL_MAX_PX)
    }

    /// Reduces an image to the size of a thumbnail, to keep it until its [`ToneMap`] is known:
    /// [`Picture::thumbnail`] of the reduced image and of the original are the same.
    pub fn reduced(image: ArrayView2<f32>) -> Array2<f32> {
        let reduction = reduction_of(image.dim(), THUMBNAIL_MAX_PX);
        let size = (image.nrows().div_ceil(reduction), image.ncols().div_ceil(reduction));
        Array2::from_shape_fn(size, |place| mean_of_block(image, reduction, place))
    }

    /// Images `[t, s, channels]` of one size with one tone map, shown in a loop; `None` if there are none.
    pub fn animation(images: &[ArrayView3<f32>], tone_map: ToneMap) -> Option<Picture> {
        let frame = |image: &ArrayView3<f32>| Picture::new(image.view(), tone_map, ANIMATION_MAX_PX);
        let (first, next) = images.split_first()?;
        Some(Picture { next: next.iter().map(frame).collect(), ..frame(first) })
    }

    /// Sets the caption; scale and size are appended to it.
    pub fn with_caption(self, caption: impl Into<String>) -> Picture {
        Picture { caption: caption.into(), ..self }
    }

    /// Adds crosses at these pixels.
    pub fn with_markers(self, markers: Vec<Marker>) -> Picture {
        Picture { markers, ..self }
    }

    /// Hatches the pixels of the image `[t, s]` that are true.
    pub fn with_hatching(self, hatched: Array2<bool>) -> Picture {
        let runs_of = |(row, pixels): (usize, ArrayView1<bool>)| {
            let mut runs: Vec<[usize; 3]> = Vec::new();
            for (column, _) in pixels.iter().enumerate().filter(|(_, is_hatched)| **is_hatched) {
                match runs.last_mut() {
                    Some([_, first, length]) if *first + *length == column => *length += 1,
                    _ => runs.push([row, column, 1]),
                }
            }
            runs
        };
        Picture { hatched: hatched.outer_iter().enumerate().flat_map(runs_of).collect(), ..self }
    }

    fn new(image: ArrayView3<f32>, tone_map: ToneMap, max_px: usize) -> Picture {
        let (rows, columns, channels) = image.dim();
        let reduction = reduction_of((rows, columns), max_px);
        let reduced = (rows.div_ceil(reduction), columns.div_ceil(reduction), channels);
        let levels = Array3::from_shape_fn(reduced, |(row, column, channel)| {
            let image = image.index_axis(Axis(2), channel);
            tone_map.level(mean_of_block(image, reduction, (row, column)))
        });
        Picture {
            levels,
            size: (rows, columns),
            reduction,
            tone_map,
            caption: String::new(),
            markers: Vec::new(),
            hatched: Vec::new(),
            next: Vec::new(),
        }
    }

    pub(super) fn tone_map(&self) -> ToneMap {
        self.tone_map
    }

    pub(super) fn to_figure(&self) -> Result<Markup> {
        let (rows, columns) = self.size;
        let shown = if self.reduction > 1 { format!(", shown 1:{}", self.reduction) } else { String::new() };
        Ok(html! {
            figure {
                div.frame { (self.to_img(&self.caption)?) (self.overlay()) }
                figcaption {
                    @if !self.caption.is_empty() { strong { (self.caption) } " " }
                    span.scale { (format!("white = {} · {columns} × {rows} px{shown}", short(self.tone_map.white))) }
                }
            }
        })
    }

    pub(super) fn to_img(&self, alt: &str) -> Result<Markup> {
        let (rows, columns, _) = self.levels.dim();
        let frames = std::iter::once(self).chain(&self.next);
        let source = format!("data:image/png;base64,{}", STANDARD.encode(to_png(frames)?));
        let class = (rows.max(columns) <= PIXELATED_MAX_PX).then_some("pixelated");
        Ok(html! { img class=[class] src=(source) width=(columns) height=(rows) alt=(alt); })
    }

    /// The picture as a PNG file, without caption and crosses.
    ///
    /// # Errors
    /// [`Error::Codec`] for an empty picture.
    pub fn to_png(&self) -> Result<Vec<u8>> {
        to_png(std::iter::once(self))
    }

    fn overlay(&self) -> Markup {
        let (rows, columns) = self.size;
        let arm = 0.028 * columns as f64;
        let hatching: String = self
            .hatched
            .iter()
            .map(|[row, column, length]| format!("M{column} {row}h{length}v1h-{length}z"))
            .collect();
        let step = columns as f64 / 200.0;
        html! {
            @if !self.hatched.is_empty() {
                svg.hatching viewBox=(format!("0 0 {columns} {rows}")) aria-label="hatched: at least the value" {
                    defs {
                        pattern id="hatching" width=(short(step)) height=(short(step))
                            patternUnits="userSpaceOnUse" patternTransform="rotate(45)" {
                            path d=(format!("M0 0V{}", short(step))) stroke=(PALETTE[0]) stroke-width=(short(step)) {}
                        }
                    }
                    path d=(hatching) style="fill:url(#hatching)" {}
                }
            }
            @if !self.markers.is_empty() {
                svg.markers viewBox=(format!("0 0 {columns} {rows}")) aria-hidden="true" {
                    @for (marker, colour) in self.markers.iter().zip(PALETTE.iter().cycle()) {
                        @let x = marker.column as f64 + 0.5;
                        @let y = marker.row as f64 + 0.5;
                        @let cross = format!(
                            "M{} {y}H{}M{x} {}V{}",
                            short(x - arm), short(x + arm), short(y - arm), short(y + arm)
                        );
                        // Above the cross and to its right, unless the picture ends there.
                        @let width = 2.1 * LETTER * arm * marker.label.chars().count() as f64;
                        @let is_left = x + 0.9 * arm + width > columns as f64;
                        @let text_x = if is_left { x - 0.9 * arm } else { x + 0.9 * arm };
                        @let text_y = if y < 2.2 * arm { (y + 2.2 * arm).min(rows as f64) } else { y - 0.6 * arm };
                        path.halo d=(cross) {}
                        path d=(cross) stroke=(colour) {}
                        text x=(short(text_x)) y=(short(text_y)) text-anchor=[is_left.then_some("end")]
                            fill=(colour) font-size=(short(2.1 * arm)) { (marker.label) }
                    }
                }
            }
        }
    }
}

/// Width of a wide letter of a cross's label, in its height.
const LETTER: f64 = 0.75;

/// Side length, in image pixels, of the block that becomes one pixel of a picture with sides of at most
/// `max_px`.
fn reduction_of((rows, columns): (usize, usize), max_px: usize) -> usize {
    rows.max(columns).div_ceil(max_px).max(1)
}

fn mean_of_block(image: ArrayView2<f32>, reduction: usize, (row, column): (usize, usize)) -> f32 {
    let span = |index: usize, len: usize| index * reduction..len.min((index + 1) * reduction);
    let block = image.slice(s![span(row, image.nrows()), span(column, image.ncols())]);
    block.sum() / block.len() as f32
}

/// Encodes a PNG file, animated if there is more than one frame; programs without animation show the first
/// frame.
fn to_png<'a>(frames: impl Iterator<Item = &'a Picture>) -> Result<Vec<u8>> {
    let frames: Vec<&Array3<u8>> = frames.map(|frame| &frame.levels).collect();
    let (rows, columns, channels) = frames.first().map_or((0, 0, 0), |levels| levels.dim());
    let failed = || format!("a picture of {columns} x {rows} pixels and {channels} channels");
    let color = match channels {
        1 => png::ColorType::Grayscale,
        3 => png::ColorType::Rgb,
        _ => return Err(Error::codec("draw", failed())("pictures have 1 or 3 channels")),
    };
    let px = |len: usize| u32::try_from(len).map_err(Error::codec("draw", failed()));
    let (width, height, count) = (px(columns)?, px(rows)?, px(frames.len())?);
    let encode = || {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, width, height);
        encoder.set_color(color);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_compression(png::Compression::Fast);
        if count > 1 {
            encoder.set_animated(count, 0)?;
            encoder.set_frame_delay(1, ANIMATION_FRAMES_PER_S)?;
        }
        let mut writer = encoder.write_header()?;
        for levels in &frames {
            writer.write_image_data(&levels.iter().copied().collect::<Vec<u8>>())?;
        }
        writer.finish()?;
        Ok(file)
    };
    encode().map_err(|error: png::EncodingError| Error::codec("draw", failed())(error))
}
