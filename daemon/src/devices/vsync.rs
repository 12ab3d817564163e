//! The VSYNC watcher's thread: forwards edges and publishes the state of the line once a second.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use raysweep_core::{DeviceError, DeviceErrorKind, DeviceState, Vsync};
use raysweep_pipeline::{DeviceEvent, EdgeTracker, Input, Line};
use raysweep_proto::Event as Told;

use super::priority;
use crate::rig::Pace;
use crate::run::board::StatusBoard;
use crate::run::orders::{Order, Orders};

const POLL: Duration = Duration::from_millis(100);
/// Interval between published states of the line.
const SHOWN_EVERY: Duration = Duration::from_secs(1);

/// Handle of the watcher's thread.
pub struct VsyncThread {
    stop: Arc<AtomicBool>,
    /// Whether the watcher's device is being reopened.
    is_lost: Arc<AtomicBool>,
    thread: Option<JoinHandle<Result<(), DeviceError>>>,
}

impl Drop for VsyncThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The result is only needed by callers of `join`.
            let _ = thread.join();
        }
    }
}

/// Ends the run, even if the watcher panics, unless it is told that the watcher ended normally.
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

/// The state of the line while it is watched. Its tracker is independent of the assembler's, which sees the same
/// edges later: the published state must not wait for frames.
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
    /// Starts watching.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start(
        mut vsync: Box<dyn Vsync>,
        line: Line,
        pace: Pace,
        board: Arc<StatusBoard>,
        input: Input<DeviceEvent>,
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
                                if input.send(DeviceEvent::Edge(edge)).is_err() {
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

    /// Waits while the watcher's device is being reopened, unless the run ends. If the device does not come back, the
    /// run ends.
    pub fn await_watcher(&self, orders: &Orders) {
        while self.is_lost.load(Ordering::Relaxed) && orders.go_on() {
            thread::sleep(POLL);
        }
    }

    /// Ends the thread.
    ///
    /// # Errors
    /// The watcher's error, if it failed.
    pub fn join(mut self) -> Result<(), DeviceError> {
        self.stop.store(true, Ordering::Relaxed);
        let Some(thread) = self.thread.take() else { return Ok(()) };
        thread.join().unwrap_or_else(|_panic| {
            Err(DeviceError::new(
                "vsync",
                DeviceErrorKind::Disconnected,
                "the watcher's thread panicked; the log has its message",
            ))
        })
    }
}
