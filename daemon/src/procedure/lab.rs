//! The environment of a plan: a rig, its camera, and the free space for sessions.

use std::path::Path;
use std::sync::Arc;

use raysweep_config::ConfigError;
use raysweep_config::plan::{KnownRows, OwnRowEdges};
use raysweep_config::rig::plane::SpotKind;
use raysweep_core::{CameraCapabilities, Size};
use raysweep_processing::calibration::{KeptCalibration, Scanning};
use raysweep_processing::memory::available_bytes;
use raysweep_processing::plane::KnownRig;
use raysweep_proto::{CheckReport, ErrorCode, RpcError};
use raysweep_session::ledger::SessionEntry;
use raysweep_session::{Session, durable};

use crate::plane::advice::edge_us;
use crate::probes::Probes;
use crate::rig::{Rig, SharedRig};

/// The environment in which a plan is to be run.
pub struct Lab<'a> {
    /// The rig.
    pub rig: &'a SharedRig,
    /// Its camera's capabilities when the daemon started.
    pub camera: &'a CameraCapabilities,
    /// Folder of the sessions.
    pub data: &'a Path,
    /// What tests insert.
    pub probes: &'a Probes,
    /// Memory limit; results that need more are made in strips of camera rows. `None`: the memory that is free.
    pub memory_limit_bytes: Option<u64>,
}

impl Lab<'_> {
    /// Memory that results may use.
    pub fn memory_free_bytes(&self) -> u64 {
        available_bytes(self.memory_limit_bytes)
    }

    /// Free disk space where sessions are, or will be.
    fn disk_free_bytes(&self) -> u64 {
        let existing = self.data.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("/"));
        durable::available_bytes(existing).unwrap_or(u64::MAX)
    }

    /// What a session and its results need, and what there is.
    pub fn room(&self, memory_bytes: u64, disk_bytes: u64) -> Room {
        let (memory_free_bytes, disk_free_bytes) = (self.memory_free_bytes(), self.disk_free_bytes());
        Room { memory_bytes, memory_free_bytes, disk_bytes, disk_free_bytes }
    }

    /// Capabilities of the rig's camera at this frame rate.
    pub fn camera_at(&self, rate_hz: f64) -> CameraCapabilities {
        let exposure_us = *self.camera.exposure_us.start()..=1e6 / rate_hz;
        CameraCapabilities { exposure_us, ..self.camera.clone() }
    }

    /// Rows and columns of the frames.
    pub fn size(&self) -> (usize, usize) {
        (self.camera.height, self.camera.width)
    }
}

/// Edges that are known less well tell nothing of the rows beside a pixel's own.
const DIVIDING_EDGE_US: f64 = 1.0;

/// A plane rig on which a plan is to run.
#[derive(Clone)]
pub struct RigOfRun<'a> {
    /// The rig.
    pub rig: &'a Arc<Rig>,
    /// Projector row that camera row 0 sees, according to the rig file.
    pub first_row: usize,
    /// Rows and columns of the frames.
    pub size: (usize, usize),
    /// The calibration that the run uses.
    pub calibration: Option<Arc<KeptCalibration>>,
}

impl<'a> RigOfRun<'a> {
    /// The rig of a new session, without a calibration.
    pub fn of_new(lab: &Lab<'_>, rig: &'a Arc<Rig>) -> Self {
        Self { rig, first_row: rig.first_row(lab.camera), size: lab.size(), calibration: None }
    }

    /// The rig of a session that was begun earlier, without a calibration.
    pub fn of_begun(rig: &'a Arc<Rig>, begun: &SessionEntry) -> Self {
        let size = (begun.shape.rows, begun.shape.columns);
        Self { rig, first_row: begun.first_row, size, calibration: None }
    }

    /// The same rig with the calibration in a folder, if it has one.
    ///
    /// # Errors
    /// When the calibration cannot be read, or is of other devices.
    pub fn calibrated(self, lab: &Lab<'_>, folder: &Path) -> Result<Self, ConfigError> {
        let calibration = KeptCalibration::of(&self.rig.file, folder, Some(lab.camera))?;
        Ok(Self { calibration: calibration.map(Arc::new), ..self })
    }

    /// What is known of it for the model.
    ///
    /// # Errors
    /// When the calibration is unusable.
    pub fn known(&self) -> Result<KnownRig<'a>, ConfigError> {
        let calibration = self.calibration.as_ref().map(|kept| kept.known(&self.rig.file)).transpose()?;
        Ok(KnownRig { file: &self.rig.file, first_row: self.first_row, size: self.size, calibration })
    }

    /// What its calibration tells of the projector's rows; `None` without one.
    pub fn rows(&self) -> Option<KnownRows> {
        let (header, file) = (&self.calibration.as_ref()?.header, &self.rig.file);
        let timing = &header.timing;
        let edge_us = edge_us(timing.jitter_us[0], file.calibration.strip_columns.is_some());
        let is_spot = match &header.drawing {
            Some(drawing) => drawing.rows != Scanning::Uniform,
            // Calibrations of earlier versions leave it to the rig file.
            None => file.projector.spot == SpotKind::Flying,
        };
        let own_row_edges = match edge_us <= DIVIDING_EDGE_US && !is_spot {
            true => OwnRowEdges::Divide,
            false => OwnRowEdges::Mislead,
        };
        Some(KnownRows { row_time_us: timing.row_time_us[0], own_row_edges })
    }

    /// A prediction, with what may not be true any more of the calibration.
    pub fn warned(&self, mut report: CheckReport) -> CheckReport {
        if let Some(kept) = &self.calibration {
            report.warnings.extend(kept.warnings(&self.rig.text, jiff::Timestamp::now()));
        }
        report
    }
}

/// What a run says at its end if it had no calibration.
pub fn notice_if_uncalibrated(is_calibrated: bool) -> Vec<String> {
    let said = "not calibrated: times and levels are those of the rig file, and errors may be many times larger than foreseen; `raysweep calibrate` measures these times and levels";
    if is_calibrated { Vec::new() } else { vec![said.to_owned()] }
}

/// Stores the calibration that a run uses in its session.
///
/// # Errors
/// When the session cannot be written.
pub fn keep_calibration(calibration: Option<&KeptCalibration>, session: &Session) -> Result<(), RpcError> {
    let kept = calibration.map_or(Ok(()), |kept| kept.write(session.dir()));
    kept.map_err(|error| RpcError::new(ErrorCode::Storage, error.to_string()))
}

/// Disk space and memory that a session and its results need, and what is available.
pub struct Room {
    memory_bytes: u64,
    memory_free_bytes: u64,
    disk_bytes: u64,
    disk_free_bytes: u64,
}

impl Room {
    /// Warnings where there is too little.
    pub fn warnings(&self) -> Vec<String> {
        let needs = [
            ("memory", self.memory_bytes, self.memory_free_bytes),
            ("disk", self.disk_bytes, self.disk_free_bytes),
        ];
        let short = needs.into_iter().filter(|(_, needed, free)| needed > free);
        let warning = |(what, needed, free)| {
            let (needed, free) = (Size(needed), Size(free));
            format!("{needed} of {what} are needed and {free} are free: the run would be refused")
        };
        short.map(warning).collect()
    }

    /// A report with these figures and nothing else yet.
    pub fn report(&self) -> CheckReport {
        let Self { memory_bytes, memory_free_bytes, disk_bytes, disk_free_bytes } = *self;
        CheckReport {
            points: 0,
            extra_points: 0,
            frames: 0,
            light_s: 0.0,
            memory_bytes,
            memory_free_bytes,
            disk_bytes,
            disk_free_bytes,
            settings: None,
            settings_refused: None,
            white_dn: None,
            reach_rows: None,
            condition: None,
            // Computed only on request: a run must not wait for it.
            advice: None,
            film: None,
            batches: None,
            response: None,
            warnings: Vec::new(),
        }
    }
}
