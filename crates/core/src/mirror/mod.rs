//! A two-axis mirror that steers a beam: angles, limits, and the trait of its drivers.

mod path;

use std::f64::consts::PI;
use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use crate::DeviceError;

pub use path::{MAX_POINTS, MirrorPath, MirrorPoint, PathError, RasterScan};

/// An angle by which the mirror itself is tilted, in degrees.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct MechanicalDeg(pub f64);

/// An angle between a reflected beam and its direction at rest, in degrees.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct OpticalDeg(pub f64);

/// The tilt of the mirror: x in the plane of incidence, y perpendicular to it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Tilt {
    /// Tilt in the plane of incidence.
    pub x: MechanicalDeg,
    /// Tilt perpendicular to it.
    pub y: MechanicalDeg,
}

impl Tilt {
    /// The mirror at rest.
    pub const ORIGIN: Self = Self { x: MechanicalDeg(0.0), y: MechanicalDeg(0.0) };

    /// A tilt from degrees of the mirror.
    pub fn new(x_deg: f64, y_deg: f64) -> Self {
        Self { x: MechanicalDeg(x_deg), y: MechanicalDeg(y_deg) }
    }

    /// Both axes in degrees of the mirror, x first.
    pub fn deg(self) -> [f64; 2] {
        [self.x.0, self.y.0]
    }

    /// The larger of the distances to `other` along the two axes, in degrees of the mirror.
    pub fn distance_deg(self, other: Self) -> f64 {
        (self.x.0 - other.x.0).abs().max((self.y.0 - other.y.0).abs())
    }

    /// Direction of the beam: `m = d_xy / d_z` of the reflected direction d, whose z axis is the reflected beam at
    /// rest.
    ///
    /// `incidence` is the angle between the beam and the mirror's normal at rest. To first order the beam turns by
    /// twice the tilt in the plane of incidence and by `2 cos(incidence)` times the tilt across it; the reflection
    /// itself is exact.
    pub fn beam(self, incidence: MechanicalDeg) -> [f64; 2] {
        let (sin, cos) = incidence.0.to_radians().sin_cos();
        let (tan_x, tan_y) = (self.x.0.to_radians().tan(), self.y.0.to_radians().tan());
        // The mirror's axes in the beam's coordinates: its normal at rest (sin, 0, cos), its x axis (cos, 0, -sin),
        // its y axis y.
        let normal = [sin + tan_x * cos, tan_y, cos - tan_x * sin];
        let square: f64 = normal.iter().map(|n| n * n).sum();
        let into = [-2.0 * sin * cos, 0.0, sin * sin - cos * cos];
        let along = 2.0 * (into[0] * normal[0] + into[2] * normal[2]) / square;
        let out = [into[0] - along * normal[0], -along * normal[1], into[2] - along * normal[2]];
        [out[0] / out[2], out[1] / out[2]]
    }

    /// The direction of the beam as angles in its x and y directions.
    pub fn beam_deg(self, incidence: MechanicalDeg) -> [OpticalDeg; 2] {
        self.beam(incidence).map(|tangent| OpticalDeg(tangent.atan().to_degrees()))
    }
}

/// Limits of a mirror, per axis. A step or a voltage beyond its limits destroys a MEMS mirror.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MirrorLimits {
    /// Largest tilt to either side.
    pub max_tilt: MechanicalDeg,
    /// Largest change from one sample to the next.
    pub max_step: MechanicalDeg,
    /// Fastest movement, in degrees of the mirror per second.
    pub max_slew_deg_per_s: f64,
    /// Highest frequency at which a path may move the mirror.
    pub bandwidth_hz: f64,
    /// Largest root mean square of a path's content above `bandwidth_hz`, from rounding and the turns of a raster.
    pub out_of_band: MechanicalDeg,
}

impl MirrorLimits {
    /// Mirrorcle A7B2.3-3600AL, by its maker.
    pub const A7B2_3_3600AL: Self = Self::by_tilt_and_bandwidth(6.5, 200.0);

    /// The limits that the tilt and the bandwidth of a mirror's data sheet suggest. Steps of a tenth of the tilt, the
    /// slew of a full sine at the bandwidth, and 1 % of the tilt above the bandwidth are [A].
    pub const fn by_tilt_and_bandwidth(max_tilt_deg: f64, bandwidth_hz: f64) -> Self {
        Self {
            max_tilt: MechanicalDeg(max_tilt_deg),
            max_step: MechanicalDeg(max_tilt_deg / 10.0),
            max_slew_deg_per_s: 2.0 * PI * bandwidth_hz * max_tilt_deg,
            bandwidth_hz,
            out_of_band: MechanicalDeg(max_tilt_deg / 100.0),
        }
    }

    /// The tilts of a ramp at `rate_hz` that starts at rest at `from` (not included) and comes to rest at `to`: half
    /// a cosine, slow enough for the step, the slew and two periods of the bandwidth. A single tilt if the mirror is
    /// already there.
    pub fn ramp(&self, from: Tilt, to: Tilt, rate_hz: f64) -> impl ExactSizeIterator<Item = Tilt> + use<> {
        let distance_deg = from.distance_deg(to);
        // The peak speed of a half cosine is pi/2 times its mean.
        let by_step = PI / 2.0 * distance_deg / self.max_step.0;
        let by_slew = PI / 2.0 * distance_deg / self.max_slew_deg_per_s * rate_hz;
        let by_bandwidth = if distance_deg > 0.0 { 2.0 * rate_hz / self.bandwidth_hz } else { 1.0 };
        let samples = by_step.max(by_slew).max(by_bandwidth).ceil().max(1.0) as u32;
        (1..samples + 1).map(move |sample| {
            if sample == samples {
                return to;
            }
            let share = (1.0 - (PI * f64::from(sample) / f64::from(samples)).cos()) / 2.0;
            let between = |from: f64, to: f64| from + share * (to - from);
            Tilt::new(between(from.x.0, to.x.0), between(from.y.0, to.y.0))
        })
    }
}

/// The response of one axis below and around its resonance: x'' + (w0/Q) x' + w0^2 x = w0^2 u.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SecondOrder {
    /// Resonance frequency.
    pub f0_hz: f64,
    /// Quality factor.
    pub q: f64,
}

/// The capabilities of a mirror and its controller.
#[derive(Debug, Clone, PartialEq)]
pub struct MirrorCapabilities {
    /// Maker, model and firmware as reported by the controller, for the manifest.
    pub model: String,
    /// Limits that paths must respect.
    pub limits: MirrorLimits,
    /// Sample rates that it accepts over this link, in samples per second.
    pub rate_hz: RangeInclusive<f64>,
    /// Samples that its FIFO holds; 1 if the host sends each sample when it is due.
    pub fifo_samples: u32,
}

/// The progress of a mirror along its path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MirrorProgress {
    /// Samples of the path that the mirror has confirmed as played, over all batches.
    pub played: u64,
    /// Samples of the path sent so far.
    pub sent: u64,
    /// Samples of the path to be played in all.
    pub total: u64,
    /// Whether it has played all samples and is back at the origin with the light off.
    pub parked: bool,
    /// Samples per second according to the confirmations; `None` until they make it certain.
    pub rate_hz: Option<f64>,
}

/// A mirror and the light that it steers.
///
/// Light and motion are coupled: the light is on only while a path is being played and the controller confirms the
/// motion. Every failure, and dropping the mirror, parks it.
pub trait Mirror: Send {
    /// The mirror's capabilities; constant while it is open.
    fn capabilities(&self) -> &MirrorCapabilities;

    /// Sets the path's rate and moves the mirror, with the light off, to the path's first point. Returns the rate
    /// that the controller really keeps.
    ///
    /// # Errors
    /// `OutOfRange` if the controller cannot keep the path's rate or the path breaks its limits; `Timeout` if its answers
    /// come too late to tell.
    fn load(&mut self, path: &MirrorPath) -> Result<f64, DeviceError>;

    /// Starts playing the loaded path `batches` times. Afterwards the mirror returns to the origin by itself, with
    /// the light off.
    ///
    /// # Errors
    /// `NotReady` before [`Mirror::load`], or if the path has light and light has not been permitted; `OutOfRange`
    /// for zero batches.
    fn start(&mut self, batches: u32) -> Result<(), DeviceError>;

    /// Sends as many samples as the controller has room for and reads its confirmations. Must be called every few
    /// milliseconds while a path is played.
    ///
    /// # Errors
    /// `Timeout` if the controller confirms no motion, `Protocol` on an underrun, `Disconnected` when it is gone,
    /// `NotReady` when light is no longer permitted. The mirror has then been parked, as far as it still answers.
    fn feed(&mut self) -> Result<MirrorProgress, DeviceError>;

    /// Turns the light off, then ramps to the origin. Idempotent.
    ///
    /// # Errors
    /// `Disconnected` or `Timeout` if the controller cannot be reached.
    fn park(&mut self) -> Result<(), DeviceError>;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_beam_turns_by_twice_the_tilt_in_the_plane_of_incidence_and_by_less_across_it() {
        for incidence_deg in [0.0, 22.5, 45.0] {
            let incidence = MechanicalDeg(incidence_deg);
            let [OpticalDeg(x), OpticalDeg(y)] = Tilt::new(3.0, 0.0).beam_deg(incidence);
            assert!((x - 6.0).abs() < 1e-12 && y == 0.0, "in the plane it is exact: {x}, {y}");
            let [_, OpticalDeg(y)] = Tilt::new(0.0, 0.01).beam_deg(incidence);
            let expected = 0.02 * incidence_deg.to_radians().cos();
            assert!((y - expected).abs() < 1e-8, "{y} at {incidence_deg}, expected {expected}");
        }
        assert!(Tilt::ORIGIN.beam(MechanicalDeg(30.0)).iter().all(|tangent| tangent.abs() < 1e-15));
    }

    #[test]
    fn ramps_keep_to_the_limits_and_end_where_they_should() {
        let limits = MirrorLimits::A7B2_3_3600AL;
        for rate_hz in [100.0, 500.0, 39_000.0] {
            let (from, to) = (Tilt::new(-6.5, 1.0), Tilt::new(6.5, 0.5));
            let mut last = from;
            for tilt in limits.ramp(from, to, rate_hz) {
                let step_deg = tilt.distance_deg(last);
                assert!(step_deg <= limits.max_step.0, "{step_deg} at {rate_hz}");
                assert!(step_deg * rate_hz <= limits.max_slew_deg_per_s, "{step_deg} at {rate_hz}");
                last = tilt;
            }
            assert_eq!(last, to);
        }
        assert_eq!(limits.ramp(Tilt::ORIGIN, Tilt::ORIGIN, 39_000.0).len(), 1);
    }
}
