//! `calibration.toml`: the figures of a calibration.

use std::collections::BTreeMap;
use std::path::Path;

use jiff::Timestamp;
use raysweep_config::RigFile;
use raysweep_core::{CameraCapabilities, PixelFormat, io_text};
use raysweep_session::input;
use raysweep_transport::plane::board::FlickeringLamp;
use raysweep_transport::plane::board::images::MOST_BEND;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::drawing::CalibratedDrawing;

/// Version of the files' format.
pub(super) const SCHEMA: u32 = 1;
/// Largest header that is read.
const MAX_HEADER_BYTES: u64 = 1 << 20;
/// No camera with at least 8 bits is calibrated with a larger `a`: its error is part of what is accepted.
const MOST_CURVE_PER_DN: f64 = 2.0 * MOST_BEND / 255.0;

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
    /// What the rig file says of where on the sensor the pixels lie and of what they count; `None` in files of earlier
    /// versions, which do not say it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<BTreeMap<String, String>>,
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
    pub(super) fn lamp(&self) -> Option<FlickeringLamp> {
        let CalibratedFlicker { frequency_hz: [frequency_hz, _], share: [share, _] } =
            self.flicker.as_ref()?;
        Some(FlickeringLamp { frequency_hz: *frequency_hz, amplitude: self.level * share })
    }
}

impl CalibrationHeader {
    /// Whether this session measured it.
    pub fn is_of(&self, session: &Path) -> bool {
        session.file_name().is_some_and(|name| *name == *self.session)
    }

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
    pub(super) fn check(&self) -> Result<(), String> {
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
            sensor: Some(rig.camera.sensor_settings()),
        }
    }

    /// Refuses other devices.
    pub(super) fn check(&self, rig: &RigFile, camera: Option<&CameraCapabilities>) -> Result<(), String> {
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
        let Some(of) = &self.sensor else { return Ok(()) };
        let now = rig.camera.sensor_settings();
        let stated = |settings: &BTreeMap<String, String>, key: &str| {
            settings.get(key).cloned().unwrap_or_else(|| "not stated".to_owned())
        };
        match of.keys().chain(now.keys()).find(|key| of.get(*key) != now.get(*key)) {
            Some(key) => Err(format!("{key} was {}, and is {}", stated(of, key), stated(&now, key))),
            None => Ok(()),
        }
    }
}

pub(super) fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]
mod tests {
    use super::*;

    #[test]
    fn pixels_elsewhere_on_the_sensor_or_of_another_gain_are_refused() {
        let rig = |in_aravis: &str| {
            let text = format!(
                "kind = \"plane\"\n[camera]\ndriver = \"aravis\"\n[camera.aravis]\naddress = \"127.0.0.1\"\n{in_aravis}\
                 [vsync]\ndriver = \"sim\"\nperiod_us = 16666.667\n[projector]\ndriver = \"sim\"\n[sim]\nbench = \"b.sock\"\n"
            );
            RigFile::parse(&text).unwrap()
        };
        let of = rig(
            "region = { y = 8, width = 64, height = 96 }\nfeatures = [\"GammaEnable=0\", \"Gain = 3\"]\n",
        );
        let valid_for = ValidFor::new(&of, "", "some camera", (96, 64));
        let refusal = |in_aravis: &str| valid_for.check(&rig(in_aravis), None).err();
        let region = "region = { y = 8, width = 64, height = 96 }\n";
        assert_eq!(refusal(&format!("{region}features = [\"Gain=3\"]\ntrigger_source = \"Line1\"\n")), None);
        let gain = "camera.aravis.features Gain was 3, and is ";
        assert_eq!(refusal(&format!("{region}features = [\"Gain=6\"]\n")).unwrap(), format!("{gain}6"));
        assert_eq!(refusal(region).unwrap(), format!("{gain}not stated"));
        let moved = "region = { y = 9, width = 64, height = 96 }\nfeatures = [\"Gain=3\"]\n";
        assert_eq!(
            refusal(moved).unwrap(),
            "camera.aravis.region was 64 x 96 from column 0 and row 8 on, and is 64 x 96 from column 0 and row 9 on"
        );
        // Files of earlier versions do not say it.
        let earlier = ValidFor { sensor: None, ..valid_for };
        assert_eq!(earlier.check(&rig(""), None), Ok(()));
    }
}
