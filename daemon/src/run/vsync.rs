//! The VSYNC watcher's thread: hands edges on.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use raysweep_core::{DeviceError, DeviceErrorKind, Vsync};
use raysweep_pipeline::{Event, Input};

use super::orders::{Order, Orders};

const POLL: Duration = Duration::from_millis(100);

/// The watcher's thread as the run sees it.
pub struct VsyncThread {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Result<(), DeviceError>>,
}

impl VsyncThread {
    /// Starts to watch.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        mut vsync: Box<dyn Vsync>,
        input: Input<Event>,
        orders: Arc<Orders>,
    ) -> Result<Self, DeviceError> {
        let stop = Arc::new(AtomicBool::new(false));
        let thread = thread::Builder::new()
            .name("vsync".into())
            .spawn({
                let stop = stop.clone();
                move || {
                    while !stop.load(Ordering::Relaxed) {
                        match vsync.next_edge(POLL) {
                            Ok(Some(edge)) => {
                                if input.send(Event::Edge(edge)).is_err() {
                                    break;
                                }
                            }
                            Ok(None) => {}
                            Err(error) => {
                                orders.give(Order::Fault);
                                return Err(error);
                            }
                        }
                    }
                    Ok(())
                }
            })
            .map_err(|error| DeviceError::new("vsync", DeviceErrorKind::NotReady, error))?;
        Ok(Self { stop, thread })
    }

    /// Ends the thread.
    ///
    /// # Errors
    /// What the watcher failed with, if it did.
    pub fn join(self) -> Result<(), DeviceError> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_else(|_panic| {
            Err(DeviceError::new(
                "vsync",
                DeviceErrorKind::NotReady,
                "the watcher's thread panicked; the log has its message",
            ))
        })
    }
}
