//! Columns in the order of their frames become batches; every frame ends in exactly one column of the account.

use std::collections::VecDeque;

use raysweep_core::{Counts, Frame, LossCause, PixelFormat};
use raysweep_transport::dots::{
    BackgroundMean, BatchArrays, Cause, Decided, DotsError, Fate, FrameShape, Observation, Region,
    SparseColumn, SyncSettings, Synchroniser, pulse_threshold,
};

use super::flow::Loss;

/// Batches in which the trailing dot's brightness is learnt before the first is cut.
const LEARNT_FROM_BATCHES: usize = 2;
/// How far a frame that waits for its index may be from where the last trailing dot puts it: a drift of one frame a
/// batch, over the two batches that it may wait.
const DRIFT_FRAMES: u64 = 2;

/// What is scanned.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scan {
    /// Size of the frames.
    pub shape: FrameShape,
    /// Frames of a batch.
    pub dots: u32,
    /// Index of the frame that shows the trailing dot.
    pub trailing_index: u32,
    /// Where in the frame it lands.
    pub trailing_region: Region,
    /// Indices of the frames whose light goes to the beam dump.
    pub background_indices: Vec<u32>,
    /// Batches that are wanted.
    pub batches: u32,
}

impl Scan {
    /// Whether a frame of the batch shows the scene: no trailing dot, no beam dump.
    pub fn is_scene(&self, index: u32) -> bool {
        index != self.trailing_index && !self.background_indices.contains(&index)
    }
}

/// A batch as it was cut.
#[derive(Debug, Clone, PartialEq)]
pub struct Cut {
    /// Its number among those wanted, from 0.
    pub batch: u32,
    /// A column for each frame; those without a frame, and those that do not show the scene, have no light.
    pub columns: BatchArrays,
    /// Which of them show the scene, `[dots]`.
    pub seen: Vec<bool>,
    /// Where its frames went.
    pub counts: Counts,
    /// Frames that came twice.
    pub duplicates: u64,
    /// Start of its first frame's exposure, on the host's clock.
    pub start_ns: i64,
    /// When its last frame was complete on the host.
    pub end_ns: i64,
    /// What the first of its frames that could not be denoised met.
    pub problem: Option<String>,
}

/// Receives batches in order.
pub trait CutSink: Send {
    /// Takes the next batch.
    fn take(&mut self, cut: Cut);

    /// Takes note of frames that belong to no batch that is wanted.
    fn outside(&mut self, counts: Counts);

    /// Looks at a raw frame, in the order of arrival.
    fn frame(&mut self, _frame: &Frame) {}

    /// Learns the id, the batch among those wanted, and the index of a frame that [`Self::frame`] has seen as number
    /// `arrival`, from 0; no batch and index if it has none.
    fn fate(&mut self, _arrival: u64, _id: u64, _place: Option<(u32, u32)>) {}
}

/// A frame as a worker has seen it.
pub(super) struct Looked {
    pub seen: Observation,
    pub column: Result<SparseColumn, String>,
    pub frame: Frame,
    pub lost_before: Vec<Loss>,
}

/// A frame whose index is not certain yet.
struct Waiting {
    id: u64,
    column: Result<SparseColumn, String>,
    /// Only of a frame that may be one of the beam dump.
    frame: Option<Frame>,
    lost_before: Vec<Loss>,
    start_ns: i64,
    end_ns: i64,
}

/// The batch under construction.
struct Building {
    /// The synchroniser's number.
    number: u64,
    cut: Cut,
}

/// How the stream is cut.
enum Cutter {
    /// Not yet: nobody knows how bright the trailing dot is.
    Learning(Vec<Observation>),
    Cutting(Box<Synchroniser>),
    /// Never: it was not seen.
    Blind,
}

pub(super) struct Gatherer<S> {
    scan: Scan,
    format: PixelFormat,
    pub sink: S,
    cutter: Cutter,
    pending: VecDeque<Option<Waiting>>,
    first_pending: u64,
    decided: Vec<Decided>,
    building: Option<Building>,
    /// Id and index of the last frame that has one.
    last: Option<(u64, u32)>,
    outside: Counts,
    duplicates: u64,
    pub background: BackgroundMean,
    /// Whether the background has changed since it was last asked for.
    background_changed: bool,
    counts: Vec<u16>,
    blank: SparseColumn,
    /// Words and values of the batch before: what the next will need.
    usual: (usize, usize),
    ending: bool,
}

impl<S: CutSink> Gatherer<S> {
    pub fn new(scan: Scan, format: PixelFormat, background: BackgroundMean, sink: S) -> Self {
        let shape = scan.shape;
        let learning = LEARNT_FROM_BATCHES * scan.dots as usize + 2;
        Self {
            cutter: Cutter::Learning(Vec::with_capacity(learning)),
            pending: VecDeque::with_capacity(2 * learning),
            first_pending: 0,
            decided: Vec::with_capacity(2 * learning),
            building: None,
            last: None,
            outside: Counts::default(),
            duplicates: 0,
            background,
            background_changed: false,
            counts: vec![0; shape.values()],
            blank: SparseColumn {
                residual: vec![0.0; shape.blocks() * shape.channels()],
                ..SparseColumn::default()
            },
            usual: (0, 0),
            scan,
            format,
            sink,
            ending: false,
        }
    }

    /// Takes the next frame; columns that are no longer needed go to `spare`.
    ///
    /// # Errors
    /// When the trailing dot is not seen where it should be.
    pub fn take(&mut self, looked: Looked, spare: &mut dyn FnMut(SparseColumn)) -> Result<(), DotsError> {
        let Looked { seen, column, frame, lost_before } = looked;
        if let Cutter::Blind = self.cutter {
            // Taken in so that it is accounted for.
            lose(&mut self.outside, &lost_before);
            self.outside.expected += 1;
            self.outside.cancelled += 1;
            return Ok(());
        }
        self.sink.frame(&frame);
        let (start_ns, end_ns) = (frame.stamp.exposure_start_ns, frame.stamp.host_ns);
        let frame = self.may_be_background(seen.id).then_some(frame);
        self.pending.push_back(Some(Waiting { id: seen.id, column, frame, lost_before, start_ns, end_ns }));
        self.decided.clear();
        match &mut self.cutter {
            Cutter::Cutting(synchroniser) => self.decided.extend_from_slice(synchroniser.push(seen)),
            Cutter::Learning(run) => {
                run.push(seen);
                if run.len() > LEARNT_FROM_BATCHES * self.scan.dots as usize {
                    self.begin_cutting()?;
                }
            }
            Cutter::Blind => {}
        }
        self.settle_all(spare);
        Ok(())
    }

    /// Ends the stream.
    ///
    /// # Errors
    /// As [`Self::take`].
    pub fn finish(&mut self, spare: &mut dyn FnMut(SparseColumn)) -> Result<(), DotsError> {
        self.decided.clear();
        let learnt = match &self.cutter {
            Cutter::Learning(run) if !run.is_empty() => self.begin_cutting(),
            _ => Ok(()),
        };
        self.settle_all(spare);
        self.ending = true;
        if let Cutter::Cutting(synchroniser) = &mut self.cutter {
            self.decided.clear();
            self.decided.extend_from_slice(synchroniser.finish());
            self.settle_all(spare);
        }
        self.close();
        // What an error has left undecided, nobody waits for any more.
        for waiting in self.pending.drain(..).flatten() {
            lose(&mut self.outside, &waiting.lost_before);
            self.outside.expected += 1;
            self.outside.cancelled += 1;
        }
        self.sink.outside(std::mem::take(&mut self.outside));
        learnt
    }

    /// The background, if it has changed since this was last asked.
    pub fn changed_background(&mut self) -> Option<&[f32]> {
        std::mem::take(&mut self.background_changed).then(|| self.background.mean())
    }

    fn begin_cutting(&mut self) -> Result<(), DotsError> {
        let Cutter::Learning(run) = std::mem::replace(&mut self.cutter, Cutter::Blind) else { return Ok(()) };
        let threshold = pulse_threshold(&run)?;
        let mut synchroniser = Synchroniser::new(SyncSettings {
            frames_per_batch: self.scan.dots,
            trailing_index: self.scan.trailing_index,
            threshold,
        })?;
        for seen in run {
            self.decided.extend_from_slice(synchroniser.push(seen));
        }
        self.cutter = Cutter::Cutting(Box::new(synchroniser));
        Ok(())
    }

    /// Whether a frame that has just come may turn out to be one of the beam dump.
    fn may_be_background(&self, id: u64) -> bool {
        let Some((last_id, last_index)) = self.last else { return false };
        let dots = u64::from(self.scan.dots);
        let expected = (u64::from(last_index) + id.saturating_sub(last_id)) % dots;
        self.scan.background_indices.iter().any(|&index| {
            let distance = expected.abs_diff(u64::from(index));
            distance.min(dots - distance) <= DRIFT_FRAMES
        })
    }

    fn settle_all(&mut self, spare: &mut dyn FnMut(SparseColumn)) {
        let mut decided = std::mem::take(&mut self.decided);
        for Decided { arrival, fate } in decided.drain(..) {
            let place = (arrival - self.first_pending) as usize;
            let Some(waiting) = self.pending.get_mut(place).and_then(Option::take) else { continue };
            while self.pending.front().is_some_and(Option::is_none) {
                self.pending.pop_front();
                self.first_pending += 1;
            }
            self.settle(arrival, waiting, fate, spare);
        }
        self.decided = decided;
    }

    fn settle(&mut self, arrival: u64, waiting: Waiting, fate: Fate, spare: &mut dyn FnMut(SparseColumn)) {
        let Waiting { id, column, frame, lost_before, start_ns, end_ns } = waiting;
        let mut place = None;
        match fate {
            // An id that has come before: no exposure of its own.
            Fate::Unused(Cause::Duplicate) => match &mut self.building {
                Some(Building { cut, .. }) => cut.duplicates += 1,
                None => self.duplicates += 1,
            },
            Fate::Dot { batch, index } => {
                self.last = Some((id, index));
                if let Some(frame) = frame.filter(|_| self.scan.background_indices.contains(&index)) {
                    self.mix_background(&frame);
                }
                if self.building.as_ref().is_some_and(|building| building.number != batch) {
                    self.close();
                }
                if batch == 0 || batch > u64::from(self.scan.batches) {
                    // The batch of the first trailing dot has no beginning; one beyond the last is not waited for.
                    lose(&mut self.outside, &lost_before);
                    self.outside.expected += 1;
                    *(if batch == 0 { &mut self.outside.settling } else { &mut self.outside.cancelled }) += 1;
                } else {
                    place = Some((batch as u32 - 1, index));
                    let is_scene = self.scan.is_scene(index);
                    let building = self.open(batch, start_ns);
                    lose(&mut building.counts, &lost_before);
                    building.counts.expected += 1;
                    building.end_ns = end_ns;
                    self.fill_to(index);
                    self.add(is_scene, &column);
                    if index + 1 == self.scan.dots {
                        self.close();
                    }
                }
            }
            Fate::Unused(cause) => {
                let is_lead_in = self.last.is_none() && cause == Cause::Unsynchronised;
                let account = match &mut self.building {
                    Some(Building { cut, .. }) if cause != Cause::Unsynchronised => &mut cut.counts,
                    _ => &mut self.outside,
                };
                lose(account, &lost_before);
                account.expected += 1;
                match cause {
                    Cause::Unsynchronised if is_lead_in => account.settling += 1,
                    Cause::Unsynchronised if self.ending => account.cancelled += 1,
                    Cause::Unsynchronised => account.lose(LossCause::Unsynchronised, 1),
                    Cause::Saturated => account.lose(LossCause::Saturated, 1),
                    Cause::Surplus | Cause::Duplicate => account.lose(LossCause::Surplus, 1),
                }
            }
        }
        self.sink.fate(arrival, id, place);
        if let Ok(column) = column {
            spare(column);
        }
    }

    /// The batch under construction, begun where there is none.
    fn open(&mut self, number: u64, start_ns: i64) -> &mut Cut {
        let dots = self.scan.dots as usize;
        let (words, values) = self.usual;
        let residual = dots * self.blank.residual.len();
        let duplicates = &mut self.duplicates;
        let building = self.building.get_or_insert_with(|| Building {
            number,
            cut: Cut {
                batch: number as u32 - 1,
                columns: BatchArrays {
                    word_offsets: Vec::with_capacity(dots + 1),
                    words: Vec::with_capacity(words),
                    masks: Vec::with_capacity(words),
                    values: Vec::with_capacity(values),
                    residual: Vec::with_capacity(residual),
                    discs: Vec::with_capacity(dots),
                    capped: Vec::with_capacity(dots),
                },
                seen: Vec::with_capacity(dots),
                counts: Counts::default(),
                duplicates: std::mem::take(duplicates),
                start_ns,
                end_ns: start_ns,
                problem: None,
            },
        });
        &mut building.cut
    }

    /// Adds dots without light until `index` is the next.
    fn fill_to(&mut self, index: u32) {
        let Some(Building { cut, .. }) = &mut self.building else { return };
        while cut.seen.len() < index as usize {
            cut.columns.push(&self.blank);
            cut.seen.push(false);
        }
    }

    fn add(&mut self, is_scene: bool, column: &Result<SparseColumn, String>) {
        let Some(Building { cut, .. }) = &mut self.building else { return };
        match column {
            Ok(column) => {
                cut.columns.push(if is_scene { column } else { &self.blank });
                cut.seen.push(is_scene);
                cut.counts.averaged += 1;
            }
            Err(problem) => {
                cut.columns.push(&self.blank);
                cut.seen.push(false);
                cut.counts.lose(LossCause::StageFailed, 1);
                cut.problem.get_or_insert_with(|| problem.clone());
            }
        }
    }

    fn close(&mut self) {
        self.fill_to(self.scan.dots);
        let Some(Building { cut, .. }) = self.building.take() else { return };
        self.usual = (cut.columns.words.len(), cut.columns.values.len());
        self.sink.take(cut);
    }

    fn mix_background(&mut self, frame: &Frame) {
        let unpacked = self.format.unpack_into(&frame.data, &mut self.counts).is_ok();
        if unpacked && self.background.push(&self.counts).is_ok() {
            self.background_changed = true;
        }
    }
}

/// Notes exposures of which no frame came.
fn lose(counts: &mut Counts, losses: &[Loss]) {
    for &Loss { frames, cause } in losses {
        counts.expected += frames;
        counts.lose(cause, frames);
    }
}
