//! A viewfinder: what its pictures say of exposure, focus and alignment. Nothing of it is stored.

mod align;
mod dot;
mod focus;
mod levels;

use std::sync::Arc;

use raysweep_config::Plan;
use raysweep_config::plan::{FinderTrigger, ViewfinderPlan};
use raysweep_core::{CameraCapabilities, CameraSettings, FinderPicture, Pattern};
use raysweep_pipeline::{Point, PointRole, Schedule};

use crate::plane::{KnownRig, PlaneTask};
use crate::stored::{Asked, ProcessError, Processed, Stored};

pub use crate::saturation::saturation_dn;

pub use align::{AlignPictures, Alignment, SeenRows};
pub use dot::LitDot;
pub use focus::{Focus, FocusMeter, Tendency};
pub use levels::{CountScale, Levels, cut, region_of};

/// Side of the squares of the picture for focus.
const GRID_CELL_PX: u32 = 16;
/// Distance of the rows of the picture for focus along them.
const ROW_PERIOD: usize = 16;
/// Width of the bars of the cross.
const CROSS_PX: u32 = 4;
/// The default exposure, as a share of the time from frame to frame: so little is left that a pixel sees all its light
/// wherever its row lies, and no picture's light twice.
pub const EXPOSED_SHARE: f64 = 0.9;

/// The pattern that shows a picture; `None`: no light, or several patterns.
pub fn pattern_of(picture: FinderPicture) -> Option<Pattern> {
    match picture {
        FinderPicture::White => Some(Pattern::White),
        FinderPicture::Grid => Some(Pattern::Checkerboard { cell_px: GRID_CELL_PX, shift_px: (0, 0) }),
        FinderPicture::Rows => Some(Pattern::SparseRows { phase: ROW_PERIOD / 2, period: ROW_PERIOD }),
        FinderPicture::Cross => Some(Pattern::Cross { width_px: CROSS_PX }),
        FinderPicture::Black | FinderPicture::Align => None,
    }
}

/// A viewfinder on a plane rig.
#[derive(Clone)]
pub struct FinderTask {
    /// The plan's own table.
    pub plan: ViewfinderPlan,
    /// One point, with the exposure of the pictures.
    pub task: Arc<PlaneTask>,
}

impl FinderTask {
    /// A viewfinder on a rig; see [`PlaneTask::new`].
    pub fn new(plan: &Plan, own: ViewfinderPlan, rig: &KnownRig<'_>) -> Self {
        // Without the trigger, a pixel sees its flash once wherever it falls only in an exposure of a whole period.
        let share = if own.trigger == FinderTrigger::None { 1.0 } else { EXPOSED_SHARE };
        let exposure_us = own.exposure_us.unwrap_or(share * rig.file.raster().period_us);
        let point = Point { role: PointRole::Sweep(0), delay_us: 0.0, exposure_us, frames: 1 };
        // No frame is matched with an edge.
        let task = PlaneTask::new(plan, Schedule { points: vec![point] }, f64::INFINITY, rig);
        Self { plan: own, task: Arc::new(task) }
    }

    /// The exposure that the plan asks for.
    pub fn exposure_us(&self) -> f64 {
        self.task.schedule.points[0].exposure_us
    }

    /// Camera settings for an exposure centred on the light of each camera row's own projector row, but for this delay.
    /// Without the trigger, the exposure begins wherever it does.
    pub fn settings(&self, exposure_us: f64, delay_us: f64, camera: &CameraCapabilities) -> CameraSettings {
        let point = Point { exposure_us, delay_us, ..self.task.schedule.points[0] };
        let settings = self.task.geometry.shot(&point, camera.trigger_latency_us).settings;
        match self.plan.trigger {
            FinderTrigger::Vsync => settings,
            FinderTrigger::None => {
                CameraSettings { trigger_delay_us: *camera.trigger_delay_us.start(), ..settings }
            }
        }
    }

    /// The frame rate of a camera that runs freely: no more frames than are shown. `None`: it is triggered.
    pub fn free_hz(&self) -> Option<f64> {
        (self.plan.trigger == FinderTrigger::None).then_some(self.plan.pictures_per_s)
    }
}

/// Refuses: there is nothing to make.
///
/// # Errors
/// Always.
pub fn process(_: &Stored<'_>, _: ViewfinderPlan, _: &Asked) -> Result<Processed, ProcessError> {
    let message = "a viewfinder stores no images, so there is nothing to make from its session";
    Err(ProcessError::Product(message.into()))
}
