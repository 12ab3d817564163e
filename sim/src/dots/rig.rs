//! The simulated dot rig and its construction.

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use raysweep_core::{Camera, Clock, Mirror};

use super::beam::DotBeam;
use super::bench::{Bench, DotsSetup};
use super::camera::DotCamera;
use super::mirror::{DotMirror, WatchedMirror};
use super::scene::{DotScene, DotSceneError};
use super::world::{DotsTruth, World};
use crate::sensor::{ImageSensor, Scale};
use crate::subject::SubjectSwitch;
use raysweep_config::sim::{DotsConfig, SimDotSensor, SimSensor};

/// Why a simulated dot rig cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum DotsRigError {
    /// The scene cannot be read or computed.
    #[error("sim.dots.scene: {0}")]
    Scene(#[from] DotSceneError),
    /// A key of `[sim.dots]` outside its range.
    #[error("sim.dots.{key} = {value}: must be {allowed}")]
    Range {
        /// Key below `[sim.dots]`.
        key: &'static str,
        /// Given value.
        value: f64,
        /// Allowed values.
        allowed: &'static str,
    },
}

impl DotsRigError {
    /// The key below `[sim.dots]` that causes the error.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Scene(_) => "scene",
            Self::Range { key, .. } => key,
        }
    }
}

/// A simulated dot rig, whose devices can be opened repeatedly.
pub struct DotsRig {
    bench: Arc<Bench>,
}

/// The devices of one dot rig, sharing one clock.
pub struct DotsDevices {
    /// The camera, which takes one frame per dot.
    pub camera: Box<dyn Camera>,
    /// The mirror and its light.
    pub mirror: Box<dyn Mirror>,
    /// Selects the scene or a plane in front of the camera.
    pub subject: SubjectSwitch,
    /// The devices' clock.
    pub clock: Clock,
    /// Ground truth, for tests only; real rigs have none.
    pub truth: DotsTruth,
}

impl DotsRig {
    /// Builds the rig; the path of a scene file is relative to `folder`.
    ///
    /// # Errors
    /// When the scene cannot be read or a key is out of range; the message names the key.
    pub fn new(config: DotsConfig, setup: DotsSetup, folder: &Path) -> Result<Self, DotsRigError> {
        check_ranges(&config)?;
        let half = config.fov_deg.map(|fov| (fov / 2.0).to_radians().tan());
        let scene = DotScene::new(&config, half, setup.format.mosaic, folder)?;
        let (rows, columns) = scene.view().size;
        let size = (rows + config.margin_rows, columns);
        let scale = Scale { white_dn: setup.white_dn, black_dn: setup.black_dn, bits: setup.format.bits() };
        let sensor = ImageSensor::new(&emva(&config.sensor), size, scale, config.seed);
        let beam = DotBeam::new(&config.dot, half);
        Ok(Self { bench: Arc::new(Bench { config, setup, scene, beam, sensor, size }) })
    }

    /// Camera rows (the scene's, then the margin with the trailing dot) and columns.
    pub fn size(&self) -> (usize, usize) {
        self.bench.size
    }

    /// Number of scene rows; the margin follows.
    pub fn scene_rows(&self) -> usize {
        self.bench.scene.view().size.0
    }

    /// Camera rows and columns that show only the trailing dot, which covers less than half of them.
    pub fn trailing_region(&self) -> (Range<usize>, Range<usize>) {
        let (rows, columns) = self.bench.size;
        let (middle, margin) = (columns / 2, self.bench.config.margin_rows);
        (self.scene_rows()..rows, middle.saturating_sub(margin)..(middle + margin).min(columns))
    }

    /// Opens the devices, with a camera that takes `frame_rate_hz` frames per second. With a mirror that has its own
    /// driver, the rig runs on the host's clock and the camera is not synchronised to the mirror's clock.
    pub fn open(&self, frame_rate_hz: f64, mirror: Option<Box<dyn Mirror>>) -> DotsDevices {
        let by_the_clock = self.bench.config.realtime || mirror.is_some();
        let clock = if by_the_clock { Clock::real() } else { Clock::simulated() };
        let world = World::new(self.bench.clone(), frame_rate_hz, clock.clone(), by_the_clock);
        let mirror: Box<dyn Mirror> = match mirror {
            Some(mirror) => Box::new(WatchedMirror::new(mirror, world.clone())),
            None => Box::new(DotMirror::new(world.clone())),
        };
        DotsDevices {
            camera: Box::new(DotCamera::new(world.clone(), clock.register())),
            mirror,
            subject: SubjectSwitch::new({
                let world = world.clone();
                move |subject| world.place(subject)
            }),
            truth: DotsTruth::new(world),
            clock,
        }
    }
}

fn check_ranges(config: &DotsConfig) -> Result<(), DotsRigError> {
    let share = (0.0..=1.0, "0 to 1");
    let not_negative = (0.0..=f64::MAX, "0 or more");
    let positive = (f64::MIN_POSITIVE..=f64::MAX, "more than 0");
    let side = (8.0..=4096.0, "8 to 4096");
    let DotsConfig { dot, mirror, camera, sensor, .. } = config;
    let [fov_x, fov_y] = config.fov_deg;
    let mut rules = vec![
        ("rows", config.rows as f64, side.clone()),
        ("columns", config.columns as f64, side),
        ("margin_rows", config.margin_rows as f64, (4.0..=512.0, "4 to 512")),
        ("motion_period_s", config.motion_period_s, (0.1..=1e6, "0.1 to 1e6")),
        ("fov_deg", fov_x.min(fov_y), (0.1..=90.0, "0.1 to 90")),
        ("fov_deg", fov_x.max(fov_y), (0.1..=90.0, "0.1 to 90")),
        ("dot.fwhm_deg", dot.fwhm_deg, (0.01..=10.0, "0.01 to 10")),
        ("dot.uneven", dot.uneven, share.clone()),
        ("dot.ghost", dot.ghost, share.clone()),
        ("mirror.f0_hz", mirror.f0_hz[0].min(mirror.f0_hz[1]), positive.clone()),
        ("mirror.q", mirror.q[0].min(mirror.q[1]), positive.clone()),
        ("mirror.filter_hz", mirror.filter_hz, positive.clone()),
        ("mirror.coupling", mirror.coupling.abs(), share.clone()),
        ("mirror.repeat_deg", mirror.repeat_deg, not_negative.clone()),
        ("camera.clock_error", camera.clock_error, (-0.01..=0.01, "-0.01 to 0.01")),
        ("camera.dropped", camera.dropped, share.clone()),
        ("camera.duplicated", camera.duplicated, share.clone()),
        ("camera.saturated", camera.saturated, share.clone()),
        ("sensor.hot_pixels", sensor.hot_pixels, share),
        ("sensor.electrons_per_dn", sensor.electrons_per_dn, positive.clone()),
        ("sensor.full_well_e", sensor.full_well_e, positive),
        ("sensor.read_noise_e", sensor.read_noise_e, not_negative.clone()),
        ("sensor.dsnu_e", sensor.dsnu_e, not_negative.clone()),
        ("sensor.column_e", sensor.column_e, not_negative.clone()),
        ("sensor.prnu_percent", sensor.prnu_percent, not_negative.clone()),
        ("sensor.hot_pixel_e_per_s", sensor.hot_pixel_e_per_s, not_negative),
        ("sensor.vignetting_percent", sensor.vignetting_percent, (0.0..=100.0, "0 to 100")),
    ];
    rules.extend(
        config.plane_depths.iter().map(|&depth| ("plane_depths", depth, (0.5..=2.0, "0.5 to 2, each"))),
    );
    for (key, value, (range, allowed)) in rules {
        if !range.contains(&value) {
            return Err(DotsRigError::Range { key, value, allowed });
        }
    }
    Ok(())
}

/// The same sensor in the terms of the plane rig's.
fn emva(sensor: &SimDotSensor) -> SimSensor {
    SimSensor {
        noise: sensor.noise,
        electrons_per_dn: sensor.electrons_per_dn,
        full_well_e: sensor.full_well_e,
        read_noise_e: sensor.read_noise_e,
        dsnu_e: sensor.dsnu_e,
        column_e: sensor.column_e,
        prnu_percent: sensor.prnu_percent,
        hot_pixels: sensor.hot_pixels,
        hot_pixel_e_per_s: sensor.hot_pixel_e_per_s,
        // Negligible in the exposure of a dot.
        dark_current_e_per_s: 0.0,
        adc_bits: 12,
        vignetting_percent: sensor.vignetting_percent,
        compression_percent: 0.0,
    }
}
