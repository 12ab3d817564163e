//! What a simulated plane rig consists of, and what its devices see of it.

use std::sync::Arc;

use raysweep_config::sim::{FlickerPhase, SimBoard, SimConfig};
use raysweep_core::{CameraCapabilities, Pattern, PixelFormat, Raster, Shutter, Subject, ns_from_us};

use crate::error::SimError;
use crate::keyed::{Purpose, keyed, uniform};
use crate::lens::Lens;
use crate::line::{Exposure, LineConfig};
use crate::optics::{RasterOptics, View};
use crate::scene::{Scene, SceneMotion};
use crate::sensor::ImageSensor;
use crate::shown::ShownOptics;
use crate::truth::PlaneTruth;

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
    /// Projector row seen by camera row 0, as far as the rig file knows.
    pub first_row: usize,
    pub truth: PlaneTruth,
    pub size: (usize, usize),
    pub format: PixelFormat,
    pub sensor: ImageSensor,
    pub camera_lens: Lens,
    pub projector_lens: Lens,
    /// What a white picture shows, which is shown in every run.
    pub white: Arc<ShownOptics>,
}

impl PlaneWorld {
    /// What the projector shows under a pattern, with this subject before the camera.
    pub fn show(&self, pattern: &Pattern, subject: Subject) -> Result<Arc<ShownOptics>, SimError> {
        let shown = match pattern {
            Pattern::White => self.white.clone(),
            _ => Arc::new(ShownOptics::new(pattern.clone())),
        };
        self.prepare(&shown, subject)?;
        Ok(shown)
    }

    /// Computes the light of a subject under what is shown, unless that is done for the lens as it is.
    pub fn prepare(&self, shown: &ShownOptics, subject: Subject) -> Result<(), SimError> {
        let Self { config, truth, .. } = self;
        let (lens_mm, disc) = self.projector_lens.now();
        if shown.optics(subject).is_some_and(|(prepared_mm, _)| prepared_mm == lens_mm) {
            return Ok(());
        }
        let view = View {
            truth,
            projector: &config.projector,
            seed: config.seed,
            mosaic: self.format.mosaic,
            disc: disc.as_deref(),
        };
        let optics = match subject {
            Subject::Scene => {
                let optics = |scene| RasterOptics::of_scene(scene, &view, &shown.pattern);
                self.scenes.iter().map(optics).collect::<Result<Arc<[RasterOptics]>, SimError>>()?
            }
            Subject::Board => [RasterOptics::of_board(&config.board, &view, &shown.pattern)?].into(),
            Subject::SecondBoard => {
                let SimBoard { second_scatter_rows, second_scatter_share, .. } = config.board;
                let board = SimBoard {
                    scatter_rows: second_scatter_rows,
                    scatter_share: second_scatter_share,
                    ..config.board
                };
                [RasterOptics::of_board(&board, &view, &shown.pattern)?].into()
            }
            Subject::Cap | Subject::Plane(_) | Subject::Diffuser => return Ok(()),
        };
        shown.keep(subject, lens_mm, optics);
        Ok(())
    }

    /// The light of a subject under what is shown, through the projector's lens as it is now; `None`: no light.
    pub fn optics(&self, shown: &ShownOptics, subject: Subject) -> Option<Arc<[RasterOptics]>> {
        let (lens_mm, _) = self.projector_lens.now();
        let (prepared_mm, optics) = shown.optics(subject)?;
        // What could be computed for one position can be for all.
        if prepared_mm == lens_mm || self.prepare(shown, subject).is_err() {
            return Some(optics);
        }
        shown.optics(subject).map(|(_, optics)| optics)
    }

    /// Start of row `t`'s exposure relative to row 0.
    pub fn row_start_us(&self, shutter: Shutter, t: usize) -> f64 {
        match shutter {
            Shutter::Rolling => t as f64 * self.truth.camera_row_time_us,
            Shutter::Global => 0.0,
        }
    }

    /// Ambient light of an exposure, in the scene's units, in a row that begins `row_start_us` after row 0.
    pub fn ambient(&self, exposure: &Exposure, row_start_us: f64) -> f32 {
        let ambient = &self.config.ambient;
        if ambient.level == 0.0 {
            return 0.0;
        }
        let exposure_s = exposure.settings.exposure_us * 1e-6;
        let phase_of = |key: &[u64]| uniform(&mut keyed(self.config.seed, Purpose::Flicker, key));
        let (phase, start_s) = match ambient.phase {
            FlickerPhase::Drawn => (
                phase_of(&[exposure.key[0], exposure.key[1]]),
                exposure.key[2] as f64 * self.setup.raster.period_us * 1e-6,
            ),
            FlickerPhase::Continuous => {
                (phase_of(&[]), exposure.start_ns as f64 * 1e-9 + row_start_us * 1e-6)
            }
        };
        let angle = |time_s: f64| std::f64::consts::TAU * (phase + ambient.flicker_hz * time_s);
        // The integral of 1 + m sin(angle) over the exposure.
        let swing = (angle(start_s).cos() - angle(start_s + exposure_s).cos())
            / (std::f64::consts::TAU * ambient.flicker_hz.max(1e-9));
        let rows = (exposure_s + ambient.flicker * swing) / (self.truth.raster.row_time_us * 1e-6);
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
            readout_us: self.readout_us(self.setup.camera_row_time_us),
            readout: camera.readout,
            exposure_us: camera.exposure_step_us..=1e6,
            trigger_delay_us: 0.0..=16e6,
        }
    }

    fn readout_us(&self, row_time_us: f64) -> f64 {
        self.config.camera.readout_us.unwrap_or(self.size.0 as f64 * row_time_us)
    }

    pub fn line_config(&self) -> LineConfig {
        let row_time_us = self.truth.camera_row_time_us;
        LineConfig {
            seed: self.config.seed,
            period_ns: ns_from_us(self.setup.raster.period_us),
            vsync: self.config.vsync.clone(),
            projector: self.config.projector.clone(),
            camera: self.config.camera.clone(),
            trigger_latency_us: self.truth.trigger_latency_us,
            motion: self.motion,
            readout_ns: ns_from_us(self.readout_us(row_time_us)),
            rolling_ns: ns_from_us(self.size.0.saturating_sub(1) as f64 * row_time_us),
        }
    }
}
