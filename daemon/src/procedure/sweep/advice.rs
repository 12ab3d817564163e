//! The settings of a sweep, as they are searched.

use raysweep_config::{Axis, GridPlan, SweepPlan};
use raysweep_processing::plane::PlaneTask;
use raysweep_processing::sweep::SweepTask;
use raysweep_transport::plane::advice::{Arrangement, Design, SweepGrid};

use crate::plane::advice::Searched;

impl Searched for SweepTask {
    const ARRANGEMENT: Arrangement = Arrangement::Sweep;

    fn task(&self) -> &PlaneTask {
        &self.task
    }

    fn design(&self) -> Design {
        let grid = |grid: GridPlan| SweepGrid {
            delays_us: grid.delay_us.values(),
            exposures_us: grid.exposure_us.values(),
        };
        Design { grids: self.sweep.grids().map(grid).collect(), frames: self.sweep.average }
    }

    fn with_design(&self, design: &Design) -> Option<Self> {
        let grid = |grid: &SweepGrid| GridPlan {
            delay_us: Axis::of_values(grid.delays_us.clone()),
            exposure_us: Axis::of_values(grid.exposures_us.clone()),
        };
        let (own, extra) = design.grids.split_first()?;
        let GridPlan { delay_us, exposure_us } = grid(own);
        let extra = extra.iter().map(grid).collect();
        let max_jitter_us = self.sweep.max_jitter_us;
        self.with_sweep(SweepPlan {
            delay_us,
            exposure_us,
            average: design.frames,
            max_jitter_us,
            extra,
            bracket: self.sweep.bracket,
            mm_per_row: self.sweep.mm_per_row,
        })
    }

    fn to_toml(&self) -> String {
        self.sweep.to_toml()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ndarray::Array2;
    use raysweep_config::{Plan, Procedure, RigFile};
    use raysweep_core::{CameraCapabilities, PixelFormat, Readout};
    use raysweep_processing::plane::KnownRig;
    use raysweep_proto::{DesignParams, NoiseSource, PlanAdvice};
    use raysweep_transport::plane::board::{BoardCalibration, CalibrationCovariance, Estimate};
    use raysweep_transport::plane::{NoiseModel, PixelResponse, RESPONSE_ROWS};

    use super::*;
    use crate::plane::advice::{NoAdvice, advise, design};
    use crate::plane::foresight::periods;

    const RIG: &str = "kind = \"plane\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\nfirst_row_us = 600\n[camera]\ndriver = \"sim\"\n";
    const SMALL: &str = "kind = \"sweep\"\n[sweep]\nexposure_us = [600, 900]\ndelay_us = { start = -900, stop = 900, count = 10 }\naverage = 1\n";

    fn camera() -> CameraCapabilities {
        CameraCapabilities {
            model: "test".into(),
            width: 16,
            height: 720,
            format: PixelFormat::Mono12,
            row_time_us: 22.22,
            trigger_latency_us: 8.0,
            readout_us: 720.0 * 22.22,
            readout: Readout::Sequential,
            exposure_us: 1.0..=1e6,
            trigger_delay_us: 0.0..=1e6,
        }
    }

    fn task(rig: &RigFile, plan: &str) -> SweepTask {
        let plan = Plan::parse(plan).unwrap();
        let Procedure::Sweep(sweep) = plan.procedure.clone() else { panic!("{plan:?}") };
        let rig = KnownRig { file: rig, first_row: 0, size: (720, 16), calibration: None };
        SweepTask::new(&plan, sweep, &rig)
    }

    fn advised(rig: &str, plan: &str, camera: &CameraCapabilities) -> Result<PlanAdvice, NoAdvice> {
        let rig = RigFile::parse(rig).unwrap();
        advise(&task(&rig, plan), false, &rig, camera)
    }

    #[test]
    fn the_proposed_sweep_is_what_it_is_said_to_be() {
        let (rig, camera) = (RigFile::parse(RIG).unwrap(), camera());
        let own = task(&rig, SMALL);
        let advice = advise(&own, false, &rig, &camera).unwrap();
        let better = advice.better.unwrap();
        let other = task(&rig, &format!("kind = \"sweep\"\n{}", better.table));
        assert_eq!((other.points(), other.sweep.average), (better.points, 1));
        let total_periods = |sweep: &SweepTask| -> u64 {
            let points = sweep.task.schedule.points.iter();
            points.map(|point| periods(&sweep.task, &camera, point) * u64::from(point.frames)).sum()
        };
        assert!(total_periods(&other) <= total_periods(&own));
        // By hand: 2500 counts of 1.66 electrons, 9 electrons of read noise, rounded to counts.
        let read = ((9.0_f64 / 4150.0).powi(2) + 1.0 / 12.0 / 2500.0_f64.powi(2)).sqrt();
        assert!((advice.noise.dark - read).abs() < 1e-12);
        assert_eq!(advise(&other, false, &rig, &camera).unwrap().expected, better.expected);
    }

    #[test]
    fn the_noise_that_a_calibration_measured_is_taken_for_true() {
        let (rig, camera) = (RigFile::parse(RIG).unwrap(), camera());
        let mut own = task(&rig, SMALL);
        let stated = own.task.geometry.clone();
        let exact = |value| Estimate { value, sd: 0.0 };
        let mut shares = [0.0; RESPONSE_ROWS];
        shares[RESPONSE_ROWS / 2] = 1.0;
        let calibration = BoardCalibration {
            row_starts_us: stated.timing().unwrap().row_starts_us().to_vec(),
            camera_row_time_us: exact(22.22),
            exposure_offset_us: exact(0.0),
            jitter_us: 0.0,
            covariance: CalibrationCovariance::independent([0.0; 5]),
            response: PixelResponse::with_beam(Array2::from_shape_fn((720, 16), |(t, _)| t as f32), &shares)
                .unwrap(),
            drawing: None,
            white_dn: Array2::from_elem((720, 16), 2500.0),
            dark_offset_dn: Array2::from_elem((720, 16), 64.0),
            linearity_per_dn: None,
            saturation_dn: None,
            noise: NoiseModel { read_variance: 0.04, gain: 0.09 },
            strip: None,
            lamp: None,
        };
        let task = Arc::make_mut(&mut own.task);
        task.geometry = stated.calibrated(Arc::new(calibration));
        let noise = advise(&own, false, &rig, &camera).unwrap().noise;
        assert_eq!((noise.dark, noise.shot, noise.source), (0.2, 0.3, NoiseSource::Calibrated));
    }

    #[test]
    fn a_flying_spot_costs_the_settings_on_the_direct_row() {
        // With exposures of 600 us, the delays of 300 us begin or end on the pixel's own row.
        let plan = "kind = \"sweep\"\n[sweep]\nexposure_us = [600]\ndelay_us = [-500, -300, 0, 300, 500]\n";
        let without = plan.replace("-300, ", "").replace("300, ", "");
        let flying = RIG.replace("[projector]\n", "[projector]\nspot = \"flying\"\n");
        let expected = |rig: &str, plan: &str| advised(rig, plan, &camera()).unwrap().expected;
        assert_ne!(expected(RIG, plan), expected(RIG, &without));
        assert_eq!(expected(&flying, plan), expected(RIG, &without));
        let none = plan.replace("-500, ", "").replace("0, 300, 500", "300");
        let error = advised(&flying, &none, &camera()).unwrap_err();
        assert!(matches!(error, NoAdvice::NothingUsable), "{error}");
    }

    #[test]
    fn what_saturates_or_takes_too_long_is_not_foreseen() {
        let bright = RIG.replace("[camera]\n", "[camera]\nwhite_dn = 4000\n");
        let error = advised(&bright, "kind = \"sweep\"\n[sweep]\ndelay_us = [0]\n", &camera()).unwrap_err();
        assert!(matches!(error, NoAdvice::NothingUsable), "{error}");
        // Settings that see the rows beside it alone tell nothing of direct light.
        let plan = "kind = \"sweep\"\n[sweep]\nexposure_us = [600]\ndelay_us = [-600, 0, 600]\n";
        let error = advised(&bright, plan, &camera()).unwrap_err();
        assert!(matches!(error, NoAdvice::NothingUsable), "{error}");
        assert!(advised(RIG, plan, &camera()).is_ok());
        let plan = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -8000, stop = 8000, count = 1000 }\n";
        let error = advised(RIG, plan, &camera()).unwrap_err();
        assert!(matches!(error, NoAdvice::TooLarge { points: 5000, .. }), "{error}");
    }

    #[test]
    fn a_designed_sweep_takes_the_wanted_time_or_reaches_the_wanted_error() {
        let (rig, camera) = (RigFile::parse(RIG).unwrap(), camera());
        let own = task(&rig, SMALL);
        let wanted = |error, light_s| {
            design(&own, &rig, &camera, &DesignParams { error, light_s, ..DesignParams::default() })
        };
        let timed = wanted(None, Some(1.0)).unwrap();
        assert!((0.4..=1.0).contains(&timed.light_s), "{timed:?}");
        let precise = wanted(Some(0.06), None).unwrap();
        assert!(precise.expected.total.median <= 0.06, "{precise:?}");
        let [said] = &precise.warnings[..] else { panic!("{precise:?}") };
        assert!(said.contains("not calibrated"), "{said}");
        let other = task(&rig, &format!("kind = \"sweep\"\n{}", precise.plan));
        assert_eq!((other.points(), other.design().total_frames() as u64), (precise.points, precise.frames));
        for (error, light_s) in [(None, None), (Some(0.1), Some(1.0)), (Some(-1.0), None)] {
            assert!(matches!(wanted(error, light_s), Err(NoAdvice::Wanted(_))));
        }
    }
}
