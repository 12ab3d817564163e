//! The stored images of a calibration, and what they say.

use ndarray::{Array2, Array3, Axis};
use raysweep_session::ledger::{PointEntry, State};
use raysweep_session::stack::{Stack, crc32};
use raysweep_transport::plane::board::Estimate;
use raysweep_transport::plane::board::images::{
    CappedFrames, CodedPictures, DarkFit, ImagesError, LightLevel, Phases, PhotonTransfer, Responses,
    RowPlaces, WhiteMap, locate_rows, photon_transfer, prnu,
};
use raysweep_transport::plane::board::times::{BoardFrame, CoarseSweep, Columns, RowTimes, TimesError};
use raysweep_transport::plane::{NoiseModel, PlaneError};

use super::task::{BoardPurpose, CalibrationTask, ROWS_PER_BLOCK, WHOLE_US};
use crate::plane::place;

/// Why a rig cannot be calibrated from a session's images.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationError {
    /// The board, its light or its pictures.
    #[error(transparent)]
    Images(#[from] ImagesError),
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
    fn image(&self, ordinal: u32) -> Result<(Array2<f32>, &PointEntry), CalibrationError> {
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
    fn frames(&self, purpose: BoardPurpose) -> Result<Array3<f32>, CalibrationError> {
        let (rows, columns) = (self.task.task.geometry.height, self.task.task.geometry.width);
        let ordinals: Vec<u32> = self.task.ordinals(purpose).collect();
        let mut frames = Array3::zeros((ordinals.len(), rows, columns));
        for (mut frame, ordinal) in frames.outer_iter_mut().zip(ordinals) {
            frame.assign(&self.image(ordinal)?.0);
        }
        Ok(frames)
    }

    /// Means of several purposes, `[n, t, s]` in counts.
    fn means(&self, purposes: impl Iterator<Item = BoardPurpose>) -> Result<Array3<f32>, CalibrationError> {
        let images: Vec<Array2<f32>> = purposes
            .map(|purpose| Ok(self.frames(purpose)?.mean_axis(Axis(0)).unwrap_or_default()))
            .collect::<Result<_, CalibrationError>>()?;
        let views: Vec<_> = images.iter().map(|image| image.view()).collect();
        ndarray::stack(Axis(0), &views).map_err(|error| CalibrationError::Image(error.to_string()))
    }
}

/// What the images say of each pixel.
pub struct BoardPixels {
    /// The dark image over exposures.
    pub dark: DarkFit,
    /// Gain and read noise.
    pub transfer: PhotonTransfer,
    /// Non-uniformity of the pixels' sensitivities.
    pub prnu: Estimate,
    /// White.
    pub white: WhiteMap,
    /// The places of single pixels against a smooth map.
    pub places: RowPlaces,
    /// Place and response.
    pub responses: Responses,
    /// The same, averaged over columns.
    pub columns: Columns,
}

impl BoardPixels {
    /// Evaluates the images of cap, black, white, greys, sparse and coded rows.
    ///
    /// # Errors
    /// When an image is missing, or board, light or pictures are of no use.
    pub fn new(images: &BoardImages<'_>) -> Result<Self, CalibrationError> {
        let task = images.task;
        let full_scale_dn = task.task.geometry.saturation_dn as f32;
        let dark = dark(images)?;
        let (black, white) = (images.frames(BoardPurpose::Black)?, images.frames(BoardPurpose::White)?);
        let dark_dn = dark.image(WHOLE_US);
        let greys: Vec<(f64, Array3<f32>)> = CalibrationTask::greys()
            .map(|(light, purpose)| Ok((light, images.frames(purpose)?)))
            .collect::<Result<_, CalibrationError>>()?;
        let level = |light, frames| LightLevel { light, frames, dark_dn: dark_dn.view() };
        let levels: Vec<LightLevel<'_>> = greys
            .iter()
            .map(|(light, frames)| level(*light, frames.view()))
            .chain([level(1.0, white.view())])
            .collect();
        let usable = dark.hot.mapv(|hot| !hot);
        let transfer = photon_transfer(&levels, full_scale_dn, Some(usable.view()))?;
        let noise = transfer.noise();
        let frames = white.len_of(Axis(0));
        let white = WhiteMap::new(white.view(), black.view(), full_scale_dn, noise)?;
        white.check(full_scale_dn)?;
        let lit = white.lit();
        let prnu = prnu(white.white_dn.view(), Some(lit.view()), frames, noise)?;
        let black_dn = black.mean_axis(Axis(0)).unwrap_or_default();
        let sparse = images.means(CalibrationTask::phases())? - &black_dn;
        let phases = Phases { images: sparse.view(), frames: task.calibration.picture_frames as usize };
        let coded = images.means(task.codes())?;
        let code = CodedPictures { images: coded.view(), lines_per_block: ROWS_PER_BLOCK };
        let projector_rows = task.task.geometry.raster.rows;
        let places = locate_rows(&phases, &code, lit.view(), projector_rows)?;
        let responses = Responses::new(&phases, &white, &places, projector_rows)?;
        responses.checks.check()?;
        let columns = Columns::new(responses.place.view(), responses.response.view())?;
        Ok(Self { dark, transfer, prnu, white, places, responses, columns })
    }

    /// Frames of the white board, as shares of white averaged over columns.
    fn board_frames(
        &self,
        images: &BoardImages<'_>,
        purpose: BoardPurpose,
    ) -> Result<Vec<BoardFrame>, CalibrationError> {
        let frame = |ordinal| {
            let (image, entry) = images.image(ordinal)?;
            let light = (image - self.dark.image(entry.exposure_us)) / &self.white.white_dn;
            let setting = images.task.board_setting(purpose, entry);
            Ok(BoardFrame { setting, light: self.columns.average(light.view())? })
        };
        images.task.ordinals(purpose).map(frame).collect()
    }

    /// The sweep, to within 10 us.
    ///
    /// # Errors
    /// When an image is missing, or the sweep cannot be seen in them.
    pub fn coarse(&self, images: &BoardImages<'_>) -> Result<CoarseSweep, CalibrationError> {
        let frames = self.board_frames(images, BoardPurpose::SweepTime)?;
        Ok(CoarseSweep::from_borders(&self.columns, &frames, &images.task.nominal())?)
    }

    /// When each row is lit.
    ///
    /// # Errors
    /// When an image is missing, or the times cannot be found.
    pub fn times(&self, images: &BoardImages<'_>) -> Result<RowTimes, CalibrationError> {
        let mut frames = Vec::new();
        for purpose in [BoardPurpose::SweepTime, BoardPurpose::Arrival, BoardPurpose::ExposureCheck] {
            frames.extend(self.board_frames(images, purpose)?);
        }
        let (noise, white_dn) = (self.transfer.noise(), self.white.level_dn.value);
        let share = NoiseModel {
            read_variance: (noise.read_noise_e / noise.electrons_per_dn / white_dn).powi(2),
            gain: 1.0 / (noise.electrons_per_dn * white_dn),
        };
        Ok(RowTimes::fit(&self.columns, &frames, &images.task.nominal(), share)?)
    }
}

fn dark(images: &BoardImages<'_>) -> Result<DarkFit, CalibrationError> {
    let exposures_us = images.task.calibration.exposure_us.values();
    let runs: Vec<(f64, Array3<f32>)> = exposures_us
        .into_iter()
        .enumerate()
        .map(|(index, exposure_us)| Ok((exposure_us, images.frames(BoardPurpose::Capped(index))?)))
        .collect::<Result<_, CalibrationError>>()?;
    let runs: Vec<CappedFrames<'_>> = runs
        .iter()
        .map(|(exposure_us, frames)| CappedFrames { exposure_us: *exposure_us, frames: frames.view() })
        .collect();
    Ok(DarkFit::new(&runs)?)
}
