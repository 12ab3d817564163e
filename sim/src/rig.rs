//! The simulated plane rig: a scene, a projector and a camera.

use std::path::Path;
use std::sync::Arc;

use ndarray::Array2;
use raysweep_core::{Clock, Pattern, Shutter, Subject};

use crate::devices::{self, PlaneDevices};
use crate::error::SimError;
use crate::lens::Lens;
use crate::line::VsyncLine;
use crate::optics;
use crate::scene::{Scene, SceneMotion, SceneSize, is_file};
use crate::sensor::{ImageSensor, Scale};
use crate::shown::ShownOptics;
use crate::truth::{PlaneTruth, Stated};
use crate::wire::{self, WireDevices};
use crate::world::{PlaneSetup, PlaneWorld};
use raysweep_config::sim::SimConfig;

/// One of a rig's lenses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LensOf {
    /// The camera's.
    Camera,
    /// The projector's.
    Projector,
}

/// Turns the lenses of a simulated rig, also during a run. For tests only: real lenses are turned by hand.
#[derive(Clone)]
pub struct LensControl(Arc<PlaneWorld>);

impl LensControl {
    /// Turns a lens's focus ring to this position, for frames that are rendered from now on.
    pub fn turn(&self, lens: LensOf, position_mm: f64) {
        match lens {
            LensOf::Camera => self.0.camera_lens.turn(position_mm),
            LensOf::Projector => self.0.projector_lens.turn(position_mm),
        }
    }
}

/// A simulated plane rig, whose devices can be opened repeatedly.
pub struct PlaneRig {
    world: Arc<PlaneWorld>,
}

impl PlaneRig {
    /// Builds the rig; the path of a scene file is relative to `folder`.
    ///
    /// # Errors
    /// When the scene cannot be read or a key is out of range; the message names the key.
    pub fn new(config: SimConfig, setup: PlaneSetup, folder: &Path) -> Result<Self, SimError> {
        check_ranges(&config)?;
        let mut scenes = if is_file(&config.scene) {
            vec![Scene::load(&folder.join(&config.scene))?]
        } else {
            let size = SceneSize { rows: config.scene_rows, columns: config.scene_columns };
            let scenes = Scene::key_positions(&config.scene.to_string_lossy(), size, config.seed)?;
            if config.scene_rows > setup.raster.rows {
                return Err(SimError::TooManyRows { rows: config.scene_rows, most: setup.raster.rows });
            }
            scenes
        };
        if let Some([first, end]) = config.board.strip_columns {
            let (_, columns) = scenes[0].size();
            if first >= end || end > columns {
                return Err(SimError::Strip { first, end, columns });
            }
            scenes.iter_mut().for_each(|scene| scene.cover_with_board(first..end));
        }
        let motion = SceneMotion::new(scenes.len(), config.motion_period_s);
        let first_row = optics::first_scene_row(&setup.raster, &scenes[0], setup.row_pitch, setup.first_row)?;
        let size = scenes[0].size();
        let stated = Stated {
            raster: setup.raster,
            camera_row_time_us: setup.camera_row_time_us,
            row_pitch: setup.row_pitch,
            first_row,
            white_dn: setup.white_dn,
            black_dn: setup.black_dn,
        };
        let truth = PlaneTruth::new(&config, stated, size, scenes[0].rows())?;
        let scale = Scale { white_dn: truth.white_dn, black_dn: truth.black_dn, bits: setup.format.bits() };
        let sensor = ImageSensor::new(&config.sensor, size, scale, config.seed);
        let world = PlaneWorld {
            camera_lens: Lens::new(config.camera.lens),
            projector_lens: Lens::new(config.projector.lens),
            config,
            setup,
            scenes,
            motion,
            first_row,
            truth,
            size,
            format: setup.format,
            sensor,
            white: Arc::new(ShownOptics::new(Pattern::White)),
        };
        world.prepare(&world.white, Subject::Scene)?;
        Ok(Self { world: Arc::new(world) })
    }

    /// The scene, at time zero if it moves: the ground truth for recovered transports.
    pub fn scene(&self) -> &Scene {
        self.scene_at(0)
    }

    /// The scene during the projector frame that begins at a time of the devices' clock.
    pub fn scene_at(&self, time_ns: i64) -> &Scene {
        &self.world.scenes[self.world.motion.key(time_ns)]
    }

    /// What is true of the rig, for tests only.
    pub fn truth(&self) -> &PlaneTruth {
        &self.world.truth
    }

    /// Turns the lenses, also while devices are open; for tests only.
    pub fn lenses(&self) -> LensControl {
        LensControl(self.world.clone())
    }

    /// Projector row seen by camera row 0, as far as the rig file knows.
    pub fn first_row(&self) -> usize {
        self.world.first_row
    }

    /// True start of each projector row's light, and the last row's end, after the VSYNC edge: `[rows + 1]`. The ground
    /// truth for measured row tables.
    ///
    /// # Errors
    /// None for a rig that was built successfully; returned so that no caller has to rely on that.
    pub fn row_starts_us(&self) -> Result<Vec<f64>, SimError> {
        let PlaneWorld { config, truth, .. } = &*self.world;
        optics::row_table(&truth.raster, &config.projector.row_table, config.seed)
    }

    /// Opens the devices, starting at time zero of their own clock.
    pub fn open(&self) -> PlaneDevices {
        let clock = if self.world.config.realtime { Clock::real() } else { Clock::simulated() };
        devices::open(&self.world, VsyncLine::new(self.world.line_config(), clock.now_ns()), clock)
    }

    /// Opens the devices on the host's clock, with the camera as the picture source of a network camera.
    pub fn open_for_wire(&self) -> WireDevices {
        wire::open(&self.world, VsyncLine::new(self.world.line_config(), Clock::real().now_ns()))
    }

    /// Light of an image without noise or jitter, in the scene's units, `[t, s]`: one white frame, each camera row
    /// exposed for `exposure_us`, centred `delay_us` after its own projector row.
    ///
    /// # Errors
    /// None for a rig that was built successfully; returned so that no caller has to rely on that.
    pub fn noise_free(&self, delay_us: f64, exposure_us: f64) -> Result<Array2<f32>, SimError> {
        self.noise_free_at(0, delay_us, exposure_us)
    }

    /// Like [`Self::noise_free`], for the projector frame that begins at a time of the devices' clock.
    ///
    /// # Errors
    /// As for [`Self::noise_free`].
    pub fn noise_free_at(
        &self,
        time_ns: i64,
        delay_us: f64,
        exposure_us: f64,
    ) -> Result<Array2<f32>, SimError> {
        let PlaneWorld { truth, white, motion, size, .. } = &*self.world;
        let start_us = truth.raster.row_centre_us(truth.first_row) + delay_us - exposure_us / 2.0;
        let mut image = Array2::zeros(*size);
        self.world.prepare(white, Subject::Scene)?;
        let Some(optics) = self.world.optics(white, Subject::Scene) else { return Ok(image) };
        let optics = &optics[motion.key(time_ns) % optics.len()];
        for (t, mut row) in image.rows_mut().into_iter().enumerate() {
            let mut light = vec![0.0; row.len()];
            let from_us = start_us + self.world.row_start_us(Shutter::Rolling, t);
            optics.expose_row(t, from_us, from_us + exposure_us, &mut light);
            row.assign(&ndarray::ArrayView1::from(&light));
        }
        Ok(image)
    }
}

fn check_ranges(config: &SimConfig) -> Result<(), SimError> {
    let truth = &config.truth;
    let share = "0 to 1";
    let not_negative = "0 or more";
    let rules = [
        ("vsync.missing", config.vsync.missing, share),
        ("vsync.false_edges", config.vsync.false_edges, share),
        ("vsync.unseen", config.vsync.unseen, share),
        ("camera.dropped", config.camera.dropped, share),
        ("sensor.hot_pixels", config.sensor.hot_pixels, share),
        ("ambient.flicker", config.ambient.flicker, share),
        ("vsync.jitter_us", config.vsync.jitter_us, not_negative),
        ("projector.phase_jitter_us", config.projector.phase_jitter_us, not_negative),
        ("camera.trigger_latency_us", config.camera.trigger_latency_us, not_negative),
        ("camera.readout_us", config.camera.readout_us.unwrap_or(0.0), not_negative),
        ("camera.exposure_step_us", config.camera.exposure_step_us, "0.001 to 1000"),
        ("camera.delay_step_us", config.camera.delay_step_us, "0.001 to 1000"),
        ("camera.lens.depth_of_field_mm", config.camera.lens.depth_of_field_mm, "0.001 to 1000"),
        ("projector.lens.depth_of_field_mm", config.projector.lens.depth_of_field_mm, "0.001 to 1000"),
        ("camera.lens.position_mm", config.camera.lens.position_mm, "-8192 to 8192"),
        ("camera.lens.focus_mm", config.camera.lens.focus_mm, "-8192 to 8192"),
        ("projector.lens.position_mm", config.projector.lens.position_mm, "-8192 to 8192"),
        ("projector.lens.focus_mm", config.projector.lens.focus_mm, "-8192 to 8192"),
        ("sensor.electrons_per_dn", config.sensor.electrons_per_dn, "more than 0"),
        ("sensor.full_well_e", config.sensor.full_well_e, "more than 0"),
        ("sensor.read_noise_e", config.sensor.read_noise_e, not_negative),
        ("sensor.dsnu_e", config.sensor.dsnu_e, not_negative),
        ("sensor.column_e", config.sensor.column_e, not_negative),
        ("sensor.prnu_percent", config.sensor.prnu_percent, not_negative),
        ("sensor.vignetting_percent", config.sensor.vignetting_percent, "0 to 100"),
        ("sensor.compression_percent", config.sensor.compression_percent, "0 to 20"),
        ("sensor.adc_bits", f64::from(config.sensor.adc_bits), "1 to 12"),
        ("camera.late_frames_max", f64::from(config.camera.late_frames_max), "0 to 100"),
        ("ambient.level", config.ambient.level, not_negative),
        ("motion_period_s", config.motion_period_s, "0.1 to 1e6"),
        ("ambient.flicker_hz", config.ambient.flicker_hz, "more than 0"),
        ("board.scatter_rows", config.board.scatter_rows, "0 to 100"),
        ("board.scatter_share", config.board.scatter_share, share),
        ("board.second_scatter_rows", config.board.second_scatter_rows, "0 to 100"),
        ("board.second_scatter_share", config.board.second_scatter_share, share),
        ("board.projector_columns", config.board.projector_columns[0], share),
        ("board.projector_columns", config.board.projector_columns[1], share),
        ("truth.first_row_us", truth.first_row_us.unwrap_or(0.0), not_negative),
        ("truth.row_time_us", truth.row_time_us.unwrap_or(1.0), "0.1 to 10000"),
        ("truth.row_pitch", truth.row_pitch.unwrap_or(1.0), "0.01 to 100"),
        ("truth.trigger_latency_us", truth.trigger_latency_us.unwrap_or(0.0), not_negative),
        ("truth.camera_row_time_us", truth.camera_row_time_us.unwrap_or(1.0), "0.1 to 10000"),
        ("truth.white_dn", truth.white_dn.unwrap_or(1.0), "more than 0"),
        ("truth.black_dn", truth.black_dn.unwrap_or(0.0), not_negative),
        ("truth.row_offset_rows", truth.row_offset_rows, "-8192 to 8192"),
        ("truth.rotation_deg", truth.rotation_deg, "-45 to 45"),
        ("truth.magnification", truth.magnification, "0.01 to 100"),
    ];
    for (key, value, allowed) in rules {
        let range = match allowed {
            "0 to 1" => 0.0..=1.0,
            "0.001 to 1000" => 0.001..=1000.0,
            "0 to 100" => 0.0..=100.0,
            "0 to 20" => 0.0..=20.0,
            "1 to 12" => 1.0..=12.0,
            "0.1 to 1e6" => 0.1..=1e6,
            "0.1 to 10000" => 0.1..=10_000.0,
            "0.01 to 100" => 0.01..=100.0,
            "-8192 to 8192" => -8192.0..=8192.0,
            "-45 to 45" => -45.0..=45.0,
            "more than 0" => f64::MIN_POSITIVE..=f64::MAX,
            _ => 0.0..=f64::MAX,
        };
        if !range.contains(&value) {
            return Err(SimError::Range { key, value, allowed });
        }
    }
    if config.camera.late_frames_min > config.camera.late_frames_max {
        return Err(SimError::Range {
            key: "camera.late_frames_min",
            value: f64::from(config.camera.late_frames_min),
            allowed: "at most sim.camera.late_frames_max",
        });
    }
    Ok(())
}
