//! Predicts the error of a plan's settings on this rig, and searches for better ones: for sweeps and films alike.

use raysweep_config::RigFile;
use raysweep_config::rig::plane::NoiseOrigin;
use raysweep_core::CameraCapabilities;
use raysweep_pipeline::{DemuxFold, Point, PointRole, SpotCut, prior_name};
use raysweep_processing::plane::PlaneTask;
use raysweep_proto::{
    BetterPlan, DesignParams, DesignReport, ErrorCode, ErrorRange, ExpectedError, NoiseEstimate, NoiseSource,
    PlanAdvice, RigAccuracy, RpcError,
};
use raysweep_transport::plane::advice::{
    Arrangement, Calibrated, Conditions, Design, Noise, PredictedError, Proposal, Search, Spread, Usable,
    sees_own_row, white_light,
};
use raysweep_transport::plane::board::CalibrationParameter;
use raysweep_transport::plane::{Demux, PlaneError, Setting};

use super::foresight::periods;

/// A task whose settings can be searched.
pub trait Searched: Clone + Sync {
    /// How its settings are arranged.
    const ARRANGEMENT: Arrangement;

    /// Its points and model.
    fn task(&self) -> &PlaneTask;

    /// Its settings.
    fn design(&self) -> Design;

    /// The same task with other settings, if the plan allows them.
    fn with_design(&self, design: &Design) -> Option<Self>;

    /// Its tables in a plan.
    fn to_toml(&self) -> String;

    /// VSYNC periods that its settings take; for a film, those of one cycle.
    fn periods(&self, camera: &CameraCapabilities) -> u64 {
        let task = self.task();
        task.settings().map(|(_, point)| periods(task, camera, point) * u64::from(point.frames)).sum()
    }
}

/// Why no advice is possible.
#[derive(Debug, thiserror::Error)]
pub enum NoAdvice {
    /// Nothing is left to demultiplex.
    #[error(
        "the errors cannot be predicted: every setting that sees a pixel's own row saturates where that is white and lit by its surroundings, or begins or ends while a flying spot draws it; scenes without such pixels are measured all the same, and under a flying spot, move the delays by a few rows"
    )]
    NothingUsable,
    /// The prediction would take too long.
    #[error(
        "the errors are not predicted, and no better settings are sought: {points} settings over {rows} relative rows would take too long"
    )]
    TooLarge {
        /// Settings of the plan.
        points: usize,
        /// Relative rows that they reach.
        rows: usize,
    },
    /// The plan gives no model.
    #[error("the errors cannot be predicted: {0}")]
    NoModel(String),
    /// A wanted value makes no sense.
    #[error("{0}")]
    Wanted(String),
}

impl From<PlaneError> for NoAdvice {
    fn from(error: PlaneError) -> Self {
        match error {
            PlaneError::NoDelays { .. } => Self::NothingUsable,
            error => Self::NoModel(error.to_string()),
        }
    }
}

impl From<NoAdvice> for RpcError {
    fn from(error: NoAdvice) -> Self {
        let code = match error {
            NoAdvice::Wanted(_) => ErrorCode::InvalidParams,
            _ => ErrorCode::InvalidPlan,
        };
        Self::new(code, error.to_string())
    }
}

/// Limit of the work per predicted error in multiplications, (settings + rows) rows^2; some dozens of them take about
/// a second.
const MAX_WORK: f64 = 1e9;

/// What a rig without a calibration is taken to be known to: what the search for better settings would want of one.
const ASSUMED: Calibrated = Calibrated { latency_us: 0.3, edge_us: 0.5, exposure_us: 0.1, place_rows: 0.02 };
/// To what a sweep finds the latency from its own images.
const REFINED_LATENCY_US: f64 = 0.3;

/// Standard deviation with which a calibrated rig knows the edges of a single frame: what VSYNC stamps leave, unless a
/// strip of the board in view shows each of them.
pub fn edge_us(jitter_us: f64, has_strip: bool) -> f64 {
    if has_strip { jitter_us.min(ASSUMED.edge_us) } else { jitter_us }
}

/// How well a task's rig is known: as its calibration says, if it has one.
fn known<T: Searched>(of: &T) -> Calibrated {
    let Some(calibration) = &of.task().geometry.calibration else { return ASSUMED };
    let sd = |parameter| calibration.covariance.sd(parameter);
    let latency_us = sd(CalibrationParameter::Latency);
    Calibrated {
        latency_us: match T::ARRANGEMENT {
            Arrangement::Sweep => latency_us.min(REFINED_LATENCY_US),
            Arrangement::Film => latency_us,
        },
        edge_us: edge_us(calibration.jitter_us, calibration.strip.is_some()),
        exposure_us: sd(CalibrationParameter::ExposureOffset),
        place_rows: sd(CalibrationParameter::Place),
    }
}

/// To what share settings must lower the errors of typical and of hard scenes alike to be proposed in place of those that
/// were chosen for the calibration, which nobody asked to replace.
const CLEARLY: f64 = 0.75;

fn is_clearly_better(proposed: &PredictedError, chosen: &PredictedError) -> bool {
    let errors = [(proposed.total.median, chosen.total.median), (proposed.total.high, chosen.total.high)];
    errors.into_iter().all(|(proposed, chosen)| proposed <= CLEARLY * chosen)
}

/// Predicts the error of `planned`, and searches for better settings that take no more frames and no more time: clearly
/// better ones if those of the plan were chosen for the calibration.
///
/// # Errors
/// If no error can be predicted.
pub fn advise<T: Searched>(
    planned: &T,
    is_chosen: bool,
    rig: &RigFile,
    camera: &CameraCapabilities,
) -> Result<PlanAdvice, NoAdvice> {
    let adviser = Adviser::new(planned, rig, camera)?;
    let (most_frames, most_periods) = (total_frames(planned), adviser.total_periods(planned));
    let search = adviser.search(known(planned), |other: &T| {
        total_frames(other) <= most_frames && adviser.total_periods(other) <= most_periods
    });
    let advice = search.advise()?;
    let better =
        advice.better.filter(|better| !is_chosen || is_clearly_better(&better.foreseen, &advice.expected));
    let better = better.and_then(|Proposal { design, foreseen }| {
        let other = planned.with_design(&design)?;
        Some(BetterPlan {
            points: design.settings().len(),
            frames: total_frames(&other),
            expected: told(&foreseen),
            table: other.to_toml(),
        })
    });
    let Noise { read, gain, .. } = adviser.noise(planned, 1);
    let source = match rig.noise().source {
        _ if planned.task().geometry.calibration.is_some() => NoiseSource::Calibrated,
        NoiseOrigin::Stated => NoiseSource::Stated,
        NoiseOrigin::Simulated => NoiseSource::Simulated,
        NoiseOrigin::Assumed => NoiseSource::Assumed,
    };
    let Calibrated { latency_us, edge_us, exposure_us, place_rows } = known(planned);
    let calibrated = planned.task().geometry.calibration.is_some();
    Ok(PlanAdvice {
        rig: RigAccuracy { calibrated, latency_us, edge_us, exposure_us, place_rows },
        noise: NoiseEstimate { dark: read, shot: gain.sqrt(), source },
        prior: prior_name(adviser.demux.prior()),
        expected: told(&advice.expected),
        better,
    })
}

/// Searches the settings of `planned` for the wanted error or time of light. The plan in the report consists of the
/// tables of the settings alone.
///
/// # Errors
/// If no error can be predicted, or the camera can take none of the settings.
pub fn design<T: Searched>(
    planned: &T,
    rig: &RigFile,
    camera: &CameraCapabilities,
    params: &DesignParams,
) -> Result<DesignReport, NoAdvice> {
    let adviser = Adviser::new(planned, rig, camera)?;
    let period_s = planned.task().geometry.raster.period_us * 1e-6;
    let edge_us = positive("edge_us", params.edge_us)?.unwrap_or(known(planned).edge_us);
    let calibrated = Calibrated { edge_us, ..known(planned) };
    let wanted = (positive("error", params.error)?, positive("light_s", params.light_s)?);
    let found = match wanted {
        (Some(error), None) => adviser.search(calibrated, |_| true).of_error(error)?,
        (None, Some(light_s)) => {
            let most_periods = (light_s / period_s * (1.0 + 1e-9)).floor();
            let settings = planned.design().total_frames() as f64;
            let frames = most_periods * settings / planned.periods(camera) as f64;
            let search = adviser.search(calibrated, |other: &T| other.periods(camera) as f64 <= most_periods);
            // Other settings may take a few periods more for each frame than the plan's.
            let tried =
                (0..=SPARED_FRAMES).map(|spared| frames.floor() as usize - spared.min(frames as usize));
            let mut found = None;
            for frames in tried {
                found = search.of_frames(frames)?;
                if found.is_some() {
                    break;
                }
            }
            found
        }
        _ => {
            let what = "give either error or light_s: what the settings are searched for";
            return Err(NoAdvice::Wanted(what.into()));
        }
    };
    let none = || {
        NoAdvice::Wanted("this camera cannot take any of the settings that were tried in this time: give more light, or another range of delays".into())
    };
    let Proposal { design, foreseen } = found.ok_or_else(none)?;
    let other = planned.with_design(&design).ok_or_else(none)?;
    Ok(DesignReport {
        points: design.settings().len(),
        frames: design.total_frames() as u64,
        light_s: other.periods(camera) as f64 * period_s,
        expected: told(&foreseen),
        plan: other.to_toml(),
        warnings: warnings(&foreseen, params.error, edge_us)
            .into_iter()
            .chain(planned.task().geometry.calibration.is_none().then(|| UNCALIBRATED.to_owned()))
            .collect(),
    })
}

/// What a design for a rig without a calibration is good for.
const UNCALIBRATED: &str = "the rig is not calibrated: the error assumes that its file is right to 0.3 us and 0.02 row; run `raysweep calibrate` first";

/// Fewer frames that are tried where those of the wanted time do not fit.
const SPARED_FRAMES: usize = 3;

/// If counting |u| <= 2 as one band lowers the error below this share, the division of the band is what errs.
const BAND_SHARE: f64 = 0.5;

fn warnings(foreseen: &PredictedError, wanted: Option<f64>, edge_us: f64) -> Vec<String> {
    let (total, band) = (foreseen.total.median, foreseen.band.median);
    let mut warnings = Vec::new();
    if let Some(wanted) = wanted.filter(|wanted| total > *wanted) {
        warnings.push(format!(
            "an error of {wanted} is not reached: {total:.3} is the best that was found; collect more light per frame, or know the edges better than to {edge_us} us"
        ));
    }
    if band < BAND_SHARE * total {
        warnings.push(format!(
            "these settings do not tell the rows next to the pixel's own apart: take |u| <= 2 as one band (width_rows = 5), whose error is {band:.3}"
        ));
    }
    warnings
}

fn positive(field: &str, value: Option<f64>) -> Result<Option<f64>, NoAdvice> {
    match value {
        Some(value) if !(value.is_finite() && value > 0.0) => {
            Err(NoAdvice::Wanted(format!("{field} = {value}: must be more than 0")))
        }
        value => Ok(value),
    }
}

/// What predictions on a rig are based on.
struct Adviser<'a, T> {
    planned: &'a T,
    rig: &'a RigFile,
    camera: &'a CameraCapabilities,
    demux: Demux,
    /// Light at which a pixel saturates, in white units.
    ceiling: f64,
    /// Share of the plan's settings that saturate a white pixel.
    saturated: f64,
}

impl<'a, T: Searched> Adviser<'a, T> {
    fn new(planned: &'a T, rig: &'a RigFile, camera: &'a CameraCapabilities) -> Result<Self, NoAdvice> {
        let task = planned.task();
        let no_model = |error: &dyn std::fmt::Display| NoAdvice::NoModel(error.to_string());
        let options = task.demux_options().map_err(|error| no_model(&error))?;
        let demux = DemuxFold::new(options, &task.schedule, &task.geometry)
            .map_err(|error| no_model(&error))?
            .demux()?;
        let (points, rows) = (task.settings().count(), demux.reach().count());
        if (points + rows) as f64 * (rows as f64).powi(2) > MAX_WORK {
            return Err(NoAdvice::TooLarge { points, rows });
        }
        let ceiling = (task.geometry.saturation_dn - rig.camera.black_dn()) / task.geometry.white_dn;
        let mut adviser = Self { planned, rig, camera, demux, ceiling, saturated: 0.0 };
        adviser.saturated = adviser.saturated_share(&planned.design().settings());
        Ok(adviser)
    }

    fn search(
        &self,
        calibrated: Calibrated,
        is_allowed: impl Fn(&T) -> bool + Sync,
    ) -> Search<'_, impl Fn(&Design) -> Option<Usable> + Sync> {
        let conditions = Conditions { timing: self.demux.timing(), prior: self.demux.prior(), calibrated };
        let usable = move |design: &Design| {
            let other = self.planned.with_design(design).filter(|other| is_allowed(other))?;
            self.usable(&other, design)
        };
        Search { conditions, arrangement: T::ARRANGEMENT, plan: self.planned.design(), usable }
    }

    /// The settings of a design whose images are usable; `None` if the camera cannot take it, or a larger share of
    /// its settings saturates than of the plan's.
    fn usable(&self, other: &T, design: &Design) -> Option<Usable> {
        let task = other.task();
        let takes = |point: &Point| {
            let shot = task.geometry.shot(point, self.camera.trigger_latency_us);
            self.camera.allows(&shot.settings).is_ok()
        };
        let mut settings = design.settings();
        if !task.schedule.points.iter().all(takes) || self.saturated_share(&settings) > self.saturated {
            return None;
        }
        let timing = self.demux.timing();
        let cut = SpotCut::of(&task.geometry, timing, &settings).ok()?;
        if cut == SpotCut::Everywhere {
            settings.clear();
        }
        let mut index = 0..;
        settings
            .retain(|setting| index.next().is_some_and(|index| cut.keeps(index)) && !self.saturates(setting));
        // All direct light would be error, though pixels that are darker than white are measured.
        let planned = design.settings();
        let sees_direct = |settings: &[Setting]| settings.iter().any(|setting| sees_own_row(timing, setting));
        if settings.len() < planned.len() && sees_direct(&planned) && !sees_direct(&settings) {
            settings.clear();
        }
        Some(Usable { settings, noise: self.noise(other, design.frames) })
    }

    fn saturates(&self, setting: &Setting) -> bool {
        white_light(self.demux.timing(), setting) >= self.ceiling
    }

    fn saturated_share(&self, settings: &[Setting]) -> f64 {
        let saturated = settings.iter().filter(|setting| self.saturates(setting)).count();
        saturated as f64 / settings.len() as f64
    }

    /// The noise of a task's images.
    fn noise(&self, of: &T, frames: u32) -> Noise {
        let geometry = &of.task().geometry;
        let (read, gain) = match &geometry.calibration {
            Some(calibration) => (calibration.noise.read_variance.sqrt(), calibration.noise.gain),
            None => {
                let (known, white_dn) = (self.rig.noise(), geometry.white_dn);
                let gain = 1.0 / (white_dn * known.electrons_per_dn);
                // Rounding to counts adds a variance of 1/12 count^2, which measured noise contains.
                ((known.read_noise_e * gain).hypot(12_f64.sqrt().recip() / white_dn), gain)
            }
        };
        let dark = unlit(of).find(|point| matches!(point.role, PointRole::Dark(_)));
        Noise { read, gain, frames, dark_frames: dark.map(|point| point.frames) }
    }

    /// VSYNC periods of all points.
    fn total_periods(&self, of: &T) -> u64 {
        let frames = |point: &Point| periods(of.task(), self.camera, point) * u64::from(point.frames);
        unlit(of).map(frames).sum::<u64>() + of.periods(self.camera)
    }
}

/// The dark points and the regular one.
fn unlit<T: Searched>(of: &T) -> impl Iterator<Item = &Point> {
    of.task().schedule.points.iter().filter(|point| !matches!(point.role, PointRole::Sweep(_)))
}

/// Frames of all points of a task.
fn total_frames<T: Searched>(of: &T) -> u64 {
    of.task().schedule.points.iter().map(|point| u64::from(point.frames)).sum()
}

fn told(foreseen: &PredictedError) -> ExpectedError {
    let range = |Spread { low, median, high }: Spread| ErrorRange { low, median, high };
    ExpectedError {
        total: range(foreseen.total),
        noise: range(foreseen.noise),
        bias: range(foreseen.bias),
        calibration: range(foreseen.calibration),
        band: range(foreseen.band),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clearly_better_settings_suit_typical_and_hard_scenes_alike() {
        let errors = |median, high| {
            let total = Spread { low: 0.01, median, high };
            PredictedError { total, noise: total, bias: total, calibration: total, band: total }
        };
        let chosen = errors(0.04, 0.4);
        assert!(is_clearly_better(&errors(0.029, 0.29), &chosen));
        for other in [errors(0.031, 0.29), errors(0.029, 0.31), errors(0.01, 0.4), errors(0.04, 0.1)] {
            assert!(!is_clearly_better(&other, &chosen), "{other:?}");
        }
    }
}
