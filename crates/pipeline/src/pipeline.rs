//! The threads: `assembler` turns events into units, workers run the stages, `sink` receives everything in order.

use std::any::Any;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, Sender, bounded};
use ndarray::Array2;
use raysweep_core::{Counts, SettingsId, VsyncStats};

use crate::assembler::{Assembler, AssemblerConfig, Decision, Event, Failure};
use crate::queue::{Input, Policy};
use crate::stage::{Stage, StageError};
use crate::unit::Unit;

/// How large the pipeline is.
#[derive(Debug, Clone, Copy)]
pub struct PipelineConfig {
    /// Events that may wait for the assembler.
    pub queue_events: usize,
    /// What happens to a frame when so many do.
    pub policy: Policy,
    /// Units that may be under way between the assembler and the sink.
    pub units_under_way: usize,
    /// Threads that run stages; 0: one a processor.
    pub worker_threads: usize,
}

/// Why the pipeline could not start or did not end well.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// The system gave no thread.
    #[error("cannot start thread {name}: {source}; raise the unit's TasksMax or the user's process limit")]
    Spawn {
        /// The thread's name.
        name: &'static str,
        /// What the system said.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A thread of the pipeline panicked: a defect.
    #[error("the {0} thread panicked; the log has its message. What was stored stays stored")]
    Panicked(&'static str),
}

/// What the sink receives, in the order in which it was assembled.
pub enum Ordered {
    /// A point's unit, and its image after all stages or why it has none.
    Unit(Unit, Result<Array2<f32>, StageError>),
    /// An attempt without all its frames.
    Failed(SettingsId, Failure, Counts),
    /// A pass is over; frames outside any attempt, and the line so far.
    Flushed(Counts, VsyncStats),
}

/// Receives a run in order, on a thread of its own.
pub trait Sink: Send {
    /// Takes the next item.
    fn take(&mut self, item: Ordered);

    /// Nothing more comes, in order or because the assembler has failed.
    fn end(&mut self);
}

/// A running pipeline. It ends when every clone of its [`Input`] is dropped.
pub struct Pipeline<S> {
    assembler: JoinHandle<()>,
    sink: JoinHandle<S>,
}

type Numbered = (u64, Ordered);

impl<S: Sink + 'static> Pipeline<S> {
    /// Starts the threads; events go into the returned input.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        config: PipelineConfig,
        assembler: AssemblerConfig,
        stages: Arc<[Box<dyn Stage>]>,
        sink: S,
    ) -> Result<(Self, Input<Event>), PipelineError> {
        let workers = rayon::ThreadPoolBuilder::new()
            .num_threads(config.worker_threads)
            .thread_name(|index| format!("stage-{index}"))
            .build()
            .map_err(|error| PipelineError::Spawn { name: "stage", source: error.into() })?;
        let (input, events) = Input::new(config.queue_events, config.policy);
        let under_way = config.units_under_way.max(1);
        // Every item under way holds a permit, so the channel to the sink never fills and no worker waits in it.
        let (done, items) = bounded::<Numbered>(under_way);
        let (give_back, permits) = bounded::<()>(under_way);
        for _ in 0..under_way {
            let _ = give_back.send(());
        }
        let sink = spawn("sink", move || run_sink(sink, &items, &give_back))?;
        let assembler = spawn("assembler", move || {
            run_assembler(Assembler::new(assembler), &events, &Dispatch { workers, stages, done, permits });
        })?;
        Ok((Self { assembler, sink }, input))
    }

    /// Waits for the end of everything sent and returns the sink.
    ///
    /// # Errors
    /// When a thread of the pipeline panicked.
    pub fn join(self) -> Result<S, PipelineError> {
        let assembler = self.assembler.join();
        let sink = self.sink.join().map_err(|_panic| PipelineError::Panicked("sink"))?;
        assembler.map_err(|_panic| PipelineError::Panicked("assembler"))?;
        Ok(sink)
    }
}

fn spawn<T: Send + 'static>(
    name: &'static str,
    body: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, PipelineError> {
    thread::Builder::new()
        .name(name.into())
        .spawn(body)
        .map_err(|source| PipelineError::Spawn { name, source: source.into() })
}

/// The way from the assembler to the sink.
struct Dispatch {
    workers: rayon::ThreadPool,
    stages: Arc<[Box<dyn Stage>]>,
    done: Sender<Numbered>,
    permits: Receiver<()>,
}

fn run_assembler(mut assembler: Assembler, events: &Receiver<Event>, dispatch: &Dispatch) {
    let mut seq = 0;
    for event in events {
        assembler.push(event, |decision| {
            if dispatch.permits.recv().is_err() {
                return;
            }
            dispatch.send(seq, decision);
            seq += 1;
        });
    }
}

impl Dispatch {
    fn send(&self, seq: u64, decision: Decision) {
        let done = self.done.clone();
        match decision {
            Decision::Unit(unit) => {
                let stages = self.stages.clone();
                self.workers.spawn(move || {
                    let image = run_stages(&stages, &unit);
                    let _ = done.send((seq, Ordered::Unit(unit, image)));
                });
            }
            Decision::Failed(id, failure, counts) => {
                let _ = done.send((seq, Ordered::Failed(id, failure, counts)));
            }
            Decision::Flushed(outside, vsync) => drop(done.send((seq, Ordered::Flushed(outside, vsync)))),
        }
    }
}

/// Passes a unit's mean image through all stages. A stage that panics costs its unit, never the run.
///
/// # Errors
/// What the first stage that gave up, or panicked, said.
pub fn run_stages(stages: &[Box<dyn Stage>], unit: &Unit) -> Result<Array2<f32>, StageError> {
    stages.iter().try_fold(unit.mean(), |image, stage| {
        catch_unwind(AssertUnwindSafe(|| stage.apply(unit, image))).unwrap_or_else(|panic| {
            Err(StageError { stage: stage.name().into(), what: format!("panicked: {}", message_of(&*panic)) })
        })
    })
}

/// What a panic said.
pub fn message_of(panic: &(dyn Any + Send)) -> &str {
    panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message")
}

/// Puts what the workers finish back into the order in which it was assembled.
fn run_sink<S: Sink>(mut sink: S, items: &Receiver<Numbered>, give_back: &Sender<()>) -> S {
    let mut next = 0;
    let mut early = BTreeMap::new();
    for (seq, item) in items {
        early.insert(seq, item);
        while let Some(item) = early.remove(&next) {
            sink.take(item);
            next += 1;
            let _ = give_back.send(());
        }
    }
    sink.end();
    sink
}
