//! What tests insert into runs, to watch them or to make them fail. The daemon inserts nothing.

use std::sync::Arc;

use raysweep_pipeline::dots::ColumnStage;
use raysweep_pipeline::{Stage, Stages};

use crate::rig::{Devices, DotDevices};

/// Replaces the stage of a dot rig's plan.
type Around = Arc<dyn Fn(Arc<dyn ColumnStage>) -> Arc<dyn ColumnStage> + Send + Sync>;

/// Replaces the devices of a plane rig.
type OtherDevices = Arc<dyn Fn(Devices) -> Devices + Send + Sync>;

/// Replaces the devices of a dot rig.
type OtherDotDevices = Arc<dyn Fn(DotDevices) -> DotDevices + Send + Sync>;

/// What is inserted into runs.
#[derive(Clone, Default)]
pub struct Probes {
    /// On the plane rig: stages after those of the plan.
    pub stages: Vec<Arc<dyn Stage>>,
    /// Called while a run is prepared, before its session is made.
    pub preparing: Option<Arc<dyn Fn() + Send + Sync>>,
    /// On the plane rig: what takes the place of the devices, given those.
    pub devices: Option<OtherDevices>,
    /// On the dot rig: the same.
    pub dot_devices: Option<OtherDotDevices>,
    /// On the dot rig: what takes the place of the plan's stage, given that one.
    pub column_stage: Option<Around>,
}

impl Probes {
    /// The stages of a plan on the plane rig, and those inserted.
    pub(crate) fn after(&self, stages: &Stages) -> Stages {
        stages.iter().chain(&self.stages).cloned().collect()
    }

    /// The devices of a plane rig, or those in their place.
    pub(crate) fn instead_of(&self, devices: Devices) -> Devices {
        match &self.devices {
            Some(instead) => instead(devices),
            None => devices,
        }
    }

    /// The devices of a dot rig, or those in their place.
    pub(crate) fn instead_of_dots(&self, devices: DotDevices) -> DotDevices {
        match &self.dot_devices {
            Some(instead) => instead(devices),
            None => devices,
        }
    }

    /// The stage of a dot rig's plan, or the one in its place.
    pub(crate) fn around(&self, stage: Arc<dyn ColumnStage>) -> Arc<dyn ColumnStage> {
        match &self.column_stage {
            Some(around) => around(stage),
            None => stage,
        }
    }
}
