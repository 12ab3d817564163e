//! The threads: `dots-N` turn frames into columns, `dots` puts the columns in order and divides them into batches.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, Sender, bounded};
use raysweep_core::{Frame, PixelFormat};
use raysweep_transport::dots::{
    Background, BackgroundMean, Correction, DotsError, NoiseFloor, Observation, SparseColumn,
};

use super::background::Backgrounds;
use super::gather::{CutSink, DotScan, Gatherer, Looked, Loss};
use super::stage::{ColumnStage, ColumnWorker};
use crate::pipeline::PipelineError;
use crate::queue::{Input, Policy, QueueError};
use crate::stage::message_of;

/// A frame, and the losses since the previous one.
pub struct Arrival {
    /// The frame; its id is `stamp.seq`.
    pub frame: Frame,
    /// Usually empty.
    pub lost_before: Vec<Loss>,
}

/// How frames are turned into batches.
pub struct DotsFlowConfig {
    /// The scan.
    pub scan: DotScan,
    /// Pixel format of the frames.
    pub format: PixelFormat,
    /// Counts from which a pixel is overexposed.
    pub saturation_dn: u16,
    /// Turns frames into columns.
    pub stage: Arc<dyn ColumnStage>,
    /// The sensor's flat field and hot pixels.
    pub correction: Correction,
    /// The background so far.
    pub background: BackgroundMean,
    /// Noise of a frame above the background.
    pub floor: NoiseFloor,
    /// Number of threads that compute columns; 0: one per processor.
    pub threads: usize,
    /// Largest number of frames waiting for them.
    pub queue_frames: usize,
    /// What happens to a frame when the queue is full.
    pub policy: Policy,
}

/// The input of a flow; frames must arrive in the order of their exposure. Dropping it ends the flow.
pub struct DotsInput {
    queue: Input<(u64, Arrival)>,
    /// Arrival number of the next frame.
    next: u64,
}

impl DotsInput {
    /// Sends a frame, which may be refused according to the flow's policy.
    ///
    /// # Errors
    /// As [`Input::offer`].
    pub fn offer(&mut self, arrival: Arrival) -> Result<(), QueueError<Arrival>> {
        self.queue.offer((self.next, arrival)).map_err(|error| match error {
            QueueError::Full((_, arrival)) => QueueError::Full(arrival),
            QueueError::Closed => QueueError::Closed,
        })?;
        self.next += 1;
        Ok(())
    }
}

/// Turns frames into batches. Ends when its [`DotsInput`] is dropped.
pub struct DotsFlow<S> {
    workers: Vec<JoinHandle<()>>,
    gatherer: JoinHandle<Gathered<S>>,
    is_blind: Arc<AtomicBool>,
}

/// The results of a flow.
pub struct Gathered<S> {
    /// The sink that received the batches.
    pub sink: S,
    /// The background at the end of the flow.
    pub background: BackgroundMean,
    /// Why the stream could not be divided into batches.
    pub error: Option<DotsError>,
}

/// Data shared by the workers.
struct Shop {
    frames: Receiver<(u64, Arrival)>,
    backgrounds: Backgrounds,
    /// Columns for reuse.
    spare: Mutex<Vec<SparseColumn>>,
    scan: DotScan,
    format: PixelFormat,
    saturation_dn: u16,
    floor: NoiseFloor,
}

type Numbered = (u64, Looked);

impl<S: CutSink + 'static> DotsFlow<S> {
    /// Starts the threads; frames go into the returned input.
    ///
    /// # Errors
    /// If the system provides no thread, or the background does not fit the frames.
    pub fn start(config: DotsFlowConfig, sink: S) -> Result<(Self, DotsInput), PipelineError> {
        let DotsFlowConfig {
            scan, format, saturation_dn, stage, correction, background, floor, policy, ..
        } = config;
        let threads = match config.threads {
            0 => thread::available_parallelism().map_or(1, usize::from),
            threads => threads,
        };
        let prepared = Background::new(&correction, background.mean())
            .map_err(|error| PipelineError::Spawn { name: "dots", source: error.into() })?;
        let (queue, frames) = Input::new(config.queue_frames, policy);
        let shop = Arc::new(Shop {
            frames,
            backgrounds: Backgrounds::new(u64::from(scan.dots), Arc::new(prepared)),
            spare: Mutex::default(),
            scan: scan.clone(),
            format,
            saturation_dn,
            floor,
        });
        let is_blind = Arc::new(AtomicBool::new(false));
        let (done, looked) = bounded::<Numbered>(config.queue_frames + threads);
        let mut gatherer = Gatherer::new(scan, format, background, sink);
        let gatherer = spawn("dots".into(), {
            let shop = shop.clone();
            let is_blind = is_blind.clone();
            move || {
                let _closing = Closing(&shop.backgrounds);
                let error = gather(&mut gatherer, &shop, &correction, &looked, &is_blind).err();
                let Gatherer { sink, background, .. } = gatherer;
                Gathered { sink, background, error }
            }
        })?;
        let workers = (0..threads).map(|index| {
            let (shop, done, mut worker) = (shop.clone(), done.clone(), stage.worker());
            spawn(format!("dots-{index}"), move || shop.work(&mut *worker, &done))
        });
        let workers = workers.collect::<Result<_, _>>()?;
        Ok((Self { workers, gatherer, is_blind }, DotsInput { queue, next: 0 }))
    }

    /// A flag, set when the trailing dot is not seen as expected: further frames are counted and discarded.
    pub fn is_blind(&self) -> Arc<AtomicBool> {
        self.is_blind.clone()
    }

    /// Waits until everything sent is processed.
    ///
    /// # Errors
    /// If a thread panicked.
    pub fn join(self) -> Result<Gathered<S>, PipelineError> {
        let worked = self.workers.into_iter().map(JoinHandle::join).filter(Result::is_err).count();
        let gathered = self.gatherer.join().map_err(|_panic| PipelineError::Panicked("dots"))?;
        if worked > 0 { Err(PipelineError::Panicked("dots worker")) } else { Ok(gathered) }
    }
}

/// Releases workers that wait for a background, even if the gatherer panics.
struct Closing<'a>(&'a Backgrounds);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

fn spawn<T: Send + 'static>(
    name: String,
    body: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, PipelineError> {
    let spawned = thread::Builder::new().name(name).spawn(body);
    spawned.map_err(|source| PipelineError::Spawn { name: "dots", source: source.into() })
}

impl Shop {
    /// Processes frames until there are no more.
    fn work(&self, worker: &mut dyn ColumnWorker, done: &Sender<Numbered>) {
        let mut unpacked = Vec::new();
        let mut background: Option<(u64, Arc<Background>)> = None;
        for (number, Arrival { frame, lost_before }) in &self.frames {
            let epoch = self.backgrounds.epoch_of(number);
            if background.as_ref().is_none_or(|(of, _)| *of != epoch) {
                background = self.backgrounds.of(epoch).map(|background| (epoch, background));
            }
            let Some((_, background)) = &background else { return };
            let (seen, column) = self.look(worker, &frame, &mut unpacked, background);
            if done.send((number, Looked { seen, column, frame, lost_before })).is_err() {
                return;
            }
        }
    }

    fn look(
        &self,
        worker: &mut dyn ColumnWorker,
        frame: &Frame,
        unpacked: &mut Vec<u16>,
        background: &Background,
    ) -> (Observation, Result<SparseColumn, String>) {
        // A frame that cannot be read has no observation.
        let unseen = Observation { id: frame.stamp.seq, energy: 0, saturated: true };
        let counts = match counts_of(frame, self.format, unpacked, self.scan.shape.values()) {
            Ok(counts) => counts,
            Err(problem) => return (unseen, Err(problem)),
        };
        let DotScan { shape, trailing_region, .. } = &self.scan;
        let seen = Observation::new(frame.stamp.seq, counts, *shape, trailing_region, self.saturation_dn);
        let mut column = self.spare.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        let made =
            catch_unwind(AssertUnwindSafe(|| worker.column(counts, background, self.floor, &mut column)));
        let made = match made {
            Ok(Ok(())) => Ok(column),
            Ok(Err(error)) => Err(error.to_string()),
            Err(panic) => Err(format!("panicked: {}", message_of(&*panic))),
        };
        (seen.unwrap_or(unseen), made)
    }
}

/// A frame's counts, borrowed if they are already 16 bits wide.
fn counts_of<'a>(
    frame: &'a Frame,
    format: PixelFormat,
    unpacked: &'a mut Vec<u16>,
    values: usize,
) -> Result<&'a [u16], String> {
    let is_wide = cfg!(target_endian = "little") && format.bits() > 8 && format.frame_bytes(4) == 8;
    if is_wide
        && let Ok(counts) = bytemuck::try_cast_slice::<u8, u16>(&frame.data)
        && counts.len() == values
    {
        return Ok(counts);
    }
    unpacked.resize(values, 0);
    format.unpack_into(&frame.data, unpacked).map_err(|error| error.to_string())?;
    Ok(unpacked)
}

/// Restores the order of frames in the workers' results.
fn gather<S: CutSink>(
    gatherer: &mut Gatherer<S>,
    shop: &Shop,
    correction: &Correction,
    looked: &Receiver<Numbered>,
    is_blind: &AtomicBool,
) -> Result<(), DotsError> {
    let mut early: VecDeque<Option<Looked>> = VecDeque::new();
    let mut next = 0;
    let mut spare = |column| shop.spare.lock().unwrap_or_else(PoisonError::into_inner).push(column);
    let mut cut = Ok(());
    for (number, frame) in looked {
        let place = (number - next) as usize;
        if early.len() <= place {
            early.resize_with(place + 1, || None);
        }
        early[place] = Some(frame);
        while let Some(frame) = early.front_mut().and_then(Option::take) {
            early.pop_front();
            if let Err(error) = gatherer.take(frame, &mut spare) {
                is_blind.store(true, Ordering::Relaxed);
                cut = Err(error);
            }
            shop.backgrounds.decided(next, || {
                let mean = gatherer.changed_background()?;
                Background::new(correction, mean).map(Arc::new).ok()
            });
            next += 1;
        }
    }
    let finished = gatherer.finish(&mut spare);
    cut.and(finished)
}
