//! The images of a sweep that were planned with one exposure.

use crate::schedule::{PointRole, Schedule};
use crate::stack::SweepStack;

/// Delays that differ by less are one, as printed.
const SAME_US: f64 = 0.01;

/// An exposure of the plan, and its delays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Planned {
    pub exposure_us: f64,
    /// Number of delays at this exposure.
    pub delays: usize,
}

impl Planned {
    /// The exposure that a product asks for, or else the shortest.
    pub(super) fn new(schedule: &Schedule, exposure_us: Option<f64>) -> Result<Self, (&'static str, String)> {
        let sweep = schedule.points.iter().filter(|point| matches!(point.role, PointRole::Sweep(_)));
        let mut exposures_us: Vec<f64> = sweep.map(|point| point.exposure_us).collect();
        exposures_us.sort_by(f64::total_cmp);
        exposures_us.dedup();
        let exposure_us = exposure_us.or(exposures_us.first().copied()).unwrap_or_default();
        match delays_us(schedule, exposure_us).len() {
            0 => {
                let what = format!("exposure_us = {exposure_us}: must be one of the plan's {exposures_us:?}");
                Err(("exposure_us", what))
            }
            delays => Ok(Self { exposure_us, delays }),
        }
    }

    /// The plan's delay at this exposure that is nearest to another.
    pub(super) fn nearest_delay_us(self, schedule: &Schedule, to_us: f64) -> f64 {
        let off_us = |delay_us: &f64| (delay_us - to_us).abs();
        let delays_us = delays_us(schedule, self.exposure_us).into_iter();
        delays_us.min_by(|a, b| off_us(a).total_cmp(&off_us(b))).unwrap_or(to_us)
    }

    /// The plan's delay at this exposure that is meant by another, which may be rounded.
    pub(super) fn delay_us(self, schedule: &Schedule, delay_us: f64) -> Result<f64, (&'static str, String)> {
        let nearest_us = self.nearest_delay_us(schedule, delay_us);
        if (nearest_us - delay_us).abs() < SAME_US {
            return Ok(nearest_us);
        }
        let delays: Vec<String> = delays_us(schedule, self.exposure_us).into_iter().map(shown).collect();
        let what = format!(
            "delay_us = {delay_us}: must be one of the plan's delays at {} µs exposure, {}",
            self.exposure_us,
            delays.join(", ")
        );
        Err(("delay_us", what))
    }

    /// Indices of the images with this exposure, by measured delay.
    pub(super) fn images_of(self, stack: &SweepStack) -> Vec<usize> {
        let mut taken: Vec<usize> =
            (0..stack.settings.len()).filter(|&n| stack.exposures_us[n] == self.exposure_us).collect();
        let measured_us = |n: usize| stack.settings[n].mean_delay_us();
        taken.sort_by(|&a, &b| measured_us(a).total_cmp(&measured_us(b)));
        taken
    }

    /// Index of the image that was planned with this delay, if the transport is made from it.
    ///
    /// # Errors
    /// Why it is not there.
    pub(super) fn image_at(self, stack: &SweepStack, delay_us: f64) -> Result<usize, String> {
        let found = self.images_of(stack).into_iter().find(|&n| stack.delays_us[n] == delay_us);
        found.ok_or_else(|| {
            format!(
                "the image at {} µs delay and {} µs exposure is not stored, or was left out of the transport as the report says",
                shown(delay_us),
                self.exposure_us
            )
        })
    }
}

/// A time as it is printed.
pub(super) fn shown(us: f64) -> String {
    let text = format!("{us:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.into() }
}

/// The plan's delays at an exposure, sorted.
fn delays_us(schedule: &Schedule, exposure_us: f64) -> Vec<f64> {
    let sweep = schedule.points.iter().filter(|point| matches!(point.role, PointRole::Sweep(_)));
    let mut delays_us: Vec<f64> =
        sweep.filter(|point| point.exposure_us == exposure_us).map(|point| point.delay_us).collect();
    delays_us.sort_by(f64::total_cmp);
    delays_us
}
