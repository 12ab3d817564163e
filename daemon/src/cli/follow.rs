//! Follows a run to its end.

use std::future::poll_fn;
use std::io::{self, IsTerminal};
use std::os::fd::AsFd;
use std::path::Path;
use std::task::{Context, Poll};
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use raysweep_proto::{Client, Event, Subscription};
use tokio::runtime::Runtime;
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::exit::Exit;
use super::failure::CommandFailure;
use super::view::EventView;

/// How long handling of an interrupt may be delayed while no event arrives.
const PATIENCE: Duration = Duration::from_millis(100);

/// The effect of Ctrl-C.
pub(super) enum OnInterrupt {
    /// The first asks the daemon, over this connection, to cancel the run; the second detaches from it.
    Cancel(Client),
    /// The first detaches from the run, which continues.
    Leave,
}

/// Catches signals instead of letting them end the process.
pub(super) struct Interrupts {
    /// Driven only by [`Interrupts::pending`].
    runtime: Runtime,
    signals: Vec<Signal>,
}

impl Interrupts {
    /// From here on, Ctrl-C no longer ends the process.
    pub fn of_operator() -> io::Result<Self> {
        Self::of(&[SignalKind::interrupt()])
    }

    /// From here on, neither Ctrl-C nor the end of the terminal nor SIGTERM ends the process: for runs that are of no
    /// use without us, and would leave the light on.
    pub fn of_any_end() -> io::Result<Self> {
        Self::of(&[SignalKind::interrupt(), SignalKind::hangup(), SignalKind::terminate()])
    }

    fn of(kinds: &[SignalKind]) -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
        let signals = {
            let _within = runtime.enter();
            kinds.iter().map(|kind| signal(*kind)).collect::<io::Result<_>>()?
        };
        Ok(Self { runtime, signals })
    }

    /// Whether Ctrl-C was pressed, or another of the signals came, since the last call.
    pub fn pending(&mut self) -> bool {
        let Self { runtime, signals } = self;
        runtime.block_on(async {
            // Yielding lets the runtime poll for signals.
            tokio::task::yield_now().await;
            let came = |context: &mut Context<'_>| {
                let came = signals.iter_mut().map(|signal| signal.poll_recv(context).is_ready());
                // Each is asked, so that none stays pending.
                Poll::Ready(came.fold(false, |any, came| any | came))
            };
            poll_fn(came).await
        })
    }
}

/// Whether somebody at the terminal has pressed Enter since the last call. Reads the line.
fn enter_pressed() -> bool {
    let stdin = io::stdin();
    let mut ready = [PollFd::new(stdin.as_fd(), PollFlags::POLLIN)];
    let is_ready = poll(&mut ready, PollTimeout::ZERO).is_ok_and(|ready| ready > 0);
    // A terminal gives whole lines. At its end there is nobody.
    is_ready && stdin.lines().next().is_some_and(|line| line.is_ok())
}

/// Shows events until the run of `session` has ended.
pub(super) fn follow(
    mut events: Subscription,
    session: &Path,
    interrupts: &mut Interrupts,
    view: &mut EventView,
    mut on_interrupt: OnInterrupt,
) -> Result<Exit, CommandFailure> {
    let (mut cancelled, mut is_asked) = (false, false);
    let is_attended = io::stdin().is_terminal() && matches!(on_interrupt, OnInterrupt::Cancel(_));
    loop {
        if is_attended
            && enter_pressed()
            && is_asked
            && let OnInterrupt::Cancel(client) = &mut on_interrupt
        {
            is_asked = false;
            if let Err(error) = client.go_on() {
                view.note(&error.to_string());
            }
        }
        if interrupts.pending() {
            match &mut on_interrupt {
                OnInterrupt::Cancel(client) if !cancelled => {
                    cancelled = true;
                    match client.cancel() {
                        Ok(()) => view.note("cancelling the run; Ctrl-C again exits without waiting"),
                        Err(error) => view
                            .note(&format!("{error}; Ctrl-C again exits and leaves the run to the daemon")),
                    }
                }
                OnInterrupt::Cancel(_) => {
                    view.note("left to the daemon; `raysweep watch` follows it");
                    return Ok(Exit::Incomplete);
                }
                OnInterrupt::Leave => return Ok(Exit::Done),
            }
        }
        let Some(event) = events.next_within(PATIENCE)? else { continue };
        view.show(&event).map_err(CommandFailure::Output)?;
        match &event {
            // What was typed before the question is no answer to it.
            Event::State { .. } => is_asked = false,
            Event::Ask(question) if is_attended && question.wants_answer => {
                enter_pressed();
                is_asked = true;
                view.note("or press Enter here when it is done");
            }
            _ => {}
        }
        if let Event::Finished { session: ended, state, missing, .. } = &event
            && ended == session
        {
            return Ok(match state.as_str() {
                "complete" if *missing == 0 => Exit::Done,
                "faulted" => Exit::Failed,
                _ => Exit::Incomplete,
            });
        }
    }
}
