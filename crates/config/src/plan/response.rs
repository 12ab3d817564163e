//! `[response]`: the chirp that identifies the response of a dot rig's mirror.

use serde::Deserialize;

use crate::document::Document;
use crate::whole::whole;

/// `[response]`: each axis in turn plays a chirp about the origin while the camera tracks the dot on a plane.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ResponsePlan {
    /// Start and end frequency of the chirp: the resonances of both axes lie between them.
    pub band_hz: [f64; 2],
    /// Mechanical amplitude of the chirp.
    pub amplitude_deg: f64,
    /// The largest quality factor that an axis may have: it limits how far the mirror moves at its resonance.
    pub max_q: f64,
    /// Duration of the chirp.
    pub chirp_s: f64,
    /// How long the mirror rests at the origin afterwards, until the ringing has died down.
    pub rest_s: f64,
    /// Samples per second of the mirror.
    pub rate_hz: f64,
    /// Frames per second.
    pub camera_rate_hz: f64,
    /// Exposure of each frame.
    pub exposure_us: f64,
    /// Frames without light before the first chirp.
    #[serde(deserialize_with = "whole::<_, 16, 65_536>")]
    pub dark_frames: u32,
    /// Region to search for the dot: first row, row after the last, first column, column after the last; default:
    /// everywhere.
    pub region: Option<[usize; 4]>,
}

impl Default for ResponsePlan {
    /// Values for Mirrorcle's A7B2.3-3600AL and the paper's camera.
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

/// Minimum number of samples, and of frames, per period at the band's upper end: fewer would not resolve the
/// movement.
const LEAST_A_PERIOD: f64 = 4.0;

impl ResponsePlan {
    pub(super) fn check(&self, document: &mut Document<'_>) {
        let rules = [
            ("amplitude_deg", self.amplitude_deg, 1e-6..=45.0),
            ("max_q", self.max_q, 0.5..=1e5),
            ("chirp_s", self.chirp_s, 0.1..=60.0),
            ("rest_s", self.rest_s, 0.0..=60.0),
            ("rate_hz", self.rate_hz, 1.0..=1e6),
            ("camera_rate_hz", self.camera_rate_hz, 1.0..=1e6),
            ("exposure_us", self.exposure_us, 0.1..=1e6),
            ("dark_frames", self.dark_frames.into(), 16.0..=65_536.0),
        ];
        for (key, value, allowed) in rules {
            document.check_range(&["response", key], value, allowed);
        }
        let [low_hz, high_hz] = self.band_hz;
        let most_hz = self.camera_rate_hz.min(self.rate_hz) / LEAST_A_PERIOD;
        if !(low_hz > 0.0 && low_hz < high_hz && high_hz <= most_hz) {
            let message = format!(
                "response.band_hz = [{low_hz}, {high_hz}]: must be [low, high] with 0 < low < high <= {most_hz}, because a period needs at least {LEAST_A_PERIOD} frames (camera_rate_hz) and samples (rate_hz)"
            );
            document.refuse(&["response", "band_hz"], message);
        }
        if self.exposure_us * self.camera_rate_hz > 1e6 {
            let message = format!(
                "response.exposure_us = {}: must be at most the {:.2} us from one frame to the next",
                self.exposure_us,
                1e6 / self.camera_rate_hz
            );
            document.refuse(&["response", "exposure_us"], message);
        }
        if let Some(region @ [top, bottom, left, right]) = self.region
            && (top >= bottom || left >= right)
        {
            let message = format!(
                "response.region = {region:?}: give [first row, row after the last, first column, column after the last]"
            );
            document.refuse(&["response", "region"], message);
        }
    }

    /// Duration of one axis.
    pub fn duration_s(&self) -> f64 {
        self.chirp_s + self.rest_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::documented;
    use crate::plan::{Plan, Procedure};

    #[test]
    fn the_default_is_the_documented_one() {
        let documented = Plan::parse(documented("response")).unwrap();
        assert_eq!(documented.procedure, Procedure::Response(ResponsePlan::default()));
    }
}
