//! The simulated plane rig: a scene, a projector and a camera.

use std::path::Path;
use std::sync::{Arc, OnceLock};

use ndarray::Array2;
use raysweep_core::{
    CameraCapabilities, Clock, Pattern, PatternError, PixelFormat, Raster, Shutter, ns_from_us,
};

use crate::config::SimConfig;
use crate::devices::{self, Devices, WireDevices};
use crate::keyed::{Purpose, keyed, uniform};
use crate::line::{Exposure, Line, LineConfig, Shown};
use crate::optics::{self, Optics};
use crate::scene::{Motion, Scene, SceneError, SceneSize};
use crate::sensor::{Scale, Sensor};

/// Why a simulated rig cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The scene cannot be read or computed.
    #[error("sim.scene: {0}")]
    Scene(#[from] SceneError),
    /// The scene has more rows than the projector below its first row.
    #[error(
        "sim.scene has {scene_rows} rows, which do not fit below row {first_row} of the projector's {projector_rows}: raise projector.rows, lower camera.first_projector_row or take a smaller scene"
    )]
    SceneRows {
        /// Scene rows.
        scene_rows: usize,
        /// Projector row of the scene's first row.
        first_row: usize,
        /// Projector rows.
        projector_rows: usize,
    },
    /// The camera rows span more projector rows than there are.
    #[error(
        "the camera rows of sim.scene look along {camera_rows} projector rows, which do not fit below row {first_row} of the projector's {projector_rows}: raise projector.rows, lower camera.row_pitch or set camera.first_projector_row"
    )]
    CameraRows {
        /// Projector rows spanned by the scene's camera rows.
        camera_rows: usize,
        /// Projector row of the first camera row.
        first_row: usize,
        /// Projector rows.
        projector_rows: usize,
    },
    /// Row times do not increase from row to row.
    #[error(
        "sim.projector.row_table: rows would be drawn in a different order; take a smaller percent or amplitude_us"
    )]
    RowTable,
    /// The beam has no extent or is too wide.
    #[error(
        "sim.projector.beam: sigma_rows must lie in 0..=100 (not 0), up_rows + down_rows in 0..=500 (not 0)"
    )]
    Beam,
    /// The pattern does not fit the projector.
    #[error(transparent)]
    Pattern(#[from] PatternError),
    /// The pattern varies along rows, which the scenes' row transport cannot represent.
    #[error(
        "the simulated projector shows white, black, a line and row weights: a pattern that changes along rows needs a real one"
    )]
    AlongRows,
    /// A key of `[sim]` outside its range.
    #[error("sim.{key} = {value}: allowed is {allowed}")]
    Range {
        /// Key below `[sim]`.
        key: &'static str,
        /// Given value.
        value: f64,
        /// Allowed values.
        allowed: &'static str,
    },
}

impl SimError {
    /// The key below `[sim]` that causes the error.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Scene(_)
            | Self::SceneRows { .. }
            | Self::CameraRows { .. }
            | Self::Pattern(_)
            | Self::AlongRows => "scene",
            Self::RowTable => "projector.row_table",
            Self::Beam => "projector.beam",
            Self::Range { key, .. } => key,
        }
    }
}

/// Parameters from the rest of the rig file that the simulation needs.
#[derive(Debug, Clone, Copy)]
pub struct PlaneSetup {
    /// Raster timing of the projector.
    pub raster: Raster,
    /// Row time of the camera.
    pub camera_row_time_us: f64,
    /// Projector rows from one camera row to the next, as for the scene.
    pub row_pitch: f64,
    /// Counts, above black, of a white pixel in the time of one projector row.
    pub white_dn: f64,
    /// Counts without light.
    pub black_dn: f64,
    /// Pixel packing of the frames.
    pub format: PixelFormat,
    /// Projector row seen by camera row 0. `None`: the scene is centred in the projector's rows.
    pub first_row: Option<usize>,
}

/// A simulated plane rig, whose devices can be opened repeatedly.
pub struct PlaneRig {
    bench: Arc<Bench>,
}

/// The parts of the rig that are constant while it runs.
pub(crate) struct Bench {
    pub config: SimConfig,
    setup: PlaneSetup,
    /// The scene in each key position of its motion; all have the same size.
    scenes: Vec<Scene>,
    motion: Motion,
    first_row: usize,
    pub size: (usize, usize),
    pub format: PixelFormat,
    pub sensor: Sensor,
    white: OnceLock<Shown>,
}

impl PlaneRig {
    /// Builds the rig; the path of a scene file is relative to `folder`.
    ///
    /// # Errors
    /// When the scene cannot be read or a key is out of range; the message names the key.
    pub fn new(config: SimConfig, setup: PlaneSetup, folder: &Path) -> Result<Self, SimError> {
        check_ranges(&config)?;
        let scenes = if config.scene.extension().is_some_and(|extension| extension == "npz") {
            vec![Scene::load(&folder.join(&config.scene))?]
        } else {
            let size = SceneSize { rows: config.scene_rows, columns: config.scene_columns };
            Scene::key_positions(&config.scene.to_string_lossy(), size, config.seed)?
        };
        let motion = Motion::new(scenes.len(), config.motion_period_s);
        let first_row = optics::first_scene_row(&setup.raster, &scenes[0], setup.row_pitch, setup.first_row)?;
        let size = scenes[0].size();
        let scale = Scale { white_dn: setup.white_dn, black_dn: setup.black_dn, bits: setup.format.bits() };
        let sensor = Sensor::new(&config.sensor, size, scale, config.seed);
        let bench = Bench {
            config,
            setup,
            scenes,
            motion,
            first_row,
            size,
            format: setup.format,
            sensor,
            white: OnceLock::new(),
        };
        bench.optics_of(&Pattern::White)?;
        Ok(Self { bench: Arc::new(bench) })
    }

    /// The scene, at time zero if it moves: the ground truth for recovered transports.
    pub fn scene(&self) -> &Scene {
        self.scene_at(0)
    }

    /// The scene during the projector frame that begins at a time of the devices' clock.
    pub fn scene_at(&self, time_ns: i64) -> &Scene {
        &self.bench.scenes[self.bench.motion.key(time_ns)]
    }

    /// Projector row seen by camera row 0.
    pub fn first_row(&self) -> usize {
        self.bench.first_row
    }

    /// True start of each projector row's light, and the last row's end, after the VSYNC edge: `[rows + 1]`. The ground
    /// truth for measured row tables.
    ///
    /// # Errors
    /// None for a rig that was built successfully; returned so that no caller has to rely on that.
    pub fn row_starts_us(&self) -> Result<Vec<f64>, SimError> {
        let Bench { config, setup, .. } = &*self.bench;
        optics::row_table(&setup.raster, &config.projector.row_table, config.seed)
    }

    /// Opens the devices, starting at time zero of their own clock.
    pub fn open(&self) -> Devices {
        let clock = if self.bench.config.realtime { Clock::real() } else { Clock::simulated() };
        devices::open(&self.bench, Line::new(self.bench.line_config(), clock.now_ns()), clock)
    }

    /// Opens the devices on the host's clock, with the camera as the picture source of a network camera.
    pub fn open_for_wire(&self) -> WireDevices {
        devices::open_for_wire(&self.bench, Line::new(self.bench.line_config(), Clock::real().now_ns()))
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
        let shown = self.bench.optics_of(&Pattern::White)?;
        let optics = &shown[self.bench.motion.key(time_ns)];
        let start_us = self.bench.setup.raster.row_centre_us(self.first_row()) + delay_us - exposure_us / 2.0;
        let mut image = Array2::zeros(self.bench.size);
        for (t, mut row) in image.rows_mut().into_iter().enumerate() {
            let mut light = vec![0.0; row.len()];
            let from_us = start_us + self.bench.row_start_us(Shutter::Rolling, t);
            optics.expose_row(t, from_us, from_us + exposure_us, &mut light);
            row.assign(&ndarray::ArrayView1::from(&light));
        }
        Ok(image)
    }
}

impl Bench {
    pub fn optics_of(&self, pattern: &Pattern) -> Result<Shown, SimError> {
        let rows = self.setup.raster.rows;
        let build = |weights: &[f32]| {
            let mosaic = self.format.mosaic;
            let (raster, projector) = (&self.setup.raster, &self.config.projector);
            let optics = |scene| {
                Optics::new(scene, raster, self.first_row, projector, weights, self.config.seed, mosaic)
                    .map(Arc::new)
            };
            self.scenes.iter().map(optics).collect::<Result<Shown, SimError>>()
        };
        if *pattern == Pattern::White {
            if let Some(white) = self.white.get() {
                return Ok(white.clone());
            }
            let white = build(&vec![1.0; rows])?;
            return Ok(self.white.get_or_init(|| white).clone());
        }
        build(&pattern.row_weights(rows)?.ok_or(SimError::AlongRows)?)
    }

    /// Start of row `t`'s exposure relative to row 0.
    pub fn row_start_us(&self, shutter: Shutter, t: usize) -> f64 {
        match shutter {
            Shutter::Rolling => t as f64 * self.setup.camera_row_time_us,
            Shutter::Global => 0.0,
        }
    }

    /// Ambient light of an exposure, in the scene's units.
    pub fn ambient(&self, exposure: &Exposure) -> f32 {
        let ambient = &self.config.ambient;
        if ambient.level == 0.0 {
            return 0.0;
        }
        let exposure_s = exposure.settings.exposure_us * 1e-6;
        let key = [exposure.key[0], exposure.key[1]];
        let phase = uniform(&mut keyed(self.config.seed, Purpose::Flicker, &key));
        let start_s = exposure.key[2] as f64 * self.setup.raster.period_us * 1e-6;
        let angle = |time_s: f64| std::f64::consts::TAU * (phase + ambient.flicker_hz * time_s);
        // The integral of 1 + m sin(angle) over the exposure.
        let swing = (angle(start_s).cos() - angle(start_s + exposure_s).cos())
            / (std::f64::consts::TAU * ambient.flicker_hz.max(1e-9));
        let rows = (exposure_s + ambient.flicker * swing) / (self.setup.raster.row_time_us * 1e-6);
        (ambient.level * rows) as f32
    }

    pub fn capabilities(&self) -> CameraCapabilities {
        let (height, width) = self.size;
        let camera = &self.config.camera;
        CameraCapabilities {
            model: "raysweep simulated camera".into(),
            width,
            height,
            format: self.format,
            row_time_us: self.setup.camera_row_time_us,
            trigger_latency_us: camera.trigger_latency_us,
            readout_us: self.readout_us(),
            readout: camera.readout,
            exposure_us: camera.exposure_step_us..=1e6,
            trigger_delay_us: 0.0..=16e6,
        }
    }

    fn readout_us(&self) -> f64 {
        self.config.camera.readout_us.unwrap_or(self.size.0 as f64 * self.setup.camera_row_time_us)
    }

    fn line_config(&self) -> LineConfig {
        LineConfig {
            seed: self.config.seed,
            period_ns: ns_from_us(self.setup.raster.period_us),
            vsync: self.config.vsync.clone(),
            projector: self.config.projector.clone(),
            camera: self.config.camera.clone(),
            motion: self.motion,
            readout_ns: ns_from_us(self.readout_us()),
            rolling_ns: ns_from_us(self.size.0.saturating_sub(1) as f64 * self.setup.camera_row_time_us),
        }
    }
}

fn check_ranges(config: &SimConfig) -> Result<(), SimError> {
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
        ("sensor.electrons_per_dn", config.sensor.electrons_per_dn, "more than 0"),
        ("sensor.full_well_e", config.sensor.full_well_e, "more than 0"),
        ("sensor.read_noise_e", config.sensor.read_noise_e, not_negative),
        ("sensor.dsnu_e", config.sensor.dsnu_e, not_negative),
        ("sensor.column_e", config.sensor.column_e, not_negative),
        ("sensor.prnu_percent", config.sensor.prnu_percent, not_negative),
        ("sensor.vignetting_percent", config.sensor.vignetting_percent, "0 to 100"),
        ("sensor.adc_bits", f64::from(config.sensor.adc_bits), "1 to 12"),
        ("camera.late_frames_max", f64::from(config.camera.late_frames_max), "0 to 100"),
        ("ambient.level", config.ambient.level, not_negative),
        ("motion_period_s", config.motion_period_s, "0.1 to 1e6"),
        ("ambient.flicker_hz", config.ambient.flicker_hz, "more than 0"),
    ];
    for (key, value, allowed) in rules {
        let range = match allowed {
            "0 to 1" => 0.0..=1.0,
            "0.001 to 1000" => 0.001..=1000.0,
            "0 to 100" => 0.0..=100.0,
            "1 to 12" => 1.0..=12.0,
            "0.1 to 1e6" => 0.1..=1e6,
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
