//! What of the fit is refused: frames that do not belong to the others, and rigs that are not as a fit must take them.

use super::super::super::Estimate;
use super::super::coarse::median;
use super::super::error::TimesError;
use super::super::model::{BoardSamples, FrameComparison};
use super::super::result::{Dropped, Residual};
use super::super::settings::ExposureMode;
use super::{Fit, MAX_STEPS};

/// Frames whose jitter is farther from the median, in robust standard deviations, are dropped.
const OUTLIER_SDS: f64 = 4.5;
/// Frames whose chi^2 per sample exceeds both this value and this multiple of the median are dropped.
const MISFIT: f64 = 9.0;
/// A frame whose edges tell its jitter less well than this has none on the light.
const NO_EDGE_SD_US: f64 = 2.0;
/// Limits of what is accepted.
const MAX_CHI2_PER_SAMPLE: f64 = 3.0;
const MAX_EXPOSURE_DIFFERENCE_US: f64 = 0.3;
/// A difference of exposures is refused if it exceeds the limit by this many standard deviations: ten or more are
/// judged in a calibration, and a good rig must not be refused.
const DIFFERENCE_SDS: f64 = 5.0;

impl Fit<'_> {
    /// chi^2 and number of samples of a frame.
    pub(super) fn misfit(&self, comparison: &FrameComparison, frame: usize) -> (f64, f64) {
        let (mut chi2, mut samples) = (0.0, 0.0);
        let late = (self.late_us[frame], self.longer_us(frame));
        comparison.visit(&self.frames[frame], late, BoardSamples::OnEdges, |_, _, _, sums| {
            chi2 += sums.chi2;
            samples += sums.samples;
        });
        (chi2, samples)
    }

    pub(super) fn drop_outliers(&mut self) {
        for frame in self.used().collect::<Vec<_>>() {
            if self.jitter_weight[frame] < NO_EDGE_SD_US.powi(-2) {
                self.dropped[frame] = Some(Dropped::NoEdge);
            }
        }
        for shutter in [ExposureMode::Global, ExposureMode::Rolling] {
            let jitters = self.jitters_of(shutter);
            let middle_us = median(&mut jitters.iter().map(|jitter| jitter.1).collect::<Vec<_>>());
            let mut away_us: Vec<f64> = jitters.iter().map(|jitter| (jitter.1 - middle_us).abs()).collect();
            let sd_us = (1.4826 * median(&mut away_us)).max(0.5);
            for (frame, late_us) in jitters {
                if (late_us - middle_us).abs() > OUTLIER_SDS * sd_us {
                    self.dropped[frame] = Some(Dropped::Late { late_us: late_us - middle_us });
                }
            }
        }
        let sweep = self.sweep();
        let comparison = self.comparison(&sweep);
        let misfits: Vec<(usize, f64)> = self
            .used()
            .map(|frame| {
                let (chi2, samples) = self.misfit(&comparison, frame);
                (frame, chi2 / samples.max(1.0))
            })
            .collect();
        let usual = median(&mut misfits.iter().map(|misfit| misfit.1).collect::<Vec<_>>());
        for (frame, chi2_per_sample) in misfits {
            if chi2_per_sample > MISFIT * usual.max(1.0) {
                self.dropped[frame] = Some(Dropped::Misfit { chi2_per_sample });
            }
        }
    }

    /// Standard deviation of the frames' jitters about the mean of their shutter mode.
    pub(super) fn check_jitter(&self) -> Result<Estimate, TimesError> {
        let (mut squares, mut count) = (0.0, 0.0);
        for shutter in [ExposureMode::Global, ExposureMode::Rolling] {
            let jitters = self.jitters_of(shutter);
            let mean_us = jitters.iter().map(|jitter| jitter.1).sum::<f64>() / jitters.len() as f64;
            squares += jitters.iter().map(|jitter| (jitter.1 - mean_us).powi(2)).sum::<f64>();
            count += jitters.len() as f64 - 1.0;
        }
        if count < 1.0 {
            return Err(TimesError::Undetermined);
        }
        let jitter_us = (squares / count).sqrt();
        let limit_us = self.nominal.row_time_us / 2.0 + 20.0;
        if jitter_us > limit_us {
            return Err(TimesError::Jitter { jitter_us, limit_us });
        }
        Ok(Estimate { value: jitter_us, sd: jitter_us / (2.0 * count).sqrt() })
    }

    pub(super) fn check_residuals(&self) -> Result<Vec<Residual>, TimesError> {
        let sweep = self.sweep();
        let comparison = self.comparison(&sweep);
        let mut residuals: Vec<Residual> = Vec::new();
        for frame in self.used() {
            let setting = self.frames[frame].setting;
            let (chi2, samples) = self.misfit(&comparison, frame);
            let same = |residual: &&mut Residual| {
                residual.shutter == setting.shutter && residual.exposure_us == setting.exposure_us
            };
            match residuals.iter_mut().find(same) {
                Some(residual) => {
                    residual.frames += 1;
                    residual.samples += samples as usize;
                    residual.chi2_per_sample += chi2;
                }
                None => residuals.push(Residual {
                    shutter: setting.shutter,
                    exposure_us: setting.exposure_us,
                    frames: 1,
                    samples: samples as usize,
                    chi2_per_sample: chi2,
                }),
            }
        }
        for residual in &mut residuals {
            residual.chi2_per_sample /= residual.samples.max(1) as f64;
        }
        let worst = residuals.iter().max_by(|a, b| a.chi2_per_sample.total_cmp(&b.chi2_per_sample));
        match worst {
            Some(worst) if worst.chi2_per_sample > MAX_CHI2_PER_SAMPLE => Err(TimesError::Misfit {
                chi2_per_sample: worst.chi2_per_sample,
                limit: MAX_CHI2_PER_SAMPLE,
                exposure_us: worst.exposure_us,
            }),
            _ => Ok(residuals),
        }
    }

    pub(super) fn chi2_per_sample(&self) -> f64 {
        let sweep = self.sweep();
        let comparison = self.comparison(&sweep);
        let (chi2, samples) = self
            .used()
            .map(|frame| self.misfit(&comparison, frame))
            .fold((0.0, 0.0), |sums, (chi2, samples)| (sums.0 + chi2, sums.1 + samples));
        chi2 / f64::max(samples, 1.0)
    }

    pub(super) fn check_order(&self) -> Result<(), TimesError> {
        let starts_us = self.starts_us();
        let back = |row: &usize| starts_us[row + 1] <= starts_us[*row];
        match self.columns.seen_rows().find(back) {
            Some(row) => Err(TimesError::FoldsBack { row, back_us: starts_us[row] - starts_us[row + 1] }),
            None => Ok(()),
        }
    }

    /// Fits the length of each exposure, and refuses those that are longer than others by more than they should.
    pub(super) fn check_exposures(&self) -> Result<(), TimesError> {
        if self.exposures_us.len() < 2 {
            return Ok(());
        }
        let mut fit = self.clone();
        fit.steps(MAX_STEPS, true)?;
        let covariance = fit.covariance(true)?;
        for (index, &exposure_us) in self.exposures_us.iter().enumerate().skip(1) {
            let unknown = self.table.coefficients + 2 + index;
            let difference_us = fit.unknowns[unknown];
            let sd_us = covariance[(unknown, unknown)].sqrt();
            if difference_us.abs() > MAX_EXPOSURE_DIFFERENCE_US + DIFFERENCE_SDS * sd_us {
                return Err(TimesError::Granular {
                    exposure_us,
                    reference_us: self.exposures_us[0],
                    difference_us,
                    sd_us,
                    limit_us: MAX_EXPOSURE_DIFFERENCE_US,
                });
            }
        }
        Ok(())
    }
}
