//! Identifies a dot rig's mirror: chirps, the dot's track on a plane, and the resonances in it.

mod analysis;
mod dot;
mod path;
mod record;
mod report;
mod task;

use std::path::Path;

use raysweep_config::{DotRigFile, ResponsePlan};
use raysweep_session::ledger::State;
use raysweep_session::{Result, Session};
use raysweep_transport::dots::identify::Resonance;

pub use self::analysis::ResponseError;
use self::analysis::{FoundAxis, analyse};
pub use self::dot::DotFinder;
pub use self::record::Record;
pub use self::task::{AXES, ResponseTask};
use crate::mirror_response::{self, KeptResponse};
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// Results of a session's records.
pub struct MirrorFindings {
    axes: [FoundAxis; 2],
}

impl MirrorFindings {
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

    /// The resonance that was identified of each axis, in a sentence.
    pub fn resonances(&self) -> Vec<String> {
        let of = |(axis, name): (&FoundAxis, &str)| {
            let Resonance { f0_hz, q } = axis.found.as_ref().ok()?.resonance;
            Some(format!("axis {name}: resonance f0 {f0_hz:.2} Hz, quality factor Q {q:.2}"))
        };
        self.axes.iter().zip(AXES).filter_map(of).collect()
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
    let findings = MirrorFindings::of(session, state, &task)?;
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
