//! Predicts the errors of a sweep on this rig, and searches for a better sweep of the same length.

use raysweep_config::rig::plane::NoiseOrigin;
use raysweep_config::{Axis, RigFile, SweepPlan};
use raysweep_core::CameraCapabilities;
use raysweep_pipeline::{DemuxFold, Point, PointRole, Spot, prior_name};
use raysweep_processing::sweep::SweepTask;
use raysweep_proto::{BetterSweep, ExpectedError, NoiseEstimate, NoiseSource, SweepAdvice};
use raysweep_transport::plane::advice::{self, Noise, SweepGrid, white_light};
use raysweep_transport::plane::calibrate::settings_on_direct_row;
use raysweep_transport::plane::{PlaneError, RowTiming, Setting};

use crate::plane::foresight::periods;

/// Why no advice is possible.
#[derive(Debug, thiserror::Error)]
pub enum NoAdvice {
    /// Nothing is left to demultiplex.
    #[error(
        "the errors cannot be predicted: every point of the sweep saturates a white pixel, or begins or ends while a flying spot draws the direct row; lower camera.white_dn (gain, aperture) or move the delays by a row"
    )]
    NothingUsable,
    /// The prediction would take too long.
    #[error(
        "the errors are not predicted, and no better sweep is sought: {points} points over {rows} relative rows would take too long"
    )]
    TooLarge {
        /// Points of the sweep.
        points: usize,
        /// Relative rows that it reaches.
        rows: usize,
    },
    /// The plan gives no model.
    #[error("the errors cannot be predicted: {0}")]
    NoModel(String),
}

impl From<PlaneError> for NoAdvice {
    fn from(error: PlaneError) -> Self {
        Self::NoModel(error.to_string())
    }
}

/// Limit of the work per predicted error in multiplications, (points + rows) rows^2; two dozen of them take about a
/// second.
const MAX_WORK: f64 = 1e9;

/// Predicts a sweep's errors, and searches for a better one that takes no more frames and no more time.
///
/// # Errors
/// If no error can be predicted.
pub fn advise(
    sweep: &SweepTask,
    rig: &RigFile,
    camera: &CameraCapabilities,
) -> Result<SweepAdvice, NoAdvice> {
    let task = &*sweep.task;
    let no_model = |error: &dyn std::fmt::Display| NoAdvice::NoModel(error.to_string());
    let options = task.demux_options().map_err(|error| no_model(&error))?;
    let demux =
        DemuxFold::new(options, &task.schedule, &task.geometry).map_err(|error| no_model(&error))?.demux()?;
    let (timing, prior) = (demux.timing(), demux.prior());
    let points = task.schedule.sweep_len();
    let rows = demux.reach().count();
    if (points + rows) as f64 * (rows as f64).powi(2) > MAX_WORK {
        return Err(NoAdvice::TooLarge { points, rows });
    }

    let known = rig.noise();
    let white_dn = task.geometry.white_dn;
    let gain = 1.0 / (white_dn * known.electrons_per_dn);
    // Rounding to counts adds a variance of 1/12 count^2.
    let read = (known.read_noise_e * gain).hypot(12_f64.sqrt().recip() / white_dn);
    let dark = task.schedule.points.iter().find(|point| matches!(point.role, PointRole::Dark(_)));
    let dark_frames = dark.map(|point| point.frames);
    let noise = Noise { read, gain, frames: sweep.sweep.average, dark_frames };

    let plan = grid_of(&sweep.sweep);
    let limits = Limits::new(sweep, rig, camera, timing);
    let advised = advice::advise(timing, &plan, &prior, &noise, |grid| limits.usable(grid));
    let advised = advised.map_err(|error| match error {
        PlaneError::NoDelays { .. } => NoAdvice::NothingUsable,
        error => error.into(),
    })?;
    let better = advised.better.and_then(|(grid, expected)| {
        let other = limits.with_grid(&grid)?;
        Some(BetterSweep {
            points: other.points(),
            frames: total_frames(&other),
            expected: told(expected),
            sweep: written(&other.sweep),
        })
    });
    Ok(SweepAdvice {
        noise: NoiseEstimate {
            dark: read,
            shot: gain.sqrt(),
            source: match known.source {
                NoiseOrigin::Stated => NoiseSource::Stated,
                NoiseOrigin::Simulated => NoiseSource::Simulated,
                NoiseOrigin::Assumed => NoiseSource::Assumed,
            },
        },
        prior: prior_name(prior),
        expected: told(advised.expected),
        better,
    })
}

/// Limits that another sweep must observe.
struct Limits<'a> {
    sweep: &'a SweepTask,
    camera: &'a CameraCapabilities,
    timing: &'a RowTiming,
    /// Light at which a pixel saturates, in white units.
    ceiling: f64,
    /// Points of the plan's sweep that saturate a white pixel.
    saturated: usize,
    /// Frames of the whole plan.
    frames: u64,
    /// VSYNC periods of these frames.
    periods: u64,
}

impl<'a> Limits<'a> {
    fn new(
        sweep: &'a SweepTask,
        rig: &RigFile,
        camera: &'a CameraCapabilities,
        timing: &'a RowTiming,
    ) -> Self {
        let task = &sweep.task;
        let ceiling = (task.geometry.saturation_dn - rig.camera.black_dn()) / task.geometry.white_dn;
        let saturated = saturated(timing, &grid_of(&sweep.sweep).settings(), ceiling);
        Self {
            sweep,
            camera,
            timing,
            ceiling,
            saturated,
            frames: total_frames(sweep),
            periods: total_periods(sweep, camera),
        }
    }

    /// The settings of a grid whose images are usable; `None` if the camera cannot take the grid, or if it needs more
    /// frames or time than the plan or saturates more points.
    fn usable(&self, grid: &SweepGrid) -> Option<Vec<Setting>> {
        let other = self.with_grid(grid)?;
        let geometry = &other.task.geometry;
        let takes = |point: &Point| {
            let shot = geometry.shot(point, self.camera.trigger_latency_us);
            self.camera.allows(&shot.settings).is_ok()
        };
        let taken = other.task.schedule.points.iter().all(takes)
            && total_frames(&other) <= self.frames
            && total_periods(&other, self.camera) <= self.periods;
        let mut settings = grid.settings();
        if !taken || saturated(self.timing, &settings, self.ceiling) > self.saturated {
            return None;
        }
        let cut = match geometry.spot {
            Spot::Uniform => Vec::new(),
            Spot::Flying(_) if geometry.modelled_spot().is_some() => Vec::new(),
            Spot::Flying(_) => settings_on_direct_row(self.timing, &settings, 0.0).ok()?,
        };
        let mut index = 0..;
        settings.retain(|setting| {
            !index.next().is_some_and(|index| cut.contains(&index))
                && white_light(self.timing, setting) < self.ceiling
        });
        Some(settings)
    }

    /// The task with another sweep, if that can be planned.
    fn with_grid(&self, grid: &SweepGrid) -> Option<SweepTask> {
        let axis = |values: &[f64]| Axis::List(values.to_vec());
        self.sweep.with_sweep(SweepPlan {
            delay_us: axis(&grid.delays_us),
            exposure_us: axis(&grid.exposures_us),
            ..self.sweep.sweep.clone()
        })
    }
}

fn grid_of(sweep: &SweepPlan) -> SweepGrid {
    SweepGrid { delays_us: sweep.delay_us.values(), exposures_us: sweep.exposure_us.values() }
}

/// How many of the settings saturate a white pixel.
fn saturated(timing: &RowTiming, settings: &[Setting], ceiling: f64) -> usize {
    settings.iter().filter(|setting| white_light(timing, setting) >= ceiling).count()
}

/// Frames of all points of a task.
fn total_frames(sweep: &SweepTask) -> u64 {
    sweep.task.schedule.points.iter().map(|point| u64::from(point.frames)).sum()
}

/// VSYNC periods that all frames of a task take.
fn total_periods(sweep: &SweepTask, camera: &CameraCapabilities) -> u64 {
    let task = &sweep.task;
    task.schedule.points.iter().map(|point| periods(task, camera, point) * u64::from(point.frames)).sum()
}

fn told(expected: advice::ExpectedError) -> ExpectedError {
    let advice::ExpectedError { epipolar, short_range, long_range, profile } = expected;
    ExpectedError { epipolar, short_range, long_range, profile }
}

/// The table `[sweep]` of a plan.
fn written(sweep: &SweepPlan) -> String {
    let SweepPlan { delay_us, exposure_us, average, max_jitter_us, bracket } = sweep;
    let (delay_us, exposure_us) = (axis(&delay_us.values()), axis(&exposure_us.values()));
    let bracket =
        bracket.map_or_else(String::new, |bracket| format!("bracket = {{ light = {} }}\n", bracket.light));
    format!(
        "[sweep]\ndelay_us = {delay_us}\nexposure_us = {exposure_us}\naverage = {average}\nmax_jitter_us = {max_jitter_us}\n{bracket}"
    )
}

/// An axis in its shortest form.
fn axis(values: &[f64]) -> String {
    if let [start, _, .., stop] = *values {
        let count = values.len();
        if (Axis::Range { start, stop, count }).values() == values {
            return format!("{{ start = {start}, stop = {stop}, count = {count} }}");
        }
    }
    let values: Vec<String> = values.iter().map(f64::to_string).collect();
    format!("[{}]", values.join(", "))
}

#[cfg(test)]
mod tests {
    use raysweep_config::{Plan, Procedure};
    use raysweep_core::{PixelFormat, Readout};
    use raysweep_processing::plane::KnownRig;
    use raysweep_transport::plane::Prior;
    use raysweep_transport::plane::advice::expected_error;

    use super::*;

    const RIG: &str = "kind = \"plane\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\nfirst_row_us = 600\n[camera]\ndriver = \"sim\"\n";

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

    fn advised(rig: &str, plan: &str, camera: &CameraCapabilities) -> Result<SweepAdvice, NoAdvice> {
        let rig = RigFile::parse(rig).unwrap();
        advise(&task(&rig, plan), &rig, camera)
    }

    /// The plan with its sweep, which is its last table, replaced by the proposed one.
    fn proposed(advice: &SweepAdvice, plan: &str) -> String {
        let rest = plan.split("[sweep]").next().unwrap();
        format!("{rest}{}", advice.better.as_ref().unwrap().sweep)
    }

    #[test]
    fn the_proposed_sweep_is_what_it_is_said_to_be() {
        let (rig, plan) = (RigFile::parse(RIG).unwrap(), "kind = \"sweep\"\n");
        let own = task(&rig, plan);
        let advice = advise(&own, &rig, &camera()).unwrap();
        let other = task(&rig, &proposed(&advice, plan));
        let better = advice.better.unwrap();
        assert_eq!((other.sweep.average, other.sweep.max_jitter_us), (8, 50.0));
        assert_eq!(other.points(), better.points);
        assert!(total_frames(&other) == better.frames && better.frames <= total_frames(&own));
        assert!(total_periods(&other, &camera()) <= total_periods(&own, &camera()));

        // By hand: 2500 counts of 1.66 electrons, 9 electrons of read noise, rounded to counts.
        let read = ((9.0_f64 / 4150.0).powi(2) + 1.0 / 12.0 / 2500.0_f64.powi(2)).sqrt();
        let noise = Noise { read, gain: 1.0 / 4150.0, frames: 8, dark_frames: Some(8) };
        let foreseen = |task: &SweepTask| {
            let (timing, grid) = (task.task.geometry.timing().unwrap(), grid_of(&task.sweep));
            expected_error(&timing, &grid.settings(), &(-94..=94), &Prior::SPLIT, &noise).unwrap()
        };
        assert_eq!(advice.expected, told(foreseen(&own)));
        assert_eq!(better.expected, told(foreseen(&other)));
        assert!(better.expected.profile < 0.9 * advice.expected.profile);
        assert!((advice.noise.dark - read).abs() < 1e-12);

        // Following the advice gives no further advice.
        assert_eq!(advise(&other, &rig, &camera()).unwrap().better.map(|better| better.sweep), None);
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
        let known = flying
            .replace("spot =", "scan = \"one-way\"\nbeam_sigma_rows = 0\nspot =")
            .replace("[camera]\n", "[camera]\nprojector_columns = [0.0, 1.0]\n");
        assert_eq!(expected(&known, plan), expected(RIG, plan));

        let none = plan.replace("-500, ", "").replace("0, 300, 500", "300");
        let error = advised(&flying, &none, &camera()).unwrap_err();
        assert!(matches!(error, NoAdvice::NothingUsable), "{error}");
    }

    #[test]
    fn no_more_points_saturate_than_in_the_plan() {
        // 54 rows in 1200 us add 0.16 to the direct light, 27 rows in 600 us half as much.
        let plan = "kind = \"sweep\"\n[sweep]\nexposure_us = [600, 1200]\n";
        let rig = |white_dn: f64| {
            let text = RIG.replace("[camera]\n", &format!("[camera]\nwhite_dn = {white_dn}\n"));
            RigFile::parse(&text).unwrap()
        };
        // Saturation is at 3972 counts, of which 64 are black. In the plan, 5 delays at 1200 us include the pixel's
        // own row.
        let usable = |white_dn: f64, delays: i32| {
            let (rig, camera) = (rig(white_dn), camera());
            let task = task(&rig, plan);
            let timing = task.task.geometry.timing().unwrap();
            let limits = Limits::new(&task, &rig, &camera, &timing);
            let delays_us = (0..delays).map(f64::from).collect();
            limits.usable(&SweepGrid { delays_us, exposures_us: vec![600.0, 1200.0] })
        };
        assert_eq!(usable(3300.0, 8).unwrap().len(), 16);
        let short = usable(3500.0, 5).unwrap();
        assert!(short.len() == 5 && short.iter().all(|setting| setting.exposure_us == 600.0), "{short:?}");
        assert_eq!(usable(3500.0, 8), None);

        let rig = rig(4000.0);
        let plan = "kind = \"sweep\"\n[sweep]\ndelay_us = [0]\n";
        let error = advise(&task(&rig, plan), &rig, &camera()).unwrap_err();
        assert!(matches!(error, NoAdvice::NothingUsable), "{error}");
    }

    #[test]
    fn products_keep_their_exposure() {
        let plan =
            "kind = \"sweep\"\n[[product]]\nkind = \"delay-profile\"\npixel = [3, 4]\nexposure_us = 900\n";
        let advice = advised(RIG, plan, &camera()).unwrap();
        let other = task(&RigFile::parse(RIG).unwrap(), &proposed(&advice, plan));
        assert!(other.sweep.exposure_us.values().contains(&900.0), "{:?}", other.sweep);
    }

    #[test]
    fn what_the_camera_cannot_do_is_not_proposed() {
        // Delays between -1500 and -200 us are triggered up to 700 us before the edge of their light.
        let plan = "kind = \"sweep\"\n[sweep]\nexposure_us = [600]\ndelay_us = [-1500, -200, -100, 0, 100, 200, 1500]\n";
        assert!(advised(RIG, plan, &camera()).unwrap().better.is_some());
        let short = CameraCapabilities { trigger_delay_us: 0.0..=15_700.0, ..camera() };
        let own = task(&RigFile::parse(RIG).unwrap(), plan);
        let settings =
            own.task.schedule.points.iter().map(|point| own.task.geometry.shot(point, 8.0).settings);
        assert!(settings.into_iter().all(|settings| short.allows(&settings).is_ok()));
        assert_eq!(advised(RIG, plan, &short).unwrap().better, None);
    }

    #[test]
    fn what_takes_longer_is_not_proposed() {
        // The grids with smaller errors have more delays that are triggered late in the period.
        let plan = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -4000, stop = 4000, count = 37 }\nexposure_us = [600, 1200]\n";
        let fast = CameraCapabilities { readout: Readout::Overlapped, readout_us: 0.0, ..camera() };
        let rig = RigFile::parse(RIG).unwrap();
        let own = task(&rig, plan);
        let advice = advise(&own, &rig, &fast).unwrap();
        let other = task(&rig, &proposed(&advice, plan));
        assert!(total_periods(&other, &fast) <= total_periods(&own, &fast));
        assert!(total_periods(&other, &camera()) > total_periods(&own, &camera()));
        let slow = advise(&own, &rig, &camera()).unwrap().better;
        assert_ne!(slow.map(|better| better.sweep), advice.better.map(|better| better.sweep));
    }

    #[test]
    fn a_sweep_that_takes_too_long_to_foresee_is_not_foreseen() {
        let plan = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -8000, stop = 8000, count = 1000 }\n";
        let error = advised(RIG, plan, &camera()).unwrap_err();
        assert!(matches!(error, NoAdvice::TooLarge { points: 5000, .. }), "{error}");
    }

    #[test]
    fn axes_are_written_as_they_are_read() {
        let paper = SweepPlan::default();
        assert_eq!(
            written(&paper),
            "[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\nexposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 8\nmax_jitter_us = 50\n"
        );
        assert_eq!(axis(&[600.0, 1200.0]), "[600, 1200]");
        assert_eq!(axis(&[-1500.0, -2.5, 0.0, 7.25]), "[-1500, -2.5, 0, 7.25]");
    }
}
