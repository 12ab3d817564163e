//! Simulation of an exposure by the clock, shared by the tests.

use raysweep_transport::plane::{RowTiming, Setting};

/// Light that a pixel of camera row `t` collects, computed by stepping through time: the row that the projector
/// lights at each instant follows from the clock and the row table alone. A row emits `light_of_row` in total, evenly
/// over its dwell.
pub fn by_stepping_through_time(
    timing: &RowTiming,
    setting: &Setting,
    t: usize,
    light_of_row: impl Fn(usize) -> f64,
) -> f64 {
    const STEP_US: f64 = 0.01;
    let steps = (setting.exposure_us / STEP_US).round() as usize;
    let (camera, starts_us) = (timing.camera(), timing.row_starts_us());
    let first_centre_us = (camera.first_row as f64 + 0.5) * timing.row_time_us();
    let centre_us = first_centre_us + setting.delays_us[0] + t as f64 * camera.row_time_us;
    let start_us = centre_us - setting.exposure_us / 2.0;
    let mut row = 0;
    let mut light = 0.0;
    for step in 0..steps {
        let instant_us = start_us + (step as f64 + 0.5) * STEP_US;
        let into_frame_us = starts_us[0] + (instant_us - starts_us[0]).rem_euclid(timing.period_us());
        // Rows follow one another, so the search continues where it ended.
        if into_frame_us < starts_us[row] {
            row = 0;
        }
        while row < timing.projector_rows() && into_frame_us >= starts_us[row + 1] {
            row += 1;
        }
        if row < timing.projector_rows() {
            light += light_of_row(row) * STEP_US / (starts_us[row + 1] - starts_us[row]);
        } else {
            row = 0;
        }
    }
    light
}
