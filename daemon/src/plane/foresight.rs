//! Predicts a plan's run on a plane rig, as far as that is independent of the procedure.

use raysweep_config::ConfigError;
use raysweep_core::CameraCapabilities;
use raysweep_pipeline::{DemuxFold, FilmSolver, Point, PointRole, SpotCut};
use raysweep_processing::plane::PlaneTask;
use raysweep_transport::plane::Setting;
use raysweep_transport::plane::board::FlickeringLamp;
use raysweep_transport::plane::calibrate::{averaged_share, can_be_followed, cancelling_frames};

/// Condition number from which on noise is amplified more than the prior can compensate.
const ILL_CONDITIONED: f64 = 1e9;

/// Flicker with a smaller amplitude is lost in the noise of a mean, of white in a row's time.
const LEAST_FLICKER: f64 = 0.0001;

/// The model that a task's points give on its rig.
pub struct Model {
    /// First and last relative row whose light can be distinguished.
    pub reach_rows: (i32, i32),
    /// Condition number of the system that is solved for a pixel in the middle of the frame.
    pub condition: f64,
    /// VSYNC periods per frame, for each point.
    pub periods: Vec<u64>,
    /// The settings that a flying spot makes unreliable, by their planned delays.
    cut: SpotCut,
}

impl Model {
    /// The model of a task whose points are in this table of the plan.
    ///
    /// # Errors
    /// When the points give no model on this rig, or exceed what the camera can do.
    pub fn of(task: &PlaneTask, camera: &CameraCapabilities, table: &str) -> Result<Self, ConfigError> {
        let no_model = |message: String| task.refuse(&[table], message);
        let geometry = &task.geometry;
        let demux = DemuxFold::new(task.demux_options()?, &task.schedule, geometry)
            .map_err(|error| no_model(error.to_string()))?
            .demux()
            .map_err(|error| no_model(error.to_string()))?;
        let condition = demux.condition(geometry.height / 2).map_err(|error| no_model(error.to_string()))?;
        let reach = demux.reach();
        let planned: Vec<Setting> = task
            .settings()
            .map(|(_, point)| geometry.setting(&[point.delay_us], point.exposure_us))
            .collect();
        let cut =
            SpotCut::of(geometry, demux.timing(), &planned).map_err(|error| no_model(error.to_string()))?;
        for point in &task.schedule.points {
            let shot = geometry.shot(point, camera.trigger_latency_us);
            camera.allows(&shot.settings).map_err(no_model)?;
        }
        let periods = task.schedule.points.iter().map(|point| periods(task, camera, point)).collect();
        // JSON has no infinity.
        let reach_rows = (*reach.start(), *reach.end());
        Ok(Self { reach_rows, condition: condition.min(f64::MAX), periods, cut })
    }

    /// Number of relative rows whose light can be distinguished.
    pub fn reach(&self) -> u64 {
        let (first, last) = self.reach_rows;
        (first..=last).count() as u64
    }

    /// What the lamp that the calibration found does to a plan whose images are means of frames; `key` sets their
    /// number, and without one the plan is a film.
    pub fn lamp_warning(&self, task: &PlaneTask, key: Option<&str>) -> Option<String> {
        let FlickeringLamp { frequency_hz, amplitude } = task.geometry.calibration.as_ref()?.lamp?;
        if amplitude <= LEAST_FLICKER {
            return None;
        }
        let lit = task.schedule.points.iter().zip(&self.periods);
        let lit = lit.filter(|(point, _)| matches!(point.role, PointRole::Sweep(_)));
        let frames = lit.clone().map(|(point, _)| point.frames).max()?;
        let mut periods: Vec<u64> = lit.map(|(_, &periods)| periods).collect();
        periods.sort_unstable();
        periods.dedup();
        let rate_hz = |&periods: &u64| 1e6 / (task.geometry.raster.period_us * periods as f64);
        let rates_hz: Vec<f64> = periods.iter().map(rate_hz).collect();
        let lamp = format!(
            "the calibration found a lamp that flickers at {frequency_hz:.1} Hz by {amplitude:.4} of white in a row's time"
        );
        if let Some(rate_hz) = rates_hz.iter().find(|&&rate_hz| !can_be_followed(frequency_hz, rate_hz)) {
            return Some(format!(
                "{lamp}: that is the same in all frames at {rate_hz:.1} frames/s, and no number of frames cancels it: switch the lamp off"
            ));
        }
        let share = |&rate_hz: &f64| averaged_share(frequency_hz, rate_hz, frames);
        let percent = 100.0 * rates_hz.iter().map(share).fold(0.0, f64::max);
        let Some(key) = key else {
            return Some(format!(
                "{lamp}, which the times of the frames should remove from all cycles of a film but the first {}: to keep these too, switch the lamp off",
                FilmSolver::FIRST_CYCLES
            ));
        };
        match cancelling_frames(frequency_hz, &rates_hz, frames) {
            Some(enough) if enough == frames => None,
            Some(enough) => Some(format!(
                "{lamp}: the mean of {frames} frames leaves {percent:.0} % of that, which the times of the frames should remove; {key} = {enough} cancels it"
            )),
            None => Some(format!(
                "{lamp}: the mean of {frames} frames leaves {percent:.0} % of that, which the times of the frames should remove; no {key} up to 64 cancels it"
            )),
        }
    }

    fn spot_warning(&self, task: &PlaneTask) -> Option<String> {
        let begin_or_end = "begin or end while the flying spot draws the rows of direct light";
        match &self.cut {
            SpotCut::Nowhere | SpotCut::Modelled { .. } => None,
            SpotCut::LeftOut { cut } => {
                // A measured response and the spot's path are not modelled together.
                let known = match task.geometry.calibration {
                    Some(_) => "",
                    None => {
                        "state projector.scan, camera.projector_columns and projector.beam_sigma_rows = 0, or "
                    }
                };
                Some(format!(
                    "{} of {} settings {begin_or_end}, and are left out: {known}move their delays by a few rows",
                    cut.len(),
                    task.settings().count()
                ))
            }
            SpotCut::Everywhere => Some(format!(
                "all settings {begin_or_end}, so direct light is not to be trusted: move the delays by a few rows"
            )),
        }
    }

    /// Warnings for the operator.
    pub fn warnings(&self, task: &PlaneTask) -> Vec<String> {
        let (geometry, condition) = (&task.geometry, self.condition);
        let mut warnings = Vec::new();
        if condition > ILL_CONDITIONED {
            warnings.push(format!(
                "condition number {condition:.1e}: raise alpha or take delays that overlap more"
            ));
        }
        let (blind, (first_us, last_us)) = task.without_light();
        if blind > 0 {
            warnings.push(format!(
                "{blind} of {} settings see no row of the projector: give delays from {first_us:.0} to {last_us:.0} us",
                task.settings().count()
            ));
        }
        warnings.extend(self.spot_warning(task));
        let brightest_rows = task
            .schedule
            .points
            .iter()
            .map(|point| (point.exposure_us / geometry.raster.row_time_us).min(geometry.raster.rows as f64))
            .fold(0.0, f64::max);
        let headroom = geometry.saturation_dn / geometry.white_dn;
        if headroom < 1.2 {
            warnings.push(format!(
                "a pixel saturates at {headroom:.2} times the direct light of a white one, and exposures collect light from up to {brightest_rows:.0} rows: lower camera.white_dn (gain, aperture) to leave room for indirect light"
            ));
        }
        warnings
    }
}

/// VSYNC periods per frame of a point.
pub fn periods(task: &PlaneTask, camera: &CameraCapabilities, point: &Point) -> u64 {
    let shot = task.geometry.shot(point, camera.trigger_latency_us);
    u64::from(camera.periods_per_frame(&shot.settings, task.geometry.raster.period_us))
}
