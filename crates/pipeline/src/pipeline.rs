//! The threads: `assembler` turns events into units, workers run the stages, `sink` receives everything in order.

use std::collections::BTreeMap;
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, Sender, bounded};
use ndarray::Array2;
use raysweep_core::{Counts, PointUnderWay, SettingsId, VsyncStats};

use crate::assembler::{Assembler, AssemblerConfig, Decision, DeviceEvent, Failure};
use crate::queue::{Input, Policy};
use crate::stage::{StageError, Stages, run_stages};
use crate::unit::Unit;

/// The size of the pipeline.
#[derive(Debug, Clone, Copy)]
pub struct PipelineConfig {
    /// Largest number of events waiting for the assembler.
    pub queue_events: usize,
    /// What happens to a frame when the queue is full.
    pub policy: Policy,
    /// Largest number of units between the assembler and the sink.
    pub units_under_way: usize,
    /// Number of threads that run stages; 0: one per processor.
    pub worker_threads: usize,
}

/// Why the pipeline could not start or failed.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// The system could not create a thread.
    #[error("cannot start thread {name}: {source}; raise the unit's TasksMax or the user's process limit")]
    Spawn {
        /// The thread's name.
        name: &'static str,
        /// The system's error.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A thread of the pipeline panicked, which is a bug.
    #[error("the {0} thread panicked, which is a bug; see the log. The stored data are kept")]
    Panicked(&'static str),
}

/// The items that the sink receives, in the order of assembly.
pub enum Ordered {
    /// A point's unit, with its image after all stages or the error that prevented it.
    Unit(Unit, Result<Array2<f32>, StageError>),
    /// An attempt that lacks frames.
    Failed(SettingsId, Failure, Counts),
    /// A long attempt goes on.
    UnderWay(PointUnderWay),
    /// A pass is over; counts of frames outside any attempt, and statistics of the line so far.
    Flushed(Counts, VsyncStats),
}

/// Receives a run's results in order, on its own thread.
pub trait Sink: Send {
    /// Takes the next item.
    fn take(&mut self, item: Ordered);

    /// Called when no more items will come, either at the regular end or because the assembler has failed.
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
    /// If the system cannot create a thread.
    pub fn start(
        config: PipelineConfig,
        assembler: AssemblerConfig,
        stages: Stages,
        sink: S,
    ) -> Result<(Self, Input<DeviceEvent>), PipelineError> {
        let workers = rayon::ThreadPoolBuilder::new()
            .num_threads(config.worker_threads)
            .thread_name(|index| format!("stage-{index}"))
            .build()
            .map_err(|error| PipelineError::Spawn { name: "stage", source: error.into() })?;
        let (input, events) = Input::new(config.queue_events, config.policy);
        let under_way = config.units_under_way.max(1);
        // Every item under way holds a permit, so the channel to the sink never fills and no worker has to wait for
        // it.
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

    /// Waits until everything sent is processed and returns the sink.
    ///
    /// # Errors
    /// If a thread of the pipeline panicked.
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

/// Hands items from the assembler to the workers and the sink.
struct Dispatch {
    workers: rayon::ThreadPool,
    stages: Stages,
    done: Sender<Numbered>,
    permits: Receiver<()>,
}

fn run_assembler(mut assembler: Assembler, events: &Receiver<DeviceEvent>, dispatch: &Dispatch) {
    let mut seq = 0;
    for event in events {
        assembler.push(event, |decision| {
            let has_permit = match decision {
                // Nobody waits for progress: frames would be lost while the sink waits for its disk.
                Decision::UnderWay(_) => dispatch.permits.try_recv().is_ok(),
                _ => dispatch.permits.recv().is_ok(),
            };
            if !has_permit {
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
            Decision::UnderWay(frames) => drop(done.send((seq, Ordered::UnderWay(frames)))),
            Decision::Flushed(outside, vsync) => drop(done.send((seq, Ordered::Flushed(outside, vsync)))),
        }
    }
}

/// Restores the order of assembly in the workers' results.
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
