//! Combines columns, in the order of their frames, into batches. Every frame is counted exactly once.

use std::collections::VecDeque;

use raysweep_core::{Counts, Frame, LossCause, PixelFormat};
use raysweep_transport::dots::{
    BackgroundMean, BatchArrays, Cause, Decided, DotsError, Fate, FrameShape, Observation, Region,
    SparseColumn, SyncSettings, Synchroniser, pulse_threshold,
};

/// Number of batches from which the trailing dot's brightness is learnt before the first batch is cut.
const LEARNT_FROM_BATCHES: usize = 2;
/// Number of batches' frames that may be given up while too many are lost to learn from.
const MOST_GIVEN_UP_BATCHES: u64 = 20;
/// Largest distance of a waiting frame from its position expected from the last trailing dot: a drift of one frame
/// per batch, over the two batches for which it may wait.
const DRIFT_FRAMES: i64 = 2;
/// Largest number of batches whose frames wait for their index.
const BATCHES_WAITING: usize = 2;

/// Consecutive exposures without a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Loss {
    /// Their number.
    pub frames: u64,
    /// The cause.
    pub cause: LossCause,
}

/// The parameters of a scan.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DotScan {
    /// Size of the frames.
    pub shape: FrameShape,
    /// Number of frames per batch.
    pub dots: u32,
    /// Index of the frame that shows the trailing dot.
    pub trailing_index: u32,
    /// Region of the frame in which this dot lands.
    pub trailing_region: Region,
    /// Indices of the frames whose light goes into the beam dump.
    pub background_indices: Vec<u32>,
    /// Number of batches requested.
    pub batches: u32,
}

impl DotScan {
    /// Whether a frame of the batch shows the scene: neither trailing dot nor beam dump.
    pub fn is_scene(&self, index: u32) -> bool {
        index != self.trailing_index && !self.background_indices.contains(&index)
    }

    /// Most frames of the beam dump, and of their neighbours, that are kept until their index is known. A pool needs as
    /// many buffers beside those in the workers, or the camera waits for ever.
    pub fn frames_kept(&self) -> usize {
        let near = self.near_background().iter().filter(|is_near| **is_near).count();
        // Beyond whole batches wait a few frames by which batches drift.
        BATCHES_WAITING * (near + DRIFT_FRAMES as usize)
    }

    /// Whether the frame expected to have an index may be one of the beam dump, `[dots]`.
    fn near_background(&self) -> Vec<bool> {
        let dots = i64::from(self.dots);
        let mut near = vec![false; self.dots as usize];
        for &index in &self.background_indices {
            for drift in -DRIFT_FRAMES..=DRIFT_FRAMES {
                near[(i64::from(index) + drift).rem_euclid(dots) as usize] = true;
            }
        }
        near
    }
}

/// A batch of columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Cut {
    /// Its number among the requested batches, from 0.
    pub batch: u32,
    /// A column for each frame. Columns of missing frames, and of frames that do not show the scene, have no light.
    pub columns: BatchArrays,
    /// Whether each column shows the scene, `[dots]`.
    pub seen: Vec<bool>,
    /// What became of its frames.
    pub counts: Counts,
    /// Number of frames that arrived twice.
    pub duplicates: u64,
    /// Start of its first frame's exposure on the host's clock.
    pub start_ns: i64,
    /// Time when its last frame was complete on the host.
    pub end_ns: i64,
    /// Error message of the first of its frames that could not be denoised.
    pub problem: Option<String>,
    /// Whether its last dots are missing because the stream has ended.
    pub is_cut_short: bool,
}

/// Receives batches in order.
pub trait CutSink: Send {
    /// Takes the next batch.
    fn take(&mut self, cut: Cut);

    /// Counts frames that belong to no requested batch.
    fn outside(&mut self, counts: Counts);

    /// Called for each raw frame, in the order of arrival.
    fn frame(&mut self, _frame: &Frame) {}

    /// Called when the fate of a frame is known: `_arrival` is its number in the order of [`Self::frame`], from 0.
    /// `_place` is its batch among those requested and its index; `None` if it has none.
    fn fate(&mut self, _arrival: u64, _id: u64, _place: Option<(u32, u32)>) {}
}

/// A frame as processed by a worker.
pub(super) struct Looked {
    pub seen: Observation,
    pub column: Result<SparseColumn, String>,
    pub frame: Frame,
    pub lost_before: Vec<Loss>,
}

/// A frame whose index is still uncertain.
struct Waiting {
    id: u64,
    column: Result<SparseColumn, String>,
    /// Kept only if it may be a frame of the beam dump.
    frame: Option<Frame>,
    lost_before: Vec<Loss>,
    start_ns: i64,
    end_ns: i64,
}

/// The batch being assembled.
struct Building {
    /// The synchroniser's batch number.
    number: u64,
    cut: Cut,
}

/// State of dividing the stream into batches.
enum Cutter {
    /// Not started: the brightness of the trailing dot is still unknown.
    Learning {
        /// The frames so far.
        run: Vec<Observation>,
        /// Frames before them, among which there was no trailing dot, while others were lost.
        given_up: u64,
    },
    Cutting(Box<Synchroniser>),
    /// Impossible: the trailing dot was not seen.
    Blind,
}

pub(super) struct Gatherer<S> {
    scan: DotScan,
    format: PixelFormat,
    pub sink: S,
    cutter: Cutter,
    pending: VecDeque<Option<Waiting>>,
    /// Number of pending frames whose pixels are kept, and the most that there may be.
    kept: usize,
    most_kept: usize,
    near_background: Vec<bool>,
    first_pending: u64,
    decided: Vec<Decided>,
    building: Option<Building>,
    /// Id and index of the last frame with an index.
    last: Option<(u64, u32)>,
    outside: Counts,
    duplicates: u64,
    pub background: BackgroundMean,
    /// Whether the background has changed since it was last requested.
    background_changed: bool,
    counts: Vec<u16>,
    blank: SparseColumn,
    /// Number of words and values in the previous batch, as an estimate for the next.
    usual: (usize, usize),
    ending: bool,
}

/// Whether exposures are missing between the frames.
fn has_gaps(run: &[Observation]) -> bool {
    run.windows(2).any(|pair| pair[1].id > pair[0].id + 1)
}

impl<S: CutSink> Gatherer<S> {
    pub fn new(scan: DotScan, format: PixelFormat, background: BackgroundMean, sink: S) -> Self {
        let shape = scan.shape;
        let learning = LEARNT_FROM_BATCHES * scan.dots as usize + 2;
        Self {
            cutter: Cutter::Learning { run: Vec::with_capacity(learning), given_up: 0 },
            pending: VecDeque::with_capacity(2 * learning),
            kept: 0,
            most_kept: scan.frames_kept(),
            near_background: scan.near_background(),
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

    /// Processes the next frame; passes columns that are no longer needed to `spare`.
    ///
    /// # Errors
    /// If the trailing dot is not seen as expected.
    pub fn take(&mut self, looked: Looked, spare: &mut dyn FnMut(SparseColumn)) -> Result<(), DotsError> {
        let Looked { seen, column, frame, lost_before } = looked;
        if let Cutter::Blind = self.cutter {
            // Processed even in this state, so that it is counted.
            lose(&mut self.outside, &lost_before);
            self.outside.expected += 1;
            self.outside.cancelled += 1;
            return Ok(());
        }
        self.sink.frame(&frame);
        let (start_ns, end_ns) = (frame.stamp.exposure_start_ns, frame.stamp.host_ns);
        let frame = self.may_be_background(seen.id).then_some(frame);
        self.kept += usize::from(frame.is_some());
        self.pending.push_back(Some(Waiting { id: seen.id, column, frame, lost_before, start_ns, end_ns }));
        self.decided.clear();
        match &mut self.cutter {
            Cutter::Cutting(synchroniser) => self.decided.extend_from_slice(synchroniser.push(seen)),
            Cutter::Learning { run, .. } => {
                run.push(seen);
                if run.len() > LEARNT_FROM_BATCHES * self.scan.dots as usize {
                    self.begin_cutting(true)?;
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
            Cutter::Learning { run, .. } if !run.is_empty() => self.begin_cutting(false),
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
        // Frames left undecided after an error count as not needed.
        for (arrival, waiting) in (self.first_pending..).zip(self.pending.drain(..)) {
            let Some(waiting) = waiting else { continue };
            lose(&mut self.outside, &waiting.lost_before);
            self.outside.expected += 1;
            self.outside.cancelled += 1;
            self.sink.fate(arrival, waiting.id, None);
        }
        self.sink.outside(std::mem::take(&mut self.outside));
        learnt
    }

    /// The background, if it has changed since the last call.
    pub fn changed_background(&mut self) -> Option<&[f32]> {
        std::mem::take(&mut self.background_changed).then(|| self.background.mean())
    }

    /// Ends the learning, or goes on with it if there was no trailing dot that could not have been lost; it cannot go on
    /// unless there are `more` frames.
    fn begin_cutting(&mut self, more: bool) -> Result<(), DotsError> {
        let Cutter::Learning { mut run, mut given_up } = std::mem::replace(&mut self.cutter, Cutter::Blind)
        else {
            return Ok(());
        };
        let dots = self.scan.dots;
        let most_given_up = MOST_GIVEN_UP_BATCHES * u64::from(dots);
        let threshold = match pulse_threshold(&run) {
            Err(DotsError::NoDot { .. }) if more && has_gaps(&run) && given_up < most_given_up => {
                let fate = Fate::Unused(Cause::Unsynchronised);
                let oldest = (given_up..).zip(run.drain(..dots as usize));
                self.decided.extend(oldest.map(|(arrival, _)| Decided { arrival, fate }));
                given_up += u64::from(dots);
                self.cutter = Cutter::Learning { run, given_up };
                return Ok(());
            }
            threshold => threshold?,
        };
        let settings =
            SyncSettings { frames_per_batch: dots, trailing_index: self.scan.trailing_index, threshold };
        let mut synchroniser = Synchroniser::new(settings)?.after(given_up);
        for seen in run {
            self.decided.extend_from_slice(synchroniser.push(seen));
        }
        self.cutter = Cutter::Cutting(Box::new(synchroniser));
        Ok(())
    }

    /// Whether a frame that has just arrived may be one of the beam dump.
    fn may_be_background(&self, id: u64) -> bool {
        let Some((last_id, last_index)) = self.last else { return false };
        let expected = (u64::from(last_index) + id.saturating_sub(last_id)) % u64::from(self.scan.dots);
        self.kept < self.most_kept && self.near_background[expected as usize]
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
        self.kept -= usize::from(frame.is_some());
        let mut place = None;
        match fate {
            // Its id has arrived before, so it is not an exposure of its own.
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
                    // The batch of the first trailing dot has no beginning; batches beyond the last are not needed.
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

    /// The batch being assembled; starts one if there is none.
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
                is_cut_short: false,
            },
        });
        &mut building.cut
    }

    /// Adds dots without light until `index` is the next one.
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
        let is_ending = self.ending;
        if let Some(Building { cut, .. }) = &mut self.building {
            cut.is_cut_short = is_ending && cut.seen.len() < self.scan.dots as usize;
        }
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

/// Counts exposures without a frame.
fn lose(counts: &mut Counts, losses: &[Loss]) {
    for &Loss { frames, cause } in losses {
        counts.expected += frames;
        counts.lose(cause, frames);
    }
}
