//! Calibrates the plane rig: shows cap and board to the camera, picture after picture, and chooses the last settings
//! by what the images before them have shown.

mod check;

use std::sync::Arc;

use raysweep_config::plan::CalibrationPlan;
use raysweep_config::{ConfigError, Plan};
use raysweep_core::SettingsId;
use raysweep_pipeline::Point;
use raysweep_processing::calibration::{
    BoardFindings, BoardImages, BoardPixels, BoardPurpose, BoardView, CalibrationError, CalibrationTask,
    ValidFor, WhichBoard,
};
use raysweep_processing::plane::Processing;
use raysweep_session::Session;
use raysweep_session::ledger::{EndEntry, EndState, Entry};
use raysweep_session::stack::{Contents, StackShape};

use crate::plane::{Opened, Passes, PointSink, Taken, missing};
use crate::procedure::lab::{Lab, RigOfRun};
use crate::rig::Rig;
use crate::run::error::RunError;
use crate::run::life::{Ended, Foreseen, Measurement, Run, end_state};
use crate::run::progress::ProgressMeter;

/// Capacity of the queue of images between the assembler and the disk.
const UNITS_UNDER_WAY: usize = 8;

/// A calibration on a rig.
struct CalibrationRun {
    rig: Arc<Rig>,
    calibration: CalibrationTask,
    /// Maker, model and serial number of the camera.
    camera: String,
}

/// Predicts a calibration, or the rest of one that was begun, perhaps by an earlier version, with these contents.
///
/// # Errors
/// For a plan that cannot be run on this rig.
pub fn foresee(
    lab: &Lab<'_>,
    rig: RigOfRun<'_>,
    plan: &Plan,
    own: CalibrationPlan,
    begun: Option<Contents>,
) -> Result<Foreseen, ConfigError> {
    let known = rig.known()?;
    let calibration = match begun {
        Some(contents) => CalibrationTask::stored(plan, own, &known, contents),
        None => CalibrationTask::new(plan, own, &known),
    };
    Ok(Foreseen {
        report: check::check(&calibration, lab)?,
        kind: plan.procedure.kind(),
        name: plan.name.clone(),
        shape: StackShape { contents: calibration.contents(), rows: rig.size.0, columns: rig.size.1 },
        first_row: rig.first_row,
        instead: "take fewer frames",
        procedure: Box::new(CalibrationRun {
            rig: rig.rig.clone(),
            calibration,
            camera: lab.camera.model.clone(),
        }),
    })
}

/// What is acquired: images until the settings of the next depend on them.
struct BoardAcquisition<'a, 'p> {
    calibration: &'a CalibrationTask,
    session: &'a Session,
    missing: Vec<SettingsId>,
    passes: &'a mut Passes<'p>,
}

impl BoardAcquisition<'_, '_> {
    /// Acquires all images; returns what those of each pixel say, or `None` if the run was ended.
    fn run(mut self) -> Result<Option<BoardPixels>, RunError> {
        let points: Vec<(u32, Point)> =
            (0..).zip(self.calibration.task.schedule.points.iter().copied()).collect();
        let purpose = |&(ordinal, _): &(u32, Point)| self.calibration.purpose(ordinal);
        let (second_board, others): (Vec<_>, Vec<_>) = points
            .into_iter()
            .filter(|point| !is_adapted(purpose(point)))
            .partition(|point| matches!(purpose(point), BoardPurpose::Response(WhichBoard::Second, _)));
        self.acquire(&others)?;
        if !self.passes.go_on() {
            return Ok(None);
        }
        let pixels = self.with_images(BoardPixels::new)?;
        let sweep_times = self.calibration.sweep_times(&pixels.columns).map_err(CalibrationError::from)?;
        self.acquire(&sweep_times)?;
        if !self.passes.go_on() {
            return Ok(None);
        }
        let coarse = self.with_images(|images| pixels.coarse(images))?;
        let first =
            self.calibration.first_arrivals(&pixels.columns, &coarse).map_err(CalibrationError::from)?;
        self.acquire(&first)?;
        if !self.passes.go_on() {
            return Ok(None);
        }
        let rolling = self.with_images(|images| pixels.rolling(images, &coarse))?;
        let arrivals =
            self.calibration.arrivals(&pixels.columns, &rolling).map_err(CalibrationError::from)?;
        self.acquire(&arrivals)?;
        if self.passes.go_on() {
            self.acquire(&second_board)?;
        }
        Ok(self.passes.go_on().then_some(pixels))
    }

    /// Acquires those of the points that are missing, view by view.
    fn acquire(&mut self, points: &[(u32, Point)]) -> Result<(), RunError> {
        let wanted: Vec<(SettingsId, Point)> = points
            .iter()
            .filter_map(|&(ordinal, point)| {
                self.missing.iter().find(|id| id.point == ordinal).map(|&id| (id, point))
            })
            .collect();
        let view = |(id, _): &(SettingsId, Point)| self.calibration.view(self.calibration.purpose(id.point));
        for group in wanted.chunk_by(|a, b| view(a) == view(b)) {
            let BoardView { subject, picture } = view(&group[0]);
            self.passes.place(subject)?;
            if !self.passes.go_on() {
                return Ok(());
            }
            let attempts = group.iter().map(|&(id, point)| {
                let mut attempt = self.passes.attempt_at(id, point);
                attempt.shot.settings.shutter = self.calibration.shutter(self.calibration.purpose(id.point));
                attempt
            });
            let attempts = attempts.collect();
            self.passes.acquire_under(picture.as_ref(), attempts)?;
        }
        Ok(())
    }

    /// Evaluates the images stored so far.
    fn with_images<T>(
        &self,
        evaluate: impl FnOnce(&BoardImages<'_>) -> Result<T, CalibrationError>,
    ) -> Result<T, RunError> {
        let (state, stack) = (self.session.state()?, self.session.stack()?);
        let images = BoardImages { task: self.calibration, state: &state, stack: &stack };
        Ok(evaluate(&images)?)
    }
}

/// Whether the settings of a purpose depend on earlier images.
fn is_adapted(purpose: BoardPurpose) -> bool {
    matches!(purpose, BoardPurpose::SweepTime | BoardPurpose::Arrival | BoardPurpose::ExposureCheck)
}

impl Measurement for CalibrationRun {
    fn measure(self: Box<Self>, mut run: Run) -> Result<Ended, RunError> {
        run.note_beginning()?;
        let Self { rig, calibration, camera } = *self;
        let task = &calibration.task;
        let opened = Opened::open(&rig, task, &run)?;
        let stack = run.session.stack()?;
        let missing = missing(task, run.ledger.state());
        let stages: Arc<[_]> = Arc::new([]);
        let processing = Processing::without_demux(stages.clone());
        let planned = task.schedule.points.len();
        let progress = ProgressMeter::new(&run.orders, planned - missing.len(), planned);
        let (session, data) = (run.session.clone(), run.data.clone());
        let (sink, results) = PointSink::new(task, run, stack, processing, progress);
        let mut pixels = None;
        let taken = opened.acquire(stages, UNITS_UNDER_WAY, sink, &results, |passes| {
            let acquisition =
                BoardAcquisition { calibration: &calibration, session: &session, missing, passes };
            pixels = acquisition.run()?;
            Ok(())
        })?;
        let Taken { sink: PointSink { run, vsync, write_error, .. }, exposures, latency, fault } = taken;
        let Run { session, mut ledger, orders, mut warnings, .. } = run;
        let mut fault = write_error.map(RunError::from).or(fault);
        let mut found = None;
        if let (None, Some(pixels)) = (&fault, pixels) {
            let stack = session.stack()?;
            let images = BoardImages { task: &calibration, state: ledger.state(), stack: &stack };
            match BoardFindings::with_pixels(pixels, &images) {
                Ok(findings) => found = Some(findings),
                Err(error) => fault = Some(error.into()),
            }
        }
        let state = match (end_state(fault.as_ref(), &orders), &found) {
            (EndState::Complete, None) => EndState::Faulted,
            (state, _) => state,
        };
        warnings.extend(found.iter().flat_map(BoardFindings::warnings));
        let stored = ledger.state().stored_points();
        let is_final = matches!(&fault, Some(RunError::Calibration(error)) if error.is_final());
        let end = EndEntry {
            is_final,
            error: fault.map(|fault| fault.to_string()),
            vsync,
            light_s: exposures.light_s(),
            simulated_time: exposures.is_simulated,
            settings_latency: latency,
            ..EndEntry::new(state, stored, ledger.state().missing_points(), warnings)
        };
        ledger.append(&Entry::End(end.clone()))?;
        let mut said = Vec::new();
        if let Some(found) = found {
            let size = (task.geometry.height, task.geometry.width);
            let valid_for = ValidFor::new(&rig.file, &rig.text, &camera, size);
            let kept = found.keep(&session, ledger.state(), valid_for)?;
            found.write(&kept, &session, ledger.state(), &calibration, &rig.file)?;
            kept.use_in(&data)?;
            said = found.found();
        }
        Ok(Ended { end, found: said })
    }
}
