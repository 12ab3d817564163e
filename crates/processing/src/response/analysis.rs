//! Identifies the resonance of an axis from its record.

use raysweep_config::ResponsePlan;
use raysweep_session::ledger::State;
use raysweep_session::{Result, Session};
use raysweep_transport::dots::identify::{
    Identified, IdentifyError, Transfer, direction, identify, transfer,
};
use serde_json::{Map, Value, json};

use super::record::Record;
use super::task::AXES;
use crate::software::SOFTWARE;

/// Share of the frames that must show the dot; the others are interpolated linearly.
const LEAST_SHOWN: f64 = 0.9;

/// Why the response of an axis is not known.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ResponseError {
    /// Too few frames show the dot.
    #[error(
        "axis {axis}: the dot is visible in {shown} of the {frames} frames of its chirp, but {needed} are needed; {lost} frames were lost. Check that the plane is in front of the camera, the light is on, response.exposure_us is long enough, response.region contains the dot, and the camera keeps up"
    )]
    Unseen {
        /// Name of the axis.
        axis: &'static str,
        /// Frames that show the dot.
        shown: usize,
        /// Frames of the chirp.
        frames: usize,
        /// Frames that must show the dot.
        needed: usize,
        /// Frames that were lost.
        lost: usize,
    },
    /// The dot's movement shows no resonance.
    #[error("axis {axis} (its chirp moved the dot by {rms_px:.3} px rms): {source}")]
    Refused {
        /// Name of the axis.
        axis: &'static str,
        /// Root mean square of the dot's movement.
        rms_px: f64,
        /// Why the fit was refused.
        source: IdentifyError,
    },
}

/// Results of an axis.
pub struct FoundAxis {
    /// Its resonance, or why it could not be identified; the gain is in pixels per degree.
    pub found: std::result::Result<Identified, ResponseError>,
    /// Measured transfer function, without a model, in pixels per degree; empty where too few frames show the dot.
    pub measured: Vec<Transfer>,
}

/// Identifies an axis' resonance from its record.
///
/// # Errors
/// None at present: why an axis could not be identified is in [`FoundAxis::found`].
pub fn analyse(record: Record, axis: usize, state: &State, plan: &ResponsePlan) -> Result<FoundAxis> {
    let name = AXES[axis];
    let lost = state.axes().find(|entry| entry.axis == axis).map_or(0, |entry| entry.lost);
    let (frames, gaps) = (record.commanded_deg.len(), record.gaps());
    let shown = frames - gaps.iter().map(ExactSizeIterator::len).sum::<usize>();
    let needed = (LEAST_SHOWN * frames as f64).ceil() as usize;
    if shown < needed {
        let found = Err(ResponseError::Unseen { axis: name, shown, frames, needed, lost });
        return Ok(FoundAxis { found, measured: Vec::new() });
    }
    let band = plan.band_hz[0]..=plan.band_hz[1];
    let rate_hz = plan.camera_rate_hz;
    let Record { commanded_deg, mut track_px } = record;
    for track in &mut track_px {
        for gap in &gaps {
            bridge(track, gap.clone());
        }
        level(track);
    }
    let [down, right] = direction([&track_px[0], &track_px[1]], rate_hz, &band);
    let along_px: Vec<f64> =
        track_px[0].iter().zip(&track_px[1]).map(|(row, column)| down * row + right * column).collect();
    let rms_px = (along_px.iter().map(|px| px * px).sum::<f64>() / frames as f64).sqrt();
    let found = identify(&commanded_deg, &along_px, rate_hz, &band)
        .map_err(|source| ResponseError::Refused { axis: name, rms_px, source });
    let measured = transfer(&commanded_deg, &along_px, rate_hz, &band).unwrap_or_default();
    Ok(FoundAxis { found, measured })
}

/// Interpolates linearly over a gap; at an end of the track, repeats the nearest value.
fn bridge(track: &mut [f64], gap: std::ops::Range<usize>) {
    let before = gap.start.checked_sub(1).map(|at| track[at]);
    let after = track.get(gap.end).copied();
    let (Some(first), Some(last)) = (before.or(after), after.or(before)) else { return };
    let steps = (gap.len() + 1) as f64;
    for (step, value) in track[gap].iter_mut().enumerate() {
        *value = first + (last - first) * (step + 1) as f64 / steps;
    }
}

/// Subtracts the straight line that fits best: the rest position and drift.
fn level(track: &mut [f64]) {
    let count = track.len() as f64;
    let middle = (count - 1.0) / 2.0;
    let mean = track.iter().sum::<f64>() / count;
    let (mut product, mut square) = (0.0, 0.0);
    for (at, value) in track.iter().enumerate() {
        let from_middle = at as f64 - middle;
        product += from_middle * (value - mean);
        square += from_middle * from_middle;
    }
    let slope = if square > 0.0 { product / square } else { 0.0 };
    for (at, value) in track.iter_mut().enumerate() {
        *value -= mean + slope * (at as f64 - middle);
    }
}

impl FoundAxis {
    /// The fitted model at the measured frequencies, if there is one.
    pub fn fitted(&self) -> Vec<Transfer> {
        let Ok(found) = &self.found else { return Vec::new() };
        self.measured.iter().map(|measured| found.at(measured.hz)).collect()
    }

    /// A warning for the operator about an identified resonance.
    pub fn warning(&self, name: &str) -> Option<String> {
        let [low_hz, high_hz] = self.found.as_ref().ok()?.band_hz;
        let is_narrowed = self.measured.first().is_some_and(|lowest| low_hz > lowest.hz);
        is_narrowed.then(|| {
            format!(
                "axis {name}: a resonance explains the movement only from {low_hz:.0} to {high_hz:.0} Hz; elsewhere a low-pass, such as the controller's, changes it. Predistorted paths compensate for the resonance only: set the controller's bandwidth above it"
            )
        })
    }

    /// Writes the table `response_x` or `response_y` among the session's products, if there is a spectrum.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn write_spectrum(&self, session: &Session, name: &str) -> Result<()> {
        if self.measured.is_empty() {
            return Ok(());
        }
        let column = |of: &[Transfer], value: fn(&Transfer) -> f64| of.iter().map(value).collect();
        let mut columns = vec![
            ("hz", column(&self.measured, |at| at.hz)),
            ("amplitude", column(&self.measured, |at| at.amplitude)),
            ("phase_rad", column(&self.measured, |at| at.phase_rad)),
        ];
        if self.found.is_ok() {
            let fitted = self.fitted();
            columns.push(("fitted_amplitude", column(&fitted, |at| at.amplitude)));
            columns.push(("fitted_phase_rad", column(&fitted, |at| at.phase_rad)));
        }
        let about = "the dot's movement over the commanded tilt, in pixels per degree of the mirror; phases are those of the movement";
        let entries = [("about", json!(about)), ("axis", json!(name)), ("software", json!(SOFTWARE))];
        let metadata: Map<String, Value> =
            entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
        session.products().table(&format!("response_{name}"), &columns, &metadata)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_bridged_and_lines_taken_away() {
        let mut record = Record::new(vec![0.0; 7]);
        for (frame, row) in [(1, 3.0), (2, 5.0), (5, 11.0)] {
            record.note(frame, [row, 0.0]);
        }
        assert_eq!(record.gaps(), [0..1, 3..5, 6..7]);
        let mut track = record.track_px[0].clone();
        record.gaps().into_iter().for_each(|gap| bridge(&mut track, gap));
        assert_eq!(track, [3.0, 3.0, 5.0, 7.0, 9.0, 11.0, 11.0]);
        let mut line = [1.0, 3.0, 5.0, 7.0];
        level(&mut line);
        assert!(line.iter().all(|value: &f64| value.abs() < 1e-12), "{line:?}");
    }
}
