//! What the daemon shows of itself: one place that holds the state and tells everybody who listens.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use raysweep_core::{ClockQuality, FilmSummary, SettingsLatency};
use raysweep_proto::{Event, RunState, Status};
use tokio::sync::broadcast;

/// Events that a slow subscriber may lag behind before it misses some.
const EVENTS: usize = 1024;

/// The daemon's state as its clients see it.
pub struct StatusBoard {
    status: Mutex<Status>,
    events: broadcast::Sender<Event>,
}

/// A state that cannot follow the present one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WrongState(pub RunState);

impl StatusBoard {
    /// An idle daemon for a rig of this kind.
    pub fn new(rig: &str) -> Self {
        let status = Status {
            version: env!("CARGO_PKG_VERSION").into(),
            rig: rig.into(),
            state: RunState::Idle,
            question: None,
            session: None,
            progress: None,
            vsync: None,
            vsync_clock: None,
            film: None,
            settings_latency: None,
            error: None,
            live: None,
            mirror: None,
        };
        Self { status: Mutex::new(status), events: broadcast::Sender::new(EVENTS) }
    }

    fn lock(&self) -> MutexGuard<'_, Status> {
        self.status.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What clients see.
    pub fn status(&self) -> Status {
        self.lock().clone()
    }

    /// Everything from now on.
    pub fn subscribe(&self) -> broadcast::Receiver<Event> {
        self.events.subscribe()
    }

    /// Goes to another state, if that may follow the present one.
    ///
    /// # Errors
    /// The present state, where it may not.
    pub fn go(&self, next: RunState) -> Result<(), WrongState> {
        let mut status = self.lock();
        if !status.state.may_become(next) {
            return Err(WrongState(status.state));
        }
        status.state = next;
        // Whatever comes after it has answered it, or needs no answer.
        status.question = None;
        if next == RunState::Preparing {
            (status.session, status.progress, status.vsync, status.error) = (None, None, None, None);
            (status.film, status.settings_latency, status.vsync_clock) = (None, None, None);
        }
        let event = Event::State { state: next, session: status.session.clone() };
        // Sent under the lock, so that subscribers see states in their true order.
        let _ = self.events.send(event);
        Ok(())
    }

    /// Holds the run for an operator who is to do something, unless it is about to end.
    pub fn ask(&self, task: &str) {
        let mut status = self.lock();
        if status.state.may_become(RunState::Paused) {
            status.state = RunState::Paused;
            let session = status.session.clone();
            let _ = self.events.send(Event::State { state: RunState::Paused, session });
        }
        if status.state == RunState::Paused {
            let text = format!("{task}, then `raysweep continue`");
            status.question = Some(text.clone());
            let _ = self.events.send(Event::Ask { text });
        }
    }

    /// Names the session of the run that is being prepared.
    pub fn set_session(&self, session: PathBuf) {
        self.lock().session = Some(session);
    }

    /// Notes how a film went.
    pub fn set_film(&self, film: FilmSummary) {
        self.lock().film = Some(film);
    }

    /// Notes how late the camera's settings take effect.
    pub fn set_settings_latency(&self, latency: Option<SettingsLatency>) {
        self.lock().settings_latency = latency;
    }

    /// Notes how well the clock of the VSYNC line's watcher is known.
    pub fn set_vsync_clock(&self, clock: Option<ClockQuality>) {
        self.lock().vsync_clock = clock;
    }

    /// Names the file with the live images.
    pub fn set_live(&self, file: PathBuf) {
        self.lock().live = Some(file);
    }

    /// Notes why a run faulted.
    pub fn set_error(&self, error: String) {
        self.lock().error = Some(error);
    }

    /// Tells everybody, and keeps what `status` shows.
    pub fn publish(&self, event: Event) {
        let mut status = self.lock();
        match &event {
            Event::Progress(progress) => status.progress = Some(progress.clone()),
            Event::Vsync(vsync) => status.vsync = Some(*vsync),
            Event::Film(estimate) => status.film = Some(estimate.film.clone()),
            _ => {}
        }
        let _ = self.events.send(event);
    }
}
