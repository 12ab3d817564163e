//! The viewfinder of a plane rig.

use std::time::{Duration, Instant};

use raysweep_config::plan::{ALIGN_NEEDS_TRIGGER, FinderSubject};
use raysweep_core::{
    Camera, CameraCapabilities, DeviceError, DeviceErrorKind, FinderPicture, FrameBuf, FramePool, FrameStamp,
    SettingsId, Subject,
};
use raysweep_processing::viewfinder::{AlignPictures, CountScale, FinderTask, SeenRows, pattern_of};
use raysweep_proto::{RowAlignment, RunState, ViewfinderParams};

use super::LitTime;
use super::finder::{Finder, FinderRig};
use crate::devices::operator;
use crate::plane::LitProjector;
use crate::rig::{Devices, Pace, Rig};
use crate::run::error::RunError;
use crate::run::life::Run;
use crate::run::orders::{Order, Orders};

/// Timeout of one wait for a frame, after which orders are looked at.
const POLL: Duration = Duration::from_millis(50);
/// A camera without frames for this long lacks its trigger.
const PATIENCE: Duration = Duration::from_secs(2);

const NO_TRIGGER: &str = "no frame for 2 s: the camera gets no trigger; check that the projector is on, and that its VSYNC line reaches the camera; `raysweep viewfinder --trigger none` needs no VSYNC, once this one is ended";
const NO_FRAMES: &str = "no frame for 2 s, though the camera should run freely; check its cable, and that nothing sets its trigger: camera.aravis.features, or camera.v4l2.controls without camera.v4l2.free_running";

/// Shows pictures until the run is told to end, or the plan's time is over.
///
/// # Errors
/// When a device fails.
pub fn view(rig: &Rig, task: FinderTask, run: &Run, lit: &mut LitTime) -> Result<(), RunError> {
    let free_hz = task.free_hz();
    let opened = free_hz.map_or_else(|| rig.open(), |free_hz| rig.open_free_running(free_hz))?;
    let Devices { camera, vsync, projector, questions, stand, pace, .. } = run.probes.instead_of(opened);
    // Nobody looks at edges.
    drop(vsync);
    let projector = LitProjector::new(projector, questions, run)?;
    let capabilities = camera.capabilities().clone();
    let geometry = &task.task.geometry;
    let (found, expected) = ((capabilities.height, capabilities.width), (geometry.height, geometry.width));
    if found != expected {
        return Err(RunError::OtherCamera { found, expected });
    }
    let scale = CountScale {
        black_dn: rig.file.camera.black_dn(),
        saturation_dn: geometry.saturation_dn,
        full_dn: capabilities.format.max_value(),
    };
    let (size, format) = (found, capabilities.format);
    let seen = FinderRig {
        size,
        format,
        scale,
        white_dn: Some(geometry.white_dn),
        exposure_us: task.exposure_us(),
        is_dot_rig: false,
    };
    let finder = Finder::new(run, &task.plan, &seen);
    let rows = AlignPictures::new(geometry.raster.rows, size);
    let buffer = FramePool::new(1, format.frame_bytes(size.0 * size.1)).take();
    let mut viewer = Viewer {
        orders: &run.orders,
        task,
        capabilities,
        camera,
        projector,
        finder,
        rows,
        buffer,
        pace,
        writes: 0,
        shown_ns: i64::MIN,
        first_seq: 0,
        lit,
    };
    let _ = run.board.go(RunState::Armed);
    let _ = run.board.go(RunState::Running);
    let subject = viewer.task.plan.subject.map(|subject| match subject {
        FinderSubject::Scene => Subject::Scene,
        FinderSubject::Board => Subject::Board,
    });
    if let Some(subject) = subject {
        operator::place(&stand, subject, 0, &run.orders, &run.board)?;
    }
    let viewed = viewer.run();
    let _ = run.board.go(RunState::Draining);
    viewed
}

/// The devices of a viewfinder, and how far it is.
struct Viewer<'a> {
    orders: &'a Orders,
    task: FinderTask,
    capabilities: CameraCapabilities,
    camera: Box<dyn Camera>,
    projector: LitProjector,
    finder: Finder,
    rows: AlignPictures,
    buffer: FrameBuf,
    pace: Pace,
    /// How often settings were written.
    writes: u32,
    /// Exposures that begin earlier may see the picture before.
    shown_ns: i64,
    /// Earlier frames may have the settings before.
    first_seq: u64,
    lit: &'a mut LitTime,
}

impl Viewer<'_> {
    fn run(&mut self) -> Result<(), RunError> {
        self.expose(self.finder.exposure_us(), 0.0)?;
        self.camera.arm()?;
        self.light()?;
        let viewed = self.frames();
        if let Err(error) = self.camera.disarm() {
            tracing::warn!(%error, "camera not disarmed");
        }
        viewed
    }

    fn frames(&mut self) -> Result<(), RunError> {
        let (complaint, frame) = match self.task.free_hz() {
            None => (NO_TRIGGER, Duration::ZERO),
            Some(free_hz) => (NO_FRAMES, Duration::from_secs_f64(1.0 / free_hz)),
        };
        let mut waiting = Instant::now();
        while self.orders.go_on() && !self.finder.is_over() {
            let is_paused = self.orders.now() == Order::Pause;
            // An operator who works the projector is asked only when the pause is over.
            if !is_paused || !self.projector.is_operated() {
                self.change()?;
            }
            if is_paused {
                self.orders.wait_while_paused_until(Some(Instant::now() + POLL));
                waiting = Instant::now();
                continue;
            }
            match self.camera.next_frame(&mut self.buffer, POLL)? {
                Some(stamp) => {
                    waiting = Instant::now();
                    self.finder.take_back(complaint);
                    self.frame(&stamp)?;
                }
                None if waiting.elapsed() > PATIENCE + 2 * frame => self.finder.complain(complaint),
                None => {}
            }
        }
        Ok(())
    }

    /// Makes the changes that clients want.
    fn change(&mut self) -> Result<(), RunError> {
        if !self.orders.look.is_changed() {
            return Ok(());
        }
        let wanted = self.orders.look.take();
        self.finder.change(&wanted);
        let ViewfinderParams { picture, exposure_us, mut delay_us, .. } = wanted;
        if delay_us.is_some() && self.task.free_hz().is_some() {
            self.finder.complain("delay_us: a camera that runs freely has no delays");
            delay_us = None;
        }
        if exposure_us.is_some() || delay_us.is_some() {
            let exposure_us = exposure_us.unwrap_or(self.finder.exposure_us());
            self.expose(exposure_us, delay_us.unwrap_or(self.finder.delay_us()))?;
        }
        if picture.is_some() {
            self.rows.restart();
            self.light()?;
        }
        Ok(())
    }

    /// Writes exposure and delay. What the camera refuses leaves them as they were.
    fn expose(&mut self, exposure_us: f64, delay_us: f64) -> Result<(), RunError> {
        let settings = self.task.settings(exposure_us, delay_us, &self.capabilities);
        let applied = self.camera.configure(SettingsId { point: 0, attempt: self.writes }, &settings);
        self.writes += 1;
        match applied {
            Ok(applied) => {
                self.finder.expose(exposure_us, delay_us);
                self.first_seq = applied.first_frame.certain();
            }
            Err(error) if error.kind == DeviceErrorKind::OutOfRange => {
                self.finder.complain(error.to_string())
            }
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    /// Shows the picture, or the next one of a series.
    fn light(&mut self) -> Result<(), RunError> {
        let pattern = match self.finder.picture() {
            FinderPicture::Align if self.task.free_hz().is_some() => {
                return self.refused(ALIGN_NEEDS_TRIGGER.into());
            }
            FinderPicture::Align => Some(self.rows.next().clone()),
            picture => pattern_of(picture),
        };
        match self.projector.show(pattern.as_ref(), self.orders) {
            Ok(Some(shown)) => {
                self.shown_ns = shown.not_before_ns;
                self.lit.note(pattern.is_some());
            }
            // The run was ended while an operator was asked.
            Ok(None) => {}
            Err(error) if is_refused(&error) => {
                let what = pattern.map_or_else(String::new, |pattern| format!("cannot show {pattern}: "));
                self.refused(format!("{what}{error}"))?;
            }
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    /// Goes on without light where a picture cannot be shown.
    fn refused(&mut self, why: String) -> Result<(), RunError> {
        self.finder.change(&ViewfinderParams { picture: Some(FinderPicture::Black), ..Default::default() });
        if let Some(shown) = self.projector.show(None, self.orders)? {
            self.shown_ns = shown.not_before_ns;
            self.lit.note(false);
        }
        self.finder.complain(why);
        Ok(())
    }

    /// Shows a frame, if it is new and due.
    fn frame(&mut self, stamp: &FrameStamp) -> Result<(), RunError> {
        if stamp.seq < self.first_seq || stamp.exposure_start_ns < self.shown_ns {
            return Ok(());
        }
        let is_align = self.finder.picture() == FinderPicture::Align;
        if !is_align && self.pace == Pace::Devices && self.finder.time_to_next() > Duration::ZERO {
            return Ok(());
        }
        let image = self.finder.unpack(&self.buffer).map_err(RunError::Frame)?;
        if is_align {
            let like_the_subject = self.rows.next_is_white();
            if let Some(rows) = self.rows.add(image) {
                let geometry = &self.task.task.geometry;
                let alignment = match rows {
                    Ok(rows) => aligned(&rows, geometry.first_row, geometry.row_pitch),
                    Err(error) => Err(error.to_string()),
                };
                self.finder.align(alignment);
            }
            self.light()?;
            if !like_the_subject {
                return Ok(());
            }
        }
        self.finder.show();
        if self.pace == Pace::Pipeline {
            self.orders.rest(self.finder.time_to_next());
        }
        Ok(())
    }
}

/// How the rows lie, and what to turn.
fn aligned(rows: &SeenRows, first_row: usize, row_pitch: f64) -> Result<RowAlignment, String> {
    let found = rows.alignment(first_row, row_pitch).ok_or_else(|| {
        "too few pixels see the projector's rows: fill the view with a white board".to_owned()
    })?;
    Ok(RowAlignment {
        measured: 0,
        shift_rows: found.shift_rows,
        rotation_deg: found.rotation_deg,
        magnification: found.magnification,
        worst_rows: found.worst_rows,
        residual_rows: found.residual_rows,
        advice: found.advice(rows.place.dim(), first_row, row_pitch),
    })
}

fn is_refused(error: &DeviceError) -> bool {
    matches!(error.kind, DeviceErrorKind::OutOfRange | DeviceErrorKind::Unsupported)
}
