//! The environment of a plan: a rig, its camera, and the free space for sessions.

use std::path::Path;
use std::sync::Arc;

use raysweep_core::CameraCapabilities;
use raysweep_processing::memory::available_bytes;
use raysweep_processing::plane::KnownRig;
use raysweep_proto::CheckReport;
use raysweep_session::durable;

use crate::probes::Probes;
use crate::rig::{DotRig, Rig};

/// The environment in which a plan is to be run.
pub struct Lab<'a> {
    /// The rig.
    pub rig: &'a LabRig,
    /// Its camera's capabilities when the daemon started.
    pub camera: &'a CameraCapabilities,
    /// Folder of the sessions.
    pub data: &'a Path,
    /// What tests insert.
    pub probes: &'a Probes,
    /// Memory limit; results that need more are made in strips of camera rows. `None`: the memory that is free.
    pub memory_limit_bytes: Option<u64>,
}

/// The daemon's rig.
#[derive(Clone)]
pub enum LabRig {
    /// Raster projector and rolling-shutter camera.
    Plane(Arc<Rig>),
    /// Mirror and fast camera.
    Dots(Arc<DotRig>),
}

impl LabRig {
    /// The rig file's text.
    pub fn text(&self) -> &str {
        match self {
            Self::Plane(rig) => &rig.text,
            Self::Dots(rig) => &rig.text,
        }
    }
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

    /// What is known of a plane rig whose camera has `size` (rows, columns), when a plan is to run on it.
    pub fn known<'a>(&self, rig: &'a Rig, first_row: usize, size: (usize, usize)) -> KnownRig<'a> {
        // Nothing calibrates rigs yet.
        KnownRig { file: &rig.file, first_row, size, calibration: None }
    }

    /// Rows and columns of the frames.
    pub fn size(&self) -> (usize, usize) {
        (self.camera.height, self.camera.width)
    }
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
            let (needed, free) = (needed / 1_000_000, free / 1_000_000);
            format!("{needed} MB of {what} are needed and {free} MB are free: the run would be refused")
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
