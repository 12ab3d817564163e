//! How a dot rig's mirror answers: chirps, the dot's way over a plane, and the resonances that it shows.

mod analysis;
pub(crate) mod check;
mod dot;
mod kept;
mod record;
mod report;

use std::path::Path;

use raysweep_core::{CameraSettings, MirrorPath, PixelFormat, Shutter};
use raysweep_session::ledger::State;
use raysweep_session::stack::StackShape;
use raysweep_session::{Result, Session};
use raysweep_transport::dots::{FrameShape, Region};

pub(crate) use self::analysis::ResponseError;
use self::analysis::{Axis, analyse};
pub(crate) use self::dot::DotFinder;
use self::kept::KeptResponse;
pub(crate) use self::kept::Predistortion;
pub(crate) use self::record::Record;
use crate::config::{ConfigError, DotRigFile, Plan, ResponsePlan};
use crate::processing::SATURATION;

/// A mirror's axes by the names that files and messages use.
pub(crate) const AXES: [&str; 2] = ["x", "y"];

/// A plan of chirps on a dot rig.
pub struct ResponseTask {
    /// The plan.
    pub plan: Plan,
    /// Size of the frames.
    pub shape: FrameShape,
    /// How they are packed.
    pub format: PixelFormat,
    /// Where the dot is looked for.
    pub region: Region,
    /// What the mirror plays, the chirp of x first.
    pub paths: [MirrorPath; 2],
}

impl ResponseTask {
    /// A plan on a rig with a camera of this size (rows, columns); `text` is the plan's.
    ///
    /// # Errors
    /// With the place in the plan's text, for what this rig cannot do.
    pub fn new(
        plan: Plan,
        text: &str,
        rig: &DotRigFile,
        format: PixelFormat,
        size: (usize, usize),
    ) -> std::result::Result<Self, ConfigError> {
        let shape = FrameShape::new(size.0, size.1, 1).map_err(|error| {
            let message = format!("the camera's frames: {error}; read out another region of its sensor");
            ConfigError::at(text, &["kind"], message)
        })?;
        let region = match plan.response.region {
            Some([top, bottom, left, right]) => Region { rows: top..bottom, columns: left..right },
            None => Region::whole(shape),
        };
        region.check(shape).map_err(|error| {
            ConfigError::at(text, &["response", "region"], format!("response.region: {error}"))
        })?;
        let paths = plan.response.paths(&rig.limits(), text)?;
        Ok(Self { plan, shape, format, region, paths })
    }

    /// The plan's own table.
    pub fn response(&self) -> &ResponsePlan {
        &self.plan.response
    }

    /// How the camera is set.
    pub fn camera_settings(&self) -> CameraSettings {
        let exposure_us = self.response().exposure_us;
        CameraSettings { shutter: Shutter::Global, exposure_us, trigger_delay_us: 0.0 }
    }

    /// What the session's folder is made for.
    pub fn stack_shape(&self) -> StackShape {
        let (rows, columns) = (self.shape.height(), self.shape.width());
        StackShape { points: AXES.len(), exposures: 0, rows, columns, settings: 0, dots: 0 }
    }

    /// Counts from which on a pixel is overexposed.
    pub fn saturation_dn(&self) -> u16 {
        (SATURATION * f64::from(self.format.max_value())) as u16
    }

    /// Frames of an axis' record.
    pub fn frames(&self) -> usize {
        self.response().frames(&self.paths[0])
    }

    /// What each frame's angle was commanded to be, in degrees.
    pub fn commanded_deg(&self, axis: usize) -> Vec<f64> {
        self.response().commanded_deg(&self.paths[axis], axis)
    }
}

/// What the records of a session show.
pub(crate) struct Findings {
    axes: [Axis; 2],
}

impl Findings {
    /// From the records that the ledger knows.
    ///
    /// # Errors
    /// When a record cannot be read, or is not there.
    pub fn of(session: &Session, state: &State, task: &ResponseTask) -> Result<Self> {
        let axis = |axis: usize| analyse(Record::read(session, axis)?, axis, state, task.response());
        Ok(Self { axes: [axis(0)?, axis(1)?] })
    }

    /// Why the mirror's response is not known, if it is not.
    pub fn refusal(&self) -> Option<&ResponseError> {
        self.axes.iter().find_map(|axis| axis.found.as_ref().err())
    }

    /// What an operator should know of what was found.
    pub fn warnings(&self) -> Vec<String> {
        self.axes.iter().zip(AXES).filter_map(|(axis, name)| axis.warning(name)).collect()
    }

    /// Keeps the response in the session's folder; in `data` too, if it is given, where later runs take it from.
    /// Nothing is written of an axis that was refused, nor of the other.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn keep(&self, session: &Session, state: &State, data: Option<&Path>) -> Result<()> {
        let [Ok(x), Ok(y)] = self.axes.each_ref().map(|axis| axis.found.as_ref()) else { return Ok(()) };
        let kept = KeptResponse::new(session, state, [x, y]);
        tracing::info!(x = ?x.response, y = ?y.response, "mirror identified");
        kept.write(&session.mirror_response_path())?;
        data.map_or(Ok(()), |data| kept.write(&kept::path_in(data)))
    }

    /// Writes spectra, report and manifest.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write(
        &self,
        session: &Session,
        state: &State,
        task: &ResponseTask,
        rig: &DotRigFile,
    ) -> Result<()> {
        for (axis, name) in self.axes.iter().zip(AXES) {
            axis.write_spectrum(session, name)?;
        }
        let page = report::make(session, state, task, &self.axes).to_html()?;
        raysweep_session::durable::write(&session.report_path(), page.as_bytes())?;
        report::write_manifest(session, state, task, rig, &self.axes)
    }
}
