use std::ops::Range;

use ndarray::Array2;

use super::super::Estimate;
use super::settings::ExposureMode;

/// When each projector row is lit, and what belongs to it.
#[derive(Debug, Clone, PartialEq)]
pub struct RowTimes {
    /// Row `v` is lit from entry `v` to entry `v + 1` after the trigger edge, as a rolling exposure sees it, whose
    /// camera row `t` opens at `delay + t * camera_row_time_us`. `[projector_rows + 1]`.
    pub row_starts_us: Vec<f64>,
    /// Standard deviations of the row starts; they grow quickly beyond the rows seen.
    pub row_starts_sd_us: Vec<f64>,
    /// Modes `[r, projector_rows + 1]` whose outer products sum to the covariance of the row starts: the offset, the
    /// slope, two for the rows beyond those seen, and then the largest until 99 % of what these leave.
    pub row_starts_modes: Array2<f64>,
    /// Rows that the image sees. Outside them, the table continues with its outermost slope.
    pub seen_rows: Range<usize>,
    /// Mean time per row over the rows seen.
    pub row_time_us: Estimate,
    /// Time from one camera row to the next.
    pub camera_row_time_us: Estimate,
    /// What each exposure has more than its nominal length.
    pub exposure_offset_us: Estimate,
    /// How much later a global exposure opens than row 0 of a rolling exposure with the same delay.
    pub mode_offset_us: Estimate,
    /// Standard deviation of the time at which light arrives in the middle camera row: jitter over the root of the
    /// number of rolling frames with edges on the light.
    pub latency_sd_us: f64,
    /// Covariance of the arrival in the middle camera row, `exposure_offset_us`, `camera_row_time_us` and
    /// `row_time_us`, in this order.
    pub covariance: [[f64; 4]; 4],
    /// Standard deviation, over frames, of the time of light after the trigger, and its own standard deviation.
    pub jitter_us: Estimate,
    /// How late the light of each frame was; `None` for frames that were dropped.
    pub jitters: Vec<Option<FrameJitter>>,
    /// Number of rolling frames with edges on the light.
    pub useful_frames: usize,
    /// How well the model describes the frames, by shutter and exposure.
    pub residuals: Vec<Residual>,
    /// The frames that were not used.
    pub dropped: Vec<(usize, Dropped)>,
}

/// How late the light of a frame was against the mean of all frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameJitter {
    /// Time after the mean of all frames.
    pub late_us: f64,
    /// Standard deviation relative to other frames.
    pub sd_us: f64,
}

/// Why a frame was not used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Dropped {
    /// No edge of its exposure meets light that the image sees.
    NoEdge,
    /// Its light comes this much later than that of other frames.
    Late {
        /// Time after the median of other frames.
        late_us: f64,
    },
    /// Its light is not that of its settings.
    Misfit {
        /// Mean square of its residuals, each divided by its expected variance.
        chi2_per_sample: f64,
    },
}

/// How well the model describes frames of one shutter mode and exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// The mode.
    pub shutter: ExposureMode,
    /// The exposure.
    pub exposure_us: f64,
    /// Number of frames used.
    pub frames: usize,
    /// Number of samples (means of a group of columns in a camera row) that an edge meets.
    pub samples: usize,
    /// Mean square of residuals, each divided by its expected variance. Below 1 if the responses are better than they
    /// need be.
    pub chi2_per_sample: f64,
}
