//! Direct and global light from shifted checkerboards, after Nayar et al., "Fast Separation of Direct and Global
//! Components of a Scene using High Frequency Illumination" (SIGGRAPH 2006).
//!
//! Over all shifts of the board a pixel's light is a constant and a wave: global light comes from so many squares that
//! it does not change, direct light comes and goes with the pixel's own square. Instead of the brightest and the darkest
//! image, whose difference grows with their noise, all images are used: their components at the frequencies of the
//! board, one period being two squares. A board of squares `c` wide, shifted by (x, y), lights the place (X, Y) with
//! (1 + q(X - x) q(Y - y)) / 2, where q is a square wave of period 2c. A pixel sees a mean over a width w along each
//! axis, because of its own size and of defocus, which leaves a = sin(z) / z of q's fundamental, z = pi w / 2c. With a
//! projector that shows black at the share b of white:
//!
//! ```text
//! mean over all shifts                       (1 + b) (direct + global) / 2
//! component at (1, 1) and at (1, -1)         (1 - b) a_x a_y direct 2 / pi^2
//! component at (3, 1) over that at (1, 1)    sin(3z) / (9 sin(z)) along x
//! components with an even number of waves    nothing but noise
//! ```
//!
//! so the images themselves say how sharp the board is and how large the noise is.

use std::f64::consts::PI;

use ndarray::{Array2, Array3, ArrayView2, Axis, s};

use super::PlaneError;

/// Waves along x and y per period of the board, of each component that is summed.
const WAVES: [(i32, i32); 10] =
    [(1, 1), (1, -1), (3, 1), (3, -1), (1, 3), (1, -3), (2, 0), (0, 2), (2, 2), (2, -2)];
/// Components that direct light has, of the first order, of the third along x, and along y.
const FIRST: [usize; 2] = [0, 1];
const THIRD_X: [usize; 2] = [2, 3];
const THIRD_Y: [usize; 2] = [4, 5];
/// Components that no light has.
const EMPTY: [usize; 4] = [6, 7, 8, 9];
/// Pixels on either side of one that are taken together with it to find its noise, and how sharp its board is.
const NEIGHBOURS_PX: usize = 2;
/// Side of the parts of the image in which the sharpness of the board is compared.
const TILE_PX: usize = 16;
/// Sharpness is taken from parts with this much more power than noise.
const LEAST_POWER: f64 = 400.0;
/// Of all parts, those this far from the least sharp to the sharpest say how sharp the board is: in others light spreads
/// in the scene.
const SHARP_PARTS: f64 = 0.9;
/// A pixel whose board is less sharp than that by this factor is marked.
const LEAST_SHARPNESS: f64 = 0.8;

/// The light of one setting of the camera under shifted checkerboards, added up image by image.
#[derive(Debug, Clone)]
pub struct CheckerboardSums {
    cell_px: u32,
    images: u32,
    /// `[t, s]`.
    sum: Array2<f32>,
    /// Real and imaginary parts of each of the [`WAVES`], `[2 wave + part, t, s]`.
    waves: Array3<f32>,
}

impl CheckerboardSums {
    /// No images yet, of a board with squares of `cell_px` projector pixels, for a camera of `(rows, columns)`.
    pub fn new(cell_px: u32, (rows, columns): (usize, usize)) -> Self {
        let waves = Array3::zeros((2 * WAVES.len(), rows, columns));
        Self { cell_px, images: 0, sum: Array2::zeros((rows, columns)), waves }
    }

    /// Adds the image `[t, s]`, in any unit of light, under the board shifted by (x, y) pixels.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] for an image of another size.
    pub fn add(&mut self, (x, y): (u32, u32), image: ArrayView2<f32>) -> Result<(), PlaneError> {
        let (actual, expected) = (image.dim(), self.sum.dim());
        if actual != expected {
            return Err(PlaneError::Shape {
                array: "image",
                axes: "[camera rows, columns]",
                actual: vec![actual.0, actual.1],
                expected: vec![expected.0, expected.1],
            });
        }
        self.images += 1;
        self.sum += &image;
        let period = 2 * i64::from(self.cell_px);
        for (wave, (along_x, along_y)) in WAVES.into_iter().enumerate() {
            // Exact in integers first: shifts by a period give the same bits.
            let turns =
                (i64::from(along_x) * i64::from(x) + i64::from(along_y) * i64::from(y)).rem_euclid(period);
            let (sin, cos) = (2.0 * PI * turns as f64 / period as f64).sin_cos();
            for (part, weight) in [cos as f32, sin as f32].into_iter().enumerate() {
                self.waves.index_axis_mut(Axis(0), 2 * wave + part).scaled_add(weight, &image);
            }
        }
        Ok(())
    }

    /// The component of a wave at a pixel.
    fn component(&self, wave: usize, [t, s]: [usize; 2]) -> Component {
        let images = f64::from(self.images.max(1));
        let part = |part: usize| f64::from(self.waves[[2 * wave + part, t, s]]) / images;
        Component { real: part(0), imaginary: part(1) }
    }

    /// Variance of a sample of each pixel, from the components that no light has, of the pixel and its neighbours.
    fn variance(&self) -> Array2<f64> {
        let power = Array2::from_shape_fn(self.sum.dim(), |(t, s)| {
            EMPTY.iter().map(|&wave| self.component(wave, [t, s]).power()).sum::<f64>() / EMPTY.len() as f64
        });
        means_around(&power) * f64::from(self.images)
    }
}

#[derive(Clone, Copy, Default)]
struct Component {
    real: f64,
    imaginary: f64,
}

impl Component {
    fn power(self) -> f64 {
        self.real * self.real + self.imaginary * self.imaginary
    }

    fn plus(self, other: Self) -> Self {
        Self { real: self.real + other.real, imaginary: self.imaginary + other.imaginary }
    }

    /// The part of this component that has the other's phase.
    fn along(self, other: Self) -> f64 {
        let length = other.power().sqrt();
        if length > 0.0 { (self.real * other.real + self.imaginary * other.imaginary) / length } else { 0.0 }
    }
}

/// What separation finds in images of several settings under the same boards.
#[derive(Debug, Clone)]
pub struct SeparatedSettings {
    /// One for each setting.
    pub settings: Vec<Separated>,
    /// Width in projector pixels, along x and y, over which each pixel sees a mean of the board, because of its own size
    /// and of defocus; `None` if no part of the image is bright enough to tell, and none was assumed. Beyond half of a
    /// square's width it is not known well.
    pub blur_px: Option<[f64; 2]>,
    /// Distance in projector pixels over which light seems to spread in the scene about each pixel, `[t, s]`: if it
    /// decays exponentially with this length, the board's third wave is as weak as it is along the worse axis. NaN where it is too dark
    /// to tell, 0 where no spread is seen.
    pub spread_px: Array2<f32>,
    /// Pixels `[t, s]` where light spreads over so few squares that some of it is taken for direct: their direct light is
    /// an upper bound, and their global light a lower one.
    pub is_spread: Array2<bool>,
}

/// Direct and global light `[t, s]` of one setting, in the unit of its images, each with its standard deviation.
#[derive(Debug, Clone)]
pub struct Separated {
    /// Light that reached the pixel straight from its own place. Noise can make it negative.
    pub direct: Array2<f32>,
    /// Its standard deviation.
    pub direct_sd: Array2<f32>,
    /// All other light.
    pub global: Array2<f32>,
    /// Its standard deviation.
    pub global_sd: Array2<f32>,
}

/// Separates direct from global light in each setting. The settings share the camera's and the projector's place, so
/// that the place of a pixel on the board is found from all of them together. `black` is the light of the projector's
/// black as a share of its white; `dark_images` is the number of images that the dark image of each setting was averaged
/// of, whose error all images share.
///
/// # Errors
/// [`PlaneError::OutOfRange`] if `black` or `dark_images` is, or if settings have no or different images;
/// [`PlaneError::Shape`] for settings of different sizes.
pub fn separate(
    settings: &[CheckerboardSums],
    black: f64,
    dark_images: f64,
) -> Result<SeparatedSettings, PlaneError> {
    let out_of_range = |field, value, allowed| PlaneError::OutOfRange { field, value, allowed };
    if dark_images.is_nan() || dark_images <= 0.0 {
        return Err(out_of_range(
            "dark_images",
            dark_images,
            "more than 0, or infinite without a dark image",
        ));
    }
    if !(0.0..1.0).contains(&black) {
        return Err(out_of_range("black", black, "at least 0 and less than 1, a share of white"));
    }
    let Some(first) = settings.first().filter(|first| first.images > 0 && !first.sum.is_empty()) else {
        return Err(out_of_range("images", 0.0, "at least one: add the images under all shifts"));
    };
    for other in settings {
        let (actual, expected) = (other.sum.dim(), first.sum.dim());
        if actual != expected {
            let (actual, expected) = (vec![actual.0, actual.1], vec![expected.0, expected.1]);
            return Err(PlaneError::Shape {
                array: "setting",
                axes: "[camera rows, columns]",
                actual,
                expected,
            });
        }
        if (other.images, other.cell_px) != (first.images, first.cell_px) {
            let allowed = "the same for all settings: add the images under the same shifts";
            return Err(out_of_range("images", other.images.into(), allowed));
        }
    }
    let variances: Vec<Array2<f64>> = settings.iter().map(CheckerboardSums::variance).collect();
    let whole = Whole { settings, variance: sum_of(&variances) };
    let edges = whole.edges();
    let sharpness = edges.sharpest();
    let phases = sharpness.map(|thirds| thirds.map(blur_phase));
    let [along_x, along_y] = phases.unwrap_or_default().map(sinc);
    let per_component = PI * PI / (2.0 * (1.0 - black) * along_x * along_y);
    let separated = settings.iter().zip(&variances).map(|(setting, variance)| {
        let dark_variance = dimmest(variance) / dark_images;
        whole.separated(
            setting,
            variance,
            Scale { per_component, per_mean: 2.0 / (1.0 + black), dark_variance },
        )
    });
    let settings = separated.collect();
    let (spread_px, is_spread) = edges.spread(sharpness.unwrap_or([1.0; 2]), first.cell_px);
    let blur_px = phases.map(|phases| phases.map(|z| 2.0 * f64::from(first.cell_px) * z / PI));
    Ok(SeparatedSettings { settings, blur_px, spread_px, is_spread })
}

/// The z of a blur that leaves the share `third` of the third wave's ratio to the first.
fn blur_phase(third: f64) -> f64 {
    let (mut sharp, mut blurred) = (0.0, PI / 3.0);
    for _ in 0..50 {
        let z = 0.5 * (sharp + blurred);
        if sinc(3.0 * z) / sinc(z) > third {
            sharp = z;
        } else {
            blurred = z;
        }
    }
    sharp
}

fn sinc(z: f64) -> f64 {
    if z > 0.0 { z.sin() / z } else { 1.0 }
}

/// The variance of the dimmest pixels, to which light adds next to nothing.
fn dimmest(variance: &Array2<f64>) -> f64 {
    let mut variances: Vec<f64> = variance.iter().copied().collect();
    variances.sort_by(f64::total_cmp);
    variances[(variances.len() - 1) / 20]
}

/// From components and means to light.
struct Scale {
    per_component: f64,
    per_mean: f64,
    dark_variance: f64,
}

/// All settings together.
struct Whole<'a> {
    settings: &'a [CheckerboardSums],
    /// Of a sample of the sum of all settings, `[t, s]`.
    variance: Array2<f64>,
}

impl Whole<'_> {
    fn component(&self, wave: usize, place: [usize; 2]) -> Component {
        self.settings
            .iter()
            .fold(Component::default(), |sum, setting| sum.plus(setting.component(wave, place)))
    }

    fn images(&self) -> f64 {
        f64::from(self.settings[0].images)
    }

    /// Direct and global light of one of the settings.
    fn separated(&self, setting: &CheckerboardSums, variance: &Array2<f64>, scale: Scale) -> Separated {
        let images = self.images();
        let size = setting.sum.dim();
        let [mut direct, mut direct_sd, mut global, mut global_sd] =
            std::array::from_fn(|_| Array2::zeros(size));
        for ((t, s), &variance) in variance.indexed_iter() {
            // Of the real or the imaginary part of a component.
            let part_variance = variance / (2.0 * images);
            let whole_variance = self.variance[[t, s]] / (2.0 * images);
            let along = |wave: usize| {
                let whole = self.component(wave, [t, s]);
                let along = setting.component(wave, [t, s]).along(whole);
                // The noise turns the phase towards itself, by which the component seems longer.
                let length = whole.power().max(whole_variance).max(f64::MIN_POSITIVE).sqrt();
                along - part_variance / length + 0.5 * along * whole_variance / (length * length)
            };
            let found = FIRST.map(along).into_iter().sum::<f64>() / FIRST.len() as f64 * scale.per_component;
            let mean = f64::from(setting.sum[[t, s]]) / images;
            let found_variance = scale.per_component.powi(2) * part_variance / FIRST.len() as f64;
            let mean_variance = variance / images + scale.dark_variance;
            direct[[t, s]] = found as f32;
            direct_sd[[t, s]] = found_variance.sqrt() as f32;
            global[[t, s]] = (scale.per_mean * mean - found) as f32;
            global_sd[[t, s]] = (scale.per_mean.powi(2) * mean_variance + found_variance).sqrt() as f32;
        }
        Separated { direct, direct_sd, global, global_sd }
    }

    /// The power of the board's edges at each pixel, without that of the noise.
    fn edges(&self) -> Edges {
        let noise = &self.variance / self.images();
        let power = |waves: [usize; 2]| {
            Array2::from_shape_fn(noise.dim(), |(t, s)| {
                let of_waves = waves.map(|wave| self.component(wave, [t, s]).power());
                of_waves.into_iter().sum::<f64>() / waves.len() as f64 - noise[[t, s]]
            })
        };
        Edges { first: power(FIRST), thirds: [power(THIRD_X), power(THIRD_Y)], noise }
    }
}

/// Power of components, `[t, s]`.
struct Edges {
    first: Array2<f64>,
    /// Along x and y.
    thirds: [Array2<f64>; 2],
    /// Of each component.
    noise: Array2<f64>,
}

impl Edges {
    /// Three times the third component over the first, along x and y: 1 for sharp edges.
    fn sharpest(&self) -> Option<[f64; 2]> {
        let (rows, columns) = self.first.dim();
        let mut ratios = [Vec::new(), Vec::new()];
        for t in (0..rows).step_by(TILE_PX) {
            for s in (0..columns).step_by(TILE_PX) {
                let tile = s![t..rows.min(t + TILE_PX), s..columns.min(s + TILE_PX)];
                let first = self.first.slice(tile).sum();
                if first <= LEAST_POWER * self.noise.slice(tile).sum() || first <= 0.0 {
                    continue;
                }
                for (ratios, third) in ratios.iter_mut().zip(&self.thirds) {
                    ratios.push((9.0 * third.slice(tile).sum() / first).max(0.0).sqrt());
                }
            }
        }
        let sharp = |mut ratios: Vec<f64>| {
            ratios.sort_by(f64::total_cmp);
            let at = (SHARP_PARTS * (ratios.len().checked_sub(1)?) as f64).round() as usize;
            // Waves that are not seen at all say nothing of the others.
            Some(ratios[at].clamp(0.05, 1.0))
        };
        let [x, y] = ratios.map(sharp);
        Some([x?, y?])
    }

    /// Over how many pixels light spreads in the scene along the axis on which it spreads most, and whether that
    /// matters, where a board without scene is this sharp along x and y.
    fn spread(&self, sharpness: [f64; 2], cell_px: u32) -> (Array2<f32>, Array2<bool>) {
        let (first, noise) = (means_around(&self.first), means_around(&self.noise));
        let thirds = self.thirds.each_ref().map(means_around);
        let around = ((2 * NEIGHBOURS_PX + 1).pow(2)) as f64;
        let mut spread_px = Array2::zeros(first.dim());
        let mut is_spread = Array2::from_elem(first.dim(), false);
        for (place, (&first, &noise)) in first.iter().zip(&noise).enumerate() {
            let place = [place / spread_px.ncols(), place % spread_px.ncols()];
            for (third, sharp) in thirds.iter().zip(sharpness) {
                let scale = 9.0 / (sharp * sharp);
                let (third, noise_of_third) = (scale * third[place].max(0.0), scale * noise);
                // Of two components of each pixel around.
                let third_sd = ((noise_of_third + 2.0 * third) * noise_of_third / (2.0 * around)).sqrt();
                if first <= LEAST_POWER / around * noise || first <= 0.0 || third_sd > 0.1 * first {
                    spread_px[place] = f32::NAN;
                    break;
                }
                is_spread[place] |= (third + 3.0 * third_sd) / first < LEAST_SHARPNESS.powi(2);
                // Exponential spread of length l leaves 1 / (1 + w^2) of the first wave and 1 / (1 + 9 w^2) of the
                // third, w = pi l / c.
                let ratio = (third / first).sqrt().clamp(1.0 / 9.0 + 1e-3, 1.0);
                let w = ((1.0 - ratio) / (9.0 * ratio - 1.0)).sqrt();
                spread_px[place] = f32::max(spread_px[place], (w * f64::from(cell_px) / PI) as f32);
            }
        }
        (spread_px, is_spread)
    }
}

/// Mean of each pixel and its neighbours.
fn means_around(image: &Array2<f64>) -> Array2<f64> {
    let (rows, columns) = image.dim();
    let around =
        |at: usize, count: usize| at.saturating_sub(NEIGHBOURS_PX)..(at + NEIGHBOURS_PX + 1).min(count);
    Array2::from_shape_fn((rows, columns), |(t, s)| {
        let window = image.slice(s![around(t, rows), around(s, columns)]);
        window.sum() / window.len() as f64
    })
}

fn sum_of(images: &[Array2<f64>]) -> Array2<f64> {
    let mut sum = Array2::zeros(images[0].dim());
    images.iter().for_each(|image| sum += image);
    sum
}
