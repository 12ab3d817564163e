//! The chirp: the mirror path, and the commanded angle of each frame.

use raysweep_config::ResponsePlan;
use raysweep_core::{MirrorLimits, MirrorPath, PathError, Tilt};
use raysweep_transport::dots::identify::chirp;

/// The paths of both axes, x first, with the light always on.
///
/// # Errors
/// The key of `[response]` and what is wrong, for a chirp that would take the mirror beyond its limits.
pub fn paths(plan: &ResponsePlan, limits: &MirrorLimits) -> Result<[MirrorPath; 2], (&'static str, String)> {
    let refused = |message| Err(("amplitude_deg", message));
    let ResponsePlan { amplitude_deg, max_q, band_hz: [low_hz, high_hz], .. } = *plan;
    // Path limits apply to the command; at its resonance the mirror moves Q times as far.
    let tilt_deg = amplitude_deg * max_q;
    if tilt_deg > limits.max_tilt.0 {
        return refused(format!(
            "response.amplitude_deg = {amplitude_deg}: with response.max_q = {max_q} the mirror may tilt by {tilt_deg} degrees at its resonance, but at most {} are allowed (mirror.limits.max_tilt): lower amplitude_deg, or max_q if no axis has such a resonance",
            limits.max_tilt.0
        ));
    }
    let deg_per_s = tilt_deg * std::f64::consts::TAU * high_hz;
    if deg_per_s > limits.max_slew_deg_per_s {
        return refused(format!(
            "response.amplitude_deg = {amplitude_deg}: with response.max_q = {max_q} the mirror may move at {deg_per_s:.0} degrees/s at a resonance of {high_hz} Hz, but at most {:.0} are allowed (mirror.limits.max_slew_deg_per_s): lower amplitude_deg or the end of band_hz, or max_q if no axis has such a resonance",
            limits.max_slew_deg_per_s
        ));
    }
    let tilts_deg = chirp(&(low_hz..=high_hz), amplitude_deg, plan.chirp_s, plan.rest_s, plan.rate_hz);
    let path = |tilt: fn(f64) -> Tilt| {
        MirrorPath::through(tilts_deg.iter().map(|&deg| tilt(deg)), plan.rate_hz, limits)
    };
    let both = path(|deg| Tilt::new(deg, 0.0)).and_then(|x| Ok([x, path(|deg| Tilt::new(0.0, deg))?]));
    both.map_err(|error| {
        let key = match error {
            PathError::Points { .. } => "chirp_s",
            _ => "amplitude_deg",
        };
        (key, format!("response.{key}: {error}"))
    })
}

/// Number of frames of one axis whose exposures end within its path.
pub fn frames(plan: &ResponsePlan, path: &MirrorPath) -> usize {
    let duration_s = path.points().len() as f64 / path.rate_hz();
    // An exposure that ends exactly with the path must count, despite rounding.
    ((duration_s - plan.exposure_us * 1e-6) * plan.camera_rate_hz + 1e-6).floor() as usize + 1
}

/// The commanded angle of each frame, in degrees: the mean of the path's samples over its exposure, each held until
/// the next.
pub fn commanded_deg(plan: &ResponsePlan, path: &MirrorPath, axis: usize) -> Vec<f64> {
    let samples_per_frame = path.rate_hz() / plan.camera_rate_hz;
    let exposure_samples = plan.exposure_us * 1e-6 * path.rate_hz();
    let mean_deg = |frame: usize| {
        let begin = frame as f64 * samples_per_frame;
        let end = begin + exposure_samples;
        let held = (begin as u64..end.ceil() as u64).map(|sample| {
            let part = end.min(sample as f64 + 1.0) - begin.max(sample as f64);
            part * path.at(sample).tilt.deg()[axis]
        });
        held.sum::<f64>() / exposure_samples
    };
    (0..frames(plan, path)).map(mean_deg).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use raysweep_config::{ConfigError, Plan, Procedure};

    const LIMITS: MirrorLimits = MirrorLimits::A7B2_3_3600AL;

    fn parse(more: &str) -> Result<ResponsePlan, ConfigError> {
        let plan = Plan::parse(&format!("kind = \"response\"\n{more}"))?;
        let Procedure::Response(response) = plan.procedure else { panic!("{plan:?}") };
        Ok(response)
    }

    #[test]
    fn the_default_is_a_path() {
        let plan = parse("").unwrap();
        let [x, y] = paths(&plan, &LIMITS).unwrap();
        assert_eq!(x.points().len(), 48_750);
        assert!(x.points().iter().all(|point| point.tilt.y.0 == 0.0 && point.light == 255));
        assert!(y.points().iter().all(|point| point.tilt.x.0 == 0.0));
    }

    #[test]
    fn a_frame_is_commanded_the_mean_over_its_exposure() {
        // 2.5 samples per frame, of which 2 are exposed.
        let plan =
            parse("[response]\nband_hz = [1, 2]\nrate_hz = 25\ncamera_rate_hz = 10\nexposure_us = 80000")
                .unwrap();
        let tilts = [0.0, 0.1, 0.2, 0.3, 0.2, 0.1, 0.0].map(|deg| Tilt::new(0.0, deg));
        let path = MirrorPath::through(tilts, 25.0, &LIMITS).unwrap();
        // Samples 0 and 1; half of 2, all of 3, half of 4; samples 5 and 6, with which the path ends.
        let expected = [0.05, 0.25, 0.05];
        let found = commanded_deg(&plan, &path, 1);
        assert_eq!(found.len(), expected.len());
        assert!(
            found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-12),
            "{found:?}"
        );
        assert!(commanded_deg(&plan, &path, 0).iter().all(|&deg| deg == 0.0));
    }

    #[test]
    fn a_chirp_that_would_take_the_mirror_beyond_its_limits_is_none() {
        let refused = |more: &str| {
            let plan = parse(&format!("[response]\n{more}")).unwrap();
            let (field, message) = paths(&plan, &LIMITS).unwrap_err();
            format!("{field}: {message}\n\n")
        };
        let refusals = [
            "amplitude_deg = 0.014\nmax_q = 500",
            "amplitude_deg = 0.015",
            "chirp_s = 4",
            // This limit applies to the command: rms beyond the bandwidth of 200 Hz.
            "amplitude_deg = 0.5\nmax_q = 2",
        ];
        insta::assert_snapshot!(refusals.map(refused).concat());
    }
}
