//! The `[sim]` table of a rig file: what the simulated rig is made of. Every key has a default; those that no
//! measurement or data sheet backs are assumptions (marked [A]) to be replaced by a lab's own values.

use std::path::PathBuf;

use raysweep_core::Readout;
use serde::Deserialize;

/// The `[sim]` table.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimConfig {
    /// An `.npz` file with `T` (relative to the rig file), or the name of a built-in scene.
    pub scene: PathBuf,
    /// Rows of a built-in scene, 8..=720; a file brings its own.
    pub scene_rows: usize,
    /// Columns of a built-in scene; a file brings its own.
    pub scene_columns: usize,
    /// Seeds everything that is random: the same seed gives the same bits.
    pub seed: u64,
    /// Time in which a built-in scene that moves goes there and back, 0.1..=1e6.
    pub motion_period_s: f64,
    /// Pace by the host's clock instead of as fast as it can.
    pub realtime: bool,
    /// Socket (relative to the rig file) of the process that simulates VSYNC line and projector beside a camera that is
    /// reached by its own driver; left out: everything is simulated in this process.
    pub bench: Option<PathBuf>,
    /// `[sim.projector]`
    pub projector: SimProjector,
    /// `[sim.vsync]`
    pub vsync: SimVsync,
    /// `[sim.camera]`
    pub camera: SimCamera,
    /// `[sim.sensor]`
    pub sensor: SimSensor,
    /// `[sim.ambient]`
    pub ambient: SimAmbient,
}

impl Default for SimConfig {
    fn default() -> Self {
        Self {
            scene: "mix".into(),
            scene_rows: 128,
            scene_columns: 128,
            seed: 1,
            motion_period_s: 4.0,
            realtime: false,
            bench: None,
            projector: SimProjector::default(),
            vsync: SimVsync::default(),
            camera: SimCamera::default(),
            sensor: SimSensor::default(),
            ambient: SimAmbient::default(),
        }
    }
}

/// How the projector draws.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimProjector {
    /// When each row is lit.
    pub row_table: RowTable,
    /// How a row's light spreads over its neighbours.
    pub beam: Beam,
    /// Whether the spot's flight along the row shows in the time of direct light.
    pub spot: Spot,
    /// Uniform error, to either side, of the light against the VSYNC edge: nothing measures it.
    pub phase_jitter_us: f64,
    /// VSYNC edges from a new picture to its light.
    pub video_latency_frames: u32,
}

impl Default for SimProjector {
    fn default() -> Self {
        Self {
            row_table: RowTable::Linear,
            beam: Beam::Ideal,
            spot: Spot::Uniform,
            phase_jitter_us: 0.0,
            video_latency_frames: 1, // [A]
        }
    }
}

/// Row -> time within the frame. Rows keep the nominal time of the whole sweep.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum RowTable {
    /// Every row takes the same time.
    Linear,
    /// A sweep that starts fast and ends slow, as a quadratic: mid-sweep is early by this share of the sweep.
    Quadratic {
        /// Largest deviation from linear, in percent of the sweep; within -20..=20.
        percent: f64,
    },
    /// Straight pieces between seeded knots, as measured tables look.
    Kinked {
        /// Pieces.
        pieces: usize,
        /// Largest deviation of a knot to either side.
        amplitude_us: f64,
    },
}

/// The beam's profile over rows; its weights sum to 1.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Beam {
    /// All light in the row itself.
    Ideal,
    /// A Gaussian, sampled at the rows' centres.
    Gaussian {
        /// Standard deviation.
        sigma_rows: f64,
    },
    /// Uniform from `up_rows` above the row's centre to `down_rows` below it.
    FlatTop {
        /// Reach towards row 0.
        up_rows: f64,
        /// Reach towards the last row.
        down_rows: f64,
    },
}

/// When within its row a pixel's direct light arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Spot {
    /// Spread over the row's whole time.
    Uniform,
    /// At the moment the spot passes the pixel's projector column, left to right.
    OneWay,
    /// The same, odd rows right to left.
    Bidirectional,
}

/// The VSYNC line and the device that watches it.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimVsync {
    /// Standard deviation of the edges, and of the light with them, about the nominal period.
    pub jitter_us: f64,
    /// Share of edges that never reach the line: the camera is not triggered.
    pub missing: f64,
    /// Share of periods with a false edge on the line: the camera is triggered by it.
    pub false_edges: f64,
    /// Share of edges that trigger the camera and that the watching device misses.
    pub unseen: f64,
}

impl Default for SimVsync {
    fn default() -> Self {
        Self { jitter_us: 5.0, missing: 0.0, false_edges: 0.0, unseen: 0.0 } // [A]
    }
}

/// The camera's timing and its faults.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimCamera {
    /// From the trigger's edge to the start of row 0's exposure.
    pub trigger_latency_us: f64,
    /// From the end of row 0's exposure until the next trigger is answered; left out: the rows' own time.
    pub readout_us: Option<f64>,
    /// Whether exposure may overlap the readout of the frame before.
    pub readout: Readout,
    /// Exposures are rounded to multiples of this.
    pub exposure_step_us: f64,
    /// Trigger delays are rounded to multiples of this.
    pub delay_step_us: f64,
    /// Fewest frames that still have the old settings after a change.
    pub late_frames_min: u32,
    /// Most frames that still have the old settings after a change.
    pub late_frames_max: u32,
    /// Whether each frame carries its own exposure (chunk data).
    pub chunk_exposure: bool,
    /// Share of frames that are exposed and then lost on the way.
    pub dropped: f64,
}

impl Default for SimCamera {
    fn default() -> Self {
        Self {
            trigger_latency_us: 8.0, // [A]
            readout_us: None,
            readout: Readout::Sequential,
            exposure_step_us: 0.01,
            delay_step_us: 0.01,
            late_frames_min: 0,
            late_frames_max: 0,
            chunk_exposure: true,
            dropped: 0.0,
        }
    }
}

/// The sensor after EMVA 1288; figures of the EV76C570.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimSensor {
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
    /// Dark current of the others, electrons per second.
    pub dark_current_e_per_s: f64,
    /// Real bits of the converter; its codes are spread over the pixel format's scale.
    pub adc_bits: u32,
    /// Loss of light in the corners of the picture, in percent.
    pub vignetting_percent: f64,
}

impl Default for SimSensor {
    fn default() -> Self {
        Self {
            noise: true,
            electrons_per_dn: 1.66,
            full_well_e: 6800.0,
            read_noise_e: 9.0, // [A] rolling shutter
            dsnu_e: 3.0,       // [A]
            column_e: 0.0,
            prnu_percent: 1.0,           // [A]
            hot_pixels: 1e-4,            // [A]
            hot_pixel_e_per_s: 50_000.0, // [A]
            dark_current_e_per_s: 50.0,  // [A]
            adc_bits: 12,
            vignetting_percent: 0.0,
        }
    }
}

/// Light that does not come from the projector.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimAmbient {
    /// What it adds to a pixel in one row time, in the scene's units (1 = a white pixel's row).
    pub level: f64,
    /// Share of it that flickers, 0..=1.
    pub flicker: f64,
    /// Frequency of the flicker: twice the mains'.
    pub flicker_hz: f64,
}

impl Default for SimAmbient {
    fn default() -> Self {
        Self { level: 0.0, flicker: 0.0, flicker_hz: 100.0 }
    }
}
