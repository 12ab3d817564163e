//! `calibration.toml` and `calibration.npz`: a calibration as sessions and the data folder keep it.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use jiff::Timestamp;
use ndarray::{Array1, Array2, Array3};
use ndarray_npy::{NpzReader, NpzWriter};
use raysweep_config::{ConfigError, RigFile};
use raysweep_core::{CameraCapabilities, PixelFormat, io_text};
use raysweep_session::{durable, input};
use raysweep_transport::plane::board::images::MOST_BEND;
use raysweep_transport::plane::board::{
    BoardCalibration, BoardStrip, CalibrationCovariance, CalibrationParameter, CameraCurve, Estimate,
    FlickeringLamp, RowDrawing,
};
use raysweep_transport::plane::calibrate::FlyingSpot;
use raysweep_transport::plane::{NoiseModel, PixelResponse, RESPONSE_ROWS};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::drawing::CalibratedDrawing;
use crate::plane::KnownCalibration;

/// Version of the files' format.
pub(super) const SCHEMA: u32 = 1;
/// Older calibrations cause a warning.
const MOST_DAYS: i64 = 30;
/// Largest header that is read.
const MAX_HEADER_BYTES: u64 = 1 << 20;
/// Room in `calibration.npz` for everything but maps and tables: names, headers, modes.
const OTHER_BYTES: u64 = 4 << 20;
/// Most modes of the covariance of the row starts.
const MAX_MODES: u64 = 256;
/// 4-byte numbers per pixel: place, its deviation, responses, white, its deviation, dark offset, slope and covariance,
/// the room's light, projector column.
const NUMBERS_PER_PX: u64 = 2 + RESPONSE_ROWS as u64 + 2 + 2 + 3 + 1 + 1;
/// Names of the arrays that older files lack.
const AMBIENT: &str = "ambient_dn_per_us";
const PROJECTOR_COLUMNS: &str = "projector_columns";

/// Folder of the calibration in use, within the daemon's data folder.
pub fn current_in(data: &Path) -> PathBuf {
    data.join("calibration")
}

/// A number and its standard deviation, as the file has them.
pub type Pair = [f64; 2];

/// `calibration.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibrationHeader {
    /// Version of the format.
    pub schema: u32,
    /// Start of the session that measured it.
    pub made: Timestamp,
    /// Name of that session's folder.
    pub session: String,
    /// SHA-256 of `calibration.npz`.
    pub arrays_sha256: String,
    /// The devices that it belongs to.
    pub valid_for: ValidFor,
    /// Times.
    pub timing: CalibratedTiming,
    /// Light and sensor.
    pub light: CalibratedLight,
    /// How the projector draws a row; `None` in files of earlier versions, which leave it to the rig file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drawing: Option<CalibratedDrawing>,
    /// The room's light; `None` if it was not measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ambient: Option<CalibratedAmbient>,
    /// Figures of the calibration's own checks, each with its limit.
    pub checks: BTreeMap<String, Pair>,
}

/// The devices that a calibration belongs to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValidFor {
    /// Maker, model and serial number of the camera.
    pub camera: String,
    /// Camera rows and columns.
    pub size: [usize; 2],
    /// Pixel format.
    pub pixel_format: PixelFormat,
    /// Projector rows.
    pub projector_rows: usize,
    /// Time from one VSYNC edge to the next, as the rig file has it.
    pub period_us: f64,
    /// SHA-256 of the rig file.
    pub rig_sha256: String,
}

/// Times, each with its standard deviation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedTiming {
    /// Mean time from one projector row to the next.
    pub row_time_us: Pair,
    /// Time from one camera row to the next.
    pub camera_row_time_us: Pair,
    /// What exposures have more than their nominal length.
    pub exposure_offset_us: Pair,
    /// Standard deviation of the time of all rows together.
    pub latency_sd_us: f64,
    /// Jitter of the light of a frame against the measured VSYNC edge.
    pub jitter_us: Pair,
    /// First projector row that the image sees, and the row after the last.
    pub seen_rows: [usize; 2],
    /// Covariance of the latency and the exposure offset, in square microseconds; `None` in files of earlier versions,
    /// which take them as independent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latency_exposure_covariance_us2: Option<f64>,
}

/// Light and sensor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedLight {
    /// Median white, in counts above black.
    pub white_dn: Pair,
    /// Gain.
    pub electrons_per_dn: Pair,
    /// Noise of a reading.
    pub read_noise_e: Pair,
    /// Non-uniformity of the pixels' sensitivities.
    pub prnu: Pair,
    /// `a` of the camera's curve: what it counts above `dark_offset_dn`, times `1 + a` of that, is proportional to the
    /// light; `None` if it was not measured, and the camera is taken as linear.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub linearity_per_dn: Option<Pair>,
    /// Counts from which on a pixel is overexposed; `None` if it was not measured: then it is a share of the converter's
    /// range.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub saturation_dn: Option<f64>,
    /// Number of pixels with unusual dark current or noise.
    pub hot_pixels: usize,
    /// Standard deviation of the width of a pixel's response, relative to itself; `None` in files of earlier versions,
    /// which take it as exact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub response_width_sd: Option<f64>,
    /// Whose responses these are; `None` in files of earlier versions, which are of beam and board.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub response_of: Option<ResponseOf>,
}

/// What the responses of a calibration contain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ResponseOf {
    /// Of one board, which spreads light inside as a wider beam would.
    #[serde(rename = "beam and board")]
    BeamAndBoard,
    /// Of the narrower one of two boards, which differ.
    #[serde(rename = "beam")]
    Beam,
    /// Of the first of two boards that do not differ.
    #[serde(rename = "boards alike")]
    BoardsAlike,
}

impl ResponseOf {
    /// For an operator.
    pub fn text(self) -> &'static str {
        match self {
            Self::BeamAndBoard => {
                "of beam and board, which one board cannot tell apart (calibration.boards = 2)"
            }
            Self::Beam => "of the beam, by two boards that differ",
            Self::BoardsAlike => {
                "of the beam, if the two boards, which respond alike, are of different material"
            }
        }
    }
}

/// The room's light.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedAmbient {
    /// Its median level, of white in the time of one projector row.
    pub level: f64,
    /// Median light of the projector's black, of white.
    pub projector_black: f64,
    /// Its flicker, if it has any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flicker: Option<CalibratedFlicker>,
}

/// The flicker of the room's light, with standard deviations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedFlicker {
    /// Frequency.
    pub frequency_hz: Pair,
    /// Amplitude as a share of the level.
    pub share: Pair,
}

/// `calibration.npz`. `[t, s]` are camera rows and columns.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibrationArrays {
    /// Start of each projector row and end of the last, `[rows + 1]`.
    pub row_starts_us: Array1<f64>,
    /// Modes `[r, rows + 1]` whose outer products sum to the covariance of the row starts.
    pub row_starts_modes: Array2<f64>,
    /// Place of each pixel in projector rows, `[t, s]`.
    pub place: Array2<f32>,
    /// Its standard deviation; NaN where the board was not lit.
    pub place_sd: Array2<f32>,
    /// Shares of the drawn rows around the place in the pixel's direct light, `[16, t, s]`.
    pub response: Array3<f32>,
    /// White above black, `[t, s]`; NaN where the board was not lit.
    pub white_dn: Array2<f32>,
    /// Its standard deviation.
    pub white_sd: Array2<f32>,
    /// Dark level at exposure 0, `[t, s]`.
    pub dark_offset_dn: Array2<f32>,
    /// Dark current, `[t, s]`.
    pub dark_slope_dn_per_us: Array2<f32>,
    /// Variance of the offset, covariance, variance of the slope, `[3, t, s]`.
    pub dark_covariance: Array3<f32>,
    /// Projector column that each pixel sees of the board, `[t, s]` in 0..=1 over its width; NaN where the board was not
    /// lit; `None` if rows are lit evenly.
    pub projector_columns: Option<Array2<f32>>,
    /// Light of the room, `[t, s]`; `None` if it was not measured.
    pub ambient_dn_per_us: Option<Array2<f32>>,
}

/// A calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct KeptCalibration {
    /// `calibration.toml`.
    pub header: CalibrationHeader,
    /// `calibration.npz`.
    pub arrays: CalibrationArrays,
}

/// No camera with at least 8 bits is calibrated with a larger `a`: its error is part of what is accepted.
const MOST_CURVE_PER_DN: f64 = 2.0 * MOST_BEND / 255.0;

impl CalibrationArrays {
    fn to_bytes(&self) -> Result<Vec<u8>, String> {
        let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
        let mut write = || {
            npz.add_array("row_starts_us", &self.row_starts_us)?;
            npz.add_array("row_starts_modes", &self.row_starts_modes)?;
            npz.add_array("place", &self.place)?;
            npz.add_array("place_sd", &self.place_sd)?;
            npz.add_array("response", &self.response)?;
            npz.add_array("white_dn", &self.white_dn)?;
            npz.add_array("white_sd", &self.white_sd)?;
            npz.add_array("dark_offset_dn", &self.dark_offset_dn)?;
            npz.add_array("dark_slope_dn_per_us", &self.dark_slope_dn_per_us)?;
            npz.add_array("dark_covariance", &self.dark_covariance)?;
            self.later().try_for_each(|(name, array)| npz.add_array(name, array))
        };
        write().map_err(|error: ndarray_npy::WriteNpzError| error.to_string())?;
        Ok(npz.finish().map_err(|error| error.to_string())?.into_inner())
    }

    /// Reads the content of `calibration.npz`.
    ///
    /// # Errors
    /// When an array is missing or cannot be read.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, ndarray_npy::ReadNpzError> {
        let mut npz = NpzReader::new(Cursor::new(bytes))?;
        let names = npz.names()?;
        let has = |name: &str| names.iter().any(|own| own == name);
        Ok(Self {
            row_starts_us: npz.by_name("row_starts_us")?,
            row_starts_modes: npz.by_name("row_starts_modes")?,
            place: npz.by_name("place")?,
            place_sd: npz.by_name("place_sd")?,
            response: npz.by_name("response")?,
            white_dn: npz.by_name("white_dn")?,
            white_sd: npz.by_name("white_sd")?,
            dark_offset_dn: npz.by_name("dark_offset_dn")?,
            dark_slope_dn_per_us: npz.by_name("dark_slope_dn_per_us")?,
            dark_covariance: npz.by_name("dark_covariance")?,
            projector_columns: has(PROJECTOR_COLUMNS).then(|| npz.by_name(PROJECTOR_COLUMNS)).transpose()?,
            ambient_dn_per_us: has(AMBIENT).then(|| npz.by_name(AMBIENT)).transpose()?,
        })
    }

    /// Those of the arrays that older files lack that there are.
    fn later(&self) -> impl Iterator<Item = (&'static str, &Array2<f32>)> {
        let arrays = [(AMBIENT, &self.ambient_dn_per_us), (PROJECTOR_COLUMNS, &self.projector_columns)];
        arrays.into_iter().filter_map(|(name, array)| Some((name, array.as_ref()?)))
    }

    /// Checks that all arrays belong to one rig.
    fn check(&self, header: &CalibrationHeader) -> Result<(), String> {
        let of = &header.valid_for;
        let [rows, columns] = of.size;
        let image = [rows, columns];
        let shapes: [(&str, &[usize], &[usize]); 9] = [
            ("row_starts_us", self.row_starts_us.shape(), &[of.projector_rows.saturating_add(1)]),
            ("place", self.place.shape(), &image),
            ("place_sd", self.place_sd.shape(), &image),
            ("response", self.response.shape(), &[RESPONSE_ROWS, rows, columns]),
            ("white_dn", self.white_dn.shape(), &image),
            ("white_sd", self.white_sd.shape(), &image),
            ("dark_offset_dn", self.dark_offset_dn.shape(), &image),
            ("dark_slope_dn_per_us", self.dark_slope_dn_per_us.shape(), &image),
            ("dark_covariance", self.dark_covariance.shape(), &[3, rows, columns]),
        ];
        let later = self.later().map(|(name, array)| (name, array.shape(), &image[..]));
        for (name, found, expected) in shapes.into_iter().chain(later) {
            if found != expected {
                return Err(format!("{name} has shape {found:?}, but valid_for says {expected:?}"));
            }
        }
        let spot = header.drawing.as_ref().and_then(CalibratedDrawing::scan);
        if spot.is_some() && self.projector_columns.is_none() {
            return Err(format!("{PROJECTOR_COLUMNS} is missing, without which a flying spot has no times"));
        }
        let is_column = |column: &f32| column.is_nan() || (0.0..=1.0).contains(column);
        if let Some(column) = self.projector_columns.iter().flatten().find(|column| !is_column(column)) {
            return Err(format!(
                "{PROJECTOR_COLUMNS} has {column}: must be from 0 to 1, or NaN where the board was not lit"
            ));
        }
        Ok(())
    }
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
        let bytes =
            input::read_itself(&path, header.most_bytes()).map_err(|error| in_file(io_text(&error)))?;
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
            curve: self
                .header
                .light
                .linearity_per_dn
                .map(|[per_dn, _]| CameraCurve { per_dn, zero_dn: self.arrays.dark_offset_dn.clone() }),
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

impl CalibratedAmbient {
    /// What was found, each as a name and a text.
    pub fn lines(&self) -> Vec<(&'static str, String)> {
        let flicker = match &self.flicker {
            Some(CalibratedFlicker { frequency_hz: [frequency_hz, hz_sd], share: [share, share_sd] }) => {
                format!(
                    "{frequency_hz:.2} +- {hz_sd:.2} Hz, {:.1} +- {:.1} % of the light",
                    100.0 * share,
                    100.0 * share_sd
                )
            }
            None => "none".into(),
        };
        // Noise makes either negative in the dark.
        let [level, black] = [self.level, self.projector_black].map(|light| light.max(0.0));
        vec![
            ("ambient light", format!("{level:.6} of white in the time of a row")),
            ("flicker", flicker),
            ("projector's black", format!("{black:.5} of white")),
        ]
    }

    /// The lamp that flickers, if one does.
    fn lamp(&self) -> Option<FlickeringLamp> {
        let CalibratedFlicker { frequency_hz: [frequency_hz, _], share: [share, _] } =
            self.flicker.as_ref()?;
        Some(FlickeringLamp { frequency_hz: *frequency_hz, amplitude: self.level * share })
    }
}

impl CalibrationHeader {
    /// Reads the header alone; `None` if the folder has none.
    ///
    /// # Errors
    /// Says how the file is damaged.
    pub fn read(folder: &Path) -> Result<Option<Self>, String> {
        let path = folder.join("calibration.toml");
        let in_file = |why: String| format!("{}: {why}", path.display());
        let bytes = match input::read_itself(&path, MAX_HEADER_BYTES) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(in_file(io_text(&error))),
        };
        let header: Self = toml::from_slice(&bytes).map_err(|error| in_file(error.to_string()))?;
        if header.schema != SCHEMA {
            let schema = header.schema;
            return Err(in_file(format!("schema = {schema}: this version reads {SCHEMA}; calibrate again")));
        }
        header.check().map_err(in_file)?;
        Ok(Some(header))
    }

    /// Checks that the rows and columns seen exist, and that times, the curve and the counts that saturate are possible.
    fn check(&self) -> Result<(), String> {
        let columns = self.drawing.as_ref().and_then(|drawing| drawing.columns);
        if let Some(column) = columns.iter().flatten().find(|column| !(0.0..=1.0).contains(*column)) {
            return Err(format!("drawing.columns has {column}: must be from 0 to 1"));
        }
        let rows = self.valid_for.projector_rows;
        let [first, end] = self.timing.seen_rows;
        if first >= end || end > rows {
            return Err(format!(
                "seen_rows = [{first}, {end}]: must be [first row, row after the last] of the {rows} projector rows"
            ));
        }
        let timing = &self.timing;
        for (key, value) in [
            ("timing.row_time_us", timing.row_time_us[0]),
            ("timing.camera_row_time_us", timing.camera_row_time_us[0]),
        ] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(format!("{key} = [{value}, ..]: must be more than 0, in microseconds"));
            }
        }
        for (key, value) in [
            ("timing.jitter_us", timing.jitter_us[0]),
            ("timing.latency_sd_us", timing.latency_sd_us),
            ("light.response_width_sd", self.light.response_width_sd.unwrap_or(0.0)),
        ] {
            if !(value >= 0.0 && value.is_finite()) {
                return Err(format!("{key} = {value}: must be 0 or more"));
            }
        }
        if let Some(dn) = self.light.saturation_dn.filter(|dn| !(*dn > 0.0 && dn.is_finite())) {
            return Err(format!("light.saturation_dn = {dn}: must be more than 0, in counts"));
        }
        match self.light.linearity_per_dn {
            Some([per_dn, sd]) if !(per_dn.abs() <= MOST_CURVE_PER_DN && sd >= 0.0) => Err(format!(
                "light.linearity_per_dn = [{per_dn}, {sd}]: must be from {} to {MOST_CURVE_PER_DN}, with a standard deviation of 0 or more",
                -MOST_CURVE_PER_DN
            )),
            _ => Ok(()),
        }
    }

    /// The largest `calibration.npz` that belongs to this header.
    fn most_bytes(&self) -> u64 {
        let [rows, columns] = self.valid_for.size.map(|side| side as u64);
        let pixels = rows.saturating_mul(columns);
        let table = (self.valid_for.projector_rows as u64).saturating_add(1);
        pixels
            .saturating_mul(4 * NUMBERS_PER_PX)
            .saturating_add(table.saturating_mul(8 * (1 + MAX_MODES)))
            .saturating_add(OTHER_BYTES)
    }
}

impl ValidFor {
    /// The devices of a rig.
    pub fn new(rig: &RigFile, rig_text: &str, camera: &str, size: (usize, usize)) -> Self {
        Self {
            camera: camera.to_owned(),
            size: [size.0, size.1],
            pixel_format: rig.camera.pixel_format,
            projector_rows: rig.projector.rows,
            period_us: rig.vsync.period_us,
            rig_sha256: sha256(rig_text.as_bytes()),
        }
    }

    /// Refuses other devices.
    fn check(&self, rig: &RigFile, camera: Option<&CameraCapabilities>) -> Result<(), String> {
        if let Some(camera) = camera {
            let (of, now) = (self.size, [camera.height, camera.width]);
            if camera.model != self.camera {
                return Err(format!("it is of camera {:?}, and this is {:?}", self.camera, camera.model));
            }
            if of != now {
                let ([rows, columns], [now_rows, now_columns]) = (of, now);
                return Err(format!(
                    "it is of {columns} x {rows} pixels, and the camera takes {now_columns} x {now_rows}"
                ));
            }
        }
        if rig.camera.pixel_format != self.pixel_format {
            let (of, now) = (self.pixel_format, rig.camera.pixel_format);
            return Err(format!("it is of pixel format {of}, and camera.pixel_format is {now}"));
        }
        if rig.projector.rows != self.projector_rows {
            let (of, now) = (self.projector_rows, rig.projector.rows);
            return Err(format!("it is of {of} projector rows, and projector.rows is {now}"));
        }
        if rig.vsync.period_us != self.period_us {
            let (of, now) = (self.period_us, rig.vsync.period_us);
            return Err(format!("it is of a period of {of} us, and vsync.period_us is {now}"));
        }
        Ok(())
    }
}

/// Median of the finite values; 0 if there are none.
pub(super) fn median(values: impl Iterator<Item = f32>) -> f64 {
    let mut values: Vec<f32> = values.filter(|value| value.is_finite()).collect();
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).map_or(0.0, |&value| f64::from(value))
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

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
