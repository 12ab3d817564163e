//! `calibration.npz`: the maps and tables of a calibration.

use std::io::Cursor;

use ndarray::{Array1, Array2, Array3, ArrayView1, Axis};
use ndarray_npy::{NpzReader, NpzWriter};
use raysweep_transport::plane::RESPONSE_ROWS;

use super::drawing::CalibratedDrawing;
use super::header::CalibrationHeader;
use super::median::median;

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

impl CalibrationArrays {
    /// Width of the responses in projector rows: the root of their second central moment, at least that of a row; the
    /// median over the pixels.
    pub fn response_width_rows(&self) -> f64 {
        let width = |shares: ArrayView1<f32>| {
            let moment = |power: i32| -> f32 {
                shares.iter().zip(0_u8..).map(|(share, row)| share * f32::from(row).powi(power)).sum()
            };
            let variance = moment(2) - moment(1).powi(2);
            // Not `max`, which would take NaN for a row.
            if variance < 1.0 / 12.0 { (1.0_f32 / 12.0).sqrt() } else { variance.sqrt() }
        };
        median(self.response.lanes(Axis(0)).into_iter().map(width))
    }

    pub(super) fn to_bytes(&self) -> Result<Vec<u8>, String> {
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

    /// The largest file that belongs to a header.
    pub(super) fn most_bytes(header: &CalibrationHeader) -> u64 {
        let [rows, columns] = header.valid_for.size.map(|side| side as u64);
        let pixels = rows.saturating_mul(columns);
        let table = (header.valid_for.projector_rows as u64).saturating_add(1);
        pixels
            .saturating_mul(4 * NUMBERS_PER_PX)
            .saturating_add(table.saturating_mul(8 * (1 + MAX_MODES)))
            .saturating_add(OTHER_BYTES)
    }

    /// Those of the arrays that older files lack that there are.
    pub(super) fn later(&self) -> impl Iterator<Item = (&'static str, &Array2<f32>)> {
        let arrays = [(AMBIENT, &self.ambient_dn_per_us), (PROJECTOR_COLUMNS, &self.projector_columns)];
        arrays.into_iter().filter_map(|(name, array)| Some((name, array.as_ref()?)))
    }

    /// Checks that all arrays belong to one rig.
    pub(super) fn check(&self, header: &CalibrationHeader) -> Result<(), String> {
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
