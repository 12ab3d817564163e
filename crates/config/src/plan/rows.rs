//! What is known of a rig's rows, by which sweeps and films choose their settings.

/// What a calibration tells of the projector's rows, by which settings are chosen that a plan does not state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownRows {
    /// Time from one row to the next.
    pub row_time_us: f64,
    /// Exposures that begin or end on a pixel's own row.
    pub own_row_edges: OwnRowEdges,
}

/// What exposures that begin or end on a pixel's own row tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OwnRowEdges {
    /// They divide direct light from that of the rows beside it.
    Divide,
    /// Nothing that can be relied on: their times are known too badly, or a spot draws the row meanwhile.
    Mislead,
}

impl KnownRows {
    /// The time of some rows in whole tens of microseconds: cameras expose in steps.
    pub(super) fn exposure_us(&self, rows: f64) -> f64 {
        (rows * self.row_time_us / 10.0).round() * 10.0
    }

    /// The delay of an exposure whose opening edge lies this many rows from the pixel's own.
    pub(super) fn opening_us(&self, exposure_us: f64, rows: f64) -> f64 {
        ((exposure_us / 2.0 + rows * self.row_time_us) * 100.0).round() / 100.0
    }
}
