//! The VSYNC watcher's thread: hands edges on and shows once a second what the line is like.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use raysweep_core::{DeviceError, DeviceErrorKind, DeviceState, Vsync};
use raysweep_pipeline::{EdgeTracker, Event, Input, Line};
use raysweep_proto::Event as Told;

use super::priority;
use crate::rig::Pace;
use crate::run::board::StatusBoard;
use crate::run::orders::{Order, Orders};

const POLL: Duration = Duration::from_millis(100);
/// How often the line is shown.
const SHOWN_EVERY: Duration = Duration::from_secs(1);

/// The watcher's thread as the run sees it.
pub struct VsyncThread {
    stop: Arc<AtomicBool>,
    /// Whether the watcher's device is being opened again.
    is_lost: Arc<AtomicBool>,
    thread: Option<JoinHandle<Result<(), DeviceError>>>,
}

impl Drop for VsyncThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // Whoever wants to know how it ended has joined it.
            let _ = thread.join();
        }
    }
}

/// Ends the run unless it is told that the watcher ended as it should: also where the watcher panics.
struct Alarm {
    orders: Arc<Orders>,
    armed: bool,
}

impl Drop for Alarm {
    fn drop(&mut self) {
        if self.armed {
            self.orders.give(Order::Fault);
        }
    }
}

/// The line while it is watched. Its tracker knows nothing of the assembler's, which sees the same edges when it gets to
/// them: what is shown must not wait for frames.
struct Meter {
    tracker: EdgeTracker,
    board: Arc<StatusBoard>,
    shown: Instant,
}

impl Meter {
    fn new(line: Line, board: Arc<StatusBoard>) -> Self {
        Self { tracker: EdgeTracker::new(line), board, shown: Instant::now() }
    }

    fn show(&mut self, vsync: &dyn Vsync) {
        if self.shown.elapsed() >= SHOWN_EVERY {
            self.shown = Instant::now();
            self.board.set_vsync_clock(vsync.clock());
            self.board.publish(Told::Vsync(self.tracker.stats()));
        }
    }
}

impl VsyncThread {
    /// Starts to watch.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        mut vsync: Box<dyn Vsync>,
        line: Line,
        pace: Pace,
        board: Arc<StatusBoard>,
        input: Input<Event>,
        orders: Arc<Orders>,
    ) -> Result<Self, DeviceError> {
        let stop = Arc::new(AtomicBool::new(false));
        let is_lost = Arc::new(AtomicBool::new(false));
        let thread = thread::Builder::new()
            .name("vsync".into())
            .spawn({
                let (stop, is_lost) = (stop.clone(), is_lost.clone());
                move || {
                    if pace == Pace::Devices {
                        priority::for_device("vsync");
                    }
                    let mut alarm = Alarm { orders, armed: true };
                    let mut meter = Meter::new(line, board);
                    while !stop.load(Ordering::Relaxed) {
                        match vsync.next_edge(POLL) {
                            Ok(Some(edge)) => {
                                meter.tracker.push(edge);
                                if input.send(Event::Edge(edge)).is_err() {
                                    break;
                                }
                            }
                            Ok(None) => {}
                            Err(error) => return Err(error),
                        }
                        is_lost.store(vsync.state() == DeviceState::Lost, Ordering::Relaxed);
                        meter.show(&*vsync);
                    }
                    alarm.armed = false;
                    Ok(())
                }
            })
            .map_err(|error| DeviceError::new("vsync", DeviceErrorKind::NotReady, error))?;
        Ok(Self { stop, is_lost, thread: Some(thread) })
    }

    /// Waits while the watcher's device is being opened again, unless the run ends. One that stays away ends it.
    pub fn await_watcher(&self, orders: &Orders) {
        while self.is_lost.load(Ordering::Relaxed) && orders.go_on() {
            thread::sleep(POLL);
        }
    }

    /// Ends the thread.
    ///
    /// # Errors
    /// What the watcher failed with, if it did.
    pub fn join(mut self) -> Result<(), DeviceError> {
        self.stop.store(true, Ordering::Relaxed);
        let Some(thread) = self.thread.take() else { return Ok(()) };
        thread.join().unwrap_or_else(|_panic| {
            Err(DeviceError::new(
                "vsync",
                DeviceErrorKind::NotReady,
                "the watcher's thread panicked; the log has its message",
            ))
        })
    }
}
