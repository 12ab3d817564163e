//! Identifies a dot rig's mirror: chirps, the dot's track on a plane, and the resonances in it.

mod analysis;
mod dot;
mod path;
mod record;
mod report;

use std::path::Path;

use raysweep_config::{ConfigError, DotRigFile, Places, Plan, ResponsePlan};
use raysweep_core::{CameraSettings, MirrorPath, PixelFormat, Shutter};
use raysweep_session::ledger::State;
use raysweep_session::stack::Contents;
use raysweep_session::{Result, Session};
use raysweep_transport::dots::{FrameShape, Region};

pub use self::analysis::ResponseError;
use self::analysis::{Axis, analyse};
pub use self::dot::DotFinder;
pub use self::record::Record;
use crate::mirror_response::{self, KeptResponse};
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// Names of a mirror's axes in files and messages.
pub const AXES: [&str; 2] = ["x", "y"];

/// A plan of chirps on a dot rig.
pub struct ResponseTask {
    /// The plan's name.
    pub name: String,
    /// The plan's own table.
    pub response: ResponsePlan,
    /// Size of the frames.
    pub shape: FrameShape,
    /// Pixel format of the frames.
    pub format: PixelFormat,
    /// Region to search for the dot.
    pub region: Region,
    /// Mirror paths; the chirp of x comes first.
    pub paths: [MirrorPath; 2],
    places: Places,
}

impl ResponseTask {
    /// A plan on a rig with a camera of this size (rows, columns).
    ///
    /// # Errors
    /// With the position in the plan's text, for what this rig cannot do.
    pub fn new(
        plan: &Plan,
        response: ResponsePlan,
        rig: &DotRigFile,
        format: PixelFormat,
        size: (usize, usize),
    ) -> std::result::Result<Self, ConfigError> {
        let shape = FrameShape::new(size.0, size.1, 1).map_err(|error| {
            let message = format!("the camera's frames: {error}; read out another region of its sensor");
            plan.places.error(&["kind"], message)
        })?;
        let region = match response.region {
            Some([top, bottom, left, right]) => Region { rows: top..bottom, columns: left..right },
            None => Region::whole(shape),
        };
        region.check(shape).map_err(|error| {
            plan.places.error(&["response", "region"], format!("response.region: {error}"))
        })?;
        let paths = path::paths(&response, &rig.limits())
            .map_err(|(key, message)| plan.places.error(&["response", key], message))?;
        let (name, places) = (plan.name.clone(), plan.places.clone());
        Ok(Self { name, response, shape, format, region, paths, places })
    }

    /// What its session stores.
    pub fn contents(&self) -> Contents {
        Contents::Axes { axes: AXES.len() }
    }

    /// An error about a value of the plan.
    pub fn refuse(&self, path: &[&str], message: impl Into<String>) -> ConfigError {
        self.places.error(path, message)
    }

    /// Camera settings for the records.
    pub fn camera_settings(&self) -> CameraSettings {
        let exposure_us = self.response.exposure_us;
        CameraSettings { shutter: Shutter::Global, exposure_us, trigger_delay_us: 0.0 }
    }

    /// Counts from which on a pixel is overexposed.
    pub fn saturation_dn(&self) -> u16 {
        crate::saturation_dn(self.format) as u16
    }

    /// Number of frames in the record of one axis.
    pub fn frames(&self) -> usize {
        path::frames(&self.response, &self.paths[0])
    }

    /// The commanded angle of each frame, in degrees.
    pub fn commanded_deg(&self, axis: usize) -> Vec<f64> {
        path::commanded_deg(&self.response, &self.paths[axis], axis)
    }
}

/// Results of a session's records.
pub struct Findings {
    axes: [Axis; 2],
}

impl Findings {
    /// Analyses the records that the ledger lists.
    ///
    /// # Errors
    /// When a record cannot be read or is missing.
    pub fn of(session: &Session, state: &State, task: &ResponseTask) -> Result<Self> {
        let axis = |axis: usize| analyse(Record::read(session, axis)?, axis, state, &task.response);
        Ok(Self { axes: [axis(0)?, axis(1)?] })
    }

    /// Why the mirror's response could not be identified, if so.
    pub fn refusal(&self) -> Option<&ResponseError> {
        self.axes.iter().find_map(|axis| axis.found.as_ref().err())
    }

    /// Warnings for the operator about the results.
    pub fn warnings(&self) -> Vec<String> {
        self.axes.iter().zip(AXES).filter_map(|(axis, name)| axis.warning(name)).collect()
    }

    /// Stores the response in the session's folder and, if given, in `data`, where later runs find it. If one axis
    /// was refused, nothing is written for either.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn keep(&self, session: &Session, state: &State, data: Option<&Path>) -> Result<()> {
        let [Ok(x), Ok(y)] = self.axes.each_ref().map(|axis| axis.found.as_ref()) else { return Ok(()) };
        let kept = KeptResponse::new(session, state, [x, y]);
        tracing::info!(x = ?x.resonance, y = ?y.resonance, "mirror identified");
        kept.write(&session.mirror_response_path())?;
        data.map_or(Ok(()), |data| kept.write(&mirror_response::path_in(data)))
    }

    /// Writes spectra, report and manifest.
    ///
    /// # Errors
    /// When the session cannot be written.
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

/// Remakes the report of stored records. The file that later runs read is left alone: it belongs to the newest run.
///
/// # Errors
/// When an axis is missing, products are asked for, or the session cannot be written.
pub fn process(
    stored: &Stored<'_>,
    response: ResponsePlan,
    asked: &Asked,
) -> std::result::Result<Processed, ProcessError> {
    let Stored { session, state, plan, .. } = stored;
    if !asked.products.is_empty() {
        let message = "a session of kind \"response\" has no products: leave --product out";
        return Err(ProcessError::Product(message.into()));
    }
    let rig = stored.dot_rig()?;
    let (shape, axes) = (state.session.shape, state.stored_points());
    if axes < shape.points() {
        let message = format!(
            "{} has the records of only {axes} of {} axes, because its run ended early: run the plan again",
            session.dir().display(),
            shape.points()
        );
        return Err(ProcessError::Config(message));
    }
    let size = (shape.rows, shape.columns);
    let task = ResponseTask::new(plan, response, &rig, rig.camera.pixel_format, size)
        .map_err(|error| ProcessError::Config(error.to_string()))?;
    stored.check_contents(task.contents())?;
    let findings = Findings::of(session, state, &task)?;
    findings.keep(session, state, None)?;
    findings.write(session, state, &task, &rig)?;
    let refusal = findings.refusal().map(ToString::to_string);
    Ok(Processed {
        report: session.report_path(),
        stored: axes,
        points: shape.points(),
        problems: refusal.into_iter().chain(findings.warnings()).collect(),
    })
}
