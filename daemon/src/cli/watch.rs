//! Watches the run in progress, across a restart of the daemon.

use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use raysweep_proto::{Client, ClientError, ErrorCode, Event, RpcError, Status, Subscription};

use super::exit::Exit;
use super::failure::CommandFailure;
use super::follow::{Interrupts, OnInterrupt, follow};
use super::printer::Printer;
use super::view::EventView;

/// Interval between attempts to reach a daemon that is gone.
const RETRY: Duration = Duration::from_millis(500);
/// How long a daemon that came back may take to go on with a run by itself (`raysweep resume --auto`).
const RESUMES_WITHIN: Duration = Duration::from_secs(10);

/// Watches until the run has ended. A daemon that goes away is waited for.
pub(super) fn watch(socket: &Path, printer: Printer) -> Result<Exit, CommandFailure> {
    let mut interrupts = Interrupts::of_operator().map_err(CommandFailure::Signals)?;
    let mut seat = Seat::take(socket)?;
    // A run that is prepared has no session yet.
    let found = if is_over(&seat.status) { Found::Nothing } else { seat.await_run(&mut interrupts)? };
    let mut session = match found {
        Found::GoesOn(session) => session,
        Found::Interrupted => return Ok(Exit::Done),
        Found::Nothing => {
            let message = "no run in progress; `raysweep sessions` lists earlier runs";
            return Err(ClientError::Rpc(RpcError::new(ErrorCode::NotRunning, message)).into());
        }
    };
    let mut view = EventView::new(printer);
    loop {
        seat.say_what_was_said(&mut view)?;
        match follow(seat.events, &session, &mut interrupts, &mut view, OnInterrupt::Leave) {
            Err(CommandFailure::Client(ClientError::Lost { .. })) => {}
            ended => return ended,
        }
        view.clear();
        view.note("the daemon is gone; waiting until it is back, Ctrl-C ends this");
        let found = loop {
            let Some(back) = await_daemon(socket, &mut interrupts)? else { return Ok(Exit::Done) };
            seat = back;
            match seat.await_run(&mut interrupts) {
                // It is gone again.
                Err(ClientError::Lost { .. }) => {}
                found => break found?,
            }
        };
        match found {
            Found::GoesOn(run) => session = run,
            Found::Nothing => return over(socket, &session, printer),
            Found::Interrupted => return Ok(Exit::Done),
        }
    }
}

/// Waits until the daemon answers again; `None` after Ctrl-C.
fn await_daemon(socket: &Path, interrupts: &mut Interrupts) -> Result<Option<Seat>, ClientError> {
    while !interrupts.pending() {
        match Seat::take(socket) {
            Ok(seat) => return Ok(Some(seat)),
            Err(refused @ ClientError::Permission { .. }) => return Err(refused),
            Err(_) => thread::sleep(RETRY),
        }
    }
    Ok(None)
}

/// What a daemon does.
enum Found {
    /// It goes on with the run of this session, or begins it.
    GoesOn(PathBuf),
    Nothing,
    /// That was not waited for, because of Ctrl-C.
    Interrupted,
}

/// A connection for the daemon's events, and its status when it was made.
struct Seat {
    events: Subscription,
    status: Status,
}

impl Seat {
    fn take(socket: &Path) -> Result<Self, ClientError> {
        let events = Client::connect(socket)?.subscribe()?;
        Ok(Self { events, status: Client::connect(socket)?.status()? })
    }

    /// Shows what was said before anybody watched.
    fn say_what_was_said(&self, view: &mut EventView) -> Result<(), CommandFailure> {
        let Status { state, session, progress, vsync, viewfinder, question, .. } = self.status.clone();
        let said = [
            Some(Event::State { state, session }),
            progress.map(Event::Progress),
            viewfinder.map(Event::Viewfinder),
            question.map(Event::Ask),
            vsync.map(Event::Vsync),
        ];
        said.into_iter().flatten().try_for_each(|event| view.show(&event)).map_err(CommandFailure::Output)
    }

    /// Whether the daemon goes on with a run soon, or begins one.
    fn await_run(&mut self, interrupts: &mut Interrupts) -> Result<Found, ClientError> {
        let began = Instant::now();
        while began.elapsed() < RESUMES_WITHIN {
            if interrupts.pending() {
                return Ok(Found::Interrupted);
            }
            if let Some(session) = under_way(&self.status) {
                return Ok(Found::GoesOn(session));
            }
            if let Some(Event::State { state, session }) = self.events.next_within(RETRY)? {
                (self.status.state, self.status.session) = (state, session);
            }
        }
        Ok(Found::Nothing)
    }
}

/// The session of the run in progress.
fn under_way(status: &Status) -> Option<PathBuf> {
    status.session.clone().filter(|_| !is_over(status))
}

fn is_over(status: &Status) -> bool {
    status.state.is_over()
}

/// What became of a run whose end nobody saw.
fn over(socket: &Path, session: &Path, printer: Printer) -> Result<Exit, CommandFailure> {
    let listed = Client::connect(socket)?.sessions()?;
    let Some(info) = listed.into_iter().find(|info| info.session == session) else {
        return Err(CommandFailure::Client(ClientError::Rpc(RpcError::new(
            ErrorCode::NotRunning,
            format!("the daemon is back, but {} is not among its sessions", session.display()),
        ))));
    };
    let is_whole = info.stored == info.points;
    let is_complete = info.state == "complete" && is_whole;
    printer.print(&info, |info| {
        let name = session.file_name().unwrap_or_default().display();
        let stored = format!("{}: {} of {} points stored", info.state, info.stored, info.points);
        let path = format!("session: {}", session.display());
        let then = if is_whole { "brings it to its end" } else { "acquires the missing points" };
        let then = format!("`raysweep resume {name}` {then}");
        let lines = if info.can_resume { vec![stored, path, then] } else { vec![stored, path] };
        lines.join("\n")
    })?;
    Ok(if is_complete { Exit::Done } else { Exit::Incomplete })
}
