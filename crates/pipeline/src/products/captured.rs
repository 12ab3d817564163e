//! Product `captured`: images of the sweep as they were taken, at one delay or as a film over all of them.

use ndarray::{Array2, Array3, Axis};
use serde::Deserialize;

use super::planned::Planned;
use crate::product::Product;
use crate::schedule::Schedule;
use crate::stack::SweepStack;

/// Options of `captured`, as given in a plan.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CapturedTable {
    /// One of the plan's delays; if omitted, all of them.
    delay_us: Option<f64>,
    /// One of the plan's exposures; if omitted, the shortest.
    exposure_us: Option<f64>,
}

/// The images of one exposure, or that of one delay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Captured {
    planned: Planned,
    delay_us: Option<f64>,
}

impl CapturedTable {
    /// The options, if they are valid for the plan.
    pub(super) fn check(self, schedule: &Schedule) -> Result<Captured, (&'static str, String)> {
        let planned = Planned::new(schedule, self.exposure_us)?;
        if let Some(delay_us) = self.delay_us {
            planned.check_delay(schedule, delay_us)?;
        }
        Ok(Captured { planned, delay_us: self.delay_us })
    }
}

impl Captured {
    pub(super) fn default_name(self) -> String {
        let exposure = self.planned.exposure_us;
        let name = match self.delay_us {
            Some(delay_us) => format!("captured_{delay_us}us_{exposure}us"),
            None => format!("captured_{exposure}us"),
        };
        // Names of products have no points.
        name.replace('.', "p")
    }

    /// The number of its images.
    pub(super) fn images(self) -> usize {
        self.delay_us.map_or(self.planned.delays, |_| 1)
    }

    /// Where one of its images saturates, `[t, s]`; `None` if nowhere.
    pub(super) fn saturates(self, stack: &SweepStack) -> Option<Array2<bool>> {
        let taken = self.taken(stack);
        let valid = stack.valid.as_ref()?.select(Axis(0), &taken);
        Some(valid.map_axis(Axis(0), |valid| valid.iter().any(|valid| !valid)))
    }

    /// Indices of its images in the stack, by delay.
    fn taken(self, stack: &SweepStack) -> Vec<usize> {
        match self.delay_us {
            Some(delay_us) => self.planned.image_at(stack, delay_us).into_iter().collect(),
            None => self.planned.images_of(stack),
        }
    }

    pub(super) fn make(self, name: String, stack: &SweepStack, mask: Array2<u8>) -> Result<Product, String> {
        let exposure_us = self.planned.exposure_us;
        let taken = self.taken(stack);
        let Some(&first) = taken.first() else {
            let at = self.delay_us.map_or_else(String::new, |delay_us| format!("{delay_us} µs delay and "));
            return Err(format!("no image at {at}{exposure_us} µs exposure is stored: resume the run"));
        };
        if let Some(delay_us) = self.delay_us {
            let about =
                format!("as captured at a delay of {delay_us} µs and an exposure of {exposure_us} µs");
            return Ok(Product::Image {
                name,
                about,
                image: stack.images.index_axis(Axis(0), first).to_owned(),
                mask,
            });
        }
        let images: Array3<f32> = stack.images.select(Axis(0), &taken);
        Ok(Product::Sequence {
            name,
            about: format!("as captured over the delay at an exposure of {exposure_us} µs"),
            axis: "delay t_d, µs".into(),
            at: taken.iter().map(|&n| Planned::delay_us(stack, n)).collect(),
            images,
            mask,
        })
    }
}
