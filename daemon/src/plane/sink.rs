//! The pipeline's sink: data first, then the ledger entry, then the demultiplexer.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

use ndarray::Array2;
use raysweep_core::{Counts, LossCause, SettingsId, VsyncStats};
use raysweep_pipeline::{
    Failure, Ordered, Point, PointRole, SeenLight, Sink, StageError, SweepGeometry, Unit,
};
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
    /// What was seen of the projector's light, if that was too little: this ends the run too.
    pub no_light: Option<SeenLight>,
}

impl Sink for PointSink {
    fn take(&mut self, item: Ordered) {
        match item {
            Ordered::Unit(unit, image) => {
                let unit = Unit { run: self.run.ledger.state().runs, ..unit };
                if self.role_of(unit.id) == PointRole::Regular {
                    self.look_for_light(&unit);
                }
                if self.no_light.is_some() {
                    let mut counts = unit.counts.clone();
                    counts.cancelled += std::mem::take(&mut counts.averaged);
                    self.fail(unit.id, Failure::Interrupted, counts);
                    return;
                }
                if self.is_stored_regular(unit.id) {
                    let mut counts = unit.counts;
                    counts.settling += std::mem::take(&mut counts.averaged);
                    self.outside(counts);
                    return;
                }
                if let Err(error) = self.store(&unit) {
                    tracing::error!(%error, point = unit.id.point, "point not stored");
                    self.note_write_error(error);
                    let mut counts = unit.counts.clone();
                    counts.forfeit(LossCause::WriterError);
                    self.fail(unit.id, Failure::Interrupted, counts);
                    return;
                }
                self.progress.point_stored(&unit.counts);
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
            Ordered::UnderWay(frames) => {
                self.progress.under_way = Some(frames);
                self.run.board.publish(Event::Progress(self.progress.shown()));
            }
            Ordered::Flushed(outside, vsync) => {
                if outside != Counts::default() {
                    self.outside(outside);
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
            no_light: None,
        };
        (sink, results)
    }

    fn role_of(&self, id: SettingsId) -> PointRole {
        self.task.schedule.points[id.point as usize].role
    }

    /// Judges by the regular image, which collects all light there is, whether the run sees any. Without light, no further
    /// point is stored, and a resumed run takes them all.
    fn look_for_light(&mut self, regular: &Unit) {
        let SweepGeometry { white_dn, saturation_dn, .. } = self.task.geometry;
        let seen = self
            .dark()
            .and_then(|dark| SeenLight::between(regular.mean().view(), dark.view(), white_dn, saturation_dn));
        if let Some(none) = seen.filter(|seen| !seen.is_light()) {
            self.note_no_light(none);
        }
    }

    /// Whether this is a regular image that was taken again, only to look for light.
    fn is_stored_regular(&self, id: SettingsId) -> bool {
        self.role_of(id) == PointRole::Regular
            && self.run.ledger.state().point(ArrayName::Regular, 0).is_some()
    }

    /// The stored dark image of the longest exposure, in counts.
    fn dark(&self) -> Option<Array2<f32>> {
        let stored = |point: &Point| {
            let (array, index) = place(point.role);
            let entry = self.run.ledger.state().point(array, index).filter(|_| array == ArrayName::Dark)?;
            let sum = self.stack.read_point(array, index).ok()?;
            Some(sum.mapv(|sum| sum as f32 / entry.frames as f32))
        };
        self.task.schedule.points.iter().rev().find_map(stored)
    }

    /// Ends the run, because it sees no light.
    pub fn note_no_light(&mut self, seen: SeenLight) {
        self.run.orders.give(Order::Fault);
        self.no_light.get_or_insert(seen);
    }

    /// Counts frames that belong to no stored point.
    pub fn outside(&mut self, counts: Counts) {
        self.progress.counts.add(&counts);
        self.append(&Entry::Outside { counts });
    }

    fn store(&mut self, unit: &Unit) -> raysweep_session::Result<()> {
        let (array, index) = place(self.role_of(unit.id));
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
        let (array, index) = place(self.role_of(id));
        self.progress.counts.add(&counts);
        self.progress.under_way = None;
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
        let (array, index) = place(self.role_of(unit.id));
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
