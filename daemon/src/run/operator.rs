//! The operator of a projector that no driver reaches: its driver's questions hold the run, `continue` answers them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::thread::{self, JoinHandle};

use raysweep_core::{DeviceError, DeviceErrorKind, Pattern};
use raysweep_drivers::projector::external::{Request, Wanted};
use raysweep_proto::{Event, RunState};

use super::board::Board;
use super::orders::{Order, Orders};

/// The thread that puts the projector's questions to the operator. It ends with the projector.
pub struct Operator {
    dismissed: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Operator {
    /// Puts `questions` to the operator of a run.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        questions: Receiver<Request>,
        orders: Arc<Orders>,
        board: Arc<Board>,
    ) -> Result<Self, DeviceError> {
        let dismissed = Arc::new(AtomicBool::new(false));
        let thread = thread::Builder::new()
            .name("operator".into())
            .spawn({
                let dismissed = dismissed.clone();
                move || {
                    for question in questions {
                        match dismissed.load(Ordering::Relaxed) {
                            true => tell(question, &board),
                            false => ask(question, &orders, &board),
                        }
                    }
                }
            })
            .map_err(|error| DeviceError::new("projector", DeviceErrorKind::NotReady, error))?;
        Ok(Self { dismissed, thread: Some(thread) })
    }

    /// From now on the operator is told what to do, and nobody waits until it is done.
    pub fn dismiss(&self) {
        self.dismissed.store(true, Ordering::Relaxed);
    }
}

impl Drop for Operator {
    fn drop(&mut self) {
        if let Some(thread) = self.thread.take() {
            // A panic of it has been logged, and refuses what was asked.
            let _ = thread.join();
        }
    }
}

/// Holds the run until the operator lets it go on.
fn ask(question: Request, orders: &Orders, board: &Board) {
    let text = task(&question.wanted);
    // Who lets a run go on that was held for another reason does not answer this.
    orders.wait_while_paused();
    orders.give(Order::Pause);
    if orders.go_on() {
        // Held already where somebody held it in this moment.
        let _ = board.go(RunState::Paused);
        tracing::info!("waiting for the operator: {text}");
        board.publish(Event::Ask { text: format!("{text}, then `raysweep continue`") });
        orders.wait_while_paused();
    }
    match orders.go_on() {
        true => question.done(),
        false => question.refuse("the run was ended before"),
    }
}

/// Says what is left to do once the run is over.
fn tell(question: Request, board: &Board) {
    let text = task(&question.wanted);
    board.publish(Event::Ask { text: format!("{text}: the run is over and does not wait for it") });
    question.refuse("the run is over and did not wait for it");
}

fn task(wanted: &Wanted) -> String {
    match wanted {
        Wanted::Pattern(Pattern::White) => "make the projector show a white picture".into(),
        Wanted::Pattern(pattern) => format!("make the projector show {pattern:?}"),
        Wanted::Dark => "turn the projector's light off, or cover its lens".into(),
    }
}
