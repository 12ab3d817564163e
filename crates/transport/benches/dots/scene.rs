//! Synthetic 12-bit frames of a flying dot.

use std::error::Error;

use rand_distr::{Distribution, Normal, Uniform};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_transport::dots::FrameShape;

/// Mean counts without light, and their noise.
pub const BACKGROUND: f64 = 100.3;
pub const NOISE: f64 = 3.0;

/// Dots in a batch, as in the paper.
pub const DOTS: usize = 2250;

/// Fails if a range of random numbers is empty, which never happens here.
pub type Drawn = Result<(), Box<dyn Error>>;

/// Frames of noise. Each frame is cut out of them at a different place.
const NOISE_FRAMES: usize = 8;

/// A scan of a frame with a grid of dots.
pub struct Scene {
    pub shape: FrameShape,
    /// `NOISE_FRAMES + 1` frames of noisy background.
    noise: Vec<u16>,
}

impl Scene {
    pub fn new(size: usize) -> Result<Self, Box<dyn Error>> {
        let shape = FrameShape::new(size, size, 1)?;
        let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
        let noise = Normal::new(BACKGROUND, NOISE)?;
        let values = shape.pixels() * (NOISE_FRAMES + 1);
        let noise = (0..values).map(|_| noise.sample(&mut random).round() as u16).collect();
        Ok(Self { shape, noise })
    }

    /// Radius of the dots: 16 pixels of 1024, as in the paper.
    fn radius_px(&self) -> f64 {
        16.0 * self.shape.width() as f64 / 1024.0
    }

    /// Radius of discs that contain a dot wherever noise puts its brightest pixel.
    pub fn disc_radius_px(&self) -> f64 {
        1.25 * self.radius_px()
    }

    /// Column and row of a dot's centre on the calibration plane.
    pub fn centre(&self, dot: usize) -> [f64; 2] {
        let columns = (DOTS as f64).sqrt().ceil();
        let pitch = self.shape.width() as f64 / columns;
        let (row, column) = ((dot as f64 / columns).floor(), dot as f64 % columns);
        [(column + 0.5) * pitch, (row + 0.5) * pitch]
    }

    /// A dot on the calibration plane: nothing else is lit.
    pub fn draw_plane(&self, dot: usize, frame: &mut [u16]) -> Drawn {
        let start = Uniform::new(0, self.shape.pixels() * NOISE_FRAMES)?
            .sample(&mut Xoshiro256PlusPlus::seed_from_u64(dot as u64));
        frame.copy_from_slice(&self.noise[start..start + self.shape.pixels()]);
        self.stamp(self.centre(dot), 1500.0, 1.0, frame);
        Ok(())
    }

    /// A dot in a scene: the dot, for a third of the dots also a dimmer image of it elsewhere, and a glow below the
    /// noise.
    pub fn draw(&self, dot: usize, frame: &mut [u16]) -> Drawn {
        self.draw_plane(dot, frame)?;
        self.stamp(self.centre(dot), 4.0, 4.0, frame);
        let mut random = Xoshiro256PlusPlus::seed_from_u64((DOTS + dot) as u64);
        let anywhere = Uniform::new(0.0, self.shape.width() as f64)?;
        if dot.is_multiple_of(3) {
            let place = [anywhere.sample(&mut random), anywhere.sample(&mut random)];
            self.stamp(place, 80.0, 0.7, frame);
        }
        Ok(())
    }

    /// Adds a round spot with soft edges.
    fn stamp(&self, [x, y]: [f64; 2], counts: f64, scale: f64, frame: &mut [u16]) {
        let radius = self.radius_px() * scale;
        let within = |at: f64| {
            let size = self.shape.width();
            (at - radius).max(0.0) as usize..((at + radius).max(0.0) as usize + 1).min(size)
        };
        for row in within(y) {
            for column in within(x) {
                let distance = (row as f64 - y).hypot(column as f64 - x) / radius;
                let pixel = &mut frame[row * self.shape.width() + column];
                *pixel = (f64::from(*pixel) + counts * (1.0 - distance.powi(4)).max(0.0)).min(4095.0) as u16;
            }
        }
    }
}
