//! What a simulated plane rig consists of, and what its devices see of it.

use std::sync::{Arc, OnceLock};

use raysweep_config::sim::SimConfig;
use raysweep_core::{CameraCapabilities, Pattern, PixelFormat, Raster, Shutter, ns_from_us};

use crate::error::SimError;
use crate::keyed::{Purpose, keyed, uniform};
use crate::line::{Exposure, LineConfig, Shown};
use crate::optics::{RasterOptics, row_table};
use crate::scene::{Scene, SceneMotion};
use crate::sensor::ImageSensor;

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

/// The parts of the rig that are constant while it runs.
pub(crate) struct PlaneWorld {
    pub config: SimConfig,
    pub setup: PlaneSetup,
    /// The scene in each key position of its motion; all have the same size.
    pub scenes: Vec<Scene>,
    pub motion: SceneMotion,
    pub first_row: usize,
    pub size: (usize, usize),
    pub format: PixelFormat,
    pub sensor: ImageSensor,
    pub white: OnceLock<Shown>,
}

impl PlaneWorld {
    pub fn optics_of(&self, pattern: &Pattern) -> Result<Shown, SimError> {
        let rows = self.setup.raster.rows;
        let build = |weights: &[f32]| {
            let (mosaic, projector) = (self.format.mosaic, &self.config.projector);
            let table = row_table(&self.setup.raster, &projector.row_table, self.config.seed)?;
            let optics = |scene| {
                RasterOptics::new(scene, mosaic, self.first_row, projector, &table, weights).map(Arc::new)
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

    pub fn line_config(&self) -> LineConfig {
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
