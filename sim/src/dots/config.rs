//! The `[sim.dots]` table of a rig file: what the simulated dot rig is made of. Every key has a default; those that no
//! measurement or data sheet backs are assumptions (marked [A]) to be replaced by a lab's own values.

use std::path::PathBuf;

use serde::Deserialize;

use crate::config::SimSensor;
use crate::mirror::MechanicsConfig;

/// The `[sim.dots]` table.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DotsConfig {
    /// An `.npz` file with `T` and `uv`, a `.npy` file with dots on a square grid (relative to the rig file), or the name
    /// of a built-in scene.
    pub scene: PathBuf,
    /// Camera rows of a built-in scene, 8..=4096; a file brings its own.
    pub rows: usize,
    /// Camera columns of a built-in scene, 8..=4096; a file brings its own.
    pub columns: usize,
    /// Camera rows below the scene, where the trailing dot shows.
    pub margin_rows: usize,
    /// Seeds everything that is random: the same seed gives the same bits.
    pub seed: u64,
    /// Time in which a built-in scene that moves goes there and back, 0.1..=1e6.
    pub motion_period_s: f64,
    /// Pace by the host's clock instead of as fast as it can.
    pub realtime: bool,
    /// Angles of the beam over which the scene extends, x and y.
    pub fov_deg: [f64; 2],
    /// Index in the batch of the frame whose light goes onto the trailing dot's static plane; left out: the last.
    pub trailing_index: Option<u32>,
    /// Indices in the batch of the frames whose light goes into the beam dump.
    pub dump_indices: Vec<u32>,
    /// Distances of the Lambertian planes that can stand before the camera, in parts of the scene's.
    pub plane_depths: Vec<f64>,
    /// `[sim.dots.dot]`
    pub dot: SimDot,
    /// `[sim.dots.mirror]`
    pub mirror: SimMirror,
    /// `[sim.dots.camera]`
    pub camera: SimDotCamera,
    /// `[sim.dots.sensor]`
    pub sensor: SimDotSensor,
}

impl Default for DotsConfig {
    fn default() -> Self {
        Self {
            scene: "v-groove".into(),
            rows: 240,
            columns: 256,
            margin_rows: 16,
            seed: 1,
            motion_period_s: 4.0,
            realtime: false,
            fov_deg: [9.27, 5.25],
            trailing_index: None,
            dump_indices: vec![0],
            plane_depths: vec![1.0, 1.1],
            dot: SimDot::default(),
            mirror: SimMirror::default(),
            camera: SimDotCamera::default(),
            sensor: SimDotSensor::default(),
        }
    }
}

/// The spot of light that the mirror moves.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimDot {
    /// Full width at half maximum in the middle of the field.
    pub fwhm_deg: f64,
    /// By which part it is wider, and across its long axis narrower, in the corners of the field.
    pub uneven: f64,
    /// Light of the ghost that the mirror's cover glass makes, in parts of the dot's.
    pub ghost: f64,
    /// Where the ghost lies from the dot, as angles of the beam.
    pub ghost_deg: [f64; 2],
}

impl Default for SimDot {
    fn default() -> Self {
        Self { fwhm_deg: 0.42, uneven: 0.25, ghost: 0.01, ghost_deg: [0.9, -0.6] } // [A] but the width
    }
}

/// How the mirror moves.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimMirror {
    /// `false`: the mirror is where it is commanded to be, always.
    pub mechanics: bool,
    /// Resonances, x and y.
    pub f0_hz: [f64; 2],
    /// Quality factors.
    pub q: [f64; 2],
    /// -3 dB frequency of the controller's filter.
    pub filter_hz: f64,
    /// Share of each axis' movement that shows in the other.
    pub coupling: f64,
    /// How fast the rest position wanders off, x and y.
    pub drift_deg_per_s: [f64; 2],
    /// Standard deviation of a movement repeated, drawn anew every batch of the paper's (1/6 s).
    pub repeat_deg: f64,
}

impl Default for SimMirror {
    fn default() -> Self {
        let MechanicsConfig { f0_hz, q, filter_hz, coupling, drift_deg_per_s, repeat_deg, .. } =
            MechanicsConfig::default();
        Self { mechanics: true, f0_hz, q, filter_hz, coupling, drift_deg_per_s, repeat_deg }
    }
}

impl SimMirror {
    pub(super) fn mechanics(&self, seed: u64) -> MechanicsConfig {
        MechanicsConfig {
            f0_hz: self.f0_hz,
            q: self.q,
            filter_hz: self.filter_hz,
            coupling: self.coupling,
            drift_deg_per_s: self.drift_deg_per_s,
            repeat_deg: self.repeat_deg,
            seed,
            ..MechanicsConfig::default()
        }
    }
}

/// The camera's clock and its faults.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimDotCamera {
    /// Parts by which it makes more frames than the mirror's sample clock triggers; 0: it is triggered by that clock.
    pub clock_error: f64,
    /// Frames of the first batch that are over before it begins to record.
    pub late_frames: u32,
    /// Share of frames that are exposed and then lost on the way.
    pub dropped: f64,
    /// Share of frames that come twice.
    pub duplicated: f64,
    /// Share of frames in which every pixel is overexposed.
    pub saturated: f64,
}

impl Default for SimDotCamera {
    fn default() -> Self {
        Self { clock_error: 0.0, late_frames: 0, dropped: 0.0, duplicated: 0.0, saturated: 0.0 }
    }
}

/// The sensor after EMVA 1288; figures of the class of the Photron SA-X2.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimDotSensor {
    /// `false`: no temporal noise, no pattern, no hot pixels; quantisation and saturation stay.
    pub noise: bool,
    /// Electrons per count of a 12-bit scale.
    pub electrons_per_dn: f64,
    /// Electrons at which a pixel saturates.
    pub full_well_e: f64,
    /// Temporal dark noise.
    pub read_noise_e: f64,
    /// Spread of the pixels' offsets.
    pub dsnu_e: f64,
    /// Spread of the columns' offsets.
    pub column_e: f64,
    /// Spread of the pixels' gains, in percent.
    pub prnu_percent: f64,
    /// Share of hot pixels.
    pub hot_pixels: f64,
    /// Dark current of a hot pixel, electrons per second.
    pub hot_pixel_e_per_s: f64,
    /// Loss of light in the corners of the picture, in percent.
    pub vignetting_percent: f64,
}

impl Default for SimDotSensor {
    fn default() -> Self {
        Self {
            noise: true,
            electrons_per_dn: 10.0, // [A]
            full_well_e: 40_000.0,  // [A]
            read_noise_e: 30.0,     // [A]
            dsnu_e: 10.0,           // [A] 1 count
            column_e: 5.0,          // [A] half a count
            prnu_percent: 1.0,      // [A]
            hot_pixels: 1e-4,       // [A]
            hot_pixel_e_per_s: 5e7, // [A] 350 counts in 70 us
            vignetting_percent: 0.0,
        }
    }
}

impl SimDotSensor {
    pub(super) fn emva(&self) -> SimSensor {
        SimSensor {
            noise: self.noise,
            electrons_per_dn: self.electrons_per_dn,
            full_well_e: self.full_well_e,
            read_noise_e: self.read_noise_e,
            dsnu_e: self.dsnu_e,
            column_e: self.column_e,
            prnu_percent: self.prnu_percent,
            hot_pixels: self.hot_pixels,
            hot_pixel_e_per_s: self.hot_pixel_e_per_s,
            // Negligible in the exposure of a dot.
            dark_current_e_per_s: 0.0,
            adc_bits: 12,
            vignetting_percent: self.vignetting_percent,
        }
    }
}
