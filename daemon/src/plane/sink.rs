//! The pipeline's sink: data first, then the ledger entry, then the demultiplexer.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

use raysweep_core::{Counts, LossCause, SettingsId, VsyncStats};
use raysweep_pipeline::{Failure, Ordered, Sink, StageError, Unit};
use raysweep_processing::plane::{PlaneTask, Processing, place};
use raysweep_proto::Event;
use raysweep_session::ledger::{Entry, FrameStarts, PointEntry};
use raysweep_session::stack::{ArrayName, Stack};

use crate::live::LiveEstimate;
use crate::run::life::Run;
use crate::run::orders::Order;
use crate::run::patience::write_patiently;
use crate::run::progress::ProgressMeter;

/// What the run is told about its points, in order.
#[derive(Debug)]
pub enum Verdict {
    /// An attempt failed, or its data could not be stored.
    Failed(SettingsId, Failure, Counts),
    /// The pass is over.
    Flushed,
}

/// Stores the points that the pipeline delivers.
pub struct PointSink {
    task: Arc<PlaneTask>,
    pub run: Run,
    stack: Stack,
    pub processing: Processing,
    /// `None` once the pipeline has ended.
    verdicts: Option<Sender<Verdict>>,
    pub progress: ProgressMeter,
    pub vsync: Option<VsyncStats>,
    /// `None` once the pipeline has ended: then the processor is needed for the results.
    pub live: Option<LiveEstimate>,
    /// The first write error, which ends the run.
    pub write_error: Option<raysweep_session::Error>,
}

impl Sink for PointSink {
    fn take(&mut self, item: Ordered) {
        match item {
            Ordered::Unit(unit, image) => {
                let unit = Unit { run: self.run.ledger.state().runs, ..unit };
                if let Err(error) = self.store(&unit) {
                    tracing::error!(%error, point = unit.id.point, "point not stored");
                    self.note_write_error(error);
                    let mut counts = unit.counts.clone();
                    counts.forfeit(LossCause::WriterError);
                    self.fail(unit.id, Failure::Interrupted, counts);
                    return;
                }
                self.progress.stored += 1;
                self.progress.counts.add(&unit.counts);
                match image {
                    Ok(image) => {
                        self.processing.push(&unit, &image);
                        if let Some(live) = &self.live
                            && let Some(snapshot) = self.processing.snapshot()
                        {
                            live.offer(Box::new(snapshot));
                        }
                    }
                    Err(error) => self.note_stage_error(&unit, &error),
                }
                self.run.board.publish(Event::Progress(self.progress.shown()));
            }
            Ordered::Failed(id, failure, counts) => self.fail(id, failure, counts),
            Ordered::Flushed(outside, vsync) => {
                if outside != Counts::default() {
                    self.progress.counts.add(&outside);
                    self.append(&Entry::Outside { counts: outside });
                }
                self.vsync = Some(vsync);
                self.run.board.publish(Event::Progress(self.progress.shown()));
                self.run.board.publish(Event::Vsync(vsync));
                self.tell(Verdict::Flushed);
            }
        }
    }

    fn end(&mut self) {
        self.verdicts = None;
        self.live = None;
    }
}

impl PointSink {
    /// A sink for the points of a run, without a live estimate, and the other end of its verdicts.
    pub fn new(
        task: &Arc<PlaneTask>,
        run: Run,
        stack: Stack,
        processing: Processing,
        progress: ProgressMeter,
    ) -> (Self, Receiver<Verdict>) {
        let (verdicts, results) = channel();
        let sink = Self {
            task: task.clone(),
            run,
            stack,
            processing,
            verdicts: Some(verdicts),
            progress,
            vsync: None,
            live: None,
            write_error: None,
        };
        (sink, results)
    }

    fn store(&mut self, unit: &Unit) -> raysweep_session::Result<()> {
        let (array, index) = place(self.task.schedule.points[unit.id.point as usize].role);
        let clipped =
            unit.clipped.as_ref().filter(|_| array == ArrayName::Sum && self.stack.has(ArrayName::Clipped));
        let (Run { ledger, orders, board, .. }, stack) = (&mut self.run, &self.stack);
        let (clipped_crc32, crc32) = write_patiently(orders, board, || {
            let clipped = clipped.map(|frames| stack.write(ArrayName::Clipped, index, frames.view()));
            Ok((clipped.transpose()?, stack.write(array, index, unit.sum.view())?))
        })?;
        let entry = Entry::Point(PointEntry {
            array,
            index,
            attempt: unit.id.attempt,
            frames: unit.frames,
            exposure_us: unit.exposure_us,
            delay_us: unit.delay_us,
            delays_us: unit.delays_us.clone(),
            counts: unit.counts.clone(),
            crc32,
            clipped_crc32,
            exposed: Some(FrameStarts { run: unit.run, starts_ns: unit.starts_ns.clone() }),
        });
        write_patiently(orders, board, || ledger.append(&entry))
    }

    fn fail(&mut self, id: SettingsId, failure: Failure, counts: Counts) {
        let (array, index) = place(self.task.schedule.points[id.point as usize].role);
        self.progress.counts.add(&counts);
        if counts.lost_total() > 0 {
            self.run.board.publish(Event::Lost {
                point: id.point,
                attempt: id.attempt,
                counts: counts.clone(),
            });
        }
        let (attempt, of_attempt) = (id.attempt, counts.clone());
        self.append(&match failure {
            Failure::Losses => Entry::AttemptFailed { array, index, attempt, counts: of_attempt },
            Failure::Interrupted => Entry::AttemptInterrupted { array, index, attempt, counts: of_attempt },
        });
        self.tell(Verdict::Failed(id, failure, counts));
    }

    fn tell(&self, verdict: Verdict) {
        if let Some(verdicts) = &self.verdicts {
            let _ = verdicts.send(verdict);
        }
    }

    pub fn note_write_error(&mut self, error: raysweep_session::Error) {
        self.run.orders.give(Order::Fault);
        self.write_error.get_or_insert(error);
    }

    fn note_stage_error(&mut self, unit: &Unit, error: &StageError) {
        tracing::error!(%error, point = unit.id.point, "stored, but left out of the results");
        let (array, index) = place(self.task.schedule.points[unit.id.point as usize].role);
        self.processing.problems.push(error.to_string());
        self.append(&Entry::StageFailed { array, index, attempt: unit.id.attempt, error: error.to_string() });
    }

    /// Appends an entry that no stored data depend on: a failure ends the run, but nothing must be undone.
    pub fn append(&mut self, entry: &Entry) {
        let Run { ledger, orders, board, .. } = &mut self.run;
        if let Err(error) = write_patiently(orders, board, || ledger.append(entry)) {
            tracing::error!(%error, "ledger not written");
            self.note_write_error(error);
        }
    }
}
