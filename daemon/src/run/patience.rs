//! Patience with a disk that is full or read-only.

use std::time::Duration;

use raysweep_proto::{Question, RunState};
use raysweep_session::Result;

use super::board::StatusBoard;
use super::orders::{Order, Orders};

/// How long a run rests before it tries a failed write again.
const RETRY: Duration = Duration::from_secs(1);

/// Writes what belongs to a run. While the disk is full or read-only, the run is paused and says why, and the write is
/// tried again and again: the run goes on by itself once the disk is mended. A run that is told to end does not wait.
///
/// # Errors
/// The write's error, if waiting does not help or is over.
pub fn write_patiently<T>(
    orders: &Orders,
    board: &StatusBoard,
    mut write: impl FnMut() -> Result<T>,
) -> Result<T> {
    // The pause for the disk, if an operator has not paused the run before.
    let mut own = None;
    let mut is_told = false;
    loop {
        let written = write();
        let Err(error) = &written else {
            // Under the orders' lock, so that no question asked meanwhile is taken for answered.
            if own.is_some_and(|own| orders.end_pause(own, || board.go(RunState::Running).is_ok())) {
                tracing::info!("the disk can be written again; the run goes on");
            }
            return written;
        };
        if !error.is_mendable() || !orders.go_on() {
            return written;
        }
        // Also after `continue`, which makes no room on the disk.
        if orders.now() == Order::Go || !is_told {
            tracing::warn!(%error, "the run waits for the disk");
            let what = match orders.now() {
                Order::Pause => "make room on the disk, or make it writable, then continue the paused run",
                _ => "make room on the disk, or make it writable; the run then goes on by itself",
            };
            is_told = board.pause_for(Question { text: format!("{error}: {what}"), wants_answer: false });
            if !is_told {
                return written;
            }
            own = orders.pause().or(own);
        }
        orders.rest(RETRY);
    }
}

#[cfg(test)]
mod tests {
    use nix::errno::Errno;
    use raysweep_session::Error;

    use super::*;

    /// What a run that acquires is told when the disk is full once; `pause`: an operator has paused it before.
    fn told(pause: bool) -> (String, Order) {
        let (orders, board) = (Orders::default(), StatusBoard::new("plane"));
        for state in [RunState::Preparing, RunState::Armed, RunState::Running] {
            board.go(state).unwrap();
        }
        if pause {
            orders.give(Order::Pause);
            board.go(RunState::Paused).unwrap();
        }
        let mut is_full = true;
        let mut asked = None;
        write_patiently(&orders, &board, || {
            asked = asked.take().or(board.status().question);
            match std::mem::take(&mut is_full) {
                true => Err(Error::Io { action: "write", path: "x".into(), source: Errno::ENOSPC.into() }),
                false => Ok(()),
            }
        })
        .unwrap();
        (asked.unwrap().text, orders.now())
    }

    #[test]
    fn a_later_pause_for_an_operator_is_not_ended_by_the_disk() {
        let (orders, board) = (Orders::default(), StatusBoard::new("plane"));
        for state in [RunState::Preparing, RunState::Armed, RunState::Running] {
            board.go(state).unwrap();
        }
        let mut tries = 0;
        write_patiently(&orders, &board, || {
            tries += 1;
            match tries {
                1 => Err(Error::Io { action: "write", path: "x".into(), source: Errno::ENOSPC.into() }),
                _ => {
                    // The operator has continued, and the run asks for something.
                    orders.give(Order::Go);
                    board.go(RunState::Running).unwrap();
                    orders.give(Order::Pause);
                    board.ask("put the plane there");
                    Ok(())
                }
            }
        })
        .unwrap();
        assert_eq!(orders.now(), Order::Pause);
        let status = board.status();
        assert_eq!(
            (status.state, status.question.unwrap().text.as_str()),
            (RunState::Paused, "put the plane there")
        );
    }

    #[test]
    fn a_run_goes_on_by_itself_unless_an_operator_paused_it() {
        let (text, order) = told(false);
        assert!(text.contains("goes on by itself") && order == Order::Go, "{text}");
        let (text, order) = told(true);
        assert!(text.contains("continue the paused run") && order == Order::Pause, "{text}");
    }
}
