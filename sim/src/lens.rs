//! A lens that may be out of focus.

use std::sync::{Arc, PoisonError, RwLock};

use rayon::prelude::*;
use raysweep_config::sim::SimLens;

/// Diameter of a point's disc at the ends of the depth of field.
const DISC_AT_ENDS_PX: f64 = 2.0;
/// Largest diameter that is computed; a lens that is farther off blurs no more.
const MAX_DISC_PX: f64 = 64.0;
/// Points along the diameter of a disc by which its light is divided among pixels.
const SAMPLES: usize = 96;

/// A lens at its present position.
pub struct Lens {
    config: SimLens,
    now: RwLock<(f64, Option<Arc<DefocusDisc>>)>,
}

impl Lens {
    pub fn new(config: SimLens) -> Self {
        let position_mm = config.position_mm;
        Self { config, now: RwLock::new((position_mm, DefocusDisc::of(&config, position_mm))) }
    }

    pub fn turn(&self, position_mm: f64) {
        let disc = DefocusDisc::of(&self.config, position_mm);
        *self.now.write().unwrap_or_else(PoisonError::into_inner) = (position_mm, disc);
    }

    /// The position, and what it makes of a point; `None`: a point.
    pub fn now(&self) -> (f64, Option<Arc<DefocusDisc>>) {
        self.now.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// The evenly lit disc that an unfocused lens makes of a point, divided among pixels between whose centres the picture
/// is linear.
pub struct DefocusDisc {
    reach: usize,
    /// Share of each pixel, row by row, `2 reach + 1` each way; they sum to 1.
    shares: Vec<f32>,
}

impl DefocusDisc {
    fn of(lens: &SimLens, position_mm: f64) -> Option<Arc<Self>> {
        let from_focus = (position_mm - lens.focus_mm).abs() / (lens.depth_of_field_mm / 2.0);
        let radius_px = (from_focus * DISC_AT_ENDS_PX).min(MAX_DISC_PX) / 2.0;
        (radius_px > 0.0).then(|| Arc::new(Self::new(radius_px)))
    }

    fn new(radius_px: f64) -> Self {
        let reach = radius_px.ceil() as usize + 1;
        let side = 2 * reach + 1;
        let mut sums = vec![0.0_f64; side * side];
        let at = |sample: usize| radius_px * ((2 * sample + 1) as f64 / SAMPLES as f64 - 1.0);
        for (y, x) in (0..SAMPLES * SAMPLES).map(|index| (at(index / SAMPLES), at(index % SAMPLES))) {
            if x * x + y * y <= radius_px * radius_px {
                let (row, column) = ((y + reach as f64), (x + reach as f64));
                let (below, right) = (row - row.floor(), column - column.floor());
                let first = row as usize * side + column as usize;
                sums[first] += (1.0 - below) * (1.0 - right);
                sums[first + 1] += (1.0 - below) * right;
                sums[first + side] += below * (1.0 - right);
                sums[first + side + 1] += below * right;
            }
        }
        let total: f64 = sums.iter().sum();
        Self { reach, shares: sums.into_iter().map(|sum| (sum / total) as f32).collect() }
    }

    /// Offsets along one axis and the disc's share at each; they sum to 1.
    pub fn profile(&self) -> impl Iterator<Item = (isize, f64)> + '_ {
        let side = 2 * self.reach + 1;
        let share = |row: &[f32]| row.iter().map(|&share| f64::from(share)).sum();
        self.shares.chunks(side).zip(-(self.reach as isize)..).map(move |(row, offset)| (offset, share(row)))
    }

    /// Blurs an image of this width, row by row, whose borders go on beyond it.
    pub fn blur(&self, image: &mut [f32], width: usize) {
        let (sharp, height, side) = (image.to_vec(), image.len() / width, 2 * self.reach + 1);
        let inside =
            |at: usize, step: usize, count: usize| (at + step).saturating_sub(self.reach).min(count - 1);
        image.par_chunks_mut(width).enumerate().for_each(|(t, blurred)| {
            blurred.fill(0.0);
            for (step, shares) in self.shares.chunks(side).enumerate() {
                let row = &sharp[inside(t, step, height) * width..][..width];
                for (across, &share) in shares.iter().enumerate().filter(|(_, share)| **share > 0.0) {
                    for (s, blurred) in blurred.iter_mut().enumerate() {
                        *blurred += share * row[inside(s, across, width)];
                    }
                }
            }
        });
    }

    /// Blurs the weights of one of the projector's rows along it.
    pub fn blur_line(&self, weights: &[f32]) -> Vec<f32> {
        let last = weights.len() as isize - 1;
        let blurred = |at: isize| -> f64 {
            let shared = |(offset, share): (isize, f64)| {
                share * f64::from(weights[(at + offset).clamp(0, last) as usize])
            };
            self.profile().map(shared).sum()
        };
        (0..=last).map(|at| blurred(at) as f32).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENS: SimLens = SimLens { position_mm: 0.0, focus_mm: 3.0, depth_of_field_mm: 0.5 };

    #[test]
    fn a_point_becomes_a_disc_of_two_pixels_at_the_ends_of_the_depth_of_field() {
        assert!(DefocusDisc::of(&LENS, 3.0).is_none());
        for (position_mm, diameter_px) in [(3.25, 2.0), (2.75, 2.0), (4.0, 8.0), (3.05, 0.4)] {
            let disc = DefocusDisc::of(&LENS, position_mm).unwrap();
            let mut image = vec![0.0; 31 * 31];
            image[15 * 31 + 15] = 1.0;
            disc.blur(&mut image, 31);
            let moment = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
                let place = |index: usize| ((index / 31) as f64 - 15.0, (index % 31) as f64 - 15.0);
                image.iter().enumerate().map(|(i, &x)| f64::from(x) * of(place(i).0, place(i).1)).sum()
            };
            assert!((moment(&|_, _| 1.0) - 1.0).abs() < 1e-5);
            assert!(moment(&|y, _| y).abs() < 1e-5 && moment(&|_, x| x).abs() < 1e-5);
            // A disc has the variance r^2 / 4 along each axis; dividing its light between two pixels at f and 1 - f
            // of their distance adds f (1 - f), whose mean is at most a quarter.
            let (variance, r) = (moment(&|y, _| y * y), diameter_px / 2.0);
            let added = variance - r * r / 4.0;
            assert!((0.0..0.25).contains(&added), "{variance} at {position_mm} mm");
            let of_profile: f64 = disc.profile().map(|(d, share)| share * (d * d) as f64).sum();
            assert!((of_profile - variance).abs() < 1e-5);
        }
    }

    #[test]
    fn what_is_even_stays_even_up_to_the_borders() {
        let disc = DefocusDisc::of(&LENS, 0.0).unwrap();
        let mut image = vec![0.75; 20 * 30];
        disc.blur(&mut image, 30);
        assert!(image.iter().chain(&disc.blur_line(&[0.75; 9])).all(|light| (light - 0.75).abs() < 1e-5));
    }
}
