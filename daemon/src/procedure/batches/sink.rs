//! From the pipeline to the disk: a batch's data first, then the ledger entry, then its live image.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};

use raysweep_core::{Counts, Frame, LossCause, PixelFormat};
use raysweep_pipeline::PipelineError;
use raysweep_pipeline::dots::{Cut, CutSink};
use raysweep_processing::batches::{DotTask, from_stored, to_stored};
use raysweep_proto::{BatchStored, Event};
use raysweep_session::dots::{BatchEntry, Dots, RawFrames};
use raysweep_session::ledger::{Entry, Ledger};
use raysweep_transport::dots::product::floodlit;
use serde_json::{Map, Value, json};

use crate::live::{FLOODLIT, Outlet};
use crate::run::board::StatusBoard;
use crate::run::orders::{Order, Orders};
use crate::run::patience::write_patiently;
use crate::run::progress::ProgressMeter;

/// Capacity of the queue of batches for the disk.
const WAITING_BATCHES: usize = 4;
/// A batch is not stored if more than one in this many of its dots is missing.
const MOST_MISSING: usize = 10;

/// An item for the writer.
enum Item {
    /// A batch, its index in `dots.zarr`, and the plane that it shows.
    Batch(Box<Cut>, usize, Option<usize>),
    /// Frames outside any batch.
    Outside(Counts),
    /// An entry for the ledger.
    Note(Entry),
    /// What the results may suffer from.
    Problem(String),
}

/// The way to the writer.
#[derive(Clone)]
struct Outbox {
    items: SyncSender<Item>,
    orders: Arc<Orders>,
}

impl Outbox {
    /// Hands over an item. A writer that is gone has panicked, which its join reports: the mirror need not play on.
    fn send(&self, item: Item) {
        if self.items.send(item).is_err() {
            self.orders.give(Order::Fault);
        }
    }
}

/// Handle of the writer's thread.
pub struct BatchSink {
    outbox: Outbox,
    board: Arc<StatusBoard>,
    thread: JoinHandle<BatchWriter>,
}

/// Result of the writer.
pub struct StoredBatches {
    /// The ledger, still locked.
    pub ledger: Ledger,
    /// Problems with single dots.
    pub problems: Vec<String>,
    /// The first write error, which ended the run.
    pub error: Option<raysweep_session::Error>,
}

/// Everything that the writer needs.
pub struct Writing {
    /// The plan on its rig.
    pub task: Arc<DotTask>,
    /// Where batches are stored.
    pub dots: Dots,
    /// The ledger that records them.
    pub ledger: Ledger,
    /// Notified of each batch.
    pub board: Arc<StatusBoard>,
    /// Told to end the run when a write fails.
    pub orders: Arc<Orders>,
    /// Where floodlit images are published, if anywhere.
    pub live: Option<Outlet>,
}

struct BatchWriter {
    writing: Writing,
    progress: ProgressMeter,
    first_ns: Option<i64>,
    problems: Vec<String>,
    error: Option<raysweep_session::Error>,
}

impl BatchSink {
    /// Starts the writer.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start(writing: Writing) -> Result<Self, PipelineError> {
        let (items, inbox) = sync_channel(WAITING_BATCHES);
        let planned = writing.task.batches.total();
        let progress = ProgressMeter::new(&writing.orders, 0, planned);
        let outbox = Outbox { items, orders: writing.orders.clone() };
        let board = writing.board.clone();
        let writer = BatchWriter { writing, progress, first_ns: None, problems: Vec::new(), error: None };
        let thread = thread::Builder::new()
            .name("dots-writer".into())
            .spawn(move || writer.run(&inbox))
            .map_err(|source| PipelineError::Spawn { name: "dots-writer", source: source.into() })?;
        Ok(Self { outbox, board, thread })
    }

    /// The sink of a pass whose first batch has this index; raw frames go to `raw`, if given.
    pub fn sink(&self, first_batch: usize, plane: Option<usize>, raw: Option<RawSink>) -> PassSink {
        PassSink { outbox: self.outbox.clone(), first_batch, plane, raw, batches: 0, cut_short: None }
    }

    /// Where raw frames of this format and number of pixels are kept.
    pub fn raw_sink(&self, frames: RawFrames, format: PixelFormat, pixels: usize) -> RawSink {
        let (orders, board) = (self.outbox.orders.clone(), self.board.clone());
        RawSink { orders, board, frames, format, counts: vec![0; pixels], before: 0, error: None }
    }

    /// Records frames that belong to no batch.
    pub fn outside(&self, counts: Counts) {
        self.outbox.send(Item::Outside(counts));
    }

    /// Records an entry that no batch depends on.
    pub fn note(&self, entry: Entry) {
        self.outbox.send(Item::Note(entry));
    }

    /// Notes what the results may suffer from.
    pub fn problem(&self, problem: String) {
        self.outbox.send(Item::Problem(problem));
    }

    /// Waits until everything is written.
    ///
    /// # Errors
    /// When the writer panicked.
    pub fn finish(self) -> Result<StoredBatches, PipelineError> {
        drop(self.outbox);
        let BatchWriter { writing, problems, error, .. } =
            self.thread.join().map_err(|_panic| PipelineError::Panicked("dots-writer"))?;
        Ok(StoredBatches { ledger: writing.ledger, problems, error })
    }
}

/// Receives a pass' batches from the pipeline.
pub struct PassSink {
    outbox: Outbox,
    first_batch: usize,
    plane: Option<usize>,
    raw: Option<RawSink>,
    /// Number of batches handed on.
    batches: u32,
    /// A batch whose last dots are missing, until it is known why.
    cut_short: Option<Cut>,
}

/// Stores raw frames.
pub struct RawSink {
    orders: Arc<Orders>,
    board: Arc<StatusBoard>,
    frames: RawFrames,
    format: PixelFormat,
    counts: Vec<u16>,
    /// Number of frames in earlier passes.
    before: u64,
    error: Option<raysweep_session::Error>,
}

impl RawSink {
    /// Completes the file.
    ///
    /// # Errors
    /// When a write fails, now or earlier.
    pub fn finish(mut self) -> raysweep_session::Result<()> {
        match self.error {
            Some(error) => Err(error),
            None => {
                write_patiently(&self.orders, &self.board, || self.frames.flush())?;
                self.frames.finish()
            }
        }
    }

    fn keep(&mut self, frame: &Frame) {
        // A frame that cannot be unpacked has no counts to store, but keeps its place.
        if self.format.unpack_into(&frame.data, &mut self.counts).is_err() {
            self.counts.fill(0);
        }
        let Self { orders, board, frames, counts, .. } = self;
        let kept = write_patiently(orders, board, || frames.push(counts));
        self.note(kept);
    }

    fn note(&mut self, done: raysweep_session::Result<()>) {
        if let (Err(error), None) = (done, &self.error) {
            tracing::error!(%error, "raw frames are no longer kept");
            self.error = Some(error);
        }
    }
}

impl PassSink {
    /// Ends the pass; returns the number of its batches and the raw sink. A batch that a pause cut short is none: it is
    /// taken again.
    pub fn finish(mut self, is_held: bool) -> (u32, Option<RawSink>) {
        match self.cut_short.take() {
            Some(Cut { mut counts, .. }) if is_held => {
                counts.cancelled += std::mem::take(&mut counts.averaged);
                self.outbox.send(Item::Outside(counts));
            }
            Some(cut) => self.hand_on(cut),
            None => {}
        }
        let raw = self.raw.map(|mut raw| {
            raw.before = raw.frames.len();
            raw
        });
        (self.batches, raw)
    }

    fn hand_on(&mut self, cut: Cut) {
        self.batches = cut.batch + 1;
        let batch = self.first_batch + cut.batch as usize;
        self.outbox.send(Item::Batch(Box::new(cut), batch, self.plane));
    }
}

impl CutSink for PassSink {
    fn take(&mut self, cut: Cut) {
        if let Some(before) = self.cut_short.take() {
            self.hand_on(before);
        }
        match cut.is_cut_short {
            true => self.cut_short = Some(cut),
            false => self.hand_on(cut),
        }
    }

    fn outside(&mut self, counts: Counts) {
        self.outbox.send(Item::Outside(counts));
    }

    fn frame(&mut self, frame: &Frame) {
        if let Some(raw) = self.raw.as_mut().filter(|raw| raw.error.is_none()) {
            raw.keep(frame);
        }
    }

    fn fate(&mut self, arrival: u64, id: u64, place: Option<(u32, u32)>) {
        let first_batch = self.first_batch;
        if let Some(raw) = self.raw.as_mut().filter(|raw| raw.error.is_none()) {
            let place = place.map(|(batch, index)| (first_batch + batch as usize, index as usize));
            let RawSink { orders, board, frames, before, .. } = &mut *raw;
            let noted = write_patiently(orders, board, || frames.note(*before + arrival, id, place));
            raw.note(noted);
        }
    }
}

impl BatchWriter {
    fn run(mut self, inbox: &Receiver<Item>) -> Self {
        for item in inbox {
            match item {
                Item::Batch(cut, batch, plane) => self.batch(*cut, batch, plane),
                Item::Outside(counts) if counts == Counts::default() => {}
                Item::Outside(counts) => {
                    self.progress.counts.add(&counts);
                    self.append(&Entry::Outside { counts });
                }
                Item::Note(entry) => self.append(&entry),
                Item::Problem(problem) => self.problems.push(problem),
            }
            self.writing.board.publish(Event::Progress(self.progress.shown()));
        }
        self
    }

    fn batch(&mut self, cut: Cut, batch: usize, plane: Option<usize>) {
        let Cut { columns, seen, mut counts, duplicates, start_ns, problem, .. } = cut;
        let task = self.writing.task.clone();
        if let Some(problem) = problem {
            self.problems.push(format!("batch {batch}: {problem}"));
        }
        let missing: Vec<usize> = (0..seen.len()).filter(|&dot| task.is_scene(dot) && !seen[dot]).collect();
        if missing.len() * MOST_MISSING > seen.len() {
            counts.cancelled += std::mem::take(&mut counts.averaged);
            self.progress.counts.add(&counts);
            self.problems.push(format!("batch {batch} lacks {} dots and is not stored", missing.len()));
            return self.append(&Entry::BatchLost { batch, counts });
        }
        let first_ns = *self.first_ns.get_or_insert(start_ns);
        let start_s = (start_ns - first_ns) as f64 * 1e-9;
        let empty = (0..seen.len()).filter(|&dot| seen[dot] && columns.discs[dot] == 0).count();
        let capped = columns.capped.iter().filter(|&&capped| capped).count();
        let stored = to_stored(self.writing.task.shape, columns, seen);
        let entry = BatchEntry {
            batch,
            plane,
            start_s,
            missing,
            empty,
            capped,
            duplicates,
            counts: counts.clone(),
            crc32: stored.crc32(),
        };
        let attributes = json!({ "batch": batch, "plane": plane, "start_s": start_s });
        let attributes = attributes.as_object().cloned().unwrap_or_default();
        let Writing { dots, ledger, board, orders, .. } = &mut self.writing;
        let written = write_patiently(orders, board, || dots.write(batch, &stored, attributes.clone()));
        let record = Entry::Batch(entry.clone());
        match written.and_then(|()| write_patiently(orders, board, || ledger.append(&record))) {
            Ok(()) => self.progress.point_stored(&counts),
            Err(error) => {
                tracing::error!(%error, batch, "batch not stored");
                self.fail(error);
                counts.forfeit(LossCause::WriterError);
                self.progress.counts.add(&counts);
                return self.append(&Entry::BatchLost { batch, counts });
            }
        }
        match from_stored(task.shape, stored) {
            Ok((columns, _)) => self.show(&entry, &floodlit(&columns)),
            Err(error) => self.problems.push(format!("batch {batch}: {error}")),
        }
    }

    /// Announces a batch and publishes its floodlit image in the live file.
    fn show(&self, entry: &BatchEntry, floodlit: &ndarray::Array3<f32>) {
        let image = floodlit.index_axis(ndarray::Axis(2), 0);
        let sequence = self.writing.live.as_ref().and_then(|Outlet { file, session, .. }| {
            let entries = [
                ("axes", json!(["t", "s"])),
                ("units", json!("camera counts above the background, summed over all dots")),
                ("session", json!(session)),
                ("batch", json!(entry.batch)),
                ("plane", json!(entry.plane)),
                ("start_s", json!(entry.start_s)),
            ];
            let metadata: Map<String, Value> =
                entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
            let shown = file.publish(FLOODLIT, image.view().into_dyn(), &metadata);
            shown.map_err(|error| tracing::warn!(%error, "a floodlit image is not shown")).ok()
        });
        self.writing.board.publish(Event::Batch(BatchStored {
            batch: entry.batch,
            plane: entry.plane,
            start_s: entry.start_s,
            missing: entry.missing.len(),
            empty: entry.empty,
            capped: entry.capped,
            duplicates: entry.duplicates,
            floodlit: f64::from(image.mean().unwrap_or(0.0)),
            sequence,
        }));
    }

    fn fail(&mut self, error: raysweep_session::Error) {
        self.writing.orders.give(Order::Fault);
        self.error.get_or_insert(error);
    }

    fn append(&mut self, entry: &Entry) {
        let Writing { ledger, board, orders, .. } = &mut self.writing;
        if let Err(error) = write_patiently(orders, board, || ledger.append(entry)) {
            tracing::error!(%error, "ledger not written");
            self.fail(error);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_without_its_writer_ends() {
        let (items, inbox) = sync_channel(WAITING_BATCHES);
        let orders = Arc::new(Orders::default());
        let outbox = Outbox { items, orders: orders.clone() };
        let mut sink =
            PassSink { outbox, first_batch: 0, plane: None, raw: None, batches: 0, cut_short: None };
        sink.outside(Counts::default());
        assert_eq!(orders.now(), Order::Go);
        drop(inbox);
        sink.outside(Counts::default());
        assert_eq!(orders.now(), Order::Fault);
    }
}
