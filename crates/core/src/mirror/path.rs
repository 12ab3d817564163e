//! Paths that a mirror can follow. Paths that break its limits cannot be constructed.

use std::f64::consts::{PI, TAU};

use serde::{Deserialize, Serialize};

use super::{MirrorLimits, SecondOrder, Tilt};

/// Largest number of samples in a path: more than any controller holds.
pub const MAX_POINTS: usize = 131_072;

/// Position of the mirror and brightness of the light in one sample.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MirrorPoint {
    /// The mirror's position.
    pub tilt: Tilt,
    /// 0: off, 255: full.
    pub light: u8,
}

/// A closed path, played once per batch: its last point is followed by its first. Its points respect the limits that
/// it was made with, including the step from the last point to the first.
#[derive(Debug, Clone, PartialEq)]
pub struct MirrorPath {
    points: Vec<MirrorPoint>,
    rate_hz: f64,
}

/// Why points do not form a valid path.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PathError {
    /// No points, or more than [`MAX_POINTS`].
    #[error("the path has {points} points: must have 1 to {MAX_POINTS}")]
    Points {
        /// Number of points.
        points: usize,
    },
    /// The rate is not positive and finite.
    #[error("rate_hz = {rate_hz}: must be more than 0 samples per second")]
    Rate {
        /// The rate in Hz.
        rate_hz: f64,
    },
    /// Invalid parameter of a shape.
    #[error("{field} = {value}: must be {allowed}")]
    Shape {
        /// Name of the parameter.
        field: &'static str,
        /// Its value.
        value: f64,
        /// The allowed values, in words.
        allowed: &'static str,
    },
    /// A point beyond the largest tilt.
    #[error(
        "{axis} = {deg} degrees at point {point}: the mirror tilts by {allowed_deg} degrees at most; make the path smaller"
    )]
    Tilt {
        /// Index of the point.
        point: usize,
        /// Name of the axis.
        axis: char,
        /// Tilt of the point.
        deg: f64,
        /// Largest allowed tilt.
        allowed_deg: f64,
    },
    /// Two consecutive points too far apart.
    #[error(
        "{axis} changes by {deg} degrees from point {point} to the next: at most {allowed_deg} degrees per sample are allowed; take more points"
    )]
    Step {
        /// Index of the first of the two points.
        point: usize,
        /// Name of the axis.
        axis: char,
        /// Distance between them along this axis.
        deg: f64,
        /// Largest allowed distance.
        allowed_deg: f64,
    },
    /// Two consecutive points too far apart for the rate.
    #[error(
        "{axis} moves at {deg_per_s} degrees/s from point {point} to the next: at most {allowed_deg_per_s} are allowed; take more points or a lower rate_hz"
    )]
    Slew {
        /// Index of the first of the two points.
        point: usize,
        /// Name of the axis.
        axis: char,
        /// Speed from one to the other.
        deg_per_s: f64,
        /// Largest allowed speed.
        allowed_deg_per_s: f64,
    },
    /// Too much movement above the bandwidth.
    #[error(
        "{axis} moves by {deg} degrees (rms) above the bandwidth of {bandwidth_hz} Hz: at most {allowed_deg} are allowed; take more points, rounder turns, or a lower rate_hz"
    )]
    Bandwidth {
        /// Name of the axis.
        axis: char,
        /// Root mean square of the movement above the bandwidth.
        deg: f64,
        /// Largest allowed root mean square.
        allowed_deg: f64,
        /// The bandwidth.
        bandwidth_hz: f64,
    },
}

/// A raster: x oscillates as a sine; y moves down at constant speed and back up once per batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterScan {
    /// Largest tilt to either side, x and y.
    pub amplitude: Tilt,
    /// Number of lines, each one crossing. Must be even, as the path is closed.
    pub lines: u32,
    /// Share of the batch in which y moves back; more than 0, less than 1.
    pub flyback: f64,
}

impl MirrorPath {
    /// The path through these points, in order and cyclically, at `rate_hz` points per second.
    ///
    /// # Errors
    /// The first limit that a point, or the path as a whole, breaks.
    pub fn new(points: Vec<MirrorPoint>, rate_hz: f64, limits: &MirrorLimits) -> Result<Self, PathError> {
        if !(1..=MAX_POINTS).contains(&points.len()) {
            return Err(PathError::Points { points: points.len() });
        }
        if !(rate_hz > 0.0 && rate_hz.is_finite()) {
            return Err(PathError::Rate { rate_hz });
        }
        for (axis, of) in [('x', 0), ('y', 1)] {
            let deg = |point: usize| points[point % points.len()].tilt.deg()[of];
            for point in 0..points.len() {
                // NaN lies in no range.
                if !(-limits.max_tilt.0..=limits.max_tilt.0).contains(&deg(point)) {
                    let allowed_deg = limits.max_tilt.0;
                    return Err(PathError::Tilt { point, axis, deg: deg(point), allowed_deg });
                }
            }
            for point in 0..points.len() {
                let step_deg = (deg(point + 1) - deg(point)).abs();
                if step_deg > limits.max_step.0 {
                    return Err(PathError::Step {
                        point,
                        axis,
                        deg: step_deg,
                        allowed_deg: limits.max_step.0,
                    });
                }
                let deg_per_s = step_deg * rate_hz;
                if deg_per_s > limits.max_slew_deg_per_s {
                    let allowed_deg_per_s = limits.max_slew_deg_per_s;
                    return Err(PathError::Slew { point, axis, deg_per_s, allowed_deg_per_s });
                }
            }
            let values: Vec<f64> = (0..points.len()).map(deg).collect();
            let out_of_band_deg = rms_beyond(&values, limits.bandwidth_hz / rate_hz);
            if out_of_band_deg > limits.out_of_band.0 {
                return Err(PathError::Bandwidth {
                    axis,
                    deg: out_of_band_deg,
                    allowed_deg: limits.out_of_band.0,
                    bandwidth_hz: limits.bandwidth_hz,
                });
            }
        }
        Ok(Self { points, rate_hz })
    }

    /// A path through tilts, with the light on all the way.
    ///
    /// # Errors
    /// As [`MirrorPath::new`].
    pub fn through(
        tilts: impl IntoIterator<Item = Tilt>,
        rate_hz: f64,
        limits: &MirrorLimits,
    ) -> Result<Self, PathError> {
        Self::new(tilts.into_iter().map(|tilt| MirrorPoint { tilt, light: 255 }).collect(), rate_hz, limits)
    }

    /// A raster of `points` points.
    ///
    /// # Errors
    /// As [`MirrorPath::new`]; `Shape` for an invalid number of lines or flyback.
    pub fn raster(
        scan: &RasterScan,
        points: usize,
        rate_hz: f64,
        limits: &MirrorLimits,
    ) -> Result<Self, PathError> {
        let RasterScan { amplitude, lines, flyback } = *scan;
        if lines < 2 || !lines.is_multiple_of(2) {
            let value = f64::from(lines);
            return Err(PathError::Shape { field: "lines", value, allowed: "an even number from 2 on" });
        }
        if !(flyback > 0.0 && flyback < 1.0) {
            return Err(PathError::Shape { field: "flyback", value: flyback, allowed: "between 0 and 1" });
        }
        let tilt = |phase: f64| {
            let x = -(TAU * f64::from(lines / 2) * phase).cos();
            let y = if phase < 1.0 - flyback {
                1.0 - 2.0 * phase / (1.0 - flyback)
            } else {
                -(PI * (phase - 1.0 + flyback) / flyback).cos()
            };
            Tilt::new(amplitude.x.0 * x, amplitude.y.0 * y)
        };
        Self::sampled(points, rate_hz, limits, tilt)
    }

    /// A Lissajous figure of `points` points: sines with integer numbers of `cycles` per batch (x, y), y a quarter of
    /// its cycle ahead.
    ///
    /// # Errors
    /// As [`MirrorPath::new`].
    pub fn lissajous(
        amplitude: Tilt,
        cycles: [u32; 2],
        points: usize,
        rate_hz: f64,
        limits: &MirrorLimits,
    ) -> Result<Self, PathError> {
        let [x, y] = cycles.map(f64::from);
        Self::sampled(points, rate_hz, limits, |phase| {
            Tilt::new(amplitude.x.0 * (TAU * x * phase).sin(), amplitude.y.0 * (TAU * y * phase).cos())
        })
    }

    /// A spiral of `points` points: from the centre out to `amplitude` and back in one batch, `turns` turns in all.
    ///
    /// # Errors
    /// As [`MirrorPath::new`].
    pub fn spiral(
        amplitude: Tilt,
        turns: u32,
        points: usize,
        rate_hz: f64,
        limits: &MirrorLimits,
    ) -> Result<Self, PathError> {
        Self::sampled(points, rate_hz, limits, |phase| {
            let radius = (1.0 - (TAU * phase).cos()) / 2.0;
            let (sin, cos) = (TAU * f64::from(turns) * phase).sin_cos();
            Tilt::new(amplitude.x.0 * radius * cos, amplitude.y.0 * radius * sin)
        })
    }

    fn sampled(
        points: usize,
        rate_hz: f64,
        limits: &MirrorLimits,
        tilt: impl Fn(f64) -> Tilt,
    ) -> Result<Self, PathError> {
        if points > MAX_POINTS {
            return Err(PathError::Points { points });
        }
        Self::through((0..points).map(|point| tilt(point as f64 / points as f64)), rate_hz, limits)
    }

    /// The same path with the light of point `i` set to `light(i)`.
    #[must_use]
    pub fn with_light(mut self, light: impl Fn(usize) -> u8) -> Self {
        self.points.iter_mut().enumerate().for_each(|(index, point)| point.light = light(index));
        self
    }

    /// The path to command so that axes with these `responses` (x, y) follow this path:
    /// `u = x + x' / (w0 Q) + x'' / w0^2`, with the derivatives as central differences round the loop.
    ///
    /// # Errors
    /// As [`MirrorPath::new`], as the commands must respect the limits too. `Shape` for an invalid response.
    pub fn predistorted(
        &self,
        responses: [SecondOrder; 2],
        limits: &MirrorLimits,
    ) -> Result<Self, PathError> {
        for SecondOrder { f0_hz, q } in responses {
            for (field, value) in [("f0_hz", f0_hz), ("q", q)] {
                if !(value > 0.0 && value.is_finite()) {
                    return Err(PathError::Shape { field, value, allowed: "more than 0" });
                }
            }
        }
        let len = self.points.len();
        let command = |index: usize, axis: usize| {
            let at = |index: usize| self.points[index % len].tilt.deg()[axis];
            let (before, here, after) = (at(index + len - 1), at(index), at(index + 1));
            // Phase of the resonance per sample, in radians.
            let w0 = TAU * responses[axis].f0_hz / self.rate_hz;
            let velocity = (after - before) / 2.0;
            let acceleration = after - 2.0 * here + before;
            here + velocity / (w0 * responses[axis].q) + acceleration / (w0 * w0)
        };
        let points = self.points.iter().enumerate().map(|(index, point)| MirrorPoint {
            tilt: Tilt::new(command(index, 0), command(index, 1)),
            light: point.light,
        });
        Self::new(points.collect(), self.rate_hz, limits)
    }

    /// The points of one batch.
    pub fn points(&self) -> &[MirrorPoint] {
        &self.points
    }

    /// The point of a sample, counted over all batches.
    pub fn at(&self, sample: u64) -> MirrorPoint {
        self.points[(sample % self.points.len() as u64) as usize]
    }

    /// Samples per second.
    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// Whether any of its points is lit.
    pub fn is_lit(&self) -> bool {
        self.points.iter().any(|point| point.light > 0)
    }
}

/// Root mean square of the part of a closed loop of values above `cycles_per_sample`, by Parseval's theorem: without
/// the mean and the discrete Fourier terms up to that frequency.
fn rms_beyond(values: &[f64], cycles_per_sample: f64) -> f64 {
    let count = values.len() as f64;
    let last_term = (cycles_per_sample * count).floor();
    if last_term >= (count / 2.0).floor() {
        return 0.0;
    }
    let mean = values.iter().sum::<f64>() / count;
    let total = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    let in_band: f64 = (1..=last_term as u32)
        .map(|term| {
            let (sin, cos) = (TAU * f64::from(term) / count).sin_cos();
            let (mut re, mut im, mut unit) = (0.0, 0.0, (1.0, 0.0));
            for value in values {
                re += (value - mean) * unit.0;
                im += (value - mean) * unit.1;
                unit = (unit.0 * cos - unit.1 * sin, unit.0 * sin + unit.1 * cos);
            }
            2.0 * (re * re + im * im) / (count * count)
        })
        .sum();
    (total - in_band).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::MechanicalDeg;

    const LIMITS: MirrorLimits = MirrorLimits::A7B2_3_3600AL;
    const RATE_HZ: f64 = 39_000.0;

    /// The definition of a path's limits, written independently of the code that checks them; the spectrum is summed
    /// term by term.
    fn keeps_to(points: &[Tilt], rate_hz: f64, limits: &MirrorLimits) -> bool {
        let n = points.len();
        (0..2).all(|axis| {
            let x: Vec<f64> = points.iter().map(|p| p.deg()[axis]).collect();
            let angle = x.iter().all(|v| v.abs() <= limits.max_tilt.0);
            let step = (0..n).all(|i| (x[(i + 1) % n] - x[i]).abs() <= limits.max_step.0);
            let slew = (0..n).all(|i| {
                (x[(i + 1) % n] - x[i]).abs() * rate_hz <= limits.max_slew_deg_per_s * (1.0 + 1e-12)
            });
            let mut beyond = 0.0;
            for k in 1..n {
                let f = k.min(n - k) as f64 / n as f64 * rate_hz;
                if f > limits.bandwidth_hz * (1.0 + 1e-9) {
                    let (mut re, mut im) = (0.0, 0.0);
                    for (i, v) in x.iter().enumerate() {
                        let angle = TAU * (k * i % n) as f64 / n as f64;
                        re += v * angle.cos();
                        im -= v * angle.sin();
                    }
                    beyond += (re * re + im * im) / (n * n) as f64;
                }
            }
            angle && step && slew && beyond.sqrt() <= limits.out_of_band.0 + 1e-9
        })
    }

    fn any_limits() -> impl Strategy<Value = MirrorLimits> {
        (1.0..10.0, 0.01..5.0, 10.0..20_000.0, 20.0..3000.0, 0.01..0.5).prop_map(
            |(tilt, step, slew, bandwidth_hz, rest)| MirrorLimits {
                max_tilt: MechanicalDeg(tilt),
                max_step: MechanicalDeg(step),
                max_slew_deg_per_s: slew,
                bandwidth_hz,
                out_of_band: MechanicalDeg(rest),
            },
        )
    }

    fn any_coordinate() -> impl Strategy<Value = f64> {
        prop_oneof![
            20 => -0.3..0.3,
            4 => -12.0..12.0,
            1 => prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX]),
        ]
    }

    fn tilts(path: &MirrorPath) -> Vec<Tilt> {
        path.points().iter().map(|point| point.tilt).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn no_points_that_break_a_limit_make_a_path(
            points in prop::collection::vec((any_coordinate(), any_coordinate()), 0..40),
            rate_hz in prop_oneof![20 => 50.0..50_000.0, 1 => -1.0..0.0, 1 => Just(f64::NAN)],
            limits in any_limits(),
        ) {
            let points: Vec<Tilt> = points.into_iter().map(|(x, y)| Tilt::new(x, y)).collect();
            let allowed = !points.is_empty() && rate_hz > 0.0 && keeps_to(&points, rate_hz, &limits);
            let made = MirrorPath::through(points, rate_hz, &limits);
            prop_assert!(allowed || made.is_err(), "{made:?}");
        }

        #[test]
        fn no_shape_breaks_a_limit(
            amplitude in (0.0..9.0, 0.0..9.0),
            count in 1_u32..40,
            points in 1_usize..300,
            rate_hz in 50.0..50_000.0,
            limits in any_limits(),
        ) {
            let amplitude = Tilt::new(amplitude.0, amplitude.1);
            let scan = RasterScan { amplitude, lines: count, flyback: 0.2 };
            let shapes = [
                MirrorPath::raster(&scan, points, rate_hz, &limits),
                MirrorPath::lissajous(amplitude, [count, count + 1], points, rate_hz, &limits),
                MirrorPath::spiral(amplitude, count, points, rate_hz, &limits),
            ];
            for path in shapes.into_iter().flatten() {
                prop_assert!(keeps_to(&tilts(&path), rate_hz, &limits));
                let responses = [SecondOrder { f0_hz: 500.0, q: 30.0 }, SecondOrder { f0_hz: 480.0, q: 25.0 }];
                if let Ok(commanded) = path.predistorted(responses, &limits) {
                    prop_assert!(keeps_to(&tilts(&commanded), rate_hz, &limits));
                }
            }
        }
    }

    #[test]
    fn each_limit_is_refused_by_its_name() {
        let line = |points: usize, amplitude: f64, cycles: u32, rate_hz: f64| {
            MirrorPath::lissajous(Tilt::new(amplitude, 0.0), [cycles, 0], points, rate_hz, &LIMITS)
                .map(|_| ())
        };
        assert_eq!(line(6500, 6.0, 10, RATE_HZ), Ok(()));
        assert!(matches!(line(6500, 7.0, 10, RATE_HZ), Err(PathError::Tilt { axis: 'x', .. })));
        assert!(matches!(line(20, 6.0, 1, 100.0), Err(PathError::Step { .. })));
        assert!(matches!(line(195, 6.5, 2, RATE_HZ), Err(PathError::Slew { .. })));
        assert!(matches!(line(130, 1.0, 1, RATE_HZ), Err(PathError::Bandwidth { .. })));
        assert!(matches!(line(0, 1.0, 1, RATE_HZ), Err(PathError::Points { points: 0 })));
        assert!(matches!(line(MAX_POINTS + 1, 1.0, 1, RATE_HZ), Err(PathError::Points { .. })));
        let open = [Tilt::new(0.0, 0.0), Tilt::new(0.0, 0.5), Tilt::new(0.0, 1.0)];
        let error = MirrorPath::through(open, 100.0, &LIMITS).unwrap_err();
        assert!(matches!(error, PathError::Step { point: 2, axis: 'y', .. }), "the way back counts: {error}");
    }

    #[test]
    fn the_papers_batch_is_a_path() {
        let amplitude = Tilt::new(9.27 / 4.0, 5.25 / 4.0);
        let scan = RasterScan { amplitude, lines: 40, flyback: 0.1 };
        let path = MirrorPath::raster(&scan, 6500, RATE_HZ, &LIMITS).unwrap();
        assert_eq!(path.points().len(), 6500);
        assert_eq!(path.at(6500 * 59 + 17), path.points()[17]);
    }

    /// The motion of the axis, integrated in small steps: an independent check of the pre-distortion.
    fn follow(commands: &[f64], rate_hz: f64, response: SecondOrder) -> Vec<f64> {
        const SUBSTEPS: u32 = 64;
        let (w0, dt) = (TAU * response.f0_hz, 1.0 / rate_hz / f64::from(SUBSTEPS));
        let (mut x, mut v) = (commands[0], 0.0);
        let mut out = Vec::new();
        // Long enough for the ringing from the start to decay.
        for _ in 0..8 {
            out.clear();
            for (index, &command) in commands.iter().enumerate() {
                out.push(x);
                let next = commands[(index + 1) % commands.len()];
                for substep in 0..SUBSTEPS {
                    let u = command + (next - command) * f64::from(substep) / f64::from(SUBSTEPS);
                    v += dt * (w0 * w0 * (u - x) - w0 / response.q * v);
                    x += dt * v;
                }
            }
        }
        out
    }

    #[test]
    fn a_predistorted_path_is_followed_closer_than_a_plain_one() {
        let responses = [SecondOrder { f0_hz: 500.0, q: 30.0 }, SecondOrder { f0_hz: 480.0, q: 30.0 }];
        let path = MirrorPath::lissajous(Tilt::new(3.0, 2.0), [30, 17], 6500, RATE_HZ, &LIMITS).unwrap();
        let commanded = path.predistorted(responses, &LIMITS).unwrap();
        for (axis, response) in responses.into_iter().enumerate() {
            let wanted: Vec<f64> = tilts(&path).iter().map(|tilt| tilt.deg()[axis]).collect();
            let error_deg = |sent: &MirrorPath| {
                let sent: Vec<f64> = tilts(sent).iter().map(|tilt| tilt.deg()[axis]).collect();
                let moved = follow(&sent, RATE_HZ, response);
                moved.iter().zip(&wanted).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
            };
            let (plain, corrected) = (error_deg(&path), error_deg(&commanded));
            assert!(corrected < 2e-3 && plain > 0.05, "axis {axis}: {plain} became {corrected}");
        }
    }
}
