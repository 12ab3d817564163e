//! `rig.toml` of a plane rig: its devices and their timing.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use raysweep_core::{PixelFormat, Raster};
use serde::Deserialize;

use super::aravis::AravisConfig;
use super::v4l2::V4l2Config;
use super::vsync::{VsyncDriver, VsyncSection};
use super::{
    RigKind, default_black_dn, default_pixel_format, default_reopen_s, default_white_dn, full_scale_dn,
    scene_file,
};
use crate::document::Document;
use crate::sim::{SimConfig, SimSpot};
use crate::{ConfigError, Places};

/// A plane rig.
#[derive(Debug, Clone)]
pub struct RigFile {
    /// `[camera]`
    pub camera: CameraSection,
    /// `[vsync]`
    pub vsync: VsyncSection,
    /// `[projector]`
    pub projector: ProjectorSection,
    /// `[calibration]`: how calibrations are used.
    pub calibration: CalibrationUse,
    /// `auto_resume`: whether the service resumes a sweep that a crash cut off, with nobody present.
    pub auto_resume: bool,
    /// `[sim]`, for the driver `sim`.
    pub sim: SimConfig,
    /// Positions of the values in the text.
    pub places: Places,
}

/// `[calibration]`: whether the rig's runs use the calibration in the daemon's data folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationUse {
    /// Whether the numbers in the rig file are used instead.
    #[serde(rename = "override")]
    pub is_overridden: bool,
    /// First camera column in which the board stays in view during runs, and the column after the last.
    pub strip_columns: Option<[usize; 2]>,
}

/// Camera drivers, by their names in rig files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraDriver {
    /// The simulated rig.
    Sim,
    /// GigE Vision and USB3 Vision through libaravis.
    Aravis,
    /// Cameras supported by the Linux kernel (V4L2).
    V4l2,
}

/// Projector drivers, by their names in rig files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProjectorDriver {
    /// The simulated rig.
    Sim,
    /// A display output of this machine.
    Drm,
    /// The operator, who is asked through the daemon's clients.
    External,
}

/// `[projector.drm]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DrmSection {
    /// The graphics card.
    pub card: PathBuf,
    /// The kernel's name of the output; default: the first with a display.
    pub connector: Option<String>,
    /// Video frames from a page flip until the projector certainly shows the image.
    pub settle_frames: u32,
}

impl Default for DrmSection {
    fn default() -> Self {
        Self { card: "/dev/dri/card0".into(), connector: None, settle_frames: 2 } // [A]
    }
}

/// `[camera]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraSection {
    /// The driver that opens it.
    pub driver: CameraDriver,
    /// How long to wait, in a run, for a camera that has stopped responding.
    #[serde(default = "default_reopen_s")]
    pub reopen_s: f64,
    /// `[camera.aravis]`, for the driver `aravis`.
    #[serde(default)]
    pub aravis: AravisConfig,
    /// `[camera.v4l2]`, for the driver `v4l2`.
    pub v4l2: Option<V4l2Config>,
    /// Counts, above black, of a white pixel in the time of one projector row; default: 2500 of 4096, scaled to the
    /// format.
    white_dn: Option<f64>,
    /// Counts without light; default: 64 of 4096, scaled to the format.
    black_dn: Option<f64>,
    /// Electrons per count; default: see [`RigFile::noise`].
    electrons_per_dn: Option<f64>,
    /// Electrons of noise in a dark sample; default: see [`RigFile::noise`].
    read_noise_e: Option<f64>,
    /// Pixel format of the frames.
    #[serde(default = "default_pixel_format")]
    pub pixel_format: PixelFormat,
    /// From the start of one row's exposure to the next row's; default: `row_pitch` times the projector's row time.
    pub row_time_us: Option<f64>,
    /// Projector rows per camera row, on the epipolar planes.
    #[serde(default = "default_row_pitch")]
    pub row_pitch: f64,
    /// Projector row that camera row 0 sees; default: the camera's rows are centred on the projector's.
    pub first_projector_row: Option<usize>,
    /// Projector columns, 0 to 1 across its width, that the image's left and right edges see; default: unknown.
    pub projector_columns: Option<[f64; 2]>,
}

impl CameraSection {
    /// Counts, above black, of a white pixel in the time of one projector row.
    pub fn white_dn(&self) -> f64 {
        self.white_dn.unwrap_or_else(|| default_white_dn(self.pixel_format))
    }

    /// Counts without light.
    pub fn black_dn(&self) -> f64 {
        self.black_dn.unwrap_or_else(|| default_black_dn(self.pixel_format))
    }

    /// What the file says of where on the sensor the pixels lie and of what they count, as keys and values: a calibration
    /// holds for these pixels alone.
    pub fn sensor_settings(&self) -> BTreeMap<String, String> {
        let (table, stated) = match self.driver {
            CameraDriver::Aravis => ("aravis", self.aravis.sensor_settings()),
            CameraDriver::V4l2 => {
                ("v4l2", self.v4l2.as_ref().map_or_else(Vec::new, V4l2Config::sensor_settings))
            }
            CameraDriver::Sim => return BTreeMap::new(),
        };
        let mut settings = BTreeMap::<String, String>::new();
        for (key, value) in stated {
            // A selector may stand between several values of one feature.
            let values = settings.entry(format!("camera.{table}.{key}")).or_default();
            *values = if values.is_empty() { value } else { format!("{values}, {value}") };
        }
        settings
    }
}

/// Origin of a camera's noise figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoiseOrigin {
    /// Stated in the rig file.
    Stated,
    /// Taken from the simulator.
    Simulated,
    /// Typical values.
    Assumed,
}

/// A camera's noise figures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraNoise {
    /// Electrons per count; infinite if there is no photon noise.
    pub electrons_per_dn: f64,
    /// Electrons of noise in a dark sample.
    pub read_noise_e: f64,
    /// Origin of the figures.
    pub source: NoiseOrigin,
}

/// Electrons at full scale of a typical camera [A].
const TYPICAL_FULL_SCALE_E: f64 = 8000.0;
/// Electrons of read noise of a typical camera [A].
const TYPICAL_READ_NOISE_E: f64 = 15.0;

/// `[projector]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProjectorSection {
    /// The driver that shows images.
    pub driver: ProjectorDriver,
    /// `[projector.drm]`, for the driver `drm`: 1280x720 at 60 Hz.
    #[serde(default)]
    pub drm: DrmSection,
    /// Number of rows.
    #[serde(default = "default_rows")]
    pub rows: usize,
    /// From one row to the next.
    #[serde(default = "default_row_time_us")]
    pub row_time_us: f64,
    /// From the VSYNC edge to the start of row 0.
    #[serde(default = "default_first_row_us")]
    pub first_row_us: f64,
    /// Measured start of each row's light and end of the last's, relative to `first_row_us`; default: rows of one row
    /// time.
    pub row_table: Option<Vec<f64>>,
    /// Standard deviation of the beam in rows, 0 for an ideal one; default: unknown.
    pub beam_sigma_rows: Option<f64>,
    /// How a row is lit.
    #[serde(default)]
    pub spot: SpotKind,
    /// Scan direction of a flying spot; default: unknown.
    pub scan: Option<ScanKind>,
}

/// How a row is lit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SpotKind {
    /// During the whole time of the row.
    #[default]
    Uniform,
    /// At the moment when the spot passes.
    Flying,
}

/// Scan direction of a flying spot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScanKind {
    /// Not known.
    Unknown,
    /// Every row from the first column to the last.
    OneWay,
    /// Odd rows in the reverse direction.
    Bidirectional,
}
/// For rectified rows of equal height.
fn default_row_pitch() -> f64 {
    1.0
}
fn default_rows() -> usize {
    720
}
/// 720p60 with 750 lines in total.
fn default_row_time_us() -> f64 {
    22.22
}
/// 720p60: 5 lines of VSYNC and 20 of back porch.
fn default_first_row_us() -> f64 {
    555.5
}

/// Maximum number of rows of a raster projector.
const MAX_ROWS: u64 = 8192;

/// Fraction by which the row times of camera and projector may differ. The model follows the drift of the delay;
/// beyond this limit, a sweep would no longer cover the epipolar planes of all rows.
const ROW_TIME_TOLERANCE: f64 = 0.05;

/// The same for a projector with a flying spot.
const SPOT_ROW_TIME_TOLERANCE: f64 = 0.01;

impl RigFile {
    /// Reads a rig file.
    ///
    /// # Errors
    /// All mistakes, with positions in the text.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let mut document = Document::parse(text)?;
        match document.require("kind", "kind = \"plane\"") {
            Some(RigKind::Plane) => {}
            Some(RigKind::Dots) => {
                document.refuse(&["kind"], "kind = \"dots\": must be \"plane\" for a plane rig")
            }
            None => return document.finish(None),
        }
        Self::read(document)
    }

    /// Reads a document whose kind is [`RigKind::Plane`].
    pub(super) fn read(mut document: Document<'_>) -> Result<Self, ConfigError> {
        let camera: Option<CameraSection> = document.require("camera", "a table [camera] with a driver");
        let vsync: Option<VsyncSection> = document.require("vsync", "a table [vsync] with a driver");
        let projector: Option<ProjectorSection> =
            document.require("projector", "a table [projector] with a driver");
        let sim: Option<SimConfig> = document.take_or_default("sim");
        let calibration: Option<CalibrationUse> = document.take_or_default("calibration");
        let auto_resume: Option<bool> = document.take_or_default("auto_resume");
        document.refuse_others(&[
            "kind",
            "auto_resume",
            "camera",
            "vsync",
            "projector",
            "calibration",
            "sim",
        ]);
        if let Some(camera) = &camera {
            camera.check(&mut document);
        }
        if let Some(vsync) = &vsync {
            vsync.check(&mut document);
        }
        if let Some(projector) = &projector {
            projector.check(&mut document);
        }
        let (Some(camera), Some(vsync), Some(projector)) = (camera, vsync, projector) else {
            return document.finish(None);
        };
        if let Some([first, end]) = calibration.and_then(|calibration| calibration.strip_columns)
            && first >= end
        {
            let message = format!(
                "calibration.strip_columns = [{first}, {end}]: must be [first column, column after the last] with at \
                 least one column between them"
            );
            document.refuse(&["calibration", "strip_columns"], message);
        }
        let (Some(calibration), Some(auto_resume), Some(sim)) = (calibration, auto_resume, sim) else {
            return document.finish(None);
        };
        let places = document.places().clone();
        let rig = Self { camera, vsync, projector, calibration, auto_resume, sim, places };
        rig.check(&mut document);
        document.finish(Some(rig))
    }

    /// What the file refers to, by paths that are relative to it or absolute, with the keys that give them.
    pub fn paths(&self) -> Vec<(Vec<String>, PathBuf)> {
        let of = |key: &str, path: &Path| (vec!["sim".to_owned(), key.to_owned()], path.to_owned());
        let bench = self.sim.bench.iter().map(|bench| of("bench", bench));
        scene_file(&self.sim.scene).map(|scene| of("scene", scene)).into_iter().chain(bench).collect()
    }

    /// Whether any of its devices is simulated, in this process or on a bench.
    pub fn has_simulated_device(&self) -> bool {
        self.camera.driver == CameraDriver::Sim
            || self.vsync.driver == VsyncDriver::Sim
            || self.projector.driver == ProjectorDriver::Sim
            || self.sim.bench.is_some()
    }

    /// When the projector lights its rows.
    pub fn raster(&self) -> Raster {
        Raster {
            rows: self.projector.rows,
            row_time_us: self.projector.row_time_us,
            first_row_us: self.projector.first_row_us,
            period_us: self.vsync.period_us,
        }
    }

    /// The camera's row time: as stated, or else the one that keeps pace with the projector.
    pub fn camera_row_time_us(&self) -> f64 {
        self.camera.row_time_us.unwrap_or_else(|| self.pace_us())
    }

    /// The camera's row time that keeps pace with the projector.
    fn pace_us(&self) -> f64 {
        self.camera.row_pitch * self.projector.row_time_us
    }

    /// The camera's noise: as stated; missing figures come from the simulator for a simulated camera, else typical
    /// values.
    pub fn noise(&self) -> CameraNoise {
        let (camera, sensor) = (&self.camera, &self.sim.sensor);
        let unstated = if camera.driver != CameraDriver::Sim {
            CameraNoise {
                electrons_per_dn: TYPICAL_FULL_SCALE_E / full_scale_dn(camera.pixel_format),
                read_noise_e: TYPICAL_READ_NOISE_E,
                source: NoiseOrigin::Assumed,
            }
        } else if sensor.noise {
            // The simulator defines its electrons per count on a 12-bit scale.
            let electrons_per_dn = sensor.electrons_per_dn * 4096.0 / full_scale_dn(camera.pixel_format);
            CameraNoise {
                electrons_per_dn,
                read_noise_e: sensor.read_noise_e,
                source: NoiseOrigin::Simulated,
            }
        } else {
            CameraNoise { electrons_per_dn: f64::INFINITY, read_noise_e: 0.0, source: NoiseOrigin::Simulated }
        };
        match (camera.electrons_per_dn, camera.read_noise_e) {
            (Some(electrons_per_dn), Some(read_noise_e)) => {
                CameraNoise { electrons_per_dn, read_noise_e, source: NoiseOrigin::Stated }
            }
            (electrons_per_dn, read_noise_e) => CameraNoise {
                electrons_per_dn: electrons_per_dn.unwrap_or(unstated.electrons_per_dn),
                read_noise_e: read_noise_e.unwrap_or(unstated.read_noise_e),
                ..unstated
            },
        }
    }

    /// Checks rules that involve several tables.
    fn check(&self, document: &mut Document<'_>) {
        let (camera, vsync, projector) = (&self.camera, &self.vsync, &self.projector);
        if self.auto_resume && projector.driver == ProjectorDriver::External {
            let message = "auto_resume = true: a projector of the driver \"external\" needs an operator; leave auto_resume out, or use another driver";
            document.refuse(&["auto_resume"], message);
        }
        if !document.is_sound(&[
            &["vsync", "period_us"],
            &["projector", "rows"],
            &["projector", "row_time_us"],
        ]) {
            return;
        }
        document.check_range(&["projector", "first_row_us"], projector.first_row_us, 0.0..=vsync.period_us);
        let lit_us = projector.rows as f64 * projector.row_time_us;
        if projector.first_row_us + lit_us > vsync.period_us {
            let message = format!(
                "projector.rows x row_time_us + first_row_us = {:.1} us is longer than vsync.period_us = {}: a frame's rows must be drawn before the next edge; lower rows, row_time_us or first_row_us",
                projector.first_row_us + lit_us,
                vsync.period_us
            );
            document.refuse(&["projector", "row_time_us"], message);
        }
        let is_paced =
            (self.camera_row_time_us() - self.pace_us()).abs() <= ROW_TIME_TOLERANCE * self.pace_us();
        if document.is_sound(&[&["camera", "row_pitch"], &["camera", "row_time_us"]]) && !is_paced {
            let message = format!(
                "camera.row_time_us = {} differs by more than {} % from camera.row_pitch x projector.row_time_us = {}: the rows must run at the same speed; set the camera's pixel clock or lens so that they do",
                self.camera_row_time_us(),
                100.0 * ROW_TIME_TOLERANCE,
                self.pace_us()
            );
            document.refuse(&["camera", "row_time_us"], message);
        }
        if self.sim.projector.spot != SimSpot::Uniform && camera.row_pitch != 1.0 {
            let message = "sim.projector.spot: flying spots are simulated only with camera.row_pitch = 1: set that, or use \"uniform\"";
            document.refuse(&["sim", "projector", "spot"], message);
        }
        if projector.spot == SpotKind::Flying && camera.row_pitch.fract() != 0.0 {
            let message = format!(
                "camera.row_pitch = {}: must be a whole number with projector.spot = \"flying\", because a flying spot is modelled only for camera rows that look at the middle of projector rows; use projector.spot = \"uniform\", or a whole pitch",
                camera.row_pitch
            );
            document.refuse(&["projector", "spot"], message);
        }
        let drifts =
            (self.camera_row_time_us() - self.pace_us()).abs() > SPOT_ROW_TIME_TOLERANCE * self.pace_us();
        if projector.spot == SpotKind::Flying && is_paced && drifts {
            let message = format!(
                "projector.spot = \"flying\" with camera.row_time_us = {}: must be within {} % of camera.row_pitch x projector.row_time_us = {}, because otherwise the edges of nearly all exposures cross the direct row of some camera row",
                self.camera_row_time_us(),
                100.0 * SPOT_ROW_TIME_TOLERANCE,
                self.pace_us()
            );
            document.refuse(&["projector", "spot"], message);
        }
        if let Some(row) = camera.first_projector_row.filter(|row| *row >= projector.rows) {
            let message = format!(
                "camera.first_projector_row = {row}: must be from 0 to {}",
                projector.rows.saturating_sub(1)
            );
            document.refuse(&["camera", "first_projector_row"], message);
        }
        self.check_row_table(document);
    }

    fn check_row_table(&self, document: &mut Document<'_>) {
        let Some(table) = &self.projector.row_table else { return };
        let Raster { rows, first_row_us, period_us, .. } = self.raster();
        let refused = if table.len() != rows + 1 {
            format!(
                "projector.row_table has {} entries: give {}, one for the start of each row and one for the end of the last",
                table.len(),
                rows + 1
            )
        } else if let Some(row) =
            table.windows(2).position(|pair| !(pair[0] < pair[1] && pair[1].is_finite()))
        {
            format!(
                "projector.row_table: entry {} is {}: give finite numbers, each later than the entry before: rows are lit one after the other",
                row + 1,
                table[row + 1]
            )
        } else {
            let (start_us, end_us) = (first_row_us + table[0], first_row_us + table[rows]);
            if start_us >= 0.0 && end_us <= period_us {
                return;
            }
            format!(
                "projector.row_table + first_row_us = {start_us:.1} to {end_us:.1} us after the edge: a frame's rows must be drawn from 0 to vsync.period_us = {period_us}"
            )
        };
        document.refuse(&["projector", "row_table"], refused);
    }
}

impl CameraSection {
    fn check(&self, document: &mut Document<'_>) {
        let max_dn = f64::from(self.pixel_format.max_value());
        for (key, value, allowed) in [
            ("row_pitch", self.row_pitch, 0.01..=100.0),
            ("row_time_us", self.row_time_us.unwrap_or(1.0), 0.1..=10_000.0),
            ("reopen_s", self.reopen_s, 0.0..=3600.0),
            ("white_dn", self.white_dn(), 1.0..=max_dn),
            ("electrons_per_dn", self.electrons_per_dn.unwrap_or(1.0), 1e-3..=1e6),
            ("read_noise_e", self.read_noise_e.unwrap_or(0.0), 0.0..=1e6),
            ("black_dn", self.black_dn(), 0.0..=max_dn / 2.0),
        ] {
            document.check_range(&["camera", key], value, allowed);
        }
        if let Some(column) = self.projector_columns.iter().flatten().find(|c| !(0.0..=1.0).contains(*c)) {
            let message = format!(
                "camera.projector_columns contains {column}: must be from 0 to 1, as fractions of the projector's width"
            );
            document.refuse(&["camera", "projector_columns"], message);
        }
        match self.driver {
            CameraDriver::Sim => {}
            CameraDriver::Aravis => document.refuse_all(&["camera", "aravis"], self.aravis.faults()),
            CameraDriver::V4l2 => V4l2Config::check_section(self.v4l2.as_ref(), document),
        }
    }
}

impl ProjectorSection {
    fn check(&self, document: &mut Document<'_>) {
        document.check_count(&["projector", "rows"], self.rows as u64, 1..=MAX_ROWS);
        document.check_range(&["projector", "row_time_us"], self.row_time_us, 0.1..=10_000.0);
        document.check_range(
            &["projector", "beam_sigma_rows"],
            self.beam_sigma_rows.unwrap_or(0.0),
            0.0..=100.0,
        );
        if self.spot == SpotKind::Uniform && self.scan.is_some() {
            let message = "projector.scan applies only to a flying spot: set projector.spot = \"flying\" or leave scan out";
            document.refuse(&["projector", "scan"], message);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINIMAL: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n";

    fn table(row_table: &str) -> String {
        MINIMAL.replace("[projector]\n", &format!("[projector]\nrows = 3\nrow_table = {row_table}\n"))
    }

    #[test]
    fn what_is_known_of_the_light_is_read() {
        let rig = RigFile::parse(&table("[0, 21.5, 44, 66.66]")).unwrap();
        assert_eq!(rig.projector.row_table, Some(vec![0.0, 21.5, 44.0, 66.66]));
        let projector = |keys: &str| {
            RigFile::parse(&MINIMAL.replace("[projector]\n", &format!("[projector]\n{keys}\n")))
                .unwrap()
                .projector
        };
        let drawn = |keys: &str| (projector(keys).spot, projector(keys).scan);
        assert_eq!(drawn(""), (SpotKind::Uniform, None));
        assert_eq!(drawn("spot = \"flying\""), (SpotKind::Flying, None));
        let both_ways = drawn("spot = \"flying\"\nscan = \"bidirectional\"");
        assert_eq!(both_ways, (SpotKind::Flying, Some(ScanKind::Bidirectional)));
        assert_eq!(projector("beam_sigma_rows = 0").beam_sigma_rows, Some(0.0));
        let halved = RigFile::parse(&MINIMAL.replace("[camera]\n", "[camera]\nrow_pitch = 0.5\n")).unwrap();
        assert_eq!(halved.camera_row_time_us(), 11.11);
    }

    #[test]
    fn noise_is_what_is_stated_else_what_is_simulated() {
        let noise = |camera: &str, sensor: &str| {
            let text = MINIMAL.replace("[camera]\n", &format!("[camera]\n{camera}\n"));
            RigFile::parse(&format!("{text}[sim.sensor]\n{sensor}\n")).unwrap().noise()
        };
        let is =
            |electrons_per_dn, read_noise_e, source| CameraNoise { electrons_per_dn, read_noise_e, source };
        assert_eq!(noise("", "read_noise_e = 7"), is(1.66, 7.0, NoiseOrigin::Simulated));
        assert_eq!(noise("pixel_format = \"Mono10\"", ""), is(6.64, 9.0, NoiseOrigin::Simulated));
        assert_eq!(noise("read_noise_e = 3", ""), is(1.66, 3.0, NoiseOrigin::Simulated));
        assert_eq!(noise("", "noise = false"), is(f64::INFINITY, 0.0, NoiseOrigin::Simulated));
        assert_eq!(noise("electrons_per_dn = 2\nread_noise_e = 3", ""), is(2.0, 3.0, NoiseOrigin::Stated));
    }

    #[test]
    fn an_operator_may_work_the_projector() {
        let text = MINIMAL.replace("[projector]\ndriver = \"sim\"", "[projector]\ndriver = \"external\"");
        assert_eq!(RigFile::parse(&text).unwrap().projector.driver, ProjectorDriver::External);
    }

    #[test]
    fn every_key_but_kind_and_drivers_has_a_default() {
        let rig = RigFile::parse(MINIMAL).unwrap();
        assert_eq!(rig.raster().rows, 720);
        assert_eq!(rig.camera_row_time_us(), 22.22);
    }

    #[test]
    fn the_documented_rig_file_is_the_defaults() {
        let page = include_str!("../../../../docs/reference/rig.md");
        let documented = page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        assert_eq!(
            format!("{:#?}", RigFile::parse(documented).unwrap()),
            format!("{:#?}", RigFile::parse(MINIMAL).unwrap())
        );
    }
}
