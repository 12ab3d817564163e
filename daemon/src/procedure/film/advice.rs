//! The settings of a film's cycle, as they are searched.

use raysweep_config::{Axis, FilmPlan};
use raysweep_core::CameraCapabilities;
use raysweep_processing::film::FilmTask;
use raysweep_processing::plane::PlaneTask;
use raysweep_transport::plane::advice::{Arrangement, Design, SweepGrid};

use super::cycle::CyclePlan;
use crate::plane::advice::Searched;

impl Searched for FilmTask {
    const ARRANGEMENT: Arrangement = Arrangement::Film;

    fn task(&self) -> &PlaneTask {
        &self.task
    }

    fn design(&self) -> Design {
        let mut delays_us = self.film.delay_us.values();
        delays_us.sort_by(f64::total_cmp);
        Design { grids: vec![SweepGrid { delays_us, exposures_us: vec![self.film.exposure_us] }], frames: 1 }
    }

    fn with_design(&self, design: &Design) -> Option<Self> {
        let [SweepGrid { delays_us, exposures_us }] = &design.grids[..] else { return None };
        let &[exposure_us] = &exposures_us[..] else { return None };
        let delay_us = Axis::of_values(delays_us.clone());
        self.with_film(FilmPlan { delay_us, exposure_us, ..self.film.clone() })
    }

    fn to_toml(&self) -> String {
        self.film.to_toml()
    }

    fn periods(&self, camera: &CameraCapabilities) -> u64 {
        u64::from(CyclePlan::new(&self.task, camera).order.cycle_periods())
    }
}
