//! `[response]`: the chirp by which a dot rig finds out how its mirror answers.

use raysweep_core::{MirrorLimits, MirrorPath, PathError, Tilt};
use raysweep_drivers::mirror::identify::chirp;
use serde::Deserialize;

use super::ConfigError;

/// `[response]`: one axis after the other plays a chirp about the origin while the camera follows the dot on a plane.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ResponsePlan {
    /// Where the chirp begins and ends: the resonances of both axes lie between.
    pub band_hz: [f64; 2],
    /// Its amplitude, mechanical.
    pub amplitude_deg: f64,
    /// The largest quality factor that an axis may have: it bounds how far the mirror moves at its resonance.
    pub max_q: f64,
    /// How long the chirp lasts.
    pub chirp_s: f64,
    /// How long the mirror stands at the origin after it, until the ringing has died down.
    pub rest_s: f64,
    /// Samples a second of the mirror.
    pub rate_hz: f64,
    /// Frames a second.
    pub camera_rate_hz: f64,
    /// Exposure of each frame.
    pub exposure_us: f64,
    /// Frames without light before the first chirp.
    pub dark_frames: u32,
    /// Where the dot is looked for: first row, row after the last, first column, column after the last; left out:
    /// everywhere.
    pub region: Option<[usize; 4]>,
}

impl Default for ResponsePlan {
    /// For Mirrorcle's A7B2.3-3600AL and the paper's camera.
    fn default() -> Self {
        Self {
            band_hz: [100.0, 900.0],
            amplitude_deg: 0.014,
            max_q: 100.0,
            chirp_s: 1.0,
            rest_s: 0.25,
            rate_hz: 39_000.0,
            camera_rate_hz: 13_500.0,
            exposure_us: 50.0,
            dark_frames: 256,
            region: None,
        }
    }
}

/// Samples, and frames, that a period of the band's upper end has at least: fewer would not show its movement.
const LEAST_A_PERIOD: f64 = 4.0;

impl ResponsePlan {
    pub(super) fn check(&self, text: &str) -> Result<(), ConfigError> {
        let refused = |key: &str, message: String| Err(ConfigError::at(text, &["response", key], message));
        let rules = [
            ("amplitude_deg", self.amplitude_deg, 1e-6, 45.0),
            ("max_q", self.max_q, 0.5, 1e5),
            ("chirp_s", self.chirp_s, 0.1, 60.0),
            ("rest_s", self.rest_s, 0.0, 60.0),
            ("rate_hz", self.rate_hz, 1.0, 1e6),
            ("camera_rate_hz", self.camera_rate_hz, 1.0, 1e6),
            ("exposure_us", self.exposure_us, 0.1, 1e6),
            ("dark_frames", self.dark_frames.into(), 16.0, 65_536.0),
        ];
        for (key, value, low, high) in rules {
            if !(low..=high).contains(&value) {
                return refused(key, format!("response.{key} = {value}: allowed is {low} to {high}"));
            }
        }
        let [low_hz, high_hz] = self.band_hz;
        let most_hz = self.camera_rate_hz.min(self.rate_hz) / LEAST_A_PERIOD;
        if !(low_hz > 0.0 && low_hz < high_hz && high_hz <= most_hz) {
            let message = format!(
                "response.band_hz = [{low_hz}, {high_hz}]: allowed is from above 0 to {most_hz}, low before high: a period needs {LEAST_A_PERIOD} frames (camera_rate_hz) and samples (rate_hz)"
            );
            return refused("band_hz", message);
        }
        if self.exposure_us * self.camera_rate_hz > 1e6 {
            let message = format!(
                "response.exposure_us = {}: longer than the {:.2} us from one frame to the next",
                self.exposure_us,
                1e6 / self.camera_rate_hz
            );
            return refused("exposure_us", message);
        }
        if let Some(region @ [top, bottom, left, right]) = self.region
            && (top >= bottom || left >= right)
        {
            let message = format!(
                "response.region = {region:?}: give [first row, row after the last, first column, column after the last]"
            );
            return refused("region", message);
        }
        Ok(())
    }

    /// The paths of both axes, x first, lit all the way.
    ///
    /// # Errors
    /// With the field, for a chirp that would take the mirror beyond its limits.
    pub fn paths(&self, limits: &MirrorLimits, text: &str) -> Result<[MirrorPath; 2], ConfigError> {
        let refused = |message| Err(ConfigError::at(text, &["response", "amplitude_deg"], message));
        let Self { amplitude_deg, max_q, band_hz: [low_hz, high_hz], .. } = *self;
        // Limits of paths hold for what is commanded; at its resonance the mirror moves Q times as far.
        let tilt_deg = amplitude_deg * max_q;
        if tilt_deg > limits.max_tilt.0 {
            return refused(format!(
                "response.amplitude_deg = {amplitude_deg}: with response.max_q = {max_q} the mirror may move by {tilt_deg} degrees at its resonance, {} are allowed (mirror.limits.max_tilt); make the amplitude smaller, or max_q if no axis has that",
                limits.max_tilt.0
            ));
        }
        let deg_per_s = tilt_deg * std::f64::consts::TAU * high_hz;
        if deg_per_s > limits.max_slew_deg_per_s {
            return refused(format!(
                "response.amplitude_deg = {amplitude_deg}: with response.max_q = {max_q} the mirror may move at {deg_per_s:.0} degrees/s at a resonance of {high_hz} Hz, {:.0} are allowed (mirror.limits.max_slew_deg_per_s); make the amplitude smaller, end band_hz lower, or make max_q smaller if no axis has that",
                limits.max_slew_deg_per_s
            ));
        }
        let tilts_deg = chirp(&(low_hz..=high_hz), amplitude_deg, self.chirp_s, self.rest_s, self.rate_hz);
        let path = |tilt: fn(f64) -> Tilt| {
            MirrorPath::through(tilts_deg.iter().map(|&deg| tilt(deg)), self.rate_hz, limits)
        };
        let both = path(|deg| Tilt::new(deg, 0.0)).and_then(|x| Ok([x, path(|deg| Tilt::new(0.0, deg))?]));
        both.map_err(|error| {
            let key = match error {
                PathError::Points { .. } => "chirp_s",
                _ => "amplitude_deg",
            };
            ConfigError::at(text, &["response", key], format!("response.{key}: {error}"))
        })
    }

    /// Time of one axis.
    pub fn duration_s(&self) -> f64 {
        self.chirp_s + self.rest_s
    }

    /// Frames of one axis whose exposures end within its path.
    pub fn frames(&self, path: &MirrorPath) -> usize {
        let duration_s = path.points().len() as f64 / path.rate_hz();
        // An exposure that ends with the path is within it, whatever rounding says.
        ((duration_s - self.exposure_us * 1e-6) * self.camera_rate_hz + 1e-6).floor() as usize + 1
    }

    /// What each frame's angle was commanded to be, in degrees: the mean of the path's samples over its exposure, each
    /// held until the next.
    pub fn commanded_deg(&self, path: &MirrorPath, axis: usize) -> Vec<f64> {
        let samples_per_frame = path.rate_hz() / self.camera_rate_hz;
        let exposure_samples = self.exposure_us * 1e-6 * path.rate_hz();
        let mean_deg = |frame: usize| {
            let begin = frame as f64 * samples_per_frame;
            let end = begin + exposure_samples;
            let held = (begin as u64..end.ceil() as u64).map(|sample| {
                let part = end.min(sample as f64 + 1.0) - begin.max(sample as f64);
                part * path.at(sample).tilt.deg()[axis]
            });
            held.sum::<f64>() / exposure_samples
        };
        (0..self.frames(path)).map(mean_deg).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Plan;

    const LIMITS: MirrorLimits = MirrorLimits::A7B2_3_3600AL;

    fn parse(more: &str) -> Result<ResponsePlan, ConfigError> {
        Plan::parse(&format!("kind = \"response\"\n{more}")).map(|plan| plan.response)
    }

    #[test]
    fn the_default_is_the_documented_one_and_a_path() {
        let plan = parse("").unwrap();
        let page = include_str!("../../../docs/reference/plan.md");
        let mut blocks = page.split("```toml\n").filter_map(|rest| rest.split("```").next());
        let documented = blocks.find(|block| block.contains("kind = \"response\"")).unwrap();
        assert_eq!(Plan::parse(documented).unwrap().response, plan);
        let [x, y] = plan.paths(&LIMITS, "").unwrap();
        assert_eq!(x.points().len(), 48_750);
        assert!(x.points().iter().all(|point| point.tilt.y.0 == 0.0 && point.light == 255));
        assert!(y.points().iter().all(|point| point.tilt.x.0 == 0.0));
    }

    #[test]
    fn a_frame_is_commanded_the_mean_over_its_exposure() {
        // 2.5 samples a frame, of which 2 are exposed.
        let plan =
            parse("[response]\nband_hz = [1, 2]\nrate_hz = 25\ncamera_rate_hz = 10\nexposure_us = 80000")
                .unwrap();
        let tilts = [0.0, 0.1, 0.2, 0.3, 0.2, 0.1, 0.0].map(|deg| Tilt::new(0.0, deg));
        let path = MirrorPath::through(tilts, 25.0, &LIMITS).unwrap();
        // Samples 0 and 1; half of 2, all of 3, half of 4; samples 5 and 6, with which the path ends.
        let expected = [0.05, 0.25, 0.05];
        let found = plan.commanded_deg(&path, 1);
        assert_eq!(found.len(), expected.len());
        assert!(
            found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-12),
            "{found:?}"
        );
        assert!(plan.commanded_deg(&path, 0).iter().all(|&deg| deg == 0.0));
    }

    #[test]
    fn a_chirp_that_would_take_the_mirror_beyond_its_limits_is_none() {
        let refused = |more: &str| {
            let text = format!("kind = \"response\"\n[response]\n{more}");
            let error = Plan::parse(&text).unwrap().response.paths(&LIMITS, &text).unwrap_err();
            (error.field.unwrap(), error.message)
        };
        for (more, field, expected) in [
            (
                "amplitude_deg = 0.014\nmax_q = 500",
                "response.amplitude_deg",
                "7 degrees at its resonance, 6.5",
            ),
            ("amplitude_deg = 0.015", "response.amplitude_deg", "max_slew_deg_per_s"),
            ("chirp_s = 4", "response.chirp_s", "131072"),
            // What limits hold for what is commanded: rms beyond the bandwidth of 200 Hz.
            ("amplitude_deg = 0.5\nmax_q = 2", "response.amplitude_deg", "above the bandwidth"),
        ] {
            let (found, message) = refused(more);
            assert!(found == field && message.contains(expected), "{more}: {found}: {message}");
        }
    }

    #[test]
    fn bad_plans_are_refused_with_field_and_place() {
        let cases = [
            ("[response]\nband_hz = [900, 100]", "low before high"),
            ("[response]\nband_hz = [0, 100]", "above 0"),
            ("[response]\ncamera_rate_hz = 3000\nexposure_us = 50", "to 750"),
            ("[response]\nrate_hz = 2000", "to 500"),
            ("[response]\namplitude_deg = 0", "amplitude_deg = 0"),
            ("[response]\nmax_q = nan", "max_q = NaN"),
            ("[response]\nchirp_s = 0", "chirp_s = 0"),
            ("[response]\nrest_s = -1", "rest_s = -1"),
            ("[response]\nexposure_us = 80", "longer than the 74.07 us"),
            ("[response]\ndark_frames = 3", "dark_frames = 3"),
            ("[response]\nregion = [4, 4, 0, 9]", "row after the last"),
            ("[response]\naxes = 1", "unknown field"),
            ("[[product]]\nkind = \"floodlit\"", "no [[product]]"),
            ("[batches]\ncount = 2", "[response]"),
        ];
        for (text, expected) in cases {
            let error = parse(text).unwrap_err();
            assert!(error.message.contains(expected), "{text:?}: {}", error.message);
            assert!(error.span.is_some(), "{text:?} has no place");
        }
    }
}
