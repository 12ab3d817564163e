//! The stored images of a calibration, and why they may be of no use.

use std::collections::BTreeMap;

use ndarray::{Array2, Array3, Axis};
use raysweep_pipeline::SeenLight;
use raysweep_session::ledger::{FrameStarts, PointEntry, State};
use raysweep_session::stack::{Stack, crc32};
use raysweep_transport::plane::PlaneError;
use raysweep_transport::plane::board::images::ImagesError;
use raysweep_transport::plane::board::times::TimesError;

use super::task::{BoardPicture, BoardPurpose, CalibrationTask, WhichBoard};
use crate::plane::place;

/// A second board whose pixels look at rows farther from those of the first stands elsewhere.
pub(super) const MOST_AWAY_ROWS: f64 = 0.05;

/// Why a rig cannot be calibrated from a session's images.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationError {
    /// The board, its light or its pictures.
    #[error(transparent)]
    Images(#[from] ImagesError),
    /// White is hardly brighter than black.
    #[error(
        "the camera sees no light of the board ({0}): take the cap off the lens, see that the projector is on, and open the aperture; `raysweep viewfinder --picture white` shows what the camera sees"
    )]
    NoLight(SeenLight),
    /// The second board, its light or its pictures.
    #[error("the second board: {0}")]
    SecondBoard(ImagesError),
    /// The second board stands elsewhere than the first.
    #[error(
        "the second board: its pixels look at rows that are {away_rows:.2} rows from those of the first, and at most {MOST_AWAY_ROWS} are allowed: put it exactly in the place of the first"
    )]
    Elsewhere {
        /// The median distance.
        away_rows: f64,
    },
    /// The room's light is not the same in the pictures of both boards.
    #[error(
        "the room's light flickers, and what is left of it in the pictures looks like light that a board spreads: switch the lamps off, or take calibration.boards = 1"
    )]
    Lamps,
    /// The times.
    #[error(transparent)]
    Times(#[from] TimesError),
    /// The geometry.
    #[error(transparent)]
    Plane(#[from] PlaneError),
    /// An image is missing or damaged.
    #[error("{0}")]
    Image(String),
    /// The session cannot be read.
    #[error(transparent)]
    Session(#[from] raysweep_session::Error),
}

impl CalibrationError {
    /// Whether the same images will always be refused: what is missing or damaged may be taken again.
    pub fn is_final(&self) -> bool {
        !matches!(self, Self::Image(_) | Self::Session(_))
    }
}

/// The images of a session.
pub struct BoardImages<'a> {
    /// The task that they belong to.
    pub task: &'a CalibrationTask,
    /// State of the session.
    pub state: &'a State,
    /// Its stack.
    pub stack: &'a Stack,
}

impl BoardImages<'_> {
    /// The mean image of a point, `[t, s]` in counts, with its line in the ledger.
    pub(super) fn image(&self, ordinal: u32) -> Result<(Array2<f32>, &PointEntry), CalibrationError> {
        let (array, index) = place(self.task.task.schedule.points[ordinal as usize].role);
        let again = "`raysweep resume` acquires it";
        let refused =
            |why: String| CalibrationError::Image(format!("image {index} of {}: {why}", array.as_str()));
        let entry = self
            .state
            .point(array, index)
            .filter(|entry| entry.frames > 0)
            .ok_or_else(|| refused(format!("it is missing; {again}")))?;
        let sum = self.stack.read_point(array, index)?;
        if crc32(sum.view()) != entry.crc32 {
            return Err(refused(format!(
                "it is damaged: its checksum differs from the ledger's; {again} again"
            )));
        }
        Ok((sum.mapv(|sum| sum as f32 / entry.frames as f32), entry))
    }

    /// All frames of a purpose, `[n, t, s]` in counts.
    pub(super) fn frames(&self, purpose: BoardPurpose) -> Result<Array3<f32>, CalibrationError> {
        let (rows, columns) = (self.task.task.geometry.height, self.task.task.geometry.width);
        let ordinals: Vec<u32> = self.task.ordinals(purpose).collect();
        let mut frames = Array3::zeros((ordinals.len(), rows, columns));
        for (mut frame, ordinal) in frames.outer_iter_mut().zip(ordinals) {
            frame.assign(&self.image(ordinal)?.0);
        }
        Ok(frames)
    }

    /// The frames of a purpose whose start was stored, those of one run or all, with the start of each exposure in s.
    pub(super) fn timed_frames(
        &self,
        purpose: BoardPurpose,
        run: Option<u32>,
    ) -> Result<(Array3<f32>, Vec<f64>), CalibrationError> {
        let (rows, columns) = (self.task.task.geometry.height, self.task.task.geometry.width);
        let (mut frames, mut opened_s) = (Array3::zeros((0, rows, columns)), Vec::new());
        for ordinal in self.task.ordinals(purpose) {
            let (image, entry) = self.image(ordinal)?;
            if let Some(FrameStarts { starts_ns, .. }) =
                entry.exposed.as_ref().filter(|of| run.is_none_or(|run| of.run == run))
                && let [start_ns] = starts_ns[..]
            {
                let shaped = |error: ndarray::ShapeError| CalibrationError::Image(error.to_string());
                frames.push(Axis(0), image.view()).map_err(shaped)?;
                opened_s.push(start_ns as f64 * 1e-9);
            }
        }
        Ok((frames, opened_s))
    }

    /// The run that took most of the frames of the room's light: each run has its own clock.
    pub(super) fn run_of_ambient(&self) -> Option<u32> {
        let mut frames = BTreeMap::<u32, usize>::new();
        for ordinal in self.task.ordinals(BoardPurpose::Ambient) {
            let (array, index) = place(self.task.task.schedule.points[ordinal as usize].role);
            let run = self.state.point(array, index)?.exposed.as_ref()?.run;
            *frames.entry(run).or_default() += 1;
        }
        frames.into_iter().max_by_key(|(run, count)| (*count, *run)).map(|(run, _)| run)
    }

    /// The black and the white frames of a board.
    pub(super) fn black_and_white(&self, board: WhichBoard) -> Result<[Array3<f32>; 2], CalibrationError> {
        let frames = |picture| self.frames(BoardPurpose::Response(board, picture));
        Ok([frames(BoardPicture::Black)?, frames(BoardPicture::White)?])
    }

    /// Means of several purposes, `[n, t, s]` in counts.
    pub(super) fn means(
        &self,
        purposes: impl Iterator<Item = BoardPurpose>,
    ) -> Result<Array3<f32>, CalibrationError> {
        let images: Vec<Array2<f32>> = purposes
            .map(|purpose| Ok(self.frames(purpose)?.mean_axis(Axis(0)).unwrap_or_default()))
            .collect::<Result<_, CalibrationError>>()?;
        let views: Vec<_> = images.iter().map(|image| image.view()).collect();
        ndarray::stack(Axis(0), &views).map_err(|error| CalibrationError::Image(error.to_string()))
    }
}
