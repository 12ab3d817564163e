//! Plays a path with the mirror while the camera takes its frames, and has the operator place subjects.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;

use raysweep_core::{Camera, Clock, FramePool, MirrorPath, Subject};
use raysweep_pipeline::dots::{Arrival, Loss};
use raysweep_pipeline::{PipelineError, message_of};

use super::camera::{FrameRefused, NextWanted, Source};
use super::motion::Motion;
use crate::devices::{operator, priority};
use crate::rig::{Pace, Stand};
use crate::run::board::StatusBoard;
use crate::run::error::RunError;
use crate::run::orders::{Order, Orders};

/// What became of a path.
pub struct Played {
    /// What was lost after the last frame.
    pub lost: Vec<Loss>,
    /// Whether a pause ended it: the mirror is parked, and what it did not come to show is for another path.
    pub is_held: bool,
}

/// The devices of a run and its communication with the operator.
pub struct Player<'a> {
    pub orders: &'a Orders,
    pub board: &'a StatusBoard,
    pub motion: &'a mut Motion,
    pub camera: &'a mut dyn Camera,
    pub pool: FramePool,
    pub stand: Stand,
    pub clock: Clock,
    pub pace: Pace,
}

impl Player<'_> {
    /// Places a subject, one of `planes` planes or the scene, before the camera; waits for the operator if needed.
    ///
    /// # Errors
    /// For a plane that the rig does not have.
    pub fn place(&self, subject: Subject, planes: usize) -> Result<(), RunError> {
        Ok(operator::place(&self.stand, subject, planes, self.orders, self.board)?)
    }

    /// Whether the camera is a recording, which may end.
    pub fn is_recorded(&self) -> bool {
        matches!(self.stand, Stand::Recorded)
    }

    /// Plays a path `rounds` times while the camera takes its frames. Ends with the path or, without a mirror, after
    /// `frames` frames; earlier if `enough` is set or the run is told to end or to pause. A recording rather waits for the
    /// end of a pause.
    ///
    /// # Errors
    /// An error of the mirror or the camera.
    pub fn play(
        &mut self,
        path: &MirrorPath,
        rounds: u32,
        frames: u64,
        enough: &AtomicBool,
        deliver: &mut (dyn FnMut(Arrival) -> Result<(), FrameRefused> + Send),
    ) -> Result<Played, RunError> {
        let orders = self.orders;
        let is_driven = self.motion.is_driven();
        // Without a mirror, no path goes on after the frames, and the next frame of a recording is the next pass's.
        let (path_over, camera_over) = (AtomicBool::new(!is_driven), AtomicBool::new(false));
        if !self.motion.start(path, rounds, &|| orders.now() == Order::Go)? {
            return Ok(Played { lost: Vec::new(), is_held: orders.go_on() });
        }
        let mut source = Source { camera: &mut *self.camera, pool: &self.pool, pace: self.pace };
        let (pace, is_simulated) = (self.pace, matches!(self.stand, Stand::Simulated(_)));
        let taken = AtomicU64::new(0);
        let is_held = AtomicBool::new(false);
        let wanted = || {
            if !is_driven {
                orders.wait_while_paused();
            }
            let is_over = match is_driven {
                true => path_over.load(Ordering::Relaxed),
                false => enough.load(Ordering::Relaxed) || taken.load(Ordering::Relaxed) >= frames,
            };
            match (orders.go_on(), is_over) {
                (true, false) => NextWanted::Frames,
                (true, true) if is_driven => NextWanted::Rest,
                _ => NextWanted::Nothing,
            }
        };
        let mut deliver = |arrival| {
            taken.fetch_add(1, Ordering::Relaxed);
            deliver(arrival)
        };
        let clock = self.clock.clone();
        let (fed, taken) = thread::scope(|scope| -> Result<_, PipelineError> {
            let camera = thread::Builder::new()
                .name("camera".into())
                .spawn_scoped(scope, || {
                    // A simulated camera computes its frames in this thread, which must yield to the workers.
                    if pace == Pace::Devices && !is_simulated {
                        priority::for_device("camera");
                    }
                    let taken = catch_unwind(AssertUnwindSafe(|| source.take(&wanted, &mut deliver)));
                    camera_over.store(true, Ordering::Relaxed);
                    // A virtual clock stops if nobody reads the camera, but the mirror must come to rest.
                    source.idle(&|| path_over.load(Ordering::Relaxed));
                    taken.unwrap_or_else(|panic| resume_unwind(panic))
                })
                .map_err(|source| PipelineError::Spawn { name: "camera", source: source.into() })?;
            let motion = &mut *self.motion;
            let mirror = thread::Builder::new().name("mirror".into()).spawn_scoped(scope, || {
                // A controller that runs out of samples lets the mirror stand, whatever camera sees it.
                if pace == Pace::Devices && is_driven {
                    priority::for_device("mirror");
                }
                let _over = SetOnDrop(&path_over);
                let go_on = || {
                    let order = orders.now();
                    is_held.store(order == Order::Pause, Ordering::Relaxed);
                    order == Order::Go
                        && !enough.load(Ordering::Relaxed)
                        && !camera_over.load(Ordering::Relaxed)
                };
                let fed = motion.play(&clock, &go_on);
                if fed.is_err() {
                    orders.give(Order::Fault);
                }
                fed
            });
            let mirror = mirror.map_err(|source| {
                // Nobody moves the mirror: the camera has nothing to wait for.
                path_over.store(true, Ordering::Relaxed);
                orders.give(Order::Fault);
                PipelineError::Spawn { name: "mirror", source: source.into() }
            })?;
            let fed = mirror.join();
            if fed.is_err() {
                orders.give(Order::Fault);
            }
            Ok((fed, camera.join()))
        })?;
        match (&fed, &taken) {
            (Err(_) | Ok(Err(_)), Ok(Err(error))) => {
                tracing::error!(%error, "the camera failed as well as the mirror");
            }
            (Err(_) | Ok(Err(_)), Err(panic)) => {
                tracing::error!(
                    panic = message_of(&**panic),
                    "the camera's thread failed as well as the mirror"
                );
            }
            _ => {}
        }
        fed.map_err(panicked)??;
        Ok(Played { lost: taken.map_err(panicked)??, is_held: is_held.into_inner() })
    }
}

fn panicked(panic: Box<dyn Any + Send>) -> RunError {
    RunError::Panicked(message_of(&*panic).to_owned())
}

/// Tells the other thread that this one is over, even if it panics.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
