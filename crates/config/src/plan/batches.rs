//! `[batches]`: the path of a dot rig's mirror and the frames that its camera takes.

use raysweep_core::{MirrorLimits, MirrorPath, MirrorPoint, PathError, RasterScan, Tilt};
use serde::Deserialize;

use crate::document::Document;
use crate::whole::whole;

/// `[batches]`: the mirror completes its path once per batch, and the camera takes one frame per dot.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BatchesPlan {
    /// Number of batches of the scene.
    #[serde(deserialize_with = "whole::<_, 1, 129_600>")]
    pub count: u32,
    /// Number of frames per batch.
    #[serde(deserialize_with = "whole::<_, 8, 65_536>")]
    pub dots: u32,
    /// Frames per second; default: the rate that gives `dots` frames in the duration of the mirror's path.
    pub camera_rate_hz: Option<f64>,
    /// Exposure of each frame.
    pub exposure_us: f64,
    /// Index of the frame that shows the trailing dot; default: the last.
    pub trailing_index: Option<u32>,
    /// Region where the trailing dot lands: first row, row after the last, first column, column after the last.
    pub trailing_region: [usize; 4],
    /// Indices of the frames whose light goes into the beam dump.
    pub background_indices: Vec<u32>,
    /// Frames without light before the first batch, to calibrate the sensor.
    #[serde(deserialize_with = "whole::<_, 16, 1_048_576>")]
    pub dark_frames: u32,
    /// Evenly lit frames after the dark frames, for the flat field; 0: none.
    #[serde(deserialize_with = "whole::<_, 0, 1_048_576>")]
    pub flat_frames: u32,
    /// Whether to store the raw frames, with 16 bits per pixel.
    pub keep_raw: bool,
    /// `[batches.path]`
    pub path: PathPlan,
    /// `[[batches.calibration]]`: the calibration plane at one or two depths, before the scene.
    pub calibration: Vec<PlanePlan>,
}

/// `[batches.path]`: the mirror's path during a batch.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PathPlan {
    /// Shape of the path; some of the other keys apply only to certain shapes.
    pub shape: Shape,
    /// Largest mechanical tilt in either direction, x and y.
    pub amplitude_deg: [f64; 2],
    /// Raster: number of crossings in x, even.
    pub lines: u32,
    /// Raster: fraction of the batch in which y flies back.
    pub flyback: f64,
    /// Lissajous figure: whole cycles per batch, x and y.
    pub cycles: [u32; 2],
    /// Spiral: turns outwards and back.
    pub turns: u32,
    /// Points: mechanical tilts x, y, in degrees; the mirror holds each until the next.
    pub points_deg: Vec<[f64; 2]>,
    /// Samples per batch; for points, the number of points.
    pub samples: usize,
    /// Samples per second.
    pub rate_hz: f64,
}

/// Shapes of paths, by their names in plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// x back and forth as a sine, y down and back.
    Raster,
    /// Sines on both axes.
    Lissajous,
    /// From the centre out and back.
    Spiral,
    /// A list of points.
    Points,
}

/// `[[batches.calibration]]`: batches that show the Lambertian plane alone.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanePlan {
    /// Number of batches.
    #[serde(deserialize_with = "whole::<_, 1, 129_600>")]
    pub batches: u32,
    /// Distance of the plane from the mirror; for the report.
    pub depth_mm: Option<f64>,
}

impl Default for BatchesPlan {
    /// The paper's values: 2250 dots at 13,500 per second, 39,000 samples per second.
    fn default() -> Self {
        Self {
            count: 12,
            dots: 2250,
            camera_rate_hz: None,
            exposure_us: 50.0,
            trailing_index: None,
            trailing_region: [0, 32, 0, 32],
            background_indices: vec![0],
            dark_frames: 256,
            flat_frames: 0,
            keep_raw: false,
            path: PathPlan::default(),
            calibration: vec![PlanePlan { batches: 2, depth_mm: None }],
        }
    }
}

impl Default for PathPlan {
    fn default() -> Self {
        Self {
            shape: Shape::Raster,
            amplitude_deg: [3.0, 3.0],
            lines: 46,
            flyback: 0.1,
            cycles: [23, 1],
            turns: 23,
            points_deg: Vec::new(),
            samples: 6500,
            rate_hz: 39_000.0,
        }
    }
}

/// Maximum number of batches: six hours at six per second.
const MAX_BATCHES: u64 = 129_600;
/// Maximum number of frames per batch.
const MAX_DOTS: u64 = 1 << 16;
/// Camera and mirror may drift apart by this fraction of a frame per batch; beyond it, indices are ambiguous.
const RATE_TOLERANCE_FRAMES: f64 = 0.5;

/// Batches that are played in addition to the requested ones: the first lacks its beginning, and the next two may
/// pass before the trailing dot is known.
const SPARE_BATCHES: u32 = 2;

impl BatchesPlan {
    pub(super) fn check(&self, document: &mut Document<'_>) {
        let dots = self.dots;
        document.check_count(&["batches", "count"], self.count.into(), 1..=MAX_BATCHES);
        document.check_count(&["batches", "dots"], dots.into(), 8..=MAX_DOTS);
        if self.trailing_index.is_some_and(|index| index >= dots) {
            let message = format!(
                "batches.trailing_index = {}: must be below batches.dots = {dots}",
                self.trailing_index()
            );
            document.refuse(&["batches", "trailing_index"], message);
        }
        if self.background_indices.is_empty() {
            let message = "batches.background_indices is empty: give the index of at least one frame per batch whose light goes into the beam dump";
            document.refuse(&["batches", "background_indices"], message);
        }
        let is_wrong = |index: &&u32| **index >= dots || **index == self.trailing_index();
        if let Some(index) = self.background_indices.iter().find(is_wrong) {
            let message = format!(
                "batches.background_indices contains {index}: must be below batches.dots = {dots}, and not the trailing dot's index"
            );
            document.refuse(&["batches", "background_indices"], message);
        }
        let [top, bottom, left, right] = self.trailing_region;
        if top >= bottom || left >= right {
            let message = format!(
                "batches.trailing_region = {:?}: give [first row, row after the last, first column, column after the last]",
                self.trailing_region
            );
            document.refuse(&["batches", "trailing_region"], message);
        }
        document.check_positive(&["batches", "exposure_us"], self.exposure_us, "microseconds");
        document.check_count(&["batches", "dark_frames"], self.dark_frames.into(), 16..=1 << 20);
        if self.flat_frames != 0 && !(16..=1 << 20).contains(&self.flat_frames) {
            let message = format!(
                "batches.flat_frames = {}: must be from 16 to 1048576, or 0 for no flat field",
                self.flat_frames
            );
            document.refuse(&["batches", "flat_frames"], message);
        }
        self.path.check(document);
        self.check_rate(document);
        if self.calibration.len() > 2 {
            let message =
                format!("batches.calibration has {} planes: give one or two", self.calibration.len());
            document.refuse(&["batches", "calibration"], message);
        }
        for (index, plane) in self.calibration.iter().enumerate() {
            let path = ["batches", "calibration", &index.to_string(), "batches"];
            document.check_count(&path, plane.batches.into(), 1..=MAX_BATCHES);
        }
    }

    /// Checks that camera and mirror keep pace.
    fn check_rate(&self, document: &mut Document<'_>) {
        let (dots, duration_s) = (self.dots, self.path.duration_s());
        if !(duration_s > 0.0 && duration_s.is_finite()) {
            return;
        }
        let camera_rate_hz = self.camera_rate_hz();
        if !(camera_rate_hz > 0.0 && camera_rate_hz.is_finite()) {
            let message =
                format!("batches.camera_rate_hz = {camera_rate_hz}: must be more than 0 frames per second");
            return document.refuse(&["batches", "camera_rate_hz"], message);
        }
        let frames = camera_rate_hz * duration_s;
        if (frames - f64::from(dots)).abs() > RATE_TOLERANCE_FRAMES {
            let message = format!(
                "batches.camera_rate_hz = {camera_rate_hz}: the camera would take {frames:.2} frames per path of the mirror, but batches.dots = {dots}; give {:.3}, or leave camera_rate_hz out",
                f64::from(dots) / duration_s
            );
            document.refuse(&["batches", "camera_rate_hz"], message);
        }
        if self.exposure_us * camera_rate_hz > 1e6 {
            let message = format!(
                "batches.exposure_us = {}: must be at most the {:.2} us from one frame to the next",
                self.exposure_us,
                1e6 / camera_rate_hz
            );
            document.refuse(&["batches", "exposure_us"], message);
        }
    }

    /// Index of the frame that shows the trailing dot.
    pub fn trailing_index(&self) -> u32 {
        self.trailing_index.unwrap_or(self.dots.saturating_sub(1))
    }

    /// Frames per second.
    pub fn camera_rate_hz(&self) -> f64 {
        self.camera_rate_hz.unwrap_or(f64::from(self.dots) / self.path.duration_s())
    }

    /// Number of batches of the calibration planes and the scene.
    pub fn total(&self) -> usize {
        self.count as usize + self.calibration.iter().map(|plane| plane.batches as usize).sum::<usize>()
    }

    /// The calibration plane that a batch shows; `None`: the scene.
    pub fn plane_of(&self, batch: usize) -> Option<usize> {
        let mut end = 0;
        self.calibration.iter().position(|plane| {
            end += plane.batches as usize;
            batch < end
        })
    }

    /// Number of times that the path is played to get `batches` complete batches.
    pub fn rounds(batches: u32) -> u32 {
        batches + SPARE_BATCHES
    }

    /// Number of times that the path is played, without light, to get `frames` frames for the calibration of the
    /// sensor.
    pub fn dark_rounds(&self, frames: u32) -> u32 {
        if frames == 0 { 0 } else { frames.div_ceil(self.dots) + 1 }
    }

    /// The path of one batch, with the light off where it goes into the beam dump.
    ///
    /// # Errors
    /// The first of the mirror's limits that the path would exceed.
    pub fn mirror_path(&self, limits: &MirrorLimits) -> Result<MirrorPath, PathError> {
        let path = self.path.path(limits)?;
        let (samples, dots) = (path.points().len() as u64, u64::from(self.dots));
        let dumped = |sample: usize| {
            let index = (sample as u64 * dots / samples) as u32;
            self.background_indices.contains(&index)
        };
        Ok(path.with_light(|sample| if dumped(sample) { 0 } else { 255 }))
    }
}

impl PathPlan {
    /// Checks only that the shape is valid. The mirror's limits are checked elsewhere; they are finite, so they also
    /// exclude infinite tilts.
    fn check(&self, document: &mut Document<'_>) {
        if !(self.rate_hz > 0.0 && self.rate_hz.is_finite()) {
            let message =
                format!("batches.path.rate_hz = {}: must be more than 0 samples per second", self.rate_hz);
            document.refuse(&["batches", "path", "rate_hz"], message);
        }
        if self.samples() == 0 {
            let (key, what) = match self.shape {
                Shape::Points => ("points_deg", "is empty: give tilts [x, y] in degrees"),
                _ => ("samples", "= 0: give at least 1 sample per batch"),
            };
            document.refuse(&["batches", "path", key], format!("batches.path.{key} {what}"));
        }
    }

    fn samples(&self) -> usize {
        if self.shape == Shape::Points { self.points_deg.len() } else { self.samples }
    }

    /// Duration of a batch.
    pub fn duration_s(&self) -> f64 {
        self.samples() as f64 / self.rate_hz
    }

    fn path(&self, limits: &MirrorLimits) -> Result<MirrorPath, PathError> {
        let [x_deg, y_deg] = self.amplitude_deg;
        let amplitude = Tilt::new(x_deg, y_deg);
        let (samples, rate_hz) = (self.samples, self.rate_hz);
        match self.shape {
            Shape::Raster => {
                let scan = RasterScan { amplitude, lines: self.lines, flyback: self.flyback };
                MirrorPath::raster(&scan, samples, rate_hz, limits)
            }
            Shape::Lissajous => MirrorPath::lissajous(amplitude, self.cycles, samples, rate_hz, limits),
            Shape::Spiral => MirrorPath::spiral(amplitude, self.turns, samples, rate_hz, limits),
            Shape::Points => {
                let point =
                    |&[x_deg, y_deg]: &[f64; 2]| MirrorPoint { tilt: Tilt::new(x_deg, y_deg), light: 255 };
                MirrorPath::new(self.points_deg.iter().map(point).collect(), rate_hz, limits)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ConfigError;
    use crate::plan::tests::documented;
    use crate::plan::{Plan, Procedure};

    fn parse(more: &str) -> Result<BatchesPlan, ConfigError> {
        let plan = Plan::parse(&format!("kind = \"batches\"\n{more}"))?;
        let Procedure::Batches(batches) = plan.procedure else { panic!("{plan:?}") };
        Ok(batches)
    }

    #[test]
    fn the_default_is_the_papers_scan_and_the_documented_one() {
        let plan = parse("").unwrap();
        assert!((plan.camera_rate_hz() - 13_500.0).abs() < 1e-9);
        assert_eq!((plan.total(), plan.plane_of(1), plan.plane_of(2)), (14, Some(0), None));
        assert_eq!(plan.trailing_index(), 2249);
        let documented = Plan::parse(documented("batches")).unwrap();
        assert_eq!(documented.procedure, Procedure::Batches(plan));
    }

    #[test]
    fn a_path_is_dark_where_its_light_would_be_background() {
        let plan = parse("[batches]\ndots = 100\nbackground_indices = [3]\n[batches.path]\nshape = \"lissajous\"\ncycles = [3, 2]\nsamples = 1000\nrate_hz = 10000").unwrap();
        let path = plan.mirror_path(&MirrorLimits::A7B2_3_3600AL).unwrap();
        let dark: Vec<usize> = (0..1000).filter(|&sample| path.points()[sample].light == 0).collect();
        assert_eq!(dark, (30..40).collect::<Vec<_>>());
    }

    #[test]
    fn a_path_beyond_the_mirrors_limits_is_none() {
        let plan = parse("[batches.path]\namplitude_deg = [9, 3]").unwrap();
        let error = plan.mirror_path(&MirrorLimits::A7B2_3_3600AL).unwrap_err();
        assert!(matches!(error, PathError::Tilt { .. }), "{error}");
    }
}
