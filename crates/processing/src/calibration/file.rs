//! A calibration as sessions and the data folder keep it.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use jiff::Timestamp;
use raysweep_config::{ConfigError, RigFile};
use raysweep_core::{CameraCapabilities, io_text};
use raysweep_session::{durable, input};
use raysweep_transport::plane::board::{
    BoardCalibration, BoardStrip, CalibrationCovariance, CalibrationParameter, Estimate, RowDrawing,
};
use raysweep_transport::plane::calibrate::FlyingSpot;
use raysweep_transport::plane::{NoiseModel, PixelResponse};

use super::arrays::CalibrationArrays;
use super::header::{CalibratedAmbient, CalibratedLight, CalibratedTiming, CalibrationHeader, Pair, sha256};
use super::median::median;
use crate::plane::KnownCalibration;

/// Older calibrations cause a warning.
const MOST_DAYS: i64 = 30;

/// Folder of the calibration in use, within the daemon's data folder.
pub fn current_in(data: &Path) -> PathBuf {
    data.join("calibration")
}

/// A calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct KeptCalibration {
    /// `calibration.toml`.
    pub header: CalibrationHeader,
    /// `calibration.npz`.
    pub arrays: CalibrationArrays,
}

impl KeptCalibration {
    /// Joins header and arrays, and states the arrays' checksum.
    ///
    /// # Errors
    /// When header and arrays do not fit together, or cannot be encoded.
    pub fn new(header: CalibrationHeader, arrays: CalibrationArrays) -> raysweep_session::Result<Self> {
        // What could not be read again must not replace a calibration in use.
        header.check().and_then(|()| arrays.check(&header)).map_err(not_encoded)?;
        let arrays_sha256 = sha256(&encoded(&arrays)?);
        Ok(Self { header: CalibrationHeader { arrays_sha256, ..header }, arrays })
    }

    /// Writes both files into a folder, the header last.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, folder: &Path) -> raysweep_session::Result<()> {
        durable::write(&folder.join("calibration.npz"), &encoded(&self.arrays)?)?;
        let header = toml::to_string(&self.header).map_err(|error| not_encoded(error.to_string()))?;
        durable::write(&folder.join("calibration.toml"), header.as_bytes())
    }

    /// Makes this the calibration in use of a data folder, at once or not at all.
    ///
    /// # Errors
    /// When it cannot be written; the one before then stays in use.
    pub fn use_in(&self, data: &Path) -> raysweep_session::Result<()> {
        durable::replace_dir(&current_in(data), |folder| self.write(folder))
    }

    /// Reads a calibration; `None` if the folder has none.
    ///
    /// # Errors
    /// Says which file is damaged, and how.
    pub fn read(folder: &Path) -> Result<Option<Self>, String> {
        let Some(header) = CalibrationHeader::read(folder)? else { return Ok(None) };
        let path = folder.join("calibration.npz");
        let in_file = |why: String| format!("{}: {why}", path.display());
        let bytes = input::read_itself(&path, CalibrationArrays::most_bytes(&header))
            .map_err(|error| in_file(io_text(&error)))?;
        if sha256(&bytes) != header.arrays_sha256 {
            return Err(in_file(
                "its SHA-256 is not the arrays_sha256 of calibration.toml: it was changed or damaged".into(),
            ));
        }
        let arrays = CalibrationArrays::from_bytes(&bytes).map_err(|error| in_file(error.to_string()))?;
        arrays.check(&header).map_err(in_file)?;
        Ok(Some(Self { header, arrays }))
    }

    /// The calibration that a rig's runs use, from the daemon's data folder or a session's; `None` if there is none, or
    /// the rig file overrides it.
    ///
    /// # Errors
    /// When it cannot be read, or is of other devices.
    pub fn of(
        rig: &RigFile,
        folder: &Path,
        camera: Option<&CameraCapabilities>,
    ) -> Result<Option<Self>, ConfigError> {
        if rig.calibration.is_overridden {
            return Ok(None);
        }
        let instead = "run `raysweep calibrate` again, or state [calibration] override = true in the rig file to use its own numbers";
        let refused = |why: String| {
            ConfigError::of_field("calibration", format!("the calibration cannot be used: {why}; {instead}"))
        };
        let Some(kept) = Self::read(folder).map_err(refused)? else { return Ok(None) };
        kept.header.valid_for.check(rig, camera).map_err(refused)?;
        Ok(Some(kept))
    }

    /// Warnings about a calibration that may not be true any more.
    pub fn warnings(&self, rig_text: &str, now: Timestamp) -> Vec<String> {
        let days = now.duration_since(self.header.made).as_hours() / 24;
        let old = (days > MOST_DAYS)
            .then(|| format!("the calibration is {days} days old: run `raysweep calibrate` again"));
        let changed = (sha256(rig_text.as_bytes()) != self.header.valid_for.rig_sha256).then(|| {
            format!(
                "the rig file was changed after the calibration of {}: if a device, a lens or a distance changed, run `raysweep calibrate` again",
                self.header.made.strftime("%Y-%m-%d %H:%M UTC")
            )
        });
        old.into_iter().chain(changed).collect()
    }

    /// The calibration as sweeps and films of a rig use it, with its date.
    ///
    /// # Errors
    /// When the arrays hold no usable response, or the image does not have the columns in which the board stays.
    pub fn known(&self, rig: &RigFile) -> Result<KnownCalibration, ConfigError> {
        let made = self.header.made.strftime("%Y-%m-%d %H:%M UTC").to_string();
        Ok(KnownCalibration { made, board: self.board(self.strip(rig)?)? })
    }

    fn strip(&self, rig: &RigFile) -> Result<Option<BoardStrip>, ConfigError> {
        let Some([first, end]) = rig.calibration.strip_columns else { return Ok(None) };
        let [_, columns] = self.header.valid_for.size;
        if end > columns {
            let message =
                format!("calibration.strip_columns = [{first}, {end}]: the camera has {columns} columns");
            return Err(rig.places.error(&["calibration", "strip_columns"], message));
        }
        Ok(Some(BoardStrip { columns: first..end, jitter_us: self.header.timing.jitter_us[0] }))
    }

    /// The calibration as the model uses it.
    ///
    /// # Errors
    /// When the arrays hold no usable response.
    fn board(&self, strip: Option<BoardStrip>) -> Result<Arc<BoardCalibration>, ConfigError> {
        let CalibratedTiming { camera_row_time_us, exposure_offset_us, jitter_us, .. } = self.header.timing;
        let CalibratedLight { white_dn: [white_dn, _], electrons_per_dn: [gain, _], read_noise_e, .. } =
            self.header.light;
        let white_e = white_dn * gain;
        let response = PixelResponse::new(self.arrays.place.clone(), self.arrays.response.clone())
            .map_err(|error| ConfigError::of_field("calibration", error.to_string()))?;
        Ok(Arc::new(BoardCalibration {
            row_starts_us: self.arrays.row_starts_us.to_vec(),
            camera_row_time_us: estimate(camera_row_time_us),
            exposure_offset_us: estimate(exposure_offset_us),
            jitter_us: jitter_us[0],
            covariance: self.covariance(),
            response,
            drawing: self.drawing(),
            white_dn: self.arrays.white_dn.clone(),
            dark_offset_dn: self.arrays.dark_offset_dn.clone(),
            linearity_per_dn: self.header.light.linearity_per_dn.map(|[per_dn, _]| per_dn),
            saturation_dn: self.header.light.saturation_dn,
            noise: NoiseModel { read_variance: (read_noise_e[0] / white_e).powi(2), gain: white_e.recip() },
            strip,
            lamp: self.header.ambient.as_ref().and_then(CalibratedAmbient::lamp),
        }))
    }

    /// How the projector draws a row, if it was measured.
    fn drawing(&self) -> Option<RowDrawing> {
        let spot = |scan| {
            let columns = self.arrays.projector_columns.clone()?;
            Some(RowDrawing::Spot(FlyingSpot { scan, columns }))
        };
        self.header.drawing.as_ref()?.scan().map_or(Some(RowDrawing::Even), spot)
    }

    /// Covariance of what a run takes from the calibration, for a typical pixel.
    fn covariance(&self) -> CalibrationCovariance {
        let (timing, arrays) = (&self.header.timing, &self.arrays);
        let white = arrays.white_sd.iter().zip(&arrays.white_dn).map(|(sd, dn)| sd / dn);
        let [_, exposure_sd_us] = timing.exposure_offset_us;
        let sds = [
            timing.latency_sd_us,
            exposure_sd_us,
            median(arrays.place_sd.iter().copied()),
            self.header.light.response_width_sd.unwrap_or(0.0),
            median(white),
        ];
        let mut covariance = CalibrationCovariance::independent(sds);
        let mixed_us2 = timing.latency_exposure_covariance_us2.unwrap_or(0.0);
        let [latency, exposure] = [CalibrationParameter::Latency, CalibrationParameter::ExposureOffset];
        for (a, b) in [(latency, exposure), (exposure, latency)] {
            covariance.matrix[a as usize][b as usize] = mixed_us2;
        }
        covariance
    }
}

fn estimate([value, sd]: Pair) -> Estimate {
    Estimate { value, sd }
}

fn encoded(arrays: &CalibrationArrays) -> raysweep_session::Result<Vec<u8>> {
    arrays.to_bytes().map_err(not_encoded)
}

fn not_encoded(why: String) -> raysweep_session::Error {
    raysweep_session::Error::Codec { action: "encode", what: "the calibration".into(), why }
}
