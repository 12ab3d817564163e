//! The `[sim.dots]` table of a rig file, which describes the simulated dot rig. Every key has a default. Defaults
//! without a measurement or data sheet behind them are assumptions (marked [A]); replace them with your lab's own
//! values.

use std::path::PathBuf;

use serde::Deserialize;

/// The `[sim.dots]` table.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DotsConfig {
    /// An `.npz` file with `T` and `uv`, or an `.npy` file with dots on a square grid (paths relative to the rig file),
    /// or the name of a built-in scene.
    pub scene: PathBuf,
    /// Camera rows of a built-in scene, 8..=4096; ignored for a scene file.
    pub rows: usize,
    /// Camera columns of a built-in scene, 8..=4096; ignored for a scene file.
    pub columns: usize,
    /// Camera rows below the scene, in which the trailing dot appears.
    pub margin_rows: usize,
    /// Seed of all random numbers: the same seed gives the same bits.
    pub seed: u64,
    /// Period of a moving built-in scene (there and back), 0.1..=1e6.
    pub motion_period_s: f64,
    /// Run in real time on the host's clock instead of as fast as possible.
    pub realtime: bool,
    /// Field of view of the beam covered by the scene, as full angles x and y.
    pub fov_deg: [f64; 2],
    /// Index in the batch of the frame whose light goes onto the trailing dot's static plane. Default: the last.
    pub trailing_index: Option<u32>,
    /// Indices in the batch of frames whose light goes into the beam dump.
    pub dump_indices: Vec<u32>,
    /// Distances of the Lambertian planes that can be placed in front of the camera, relative to the scene's distance.
    pub plane_depths: Vec<f64>,
    /// Files with images of planes under the dots of a scene file, instead of the planes at `plane_depths`: each array
    /// `[N, H, W]` or `[N, H, W, 3]` in them is a plane. Paths are relative to the rig file.
    pub plane_files: Vec<PathBuf>,
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
            plane_files: Vec::new(),
            dot: SimDot::default(),
            mirror: SimMirror::default(),
            camera: SimDotCamera::default(),
            sensor: SimDotSensor::default(),
        }
    }
}

/// The spot of light moved by the mirror.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimDot {
    /// Full width at half maximum in the middle of the field of view.
    pub fwhm_deg: f64,
    /// Relative widening along the long axis, and narrowing across it, in the corners of the field of view.
    pub uneven: f64,
    /// Light of the ghost caused by the mirror's cover glass, as a fraction of the dot's.
    pub ghost: f64,
    /// Offset of the ghost from the dot, as beam angles.
    pub ghost_deg: [f64; 2],
}

impl Default for SimDot {
    fn default() -> Self {
        Self { fwhm_deg: 0.42, uneven: 0.25, ghost: 0.01, ghost_deg: [0.9, -0.6] } // [A] except the width
    }
}

/// Mirror mechanics.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimMirror {
    /// `false`: the mirror always follows its commands exactly.
    pub mechanics: bool,
    /// Resonant frequencies, x and y.
    pub f0_hz: [f64; 2],
    /// Quality factors, x and y.
    pub q: [f64; 2],
    /// -3 dB frequency of the controller's filter.
    pub filter_hz: f64,
    /// Fraction of each axis' movement that appears in the other.
    pub coupling: f64,
    /// Drift of the rest position, x and y.
    pub drift_deg_per_s: [f64; 2],
    /// Standard deviation of the repeatability error, drawn anew once per batch of the paper (1/6 s).
    pub repeat_deg: f64,
}

impl Default for SimMirror {
    fn default() -> Self {
        Self {
            mechanics: true,
            f0_hz: [500.0, 480.0], // [A]
            q: [30.0, 30.0],       // [A]
            filter_hz: 200.0,
            coupling: 0.0,
            drift_deg_per_s: [0.0, 0.0],
            repeat_deg: 0.0,
        }
    }
}

/// Camera timing and faults.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimDotCamera {
    /// Relative excess of the camera's frame rate over the mirror's sample clock; 0: triggered by that clock.
    pub clock_error: f64,
    /// Number of frames at the start of a path that pass before the camera records.
    pub late_frames: u32,
    /// Fraction of frames that are exposed and then lost in transit.
    pub dropped: f64,
    /// Fraction of frames delivered twice.
    pub duplicated: f64,
    /// Fraction of frames in which every pixel is overexposed.
    pub saturated: f64,
}

impl Default for SimDotCamera {
    fn default() -> Self {
        Self { clock_error: 0.0, late_frames: 0, dropped: 0.0, duplicated: 0.0, saturated: 0.0 }
    }
}

/// Sensor after EMVA 1288; defaults in the class of the Photron SA-X2.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimDotSensor {
    /// `false`: no temporal noise, no fixed pattern, no hot pixels; quantisation and saturation remain.
    pub noise: bool,
    /// Electrons per count on a 12-bit scale.
    pub electrons_per_dn: f64,
    /// Electrons at which a pixel saturates.
    pub full_well_e: f64,
    /// Temporal dark noise, in electrons.
    pub read_noise_e: f64,
    /// Spread of the pixels' offsets, in electrons.
    pub dsnu_e: f64,
    /// Spread of the columns' offsets, in electrons.
    pub column_e: f64,
    /// Spread of the pixels' gains, in percent.
    pub prnu_percent: f64,
    /// Fraction of hot pixels.
    pub hot_pixels: f64,
    /// Dark current of a hot pixel, electrons per second.
    pub hot_pixel_e_per_s: f64,
    /// Loss of light in the corners of the image, in percent.
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
            column_e: 5.0,          // [A] 0.5 count
            prnu_percent: 1.0,      // [A]
            hot_pixels: 1e-4,       // [A]
            hot_pixel_e_per_s: 5e7, // [A] 350 counts in 70 us
            vignetting_percent: 0.0,
        }
    }
}
