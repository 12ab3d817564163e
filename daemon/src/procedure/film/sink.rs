//! The sink of a film: assembles frames into cycles and passes these to the disk and the solver.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::{Array2, Array3, Axis};
use raysweep_core::{Counts, LossCause, SettingsId};
use raysweep_pipeline::{
    Cycle, FilmFrame, FilmImage, Ordered, PipelineError, SeenLight, Sink, StageError, Unit,
};
use raysweep_processing::plane::PlaneTask;
use raysweep_proto::Event;
use raysweep_session::film::{CycleEntry, Film, crc32};
use raysweep_session::ledger::Entry;

use super::worker::{Account, CycleFrames, Worker};
use crate::plane::PointSink;
use crate::rig::Pace;
use crate::run::life::Run;
use crate::run::patience::write_patiently;

/// The pipeline's sink of a film.
pub struct FilmSink {
    /// Receives what does not belong to the film: the dark image.
    pub points: PointSink,
    /// Receives the film.
    pub film: Cycles,
}

/// The sink's state of a film.
pub struct Cycles {
    film: Film,
    worker: Worker,
    account: Arc<Account>,
    pace: Pace,
    timing: CycleTiming,
    /// Ordinal of the cycle's first setting in the schedule.
    first_ordinal: u32,
    settings: usize,
    dark: Option<FilmImage>,
    /// The cycle in progress.
    cycle: Option<Cycle>,
    /// The newest frame of each setting that has an image.
    newest: Vec<Option<FilmFrame>>,
    first_start_ns: Option<i64>,
    /// Light of a white pixel, and the level from which pixels saturate, in counts.
    white_dn: f64,
    saturation_dn: f64,
    /// Whether a cycle has shown light.
    is_lit: bool,
    /// Starts of the first and the last stored cycle.
    stored_span_ns: Option<(i64, i64)>,
}

/// The figures that a cycle's times are computed from.
#[derive(Debug, Clone, Copy)]
pub struct CycleTiming {
    /// VSYNC periods of a cycle, in nanoseconds.
    pub cycle_ns: f64,
    /// From the start of row 0's exposure to the end of the last row's.
    pub frame_ns: i64,
}

impl Cycles {
    /// The sink of a film without any frames yet.
    pub fn new(
        task: &PlaneTask,
        film: Film,
        worker: Worker,
        account: Arc<Account>,
        pace: Pace,
        timing: CycleTiming,
    ) -> Self {
        let settings = task.settings().count();
        Self {
            film,
            worker,
            account,
            pace,
            timing,
            first_ordinal: task.settings().map(|(ordinal, _)| ordinal).next().unwrap_or(0),
            settings,
            dark: None,
            cycle: None,
            newest: vec![None; settings],
            first_start_ns: None,
            white_dn: task.geometry.white_dn,
            saturation_dn: task.geometry.saturation_dn,
            is_lit: false,
            stored_span_ns: None,
        }
    }

    /// Stores the dark image, which every transport needs.
    pub fn note_dark(&mut self, unit: &Unit, image: &Array2<f32>) {
        self.dark = Some(FilmImage::of(unit, image.clone()));
    }

    /// Index of a point among the cycle's settings, if it is one.
    pub fn setting_of(&self, id: SettingsId) -> Option<usize> {
        let setting = id.point.checked_sub(self.first_ordinal)? as usize;
        (setting < self.settings).then_some(setting)
    }

    /// The cycle with this number; also returns the previous one, if any, which is over.
    fn cycle(&mut self, number: u32) -> (&mut Cycle, Option<Cycle>) {
        let over = self.cycle.take_if(|cycle| cycle.number != number);
        (self.cycle.get_or_insert_with(|| Cycle::new(number, self.settings)), over)
    }

    fn seconds_since_start(&self, time_ns: i64) -> f64 {
        (time_ns - self.first_start_ns.unwrap_or(time_ns)) as f64 * 1e-9
    }

    /// The light in the brightest frame of a cycle, if it is none and no earlier cycle had any.
    fn no_light(&mut self, cycle: &Cycle) -> Option<SeenLight> {
        let dark = self.dark.as_ref().filter(|_| !self.is_lit)?;
        let images = cycle.frames.iter().flatten().filter_map(|frame| frame.image.as_ref());
        let seen = images.filter_map(|image| {
            SeenLight::between(image.view(), dark.counts.view(), self.white_dn, self.saturation_dn)
        });
        let brightest = seen.max_by(|a, b| a.mean_dn.total_cmp(&b.mean_dn))?;
        self.is_lit = brightest.is_light();
        (!self.is_lit).then_some(brightest)
    }

    fn exposed(&self, cycle: u32, frames: Vec<FilmImage>, starts_ns: (i64, i64)) -> Option<CycleFrames> {
        let (oldest_ns, newest_ns) = starts_ns;
        Some(CycleFrames {
            cycle,
            frames,
            dark: self.dark.clone()?,
            start_s: self.seconds_since_start(oldest_ns),
            end_ns: newest_ns + self.timing.frame_ns,
        })
    }

    /// Offers the newest frame of each setting to the solver, once all settings have one.
    fn offer_sliding(&self, number: u32, decided: usize) {
        // On a virtual clock the machine is never too slow, so nothing would limit the rate.
        if self.pace == Pace::Pipeline {
            return;
        }
        let newest: Vec<&FilmFrame> = self.newest.iter().flatten().collect();
        let starts = || newest.iter().map(|frame| frame.exposure_start_ns);
        let Some(span_ns) = starts().min().zip(starts().max()).filter(|_| newest.len() == self.settings)
        else {
            return;
        };
        let left = (self.settings - decided) as f64 / self.settings as f64;
        let cycle_end = Instant::now() + Duration::from_secs_f64(left * self.timing.cycle_ns * 1e-9);
        let Some(frames) = newest.iter().map(|frame| frame.staged()).collect() else { return };
        if let Some(exposed) = self.exposed(number, frames, span_ns) {
            self.worker.sliding(exposed, cycle_end);
        }
    }

    fn note_stored(&mut self, start_ns: i64) {
        let (first_ns, _) = self.stored_span_ns.unwrap_or((start_ns, start_ns));
        self.stored_span_ns = Some((first_ns, start_ns));
        let span_s = (start_ns - first_ns) as f64 * 1e-9;
        self.account.note(|film| {
            film.cycles_stored += 1;
            film.cycles_per_s = (span_s > 0.0).then(|| (film.cycles_stored - 1) as f64 / span_s);
        });
    }

    /// Waits for the transports of all stored cycles.
    ///
    /// # Errors
    /// When a write failed, or the solver's thread panicked.
    pub fn finish(self) -> raysweep_session::Result<Result<(), PipelineError>> {
        self.worker.finish()
    }
}

impl Sink for FilmSink {
    fn take(&mut self, item: Ordered) {
        match item {
            Ordered::Unit(unit, image) => match self.film.setting_of(unit.id) {
                Some(setting) => self.frame(setting, &unit, &image),
                None => {
                    if let Ok(image) = &image {
                        self.film.note_dark(&unit, image);
                    }
                    self.points.take(Ordered::Unit(unit, image));
                }
            },
            Ordered::Failed(id, _, counts) if self.film.setting_of(id).is_some() => {
                self.frame_lost(id, &counts)
            }
            Ordered::Flushed(..) => {
                self.film_over();
                self.points.take(item);
            }
            item => self.points.take(item),
        }
    }

    fn end(&mut self) {
        self.points.end();
    }
}

impl FilmSink {
    /// Receives a frame of the film with this setting.
    fn frame(&mut self, setting: usize, unit: &Unit, image: &Result<Array2<f32>, StageError>) {
        if let Err(error) = image {
            self.note_stage_error(unit, setting, error);
        }
        let film = &mut self.film;
        let number = unit.id.attempt;
        let frame = FilmFrame::of(unit, image.as_ref().ok().map(|image| Arc::new(image.clone())));
        if let Some(frame) = &frame {
            film.first_start_ns.get_or_insert(frame.exposure_start_ns);
        }
        if frame.as_ref().is_some_and(|frame| frame.image.is_some()) {
            film.newest[setting].clone_from(&frame);
        }
        self.decided(number, |cycle| {
            cycle.counts.add(&unit.counts);
            cycle.frames[setting] = frame;
        });
    }

    /// Records a lost frame of the film.
    fn frame_lost(&mut self, id: SettingsId, counts: &Counts) {
        if counts.lost_total() > 0 {
            let lost = Event::Lost { point: id.point, attempt: id.attempt, counts: counts.clone() };
            self.points.run.board.publish(lost);
        }
        self.decided(id.attempt, |cycle| cycle.counts.add(counts));
    }

    /// Records that the fate of another frame of a cycle is decided.
    fn decided(&mut self, number: u32, decide: impl FnOnce(&mut Cycle)) {
        let (cycle, over) = self.film.cycle(number);
        decide(cycle);
        cycle.decided += 1;
        let (is_over, decided) = (cycle.is_over(), cycle.decided);
        if let Some(over) = over {
            self.close_cycle(over);
        }
        if !is_over {
            self.film.offer_sliding(number, decided);
        } else if let Some(cycle) = self.film.cycle.take() {
            self.close_cycle(cycle);
        }
    }

    fn close_cycle(&mut self, mut cycle: Cycle) {
        let missing = cycle.missing();
        if missing.is_empty()
            && let Some(none) = self.film.no_light(&cycle)
        {
            self.points.note_no_light(none);
            self.give_up_whole(cycle);
            return;
        }
        let stored = missing.is_empty().then(|| self.store_cycle(&cycle));
        match stored {
            Some(Ok(())) => {
                self.points.progress.stored += 1;
                self.points.progress.counts.add(&cycle.counts);
            }
            unstored => {
                let cause = if let Some(Err(error)) = unstored {
                    tracing::error!(%error, cycle = cycle.number, "cycle not stored");
                    self.points.note_write_error(error);
                    Some(LossCause::WriterError)
                } else {
                    None
                };
                give_up(&mut cycle.counts, cause);
                self.points.progress.counts.add(&cycle.counts);
                self.film.account.note(|film| film.cycles_incomplete += 1);
                let Cycle { number, counts, .. } = cycle;
                self.points.append(&Entry::CycleLost { cycle: number as usize, missing, counts });
            }
        }
        self.points.run.board.publish(Event::Progress(self.points.progress.shown()));
    }

    fn store_cycle(&mut self, cycle: &Cycle) -> raysweep_session::Result<()> {
        let film = &mut self.film;
        let frames: Vec<&FilmFrame> = cycle.frames.iter().flatten().collect();
        let starts = || frames.iter().map(|frame| frame.exposure_start_ns);
        let Some((first_ns, last_ns)) = starts().min().zip(starts().max()) else { return Ok(()) };
        let (rows, columns) = frames[0].raw.dim();
        let mut raw = Array3::<u16>::zeros((frames.len(), rows, columns));
        for (frame, mut place) in frames.iter().zip(raw.axis_iter_mut(Axis(0))) {
            // A single frame with at most 16 bits per pixel.
            place.zip_mut_with(&frame.raw, |place, &counts| *place = counts.min(u32::from(u16::MAX)) as u16);
        }
        let entry = Entry::Cycle(CycleEntry {
            cycle: cycle.number as usize,
            start_s: film.seconds_since_start(first_ns),
            exposure_us: frames[0].setting.exposure_us,
            delays_us: frames.iter().flat_map(|frame| frame.setting.delays_us.clone()).collect(),
            starts_ns: starts().collect(),
            counts: cycle.counts.clone(),
            crc32: crc32(raw.view()),
        });
        let Run { ledger, orders, board, .. } = &mut self.points.run;
        write_patiently(orders, board, || film.film.write(cycle.number as usize, raw.view()))?;
        write_patiently(orders, board, || ledger.append(&entry))?;
        film.note_stored(first_ns);
        let images: Option<Vec<FilmImage>> = frames.iter().map(|frame| frame.staged()).collect();
        match images.and_then(|images| film.exposed(cycle.number, images, (first_ns, last_ns))) {
            Some(exposed) => film.worker.cycle(exposed),
            None => film.account.note(|film| film.transports_missing += 1),
        }
        Ok(())
    }

    /// The film has no further frames; an incomplete cycle was cut short by a cancel or a fault.
    fn film_over(&mut self) {
        if let Some(cycle) = self.film.cycle.take() {
            self.give_up_whole(cycle);
        }
    }

    /// Leaves out a cycle as if it had not been planned.
    fn give_up_whole(&mut self, mut cycle: Cycle) {
        give_up(&mut cycle.counts, None);
        self.points.outside(cycle.counts);
    }

    fn note_stage_error(&mut self, unit: &Unit, setting: usize, error: &StageError) {
        let cycle = unit.id.attempt;
        tracing::error!(%error, cycle, setting, "stored, but its cycle has no transport");
        self.points.processing.problems.push(format!("cycle {cycle}, setting {setting}: {error}"));
    }
}

/// Valid frames of a cycle that is not stored are counted separately from stored ones.
fn give_up(counts: &mut Counts, cause: Option<LossCause>) {
    match cause {
        Some(cause) => counts.forfeit(cause),
        None => counts.cancelled += std::mem::take(&mut counts.averaged),
    }
}
