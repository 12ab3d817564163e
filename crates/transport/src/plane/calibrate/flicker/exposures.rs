//! When images were exposed, and what they see of light that flickers.

use std::f64::consts::{PI, TAU};

use nalgebra::Complex;

/// When the frames of an averaged image were exposed.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameExposures {
    /// Exposure of each camera row.
    pub exposure_us: f64,
    /// Start of the exposure of camera row 0 in each frame, on one clock for all images.
    pub opened_s: Vec<f64>,
}

/// An image of the sweep and the dark image that was subtracted from it.
#[derive(Debug, Clone, PartialEq)]
pub struct TimedImage {
    /// The frames of the image.
    pub light: FrameExposures,
    /// The frames of its dark image.
    pub dark: FrameExposures,
}

/// Most frames that are proposed for an average.
const MOST_FRAMES: u32 = 64;
/// Share of a flicker that may remain in an average that cancels it.
const CANCELLED_SHARE: f64 = 0.02;
/// Distance from multiples of the frame rate from which flicker can be followed.
const FOLLOWED_HZ: f64 = 0.5;

/// Share of a flicker that remains in the mean of `frames` frames.
pub fn averaged_share(frequency_hz: f64, frame_rate_hz: f64, frames: u32) -> f64 {
    let turn = PI * frequency_hz / frame_rate_hz;
    let n = f64::from(frames);
    if turn.sin().abs() < 1e-9 { 1.0 } else { ((n * turn).sin() / (n * turn.sin())).abs() }
}

/// The smallest number of frames, not less than `frames`, whose mean cancels a flicker at all of these frame rates;
/// `None` if 64 do not.
pub fn cancelling_frames(frequency_hz: f64, frame_rates_hz: &[f64], frames: u32) -> Option<u32> {
    let cancels = |n: &u32| {
        frame_rates_hz.iter().all(|&rate_hz| averaged_share(frequency_hz, rate_hz, *n) <= CANCELLED_SHARE)
    };
    (frames.max(1)..=MOST_FRAMES.max(frames)).find(cancels)
}

/// Whether flicker differs from frame to frame. Within 0.5 Hz of a multiple of the frame rate it is the same in all
/// frames, and cannot be told from the scene or cancelled.
pub fn can_be_followed(frequency_hz: f64, frame_rate_hz: f64) -> bool {
    let multiple = frame_rate_hz * (frequency_hz / frame_rate_hz).round();
    (frequency_hz - multiple).abs() >= FOLLOWED_HZ
}

impl FrameExposures {
    /// Mean over the frames of the integral of `hat exp(2 pi i f t)` over the exposure of row 0, in us; `hat` weighs
    /// each frame.
    pub(super) fn phasor(&self, frequency_hz: f64, hat: impl Fn(f64) -> f64) -> Complex<f64> {
        let half_s = self.exposure_us * 0.5e-6;
        let seen_us = 1e6 * (TAU * frequency_hz * half_s).sin() / (PI * frequency_hz);
        let turned = |&opened_s: &f64| turn(frequency_hz, opened_s + half_s) * hat(opened_s);
        self.opened_s.iter().map(turned).sum::<Complex<f64>>() * seen_us / self.opened_s.len().max(1) as f64
    }
}

/// `exp(2 pi i f t)`.
pub(super) fn turn(frequency_hz: f64, time_s: f64) -> Complex<f64> {
    Complex::from_polar(1.0, TAU * (frequency_hz * time_s).fract())
}
