//! What a viewfinder takes and tells.

use raysweep_core::FinderPicture;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `viewfinder`: what a running viewfinder changes. What is left out stays as it is.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ViewfinderParams {
    /// What the projector shows.
    #[serde(default)]
    pub picture: Option<FinderPicture>,
    /// Region of the focus score and the other figures: first row, row after the last, first column, column after the
    /// last.
    #[serde(default)]
    pub region: Option<[usize; 4]>,
    /// Exposure of each frame.
    #[serde(default)]
    pub exposure_us: Option<f64>,
    /// Delay of each exposure, as in a sweep: 0 is centred on the light of a row's own projector row. On a plane rig whose
    /// camera is triggered.
    #[serde(default)]
    pub delay_us: Option<f64>,
}

/// A picture of a viewfinder; the image `viewfinder` itself is in the live file. Counts are those of the camera, and
/// shares are of the pixels of the region.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ViewfinderValues {
    /// Number of the picture, counted from 1.
    pub pictures: u64,
    /// Sequence number of the image in the live file, if there is a live file.
    pub sequence: Option<u64>,
    /// What the projector shows.
    pub picture: FinderPicture,
    /// Exposure of the frame.
    pub exposure_us: f64,
    /// Its delay; 0 on a dot rig.
    #[serde(default)]
    pub delay_us: f64,
    /// First row, row after the last, first column, column after the last.
    pub region: [usize; 4],
    /// Count without light.
    pub black_dn: f64,
    /// Count from which on a pixel is saturated.
    pub saturation_dn: f64,
    /// Largest count of the camera's format.
    pub full_dn: u16,
    /// Counts above black of a white pixel under its own row, as the calibration or else the rig file has it; `None` on a
    /// dot rig.
    #[serde(default)]
    pub white_dn: Option<f64>,
    /// Share of saturated pixels.
    pub saturated: f64,
    /// Share of pixels with less than 2 % of the range from black to saturation.
    pub underexposed: f64,
    /// Mean count.
    pub mean_dn: f64,
    /// Count of the brightest pixel.
    pub brightest_dn: u16,
    /// Number of pixels in each of 64 equal ranges, from 0 to `full_dn`.
    pub histogram: Vec<u64>,
    /// Counts along the row through the middle of the region, averaged to at most 128 values.
    pub row_cut: Vec<f32>,
    /// Counts along the column through the middle of the region, averaged to at most 128 values.
    pub column_cut: Vec<f32>,
    /// How sharp the picture is; `None` after a change and without light.
    pub focus: Option<FocusScore>,
    /// How far camera rows are off projector rows, as last measured with the picture `align`.
    pub alignment: Option<RowAlignment>,
    /// On a dot rig: the dot, if there is one.
    pub dot: Option<SeenDot>,
    /// What keeps the viewfinder from showing more.
    pub problem: Option<String>,
}

/// How sharp a picture is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FocusScore {
    /// Tenengrad: mean squared gradient over the square of the mean light.
    pub score: f64,
    /// The best since picture, region and exposure were last changed.
    pub best: f64,
    /// Which way it goes.
    pub trend: FocusTrend,
}

/// Which way the focus goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FocusTrend {
    /// The picture becomes sharper.
    Rising,
    /// The picture becomes less sharp.
    Falling,
    /// Neither can be told from noise.
    Steady,
}

/// How far camera rows are off the projector rows that the rig file says they see.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RowAlignment {
    /// How often it was measured.
    pub measured: u64,
    /// Projector rows by which the middle of the image looks further down.
    pub shift_rows: f64,
    /// Angle by which camera rows run down the projector's from left to right.
    pub rotation_deg: f64,
    /// Factor on the projector rows between camera rows.
    pub magnification: f64,
    /// The largest distance of a pixel from its stated row.
    pub worst_rows: f64,
    /// Root mean square of what shift, rotation and magnification do not explain.
    pub residual_rows: f64,
    /// What to turn; nothing if all is within a tenth of a row.
    pub advice: Vec<String>,
}

/// The dot of a dot rig.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SeenDot {
    /// Row of its centroid, 0 at the centre of the first row.
    pub row: f64,
    /// Column of its centroid.
    pub column: f64,
    /// Full width at half maximum.
    pub fwhm_px: f64,
    /// Counts above the background at its peak.
    pub peak_dn: f64,
}
