//! The sink's part in a film: frames into cycles, cycles to the disk and to the solver.

mod worker;

use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::{Array2, Array3, Axis};
use raysweep_core::{Counts, LossCause, SettingsId};
use raysweep_pipeline::{Cycle, FilmFrame, PipelineError, StageError, Unit};
use raysweep_proto::Event;
use raysweep_session::film::{CycleEntry, Film, crc32};
use raysweep_session::ledger::Entry;
use raysweep_transport::plane::Setting;

pub use self::worker::{Account, Exposed, Solving, Worker};
use super::storage::Storage;
use crate::processing::Task;
use crate::rig::Pace;

/// A film as its sink keeps it.
pub struct FilmSink {
    film: Film,
    worker: Worker,
    account: Arc<Account>,
    pace: Pace,
    timing: CycleTiming,
    /// Ordinal of the cycle's first setting in the schedule.
    first_ordinal: u32,
    settings: usize,
    dark: Option<Arc<Array2<f32>>>,
    /// The cycle under way.
    cycle: Option<Cycle>,
    /// The newest frame of each setting that has an image.
    newest: Vec<Option<FilmFrame>>,
    first_start_ns: Option<i64>,
    /// Starts of the first and the last stored cycle.
    stored_span_ns: Option<(i64, i64)>,
}

/// What the times of a cycle follow from.
#[derive(Debug, Clone, Copy)]
pub struct CycleTiming {
    /// VSYNC periods of a cycle, in nanoseconds.
    pub cycle_ns: f64,
    /// From the start of row 0's exposure to the end of the last row's.
    pub frame_ns: i64,
}

impl FilmSink {
    /// The sink of a film of which nothing is there yet.
    pub fn new(
        task: &Task,
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
            stored_span_ns: None,
        }
    }

    /// Keeps the image without light, which every transport needs.
    pub fn note_dark(&mut self, image: &Array2<f32>) {
        self.dark = Some(Arc::new(image.clone()));
    }

    /// Which setting of the cycle a point is, if it is one.
    pub fn setting_of(&self, id: SettingsId) -> Option<usize> {
        let setting = id.point.checked_sub(self.first_ordinal)? as usize;
        (setting < self.settings).then_some(setting)
    }

    /// The cycle that `number` is; the one before it, if there is one, is over.
    fn cycle(&mut self, number: u32) -> (&mut Cycle, Option<Cycle>) {
        let over = self.cycle.take_if(|cycle| cycle.number != number);
        (self.cycle.get_or_insert_with(|| Cycle::new(number, self.settings)), over)
    }

    fn seconds_since_start(&self, time_ns: i64) -> f64 {
        (time_ns - self.first_start_ns.unwrap_or(time_ns)) as f64 * 1e-9
    }

    fn exposed(
        &self,
        cycle: u32,
        frames: Vec<(Setting, Arc<Array2<f32>>)>,
        starts_ns: (i64, i64),
    ) -> Option<Exposed> {
        let (oldest_ns, newest_ns) = starts_ns;
        Some(Exposed {
            cycle,
            frames,
            dark: self.dark.clone()?,
            start_s: self.seconds_since_start(oldest_ns),
            end_ns: newest_ns + self.timing.frame_ns,
        })
    }

    /// Offers the newest frame of every setting, once there is one of each.
    fn offer_sliding(&self, number: u32, decided: usize) {
        // On a virtual clock the machine is never the slower one, so nothing would say how often is often enough.
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
        let Some(frames) = images_of(&newest) else { return };
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

    /// Waits for the transports of everything stored.
    ///
    /// # Errors
    /// When the disk refused, or the solver's thread panicked.
    pub fn finish(self) -> raysweep_session::Result<Result<(), PipelineError>> {
        self.worker.finish()
    }
}

impl Storage {
    /// Takes a frame of the film, if it is one; gives it back if not.
    pub(super) fn film_frame(&mut self, unit: &Unit, image: &Result<Array2<f32>, StageError>) -> bool {
        let Some(film) = &mut self.film else { return false };
        let Some(setting) = film.setting_of(unit.id) else {
            if let Ok(image) = image {
                film.note_dark(image);
            }
            return false;
        };
        if let Err(error) = image {
            self.note_stage_error_of_film(unit, setting, error);
        }
        let Some(film) = &mut self.film else { return true };
        let number = unit.id.attempt;
        let frame = FilmFrame::of(unit, image.as_ref().ok().map(|image| Arc::new(image.clone())));
        if let Some(frame) = &frame {
            film.first_start_ns.get_or_insert(frame.exposure_start_ns);
        }
        if frame.as_ref().is_some_and(|frame| frame.image.is_some()) {
            film.newest[setting].clone_from(&frame);
        }
        self.film_decided(number, |cycle| {
            cycle.counts.add(&unit.counts);
            cycle.frames[setting] = frame;
        });
        true
    }

    /// Takes note of a frame of the film that is lost, if it is one of the film.
    pub(super) fn film_frame_lost(&mut self, id: SettingsId, counts: &Counts) -> bool {
        if self.film.as_ref().and_then(|film| film.setting_of(id)).is_none() {
            return false;
        }
        if counts.lost_total() > 0 {
            self.board.publish(Event::Lost { point: id.point, attempt: id.attempt, counts: counts.clone() });
        }
        self.film_decided(id.attempt, |cycle| cycle.counts.add(counts));
        true
    }

    /// The fate of one more frame of a cycle is decided.
    fn film_decided(&mut self, number: u32, decide: impl FnOnce(&mut Cycle)) {
        let Some(film) = &mut self.film else { return };
        let (cycle, over) = film.cycle(number);
        decide(cycle);
        cycle.decided += 1;
        let (is_over, decided) = (cycle.is_over(), cycle.decided);
        if let Some(over) = over {
            self.close_cycle(over);
        }
        let Some(film) = &mut self.film else { return };
        if !is_over {
            film.offer_sliding(number, decided);
        } else if let Some(cycle) = film.cycle.take() {
            self.close_cycle(cycle);
        }
    }

    fn close_cycle(&mut self, mut cycle: Cycle) {
        let missing = cycle.missing();
        let stored = missing.is_empty().then(|| self.store_cycle(&cycle));
        match stored {
            Some(Ok(())) => {
                self.pace.stored += 1;
                self.pace.counts.add(&cycle.counts);
            }
            unstored => {
                let cause = if let Some(Err(error)) = unstored {
                    tracing::error!(%error, cycle = cycle.number, "cycle not stored");
                    self.note_write_error(error);
                    Some(LossCause::WriterError)
                } else {
                    None
                };
                give_up(&mut cycle.counts, cause);
                self.pace.counts.add(&cycle.counts);
                if let Some(film) = &self.film {
                    film.account.note(|film| film.cycles_incomplete += 1);
                }
                let Cycle { number, counts, .. } = cycle;
                self.append(&Entry::CycleLost { cycle: number as usize, missing, counts });
            }
        }
        self.board.publish(Event::Progress(self.pace.progress()));
    }

    fn store_cycle(&mut self, cycle: &Cycle) -> raysweep_session::Result<()> {
        let Some(film) = &mut self.film else { return Ok(()) };
        let frames: Vec<&FilmFrame> = cycle.frames.iter().flatten().collect();
        let starts = || frames.iter().map(|frame| frame.exposure_start_ns);
        let Some((first_ns, last_ns)) = starts().min().zip(starts().max()) else { return Ok(()) };
        let (rows, columns) = frames[0].raw.dim();
        let mut raw = Array3::<u16>::zeros((frames.len(), rows, columns));
        for (frame, mut place) in frames.iter().zip(raw.axis_iter_mut(Axis(0))) {
            // One frame of at most 16 bits a pixel.
            place.zip_mut_with(&frame.raw, |place, &counts| *place = counts.min(u32::from(u16::MAX)) as u16);
        }
        film.film.write(cycle.number as usize, raw.view())?;
        self.ledger.append(&Entry::Cycle(CycleEntry {
            cycle: cycle.number as usize,
            start_s: film.seconds_since_start(first_ns),
            exposure_us: frames[0].setting.exposure_us,
            delays_us: frames.iter().flat_map(|frame| frame.setting.delays_us.clone()).collect(),
            counts: cycle.counts.clone(),
            crc32: crc32(raw.view()),
        }))?;
        film.note_stored(first_ns);
        match images_of(&frames).and_then(|images| film.exposed(cycle.number, images, (first_ns, last_ns))) {
            Some(exposed) => film.worker.cycle(exposed),
            None => film.account.note(|film| film.transports_missing += 1),
        }
        Ok(())
    }

    /// The film has no further frames; a cycle that is not whole was cut short by a cancel or a fault.
    pub(super) fn film_over(&mut self) {
        let Some(mut cycle) = self.film.as_mut().and_then(|film| film.cycle.take()) else { return };
        give_up(&mut cycle.counts, None);
        self.pace.counts.add(&cycle.counts);
        self.append(&Entry::Outside { counts: cycle.counts });
    }

    fn note_stage_error_of_film(&mut self, unit: &Unit, setting: usize, error: &StageError) {
        let cycle = unit.id.attempt;
        tracing::error!(%error, cycle, setting, "stored, but its cycle has no transport");
        self.processing.problems.push(format!("cycle {cycle}, setting {setting}: {error}"));
    }
}

/// The images of frames with their settings, if all have one.
fn images_of(frames: &[&FilmFrame]) -> Option<Vec<(Setting, Arc<Array2<f32>>)>> {
    frames.iter().map(|frame| Some((frame.setting.clone(), frame.image.clone()?))).collect()
}

/// The sound frames of a cycle that is not stored end in another column than those that are.
fn give_up(counts: &mut Counts, cause: Option<LossCause>) {
    match cause {
        Some(cause) => counts.forfeit(cause),
        None => counts.cancelled += std::mem::take(&mut counts.averaged),
    }
}
