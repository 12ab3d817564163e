//! The operator of a projector without a driver, and of what stands before a camera: questions pause the run, and
//! `continue` answers them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::thread::{self, JoinHandle};

use raysweep_core::{DeviceError, DeviceErrorKind, Subject};
use raysweep_drivers::projector::external::{ShowRequest, WantedPicture};
use raysweep_proto::{Event, Question};

use crate::rig::Stand;
use crate::run::board::StatusBoard;
use crate::run::orders::{Order, Orders};

/// The thread that passes the projector's questions to the operator. It ends with the projector.
pub struct Operator {
    dismissed: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Operator {
    /// Starts passing `questions` to the operator of a run.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start(
        questions: Receiver<ShowRequest>,
        orders: Arc<Orders>,
        board: Arc<StatusBoard>,
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
                            false => answer(question, &orders, &board),
                        }
                    }
                }
            })
            .map_err(|error| DeviceError::new("projector", DeviceErrorKind::NotReady, error))?;
        Ok(Self { dismissed, thread: Some(thread) })
    }

    /// From now on, the operator is only told what to do; nobody waits for it.
    pub fn dismiss(&self) {
        self.dismissed.store(true, Ordering::Relaxed);
    }
}

impl Drop for Operator {
    fn drop(&mut self) {
        if let Some(thread) = self.thread.take() {
            // A panic has already been logged; the pending request is refused.
            let _ = thread.join();
        }
    }
}

/// Answers the projector's question once the operator has.
fn answer(question: ShowRequest, orders: &Orders, board: &StatusBoard) {
    match ask(&task(&question.wanted), orders, board) {
        true => question.done(),
        false => question.refuse("the run was ended before"),
    }
}

/// Asks the operator to do this and pauses the run until the operator continues it. Returns whether the run goes on.
fn ask(text: &str, orders: &Orders, board: &StatusBoard) -> bool {
    // The run may be paused for another reason: continuing from that pause does not answer this question.
    orders.wait_while_paused();
    orders.give(Order::Pause);
    if orders.go_on() {
        tracing::info!("waiting for the operator: {text}");
        board.ask(text);
        orders.wait_while_paused();
    }
    orders.go_on()
}

/// Tells the operator what remains to be done after the run.
fn tell(question: ShowRequest, board: &StatusBoard) {
    let text = format!("{}: the run is over and does not wait for it", task(&question.wanted));
    board.publish(Event::Ask(Question { text, wants_answer: false }));
    question.refuse("the run is over and did not wait for it");
}

/// Places a subject in front of the camera; waits for the operator if needed. `planes` is the number of calibration
/// planes.
///
/// # Errors
/// For a subject that the rig does not have.
pub fn place(
    stand: &Stand,
    subject: Subject,
    planes: usize,
    orders: &Orders,
    board: &StatusBoard,
) -> Result<(), DeviceError> {
    orders.wait_while_paused();
    if !stand.place(subject)? {
        let text = match subject {
            Subject::Diffuser => "hold an evenly lit diffuser directly in front of the camera's lens".into(),
            Subject::Plane(_) => format!("put {subject} of {planes} in front of the camera"),
            Subject::Scene => "put the scene in front of the camera and remove everything else".into(),
            Subject::Board => "put the white board in the scene's place, so that it fills the view".into(),
            Subject::SecondBoard => {
                "put the second white board, of another material, in the place of the first".into()
            }
            Subject::Cap => "put the cap on the camera's lens".into(),
        };
        ask(&text, orders, board);
    }
    Ok(())
}

fn task(wanted: &WantedPicture) -> String {
    match wanted {
        WantedPicture::Pattern(pattern) => format!("make the projector show {pattern}"),
        WantedPicture::Dark => "turn the projector's light off, or cover its lens".into(),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use raysweep_core::{Pattern, Projector};
    use raysweep_drivers::projector::external::External;
    use raysweep_proto::RunState;

    use super::*;

    /// A run in progress, and the operator that its projector asks.
    struct Run {
        board: Arc<StatusBoard>,
        orders: Arc<Orders>,
        operator: Operator,
    }

    impl Drop for Run {
        /// Keeps a failed test from waiting forever.
        fn drop(&mut self) {
            self.orders.give(Order::Cancel);
        }
    }

    fn run() -> (Run, External) {
        let (board, orders) = (Arc::new(StatusBoard::new("plane")), Arc::new(Orders::default()));
        for state in [RunState::Preparing, RunState::Armed, RunState::Running] {
            board.go(state).unwrap();
        }
        let (projector, questions) = External::new(Duration::MAX);
        let operator = Operator::start(questions, orders.clone(), board.clone()).unwrap();
        (Run { board, orders, operator }, projector)
    }

    impl Run {
        /// Does what the socket's `continue` does.
        fn go_on(&self) {
            self.board.go(RunState::Running).unwrap();
            self.orders.give(Order::Go);
        }

        fn await_question(&self) {
            for _ in 0..10_000 {
                if self.board.status().question.is_some() {
                    return;
                }
                thread::sleep(Duration::from_millis(1));
            }
            panic!("nothing was asked");
        }
    }

    #[test]
    fn who_lets_a_held_run_go_on_answers_no_question_that_was_not_asked() {
        let (run, mut projector) = run();
        run.orders.give(Order::Pause);
        run.board.go(RunState::Paused).unwrap();
        let shown = thread::spawn(move || projector.show(&Pattern::White));
        // Long enough for a question to come up if the operator's thread did not wait.
        thread::sleep(Duration::from_millis(100));
        assert_eq!(run.board.status().question, None, "it is asked once the run goes on");
        run.go_on();
        run.await_question();
        thread::sleep(Duration::from_millis(100));
        assert!(!shown.is_finished(), "nobody has answered");
        run.go_on();
        shown.join().unwrap().unwrap();
        assert_eq!(run.board.status().question, None);
    }

    #[test]
    fn a_run_that_is_ended_meanwhile_is_no_answer() {
        let (run, mut projector) = run();
        let shown = thread::spawn(move || (projector.show(&Pattern::White), projector));
        run.await_question();
        run.orders.give(Order::Cancel);
        let (shown, mut projector) = shown.join().unwrap();
        assert!(shown.unwrap_err().to_string().contains("ended before"));
        // The operator is asked nothing more, and only told about the light that is still on.
        let mut events = run.board.subscribe();
        assert!(projector.show(&Pattern::White).is_err());
        assert!(events.try_recv().is_err());
        run.operator.dismiss();
        assert!(projector.blank().is_err());
        assert!(matches!(events.try_recv(), Ok(Event::Ask(question)) if question.text.contains("is over")));
        drop(projector);
    }
}
