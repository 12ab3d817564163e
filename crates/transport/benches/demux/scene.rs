use std::error::Error;

use ndarray::{Array3, s};
use raysweep_transport::plane::{PlaneError, RowTiming, Setting};

use super::Sample;
use super::common::{corner, ideal_stack, paper_sweep as papers_settings, photographed};

/// Row time of the results in the tests.
const ROW_TIME_US: f64 = 22.22;

/// Rows and columns of the rendered corner from which all stacks are made.
const TILE: usize = 128;

/// A stack and the settings of its acquisition.
pub struct Case {
    pub name: &'static str,
    pub timing: RowTiming,
    pub settings: Vec<Setting>,
    /// `[settings, t, s]`: the mean of 8 noisy frames.
    pub stack: Array3<f32>,
    pub repetitions: usize,
    /// Which pixels the reference solves.
    pub sample: Sample,
    pub with_peers: bool,
    pub in_its_own_process: bool,
}

/// The paper's problem, N = 75 and V = 128: the corner in the middle of a projector of 720 rows.
pub fn paper_sized() -> Result<Case, PlaneError> {
    let settings = sweep_of_128_rows();
    Ok(Case {
        name: "128x128 V=128",
        timing: projector()?.centred(TILE)?,
        stack: photographed(&ideal_stack(&corner(), &settings), 1),
        settings,
        repetitions: 9,
        sample: Sample::EVERY_PIXEL,
        with_peers: true,
        in_its_own_process: false,
    })
}

/// The paper's full sweep, whose delays cover 189 rows.
pub fn paper_sweep() -> Result<Case, PlaneError> {
    let settings = papers_settings();
    Ok(Case {
        name: "128x128 V=189",
        timing: projector()?.centred(TILE)?,
        stack: photographed(&ideal_stack(&corner(), &settings), 1),
        settings,
        repetitions: 9,
        sample: Sample { every_row: 4, every_column: 4 },
        with_peers: false,
        in_its_own_process: false,
    })
}

/// One camera pixel for each of 1280x720 projector pixels: the corner repeated, N = 75 and V = 128 as in the small
/// case.
pub fn whole_projector() -> Result<Case, Box<dyn Error>> {
    let settings = sweep_of_128_rows();
    let (rows, columns) = (720, 1280);
    let whole_tile = photographed(&ideal_stack(&corner(), &settings), 1);
    // The projector, and with it the light, ends within the last tile.
    let rest = rows % TILE;
    let mut cut_corner = corner();
    cut_corner.slice_mut(s![rest.., .., ..]).fill(0.0);
    let cut_tile = photographed(&ideal_stack(&cut_corner, &settings), 1);

    let mut stack = Array3::zeros((settings.len(), rows, columns));
    for row in (0..rows).step_by(TILE) {
        let height = TILE.min(rows - row);
        let tile = if height < TILE { &cut_tile } else { &whole_tile };
        for column in (0..columns).step_by(TILE) {
            stack.slice_mut(s![.., row..row + height, column..column + TILE]).assign(&tile.slice(s![
                ..,
                ..height,
                ..
            ]));
        }
    }
    Ok(Case {
        name: "1280x720 V=128",
        timing: projector()?,
        settings,
        stack,
        repetitions: 3,
        sample: Sample { every_row: 23, every_column: 20 },
        with_peers: false,
        in_its_own_process: true,
    })
}

fn projector() -> Result<RowTiming, PlaneError> {
    RowTiming::new(720, ROW_TIME_US, 50_000.0 / 3.0)
}

/// As many delays and exposures as the paper's, with the delays closer together and moved by half a row, so that the
/// settings see exactly the rows -63..=64.
fn sweep_of_128_rows() -> Vec<Setting> {
    let delay_us = |point: usize| -822.0 + 1644.0 / 14.0 * (point % 15) as f64 + ROW_TIME_US / 2.0;
    let exposure_us = |point: usize| 600.0 + 150.0 * (point / 15) as f64;
    (0..75).map(|point| Setting::new(delay_us(point), exposure_us(point))).collect()
}
