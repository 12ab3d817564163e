//! The images of a sweep that were planned with one exposure.

use crate::schedule::{PointRole, Schedule};
use crate::stack::SweepStack;

/// An exposure of the plan, and its delays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Planned {
    pub exposure_us: f64,
    /// Number of delays at this exposure.
    pub delays: usize,
    /// Half the smallest distance of two delays, by which measured delays are told apart.
    within_us: f64,
}

impl Planned {
    /// The exposure that a product asks for, or else the shortest.
    pub(super) fn new(schedule: &Schedule, exposure_us: Option<f64>) -> Result<Self, (&'static str, String)> {
        let sweep = schedule.points.iter().filter(|point| matches!(point.role, PointRole::Sweep(_)));
        let mut exposures_us: Vec<f64> = sweep.map(|point| point.exposure_us).collect();
        exposures_us.sort_by(f64::total_cmp);
        exposures_us.dedup();
        let exposure_us = exposure_us.or(exposures_us.first().copied()).unwrap_or_default();
        let delays_us = delays_us(schedule, exposure_us);
        if delays_us.is_empty() {
            let what = format!("exposure_us = {exposure_us}: must be one of the plan's {exposures_us:?}");
            return Err(("exposure_us", what));
        }
        let gaps_us = delays_us.windows(2).map(|pair| pair[1] - pair[0]);
        Ok(Self {
            exposure_us,
            delays: delays_us.len(),
            within_us: gaps_us.fold(f64::INFINITY, f64::min) / 2.0,
        })
    }

    /// The plan's delay at this exposure that is nearest to another.
    pub(super) fn nearest_delay_us(self, schedule: &Schedule, to_us: f64) -> f64 {
        let off_us = |delay_us: &f64| (delay_us - to_us).abs();
        let delays_us = delays_us(schedule, self.exposure_us).into_iter();
        delays_us.min_by(|a, b| off_us(a).total_cmp(&off_us(b))).unwrap_or(to_us)
    }

    /// Refuses a delay that the plan does not have at this exposure.
    pub(super) fn check_delay(
        self,
        schedule: &Schedule,
        delay_us: f64,
    ) -> Result<(), (&'static str, String)> {
        let delays_us = delays_us(schedule, self.exposure_us);
        if delays_us.contains(&delay_us) {
            return Ok(());
        }
        let what = format!(
            "delay_us = {delay_us}: must be one of the plan's delays at {} µs exposure, {delays_us:?}",
            self.exposure_us
        );
        Err(("delay_us", what))
    }

    /// Indices of the images with this exposure, by delay.
    pub(super) fn images_of(self, stack: &SweepStack) -> Vec<usize> {
        let mut taken: Vec<usize> =
            (0..stack.settings.len()).filter(|&n| stack.exposures_us[n] == self.exposure_us).collect();
        taken.sort_by(|&a, &b| Self::delay_us(stack, a).total_cmp(&Self::delay_us(stack, b)));
        taken
    }

    /// Index of the image that was planned with this delay, if it is stored.
    pub(super) fn image_at(self, stack: &SweepStack, delay_us: f64) -> Option<usize> {
        let off_us = |n: &usize| (Self::delay_us(stack, *n) - delay_us).abs();
        let images = self.images_of(stack).into_iter();
        images.min_by(|a, b| off_us(a).total_cmp(&off_us(b))).filter(|n| off_us(n) < self.within_us)
    }

    /// The mean measured delay of an image.
    pub(super) fn delay_us(stack: &SweepStack, n: usize) -> f64 {
        let delays_us = &stack.settings[n].delays_us;
        delays_us.iter().sum::<f64>() / delays_us.len() as f64
    }
}

/// The plan's delays at an exposure, sorted.
fn delays_us(schedule: &Schedule, exposure_us: f64) -> Vec<f64> {
    let sweep = schedule.points.iter().filter(|point| matches!(point.role, PointRole::Sweep(_)));
    let mut delays_us: Vec<f64> =
        sweep.filter(|point| point.exposure_us == exposure_us).map(|point| point.delay_us).collect();
    delays_us.sort_by(f64::total_cmp);
    delays_us
}
