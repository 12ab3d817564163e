//! The `[sim]` table of a rig file, which describes the simulated rig. Every key has a default. Defaults without a
//! measurement or data sheet behind them are assumptions (marked [A]); replace them with your lab's own values.

use std::path::PathBuf;

use raysweep_core::Readout;
use serde::Deserialize;

/// The `[sim]` table.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimConfig {
    /// An `.npz` file with `T` (path relative to the rig file), or the name of a built-in scene.
    pub scene: PathBuf,
    /// Rows of a built-in scene, 8..=720; ignored for a scene file.
    pub scene_rows: usize,
    /// Columns of a built-in scene; ignored for a scene file.
    pub scene_columns: usize,
    /// Seed of all random numbers: the same seed gives the same bits.
    pub seed: u64,
    /// Period of a moving built-in scene (there and back), 0.1..=1e6.
    pub motion_period_s: f64,
    /// Run in real time on the host's clock instead of as fast as possible.
    pub realtime: bool,
    /// Socket (relative to the rig file) of the process that simulates VSYNC line and projector for a camera with a
    /// driver of its own. Default: everything is simulated in this process.
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
    /// `[sim.board]`
    pub board: SimBoard,
    /// `[sim.truth]`
    pub truth: SimTruth,
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
            board: SimBoard::default(),
            truth: SimTruth::default(),
        }
    }
}

/// Projector properties.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimProjector {
    /// Time at which each row is lit.
    pub row_table: RowTable,
    /// How a row's light spreads over its neighbours.
    pub beam: SimBeam,
    /// Whether the spot's movement along the row affects the timing of direct light.
    pub spot: SimSpot,
    /// Timing error of the light relative to the VSYNC edge: uniform, plus or minus this. No device measures it.
    pub phase_jitter_us: f64,
    /// Number of VSYNC edges between setting a new picture and its light.
    pub video_latency_frames: u32,
    /// `[sim.projector.lens]`
    pub lens: SimLens,
}

impl Default for SimProjector {
    fn default() -> Self {
        Self {
            row_table: RowTable::Linear,
            beam: SimBeam::Ideal,
            spot: SimSpot::Uniform,
            phase_jitter_us: 0.0,
            video_latency_frames: 1, // [A]
            lens: SimLens::default(),
        }
    }
}

/// A lens, whose picture is blurred by its distance from the focus: each point becomes an evenly lit disc, 2 pixels
/// across at the ends of the depth of field.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimLens {
    /// Where its focus ring is.
    pub position_mm: f64,
    /// Where its focus ring would have to be.
    pub focus_mm: f64,
    /// Depth of field, along the positions of the ring.
    pub depth_of_field_mm: f64,
}

impl Default for SimLens {
    /// In focus.
    fn default() -> Self {
        Self { position_mm: 0.0, focus_mm: 0.0, depth_of_field_mm: 1.0 }
    }
}

/// Maps rows to times within the frame. The sweep as a whole keeps its nominal duration.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum RowTable {
    /// Every row takes the same time.
    Linear,
    /// Quadratic: the sweep starts fast and ends slow; mid-sweep is early by this percentage of the sweep.
    Quadratic {
        /// Largest deviation from linear, in percent of the sweep; within -20..=20.
        percent: f64,
    },
    /// Piecewise linear between seeded knots, similar to measured tables.
    Kinked {
        /// Number of pieces.
        pieces: usize,
        /// Largest deviation of a knot, in either direction.
        amplitude_us: f64,
        /// The quadratic deviation on which the kinks lie, in percent of the sweep; within -20..=20.
        #[serde(default)]
        percent: f64,
    },
}

/// The beam's profile over rows; its weights sum to 1.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum SimBeam {
    /// All light falls in the row itself.
    Ideal,
    /// A Gaussian, sampled at the rows' centres.
    Gaussian {
        /// Standard deviation in rows.
        sigma_rows: f64,
    },
    /// Uniform from `up_rows` above the row's centre to `down_rows` below it.
    FlatTop {
        /// Extent towards row 0.
        up_rows: f64,
        /// Extent towards the last row.
        down_rows: f64,
    },
    /// Any profile over whole rows.
    Kernel {
        /// Offsets from the row, towards the last row, rising.
        rows: Vec<i32>,
        /// Light at each offset, as drawn by the first row.
        weights: Vec<f64>,
        /// Light at each offset, as drawn by the last row; the shares of rows between change linearly. Default: as
        /// `weights`.
        to: Option<Vec<f64>>,
    },
}

/// Time within its row at which a pixel's direct light arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SimSpot {
    /// Spread evenly over the row's dwell.
    Uniform,
    /// When the spot passes the pixel's projector column, left to right.
    OneWay,
    /// Like `OneWay`, but odd rows run right to left.
    Bidirectional,
}

/// VSYNC line and its monitor.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimVsync {
    /// Standard deviation of the edges, and of the light that follows them, about their nominal times.
    pub jitter_us: f64,
    /// Fraction of edges that never reach the line and so do not trigger the camera.
    pub missing: f64,
    /// Fraction of periods with a false edge on the line, which triggers the camera.
    pub false_edges: f64,
    /// Fraction of edges that trigger the camera but are missed by the monitor.
    pub unseen: f64,
}

impl Default for SimVsync {
    fn default() -> Self {
        Self { jitter_us: 5.0, missing: 0.0, false_edges: 0.0, unseen: 0.0 } // [A]
    }
}

/// Camera timing and faults.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimCamera {
    /// Time from the trigger edge to the start of row 0's exposure.
    pub trigger_latency_us: f64,
    /// Time from the end of row 0's exposure until the camera accepts the next trigger. Default: the readout time of
    /// all rows.
    pub readout_us: Option<f64>,
    /// Whether an exposure may overlap the readout of the previous frame.
    pub readout: Readout,
    /// Exposures are rounded to multiples of this.
    pub exposure_step_us: f64,
    /// Trigger delays are rounded to multiples of this.
    pub delay_step_us: f64,
    /// Minimum number of frames after a change that still use the old settings.
    pub late_frames_min: u32,
    /// Maximum number of frames after a change that still use the old settings.
    pub late_frames_max: u32,
    /// Whether each frame carries its own exposure (chunk data).
    pub chunk_exposure: bool,
    /// Fraction of frames that are exposed and then lost in transit.
    pub dropped: f64,
    /// `[sim.camera.lens]`
    pub lens: SimLens,
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
            lens: SimLens::default(),
        }
    }
}

/// Sensor after EMVA 1288; defaults of the EV76C570.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimSensor {
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
    /// Dark current of all other pixels, electrons per second.
    pub dark_current_e_per_s: f64,
    /// Actual resolution of the converter in bits; its codes are spread over the pixel format's scale.
    pub adc_bits: u32,
    /// Loss of light in the corners of the image, in percent.
    pub vignetting_percent: f64,
    /// By how much counts of full scale fall short of a straight line, in percent; half of it at half of full scale.
    pub compression_percent: f64,
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
            compression_percent: 0.0,
        }
    }
}

/// Ambient light, which does not come from the projector.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimAmbient {
    /// Light added to a pixel in one row time, in the scene's units (1 = a white pixel's row).
    pub level: f64,
    /// Fraction of the ambient light that flickers, 0..=1.
    pub flicker: f64,
    /// Frequency of the flicker: twice the mains frequency.
    pub flicker_hz: f64,
    /// The phase of the flicker.
    pub phase: FlickerPhase,
}

/// The phase of ambient flicker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FlickerPhase {
    /// Drawn for each attempt at a point, and the same in all rows of a frame: the same seed gives the same bits
    /// wherever a run was interrupted.
    Drawn,
    /// That of a lamp, which flickers in time: each row sees it at the time of its own exposure.
    Continuous,
}

impl Default for SimAmbient {
    fn default() -> Self {
        Self { level: 0.0, flicker: 0.0, flicker_hz: 100.0, phase: FlickerPhase::Continuous }
    }
}

/// The board of a calibration: flat, matt, white, in the scene's place.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimBoard {
    /// Standard deviation, in projector rows, of the light that spreads inside the board.
    pub scatter_rows: f64,
    /// Share of the board's light that spreads inside it, 0..=1.
    pub scatter_share: f64,
    /// The same of the second board, which a calibration with two boards compares it with.
    pub second_scatter_rows: f64,
    /// The same of the second board.
    pub second_scatter_share: f64,
    /// Projector columns, 0 to 1 across its width, that the image's left and right edges see on the board.
    pub projector_columns: [f64; 2],
    /// First column of the scene's images in which the board stays in view, and the column after the last.
    pub strip_columns: Option<[usize; 2]>,
}

impl Default for SimBoard {
    fn default() -> Self {
        Self {
            scatter_rows: 0.0,
            scatter_share: 0.0,
            second_scatter_rows: 0.0,
            second_scatter_share: 0.0,
            projector_columns: [0.0, 1.0],
            strip_columns: None,
        }
    }
}

/// What is true of the simulated rig where the rest of the rig file says something else. The simulator alone knows it.
/// Without a key, the rig file is right.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimTruth {
    /// `projector.first_row_us`
    pub first_row_us: Option<f64>,
    /// `projector.row_time_us`
    pub row_time_us: Option<f64>,
    /// `camera.row_pitch`
    pub row_pitch: Option<f64>,
    /// `camera.first_projector_row`
    pub first_projector_row: Option<usize>,
    /// `sim.camera.trigger_latency_us`, which stays the one that the camera states and stamps its frames by.
    pub trigger_latency_us: Option<f64>,
    /// `camera.row_time_us`
    pub camera_row_time_us: Option<f64>,
    /// `camera.white_dn`
    pub white_dn: Option<f64>,
    /// `camera.black_dn`
    pub black_dn: Option<f64>,
    /// Projector rows by which all pixels look further down.
    pub row_offset_rows: f64,
    /// Angle by which the camera's rows run down the projector's from left to right.
    pub rotation_deg: f64,
    /// Factor on the projector rows between the camera's rows, about the middle row.
    pub magnification: f64,
}

impl Default for SimTruth {
    fn default() -> Self {
        Self {
            first_row_us: None,
            row_time_us: None,
            row_pitch: None,
            first_projector_row: None,
            trigger_latency_us: None,
            camera_row_time_us: None,
            white_dn: None,
            black_dn: None,
            row_offset_rows: 0.0,
            rotation_deg: 0.0,
            magnification: 1.0,
        }
    }
}
