//! The images of a calibration: what each is for, and the settings with which it is taken.

use std::sync::Arc;

use raysweep_config::Plan;
use raysweep_config::plan::CalibrationPlan;
use raysweep_core::{PROJECTOR_COLUMNS, Pattern, Raster, Shutter, Subject};
use raysweep_pipeline::{Point, PointRole, Schedule};
use raysweep_session::ledger::PointEntry;
use raysweep_session::stack::Contents;
use raysweep_transport::plane::PlaneError;
use raysweep_transport::plane::board::times::{
    BoardSetting, CoarseSweep, Columns, ExposureMode, Nominal, RollingSweep, arrival_settings,
    check_settings, sweep_settings,
};

use crate::plane::{KnownRig, PlaneTask};

/// What an image shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoardPurpose {
    /// The dark image of one of the plan's exposures, with the lens capped.
    Capped(usize),
    /// What tells how a pixel responds to rows, of each board.
    Response(WhichBoard, BoardPicture),
    /// The first board under the projector's black in a shorter exposure, which tells the room's light from the projector's black.
    Ambient,
    /// The board under one of the [`GREYS`], its light inside the exposure.
    Grey(usize),
    /// The board under grey, in an exposure with this many passes of the beam: how linear the camera is.
    Passes(usize),
    /// The board under white, in as long an exposure as the longest of those: where pixels saturate.
    Saturated,
    /// The board under a picture of the columns' Gray code: the highest bit first, each followed by its inverse.
    ColumnCode(usize),
    /// The white board with a global shutter: when the rows are lit.
    SweepTime,
    /// The white board in exposures of three rows: when each row's light arrives.
    Arrival,
    /// The white board in longer exposures: whether they are as long as they should be.
    ExposureCheck,
}

/// One of the boards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhichBoard {
    /// The one from which all is measured.
    First,
    /// One of another material, whose response alone is measured.
    Second,
}

/// A picture on a board, its light inside the exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoardPicture {
    /// The projector's black.
    Black,
    /// White.
    White,
    /// Every 16th row, beginning with this one.
    Rows(usize),
    /// A picture of the rows' Gray code: the highest bit first, each followed by its inverse.
    RowCode(usize),
}

/// What stands before the camera, and what the projector shows.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardView {
    /// The subject.
    pub subject: Subject,
    /// The picture; `None`: no light.
    pub picture: Option<Pattern>,
}

/// Levels of grey for the photon transfer.
const GREYS: [f32; 3] = [0.25, 0.5, 0.75];
/// Grey of which three passes stay below saturation where a pass of white has 50 to 65 % of full scale.
pub(super) const PASSES_GREY: f32 = 0.45;
/// Frames of each number of passes.
const PASSES_FRAMES: usize = 8;
/// Frames in which pixels saturate.
const SATURATED_FRAMES: usize = 4;
/// Number of pictures of sparse rows, and the distance of their rows.
const PHASES: usize = 16;
/// Rows with the same Gray code.
pub(super) const ROWS_PER_BLOCK: usize = 8;
/// Columns with the same Gray code.
pub(super) const COLUMNS_PER_BLOCK: usize = 16;
/// Exposure that contains all light of a pixel.
pub(super) const WHOLE_US: f64 = 3600.0;
/// Exposure of the shorter images of the room's light.
pub(super) const AMBIENT_US: f64 = 1200.0;
/// How long before the light of the middle camera row it begins.
const BEFORE_LIGHT_US: f64 = 1600.0;
/// Global exposures that show when the rows are lit.
const SWEEP_TIMES: usize = 24;
/// Passes over the delays at which light arrives: the first one finds them.
const ARRIVAL_PASSES: usize = 3;
/// Long exposures that check the short one.
const EXPOSURE_CHECKS: usize = 24;
/// Frames of each grey.
const GREY_FRAMES: usize = 8;

/// A calibration on a plane rig.
#[derive(Clone)]
pub struct CalibrationTask {
    /// The plan's own table.
    pub calibration: CalibrationPlan,
    /// Its points, with settings as foreseen from the rig file. Those of the sweep's times, the arrivals and the checks of
    /// exposures follow from images taken before them: see [`Self::sweep_times`], [`Self::first_arrivals`] and [`Self::arrivals`].
    pub task: Arc<PlaneTask>,
    /// The purpose of each point.
    purposes: Vec<BoardPurpose>,
}

impl CalibrationTask {
    /// A calibration on a rig; see [`PlaneTask::new`].
    pub fn new(plan: &Plan, calibration: CalibrationPlan, known: &KnownRig<'_>) -> Self {
        let purposes = purposes(&calibration, known.file.projector.rows);
        Self::with_purposes(plan, calibration, known, purposes)
    }

    /// The calibration of a session with these contents, which may be from before it was measured where pixels saturate,
    /// the columns, the camera's linearity or the room's light.
    pub fn stored(
        plan: &Plan,
        calibration: CalibrationPlan,
        known: &KnownRig<'_>,
        contents: Contents,
    ) -> Self {
        let task = Self::new(plan, calibration.clone(), known);
        if task.contents() == contents {
            return task;
        }
        let before_passes = CalibrationPlan { passes: 0, ..calibration.clone() };
        let earlier = [
            (calibration.clone(), true, true),
            (calibration, false, true),
            (before_passes.clone(), false, true),
            (before_passes, false, false),
        ];
        let earlier = earlier.map(|(calibration, has_columns, has_ambient)| {
            let mut purposes = purposes(&calibration, known.file.projector.rows);
            purposes.retain(|purpose| match purpose {
                BoardPurpose::Saturated => false,
                BoardPurpose::ColumnCode(_) => has_columns,
                BoardPurpose::Ambient => has_ambient,
                _ => true,
            });
            Self::with_purposes(plan, calibration, known, purposes)
        });
        earlier.into_iter().find(|earlier| earlier.contents() == contents).unwrap_or(task)
    }

    fn with_purposes(
        plan: &Plan,
        calibration: CalibrationPlan,
        known: &KnownRig<'_>,
        purposes: Vec<BoardPurpose>,
    ) -> Self {
        let (rig, size) = (known.file, known.size);
        let raster = rig.raster();
        let lag_us = size.0 as f64 / 2.0
            * (rig.camera.row_pitch * rig.projector.row_time_us - rig.camera_row_time_us());
        let mut next = [0_u32; 2];
        let mut point = |purpose: &BoardPurpose| {
            let capped = matches!(purpose, BoardPurpose::Capped(_));
            let index = &mut next[usize::from(capped)];
            let role = if capped { PointRole::Dark(*index) } else { PointRole::Sweep(*index) };
            *index += 1;
            let (exposure_us, frames) = match *purpose {
                BoardPurpose::Capped(exposure) => (calibration.exposure_us.values()[exposure], 1),
                BoardPurpose::Response(_, BoardPicture::Rows(_)) => (WHOLE_US, calibration.picture_frames),
                BoardPurpose::SweepTime => (raster.rows as f64 * raster.row_time_us * 0.5, 1),
                BoardPurpose::Arrival => (3.0 * raster.row_time_us, 1),
                BoardPurpose::ExposureCheck => (1200.0, 1),
                BoardPurpose::Ambient => (AMBIENT_US, 1),
                BoardPurpose::Passes(passes) => (passes as f64 * raster.period_us, 1),
                BoardPurpose::Saturated => (f64::from(calibration.passes) * raster.period_us, 1),
                BoardPurpose::Response(..) | BoardPurpose::Grey(_) | BoardPurpose::ColumnCode(_) => {
                    (WHOLE_US, 1)
                }
            };
            let delay_us = match purpose {
                BoardPurpose::SweepTime | BoardPurpose::Arrival | BoardPurpose::ExposureCheck => 0.0,
                // Half a period from the light at either end.
                BoardPurpose::Passes(_) | BoardPurpose::Saturated => {
                    lag_us + (exposure_us - raster.period_us) / 2.0
                }
                _ => lag_us + WHOLE_US / 2.0 - BEFORE_LIGHT_US,
            };
            Point { role, delay_us, exposure_us, frames }
        };
        let schedule = Schedule { points: purposes.iter().map(&mut point).collect() };
        let task = PlaneTask::new(plan, schedule, calibration.max_jitter_us, known);
        Self { calibration, task: Arc::new(task), purposes }
    }

    /// What its session stores.
    pub fn contents(&self) -> Contents {
        let images = self.points();
        Contents::Board { images, capped: self.purposes.len() - images }
    }

    /// Number of images of the board.
    pub fn points(&self) -> usize {
        self.task.schedule.sweep_len()
    }

    /// The purpose of a point, given by its ordinal.
    pub fn purpose(&self, ordinal: u32) -> BoardPurpose {
        self.purposes[ordinal as usize]
    }

    /// The ordinals of all points of a purpose.
    pub fn ordinals(&self, purpose: BoardPurpose) -> impl Iterator<Item = u32> {
        (0..).zip(&self.purposes).filter(move |(_, own)| **own == purpose).map(|(ordinal, _)| ordinal)
    }

    /// What the frames of a purpose show.
    pub fn view(&self, purpose: BoardPurpose) -> BoardView {
        let subject = match purpose {
            BoardPurpose::Capped(_) => return BoardView { subject: Subject::Cap, picture: None },
            BoardPurpose::Response(WhichBoard::Second, _) => Subject::SecondBoard,
            _ => Subject::Board,
        };
        let picture = match purpose {
            BoardPurpose::Capped(_)
            | BoardPurpose::Ambient
            | BoardPurpose::Response(_, BoardPicture::Black) => Pattern::Black,
            BoardPurpose::Grey(grey) => Pattern::Grey { level: GREYS[grey] },
            BoardPurpose::Passes(_) => Pattern::Grey { level: PASSES_GREY },
            BoardPurpose::Response(_, BoardPicture::Rows(phase)) => {
                Pattern::SparseRows { phase, period: PHASES }
            }
            BoardPurpose::Response(_, BoardPicture::RowCode(picture)) => Pattern::GrayRows {
                bit: row_bits(self.task.geometry.raster.rows) - 1 - picture as u32 / 2,
                inverse: picture % 2 == 1,
                block: ROWS_PER_BLOCK,
            },
            BoardPurpose::ColumnCode(picture) => Pattern::GrayColumns {
                bit: column_bits() - 1 - picture as u32 / 2,
                inverse: picture % 2 == 1,
                block: COLUMNS_PER_BLOCK,
            },
            BoardPurpose::Response(_, BoardPicture::White)
            | BoardPurpose::Saturated
            | BoardPurpose::SweepTime
            | BoardPurpose::Arrival
            | BoardPurpose::ExposureCheck => Pattern::White,
        };
        BoardView { subject, picture: Some(picture) }
    }

    /// How the rows are exposed for a purpose.
    pub fn shutter(&self, purpose: BoardPurpose) -> Shutter {
        if purpose == BoardPurpose::SweepTime { Shutter::Global } else { Shutter::Rolling }
    }

    /// The levels of grey, and the purposes of their images.
    pub(super) fn greys() -> impl Iterator<Item = (f64, BoardPurpose)> {
        GREYS.into_iter().enumerate().map(|(grey, level)| (f64::from(level), BoardPurpose::Grey(grey)))
    }

    /// The numbers of passes, and the purposes of their images.
    pub(super) fn passes(&self) -> impl Iterator<Item = (usize, BoardPurpose)> {
        (1..=self.calibration.passes as usize).map(|passes| (passes, BoardPurpose::Passes(passes)))
    }

    /// Whether there is a second board.
    pub(super) fn has_second_board(&self) -> bool {
        self.calibration.boards > 1
    }

    /// The purposes of a board's pictures of sparse rows.
    pub(super) fn phases(board: WhichBoard) -> impl Iterator<Item = BoardPurpose> {
        (0..PHASES).map(move |phase| BoardPurpose::Response(board, BoardPicture::Rows(phase)))
    }

    /// The purposes of a board's pictures of the rows' Gray code.
    pub(super) fn row_codes(&self, board: WhichBoard) -> impl Iterator<Item = BoardPurpose> + use<> {
        row_codes(self.task.geometry.raster.rows, board)
    }

    /// Those of the pictures of the columns' Gray code; empty for a session from before they were taken.
    pub(super) fn column_codes(&self) -> impl Iterator<Item = BoardPurpose> {
        self.purposes.iter().copied().filter(|purpose| matches!(purpose, BoardPurpose::ColumnCode(_)))
    }

    /// What the rig file says of the times.
    pub(super) fn nominal(&self) -> Nominal {
        let geometry = &self.task.geometry;
        Nominal {
            projector_rows: geometry.raster.rows,
            first_row_us: geometry.raster.first_row_us,
            row_time_us: geometry.raster.row_time_us,
            camera_row_time_us: geometry.camera_row_time_us,
            period_us: geometry.raster.period_us,
        }
    }

    /// The points that show when the rows are lit, once it is known which rows the image sees.
    ///
    /// # Errors
    /// Those of [`sweep_settings`].
    pub fn sweep_times(&self, columns: &Columns) -> Result<Vec<(u32, Point)>, PlaneError> {
        let settings = sweep_settings(&self.nominal(), columns.seen_rows())?;
        Ok(self.points_at(BoardPurpose::SweepTime, settings))
    }

    /// The points of a first pass over all times at which each row's light may arrive, once the sweep is known to within
    /// 10 us: those of later passes follow from them.
    ///
    /// # Errors
    /// Those of [`arrival_settings`].
    pub fn first_arrivals(
        &self,
        columns: &Columns,
        coarse: &CoarseSweep,
    ) -> Result<Vec<(u32, Point)>, PlaneError> {
        let nominal = self.nominal();
        let rolling = RollingSweep::foreseen(coarse, &nominal, columns.rows());
        let settings = arrival_settings(columns, &rolling, &nominal, self.calibration.delays as usize)?;
        Ok(self.points_at(BoardPurpose::Arrival, settings))
    }

    /// The points of the later passes, which show when each row's light arrives, and those that show how long exposures
    /// are.
    ///
    /// # Errors
    /// Those of [`arrival_settings`].
    pub fn arrivals(
        &self,
        columns: &Columns,
        rolling: &RollingSweep,
    ) -> Result<Vec<(u32, Point)>, PlaneError> {
        let nominal = self.nominal();
        let delays = self.calibration.delays as usize;
        // Each delay once before any comes again: drift does not look like a delay.
        let pass = arrival_settings(columns, rolling, &nominal, delays)?;
        let passes = pass.iter().cycle().take((ARRIVAL_PASSES - 1) * delays).copied().collect();
        let checks = check_settings(columns, rolling, &nominal)?;
        let mut points = self.points_after(BoardPurpose::Arrival, delays, passes);
        points.extend(self.points_at(BoardPurpose::ExposureCheck, checks));
        Ok(points)
    }

    /// The points of a purpose with these settings.
    fn points_at(&self, purpose: BoardPurpose, settings: Vec<BoardSetting>) -> Vec<(u32, Point)> {
        self.points_after(purpose, 0, settings)
    }

    /// The points of a purpose after the first ones, with these settings.
    fn points_after(
        &self,
        purpose: BoardPurpose,
        first: usize,
        settings: Vec<BoardSetting>,
    ) -> Vec<(u32, Point)> {
        let geometry = &self.task.geometry;
        let point = |(ordinal, setting): (u32, BoardSetting)| {
            let BoardSetting { delay_us, exposure_us, .. } = setting;
            let delay_us = geometry.raster.delay_us(geometry.first_row, delay_us, exposure_us);
            let foreseen = self.task.schedule.points[ordinal as usize];
            (ordinal, Point { delay_us, exposure_us, ..foreseen })
        };
        self.ordinals(purpose).skip(first).zip(settings).map(point).collect()
    }

    /// The setting of a stored frame, by its measured delay.
    pub(super) fn board_setting(&self, purpose: BoardPurpose, entry: &PointEntry) -> BoardSetting {
        let geometry = &self.task.geometry;
        let delay_us = entry.delays_us.iter().sum::<f64>() / entry.delays_us.len().max(1) as f64;
        let shutter = match self.shutter(purpose) {
            Shutter::Global => ExposureMode::Global,
            Shutter::Rolling => ExposureMode::Rolling,
        };
        BoardSetting {
            shutter,
            delay_us: start_us(&geometry.raster, geometry.first_row, delay_us, entry.exposure_us),
            exposure_us: entry.exposure_us,
        }
    }
}

/// Time from the edge of the light to the start of row 0's exposure: the inverse of [`Raster::delay_us`].
fn start_us(raster: &Raster, first_row: usize, delay_us: f64, exposure_us: f64) -> f64 {
    raster.row_centre_us(first_row) + delay_us - exposure_us / 2.0
}

/// Bits of the Gray code of all blocks of rows.
fn row_bits(projector_rows: usize) -> u32 {
    code_bits(projector_rows.div_ceil(ROWS_PER_BLOCK))
}

/// Those of all blocks of columns.
fn column_bits() -> u32 {
    code_bits(PROJECTOR_COLUMNS.div_ceil(COLUMNS_PER_BLOCK))
}

fn code_bits(blocks: usize) -> u32 {
    usize::BITS - (blocks.max(2) - 1).leading_zeros()
}

/// The purposes of all points, in the order of acquisition.
fn purposes(plan: &CalibrationPlan, projector_rows: usize) -> Vec<BoardPurpose> {
    let frames = plan.frames as usize;
    let several = |purpose, frames| std::iter::repeat_n(purpose, frames);
    let capped =
        (0..plan.exposure_us.len()).flat_map(|exposure| several(BoardPurpose::Capped(exposure), frames));
    let of = BoardPurpose::Response;
    let [first, second] = [WhichBoard::First, WhichBoard::Second];
    let [black, white] = [BoardPicture::Black, BoardPicture::White];
    let levels = [of(first, black), BoardPurpose::Ambient, of(first, white)]
        .map(|purpose| several(purpose, 2 * frames));
    let greys = (0..GREYS.len()).flat_map(|grey| several(BoardPurpose::Grey(grey), GREY_FRAMES));
    let passes =
        (1..=plan.passes as usize).flat_map(|passes| several(BoardPurpose::Passes(passes), PASSES_FRAMES));
    let saturated = several(BoardPurpose::Saturated, if plan.passes > 0 { SATURATED_FRAMES } else { 0 });
    let second_board = [of(second, black), of(second, white)]
        .into_iter()
        .flat_map(|purpose| several(purpose, frames))
        .chain(CalibrationTask::phases(second))
        .chain(row_codes(projector_rows, second));
    let column_codes = 2 * column_bits() as usize;
    capped
        .chain(levels.into_iter().flatten())
        .chain(greys)
        .chain(passes)
        .chain(saturated)
        .chain(CalibrationTask::phases(first))
        .chain(row_codes(projector_rows, first))
        .chain((0..column_codes).map(BoardPurpose::ColumnCode))
        .chain(several(BoardPurpose::SweepTime, SWEEP_TIMES))
        .chain(several(BoardPurpose::Arrival, ARRIVAL_PASSES * plan.delays as usize))
        .chain(several(BoardPurpose::ExposureCheck, EXPOSURE_CHECKS))
        .chain(second_board.filter(|_| plan.boards > 1))
        .collect()
}

/// The purposes of a board's pictures of the rows' Gray code.
fn row_codes(projector_rows: usize, board: WhichBoard) -> impl Iterator<Item = BoardPurpose> {
    let pictures = 0..2 * row_bits(projector_rows) as usize;
    pictures.map(move |picture| BoardPurpose::Response(board, BoardPicture::RowCode(picture)))
}
