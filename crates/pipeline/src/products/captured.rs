//! Product `captured`: images of the sweep as they were taken, at one delay or as a film over all of them.

use ndarray::{Array2, Axis};
use serde::Deserialize;

use super::planned::{Planned, shown};
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
        let delay_us = self.delay_us.map(|delay_us| planned.delay_us(schedule, delay_us)).transpose()?;
        Ok(Captured { planned, delay_us })
    }
}

impl Captured {
    pub(super) fn default_name(self) -> String {
        let exposure_us = shown(self.planned.exposure_us);
        let name = match self.delay_us {
            Some(delay_us) => format!("captured_{}us_{exposure_us}us", shown(delay_us)),
            None => format!("captured_{exposure_us}us"),
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
        let taken = match self.delay_us {
            Some(delay_us) => self.planned.image_at(stack, delay_us).into_iter().collect(),
            None => self.planned.images_of(stack),
        };
        let valid = stack.valid.as_ref()?.select(Axis(0), &taken);
        Some(valid.map_axis(Axis(0), |valid| valid.iter().any(|valid| !valid)))
    }

    pub(super) fn make(self, name: String, stack: &SweepStack, mask: Array2<u8>) -> Result<Product, String> {
        let Planned { exposure_us, delays } = self.planned;
        let measured_us = |n: usize| stack.settings[n].mean_delay_us();
        if let Some(delay_us) = self.delay_us {
            let n = self.planned.image_at(stack, delay_us)?;
            let about = format!(
                "as captured at a delay of {} µs (measured {}) and an exposure of {exposure_us} µs",
                shown(delay_us),
                shown(measured_us(n))
            );
            let image = stack.images.index_axis(Axis(0), n).to_owned();
            return Ok(Product::Image { name, about, is_light: true, image, mask });
        }
        let taken = self.planned.images_of(stack);
        if taken.is_empty() {
            return Err(format!(
                "no image at {exposure_us} µs exposure is stored, or all were left out of the transport, as the report says"
            ));
        }
        let left_out = match delays - taken.len() {
            0 => String::new(),
            few => format!("; {few} of {delays} images are not stored, or were left out of the transport"),
        };
        Ok(Product::Sequence {
            name,
            about: format!(
                "as captured over the measured delay at an exposure of {exposure_us} µs{left_out}"
            ),
            axis: "delay t_d, µs".into(),
            at: taken.iter().map(|&n| measured_us(n)).collect(),
            images: stack.images.select(Axis(0), &taken),
            mask,
        })
    }
}
