//! The daemon's published state: holds it and notifies all subscribers.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use raysweep_core::{ClockQuality, FilmSummary, SettingsLatency};
use raysweep_proto::{Event, Question, RunState, Status};
use tokio::sync::broadcast;

/// Number of events by which a slow subscriber may lag before it misses some.
const EVENTS: usize = 1024;

/// The daemon's state as its clients see it.
pub struct StatusBoard {
    status: Mutex<Status>,
    events: broadcast::Sender<Event>,
}

/// The current state, from which the requested transition is not allowed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WrongState(pub RunState);

impl StatusBoard {
    /// The board of an idle daemon for a rig of this kind.
    pub fn new(rig: &str) -> Self {
        let status = Status {
            role: None,
            operators: None,
            version: env!("CARGO_PKG_VERSION").into(),
            rig: rig.into(),
            state: RunState::Idle,
            question: None,
            data: None,
            session: None,
            progress: None,
            vsync: None,
            vsync_clock: None,
            film: None,
            viewfinder: None,
            settings_latency: None,
            ended: None,
            error: None,
            warnings: Vec::new(),
            live: None,
            mirror: None,
        };
        Self { status: Mutex::new(status), events: broadcast::Sender::new(EVENTS) }
    }

    fn lock(&self) -> MutexGuard<'_, Status> {
        self.status.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The status that clients see.
    pub fn status(&self) -> Status {
        self.lock().clone()
    }

    /// Subscribes to all events from now on.
    pub fn subscribe(&self) -> broadcast::Receiver<Event> {
        self.events.subscribe()
    }

    /// Changes to another state, if that may follow the current one.
    ///
    /// # Errors
    /// The current state, if the transition is not allowed.
    pub fn go(&self, next: RunState) -> Result<(), WrongState> {
        let mut status = self.lock();
        if !status.state.may_become(next) {
            return Err(WrongState(status.state));
        }
        status.state = next;
        // Every transition means that the question was answered, or needs no answer.
        status.question = None;
        if next == RunState::Preparing {
            (status.session, status.progress, status.vsync, status.error) = (None, None, None, None);
            (status.ended, status.warnings) = (None, Vec::new());
            status.viewfinder = None;
            (status.film, status.settings_latency, status.vsync_clock) = (None, None, None);
        }
        let event = Event::State { state: next, session: status.session.clone() };
        // Sent under the lock, so that subscribers see states in their actual order.
        let _ = self.events.send(event);
        Ok(())
    }

    /// Pauses the run for a task of the operator, unless the run is about to end.
    pub fn ask(&self, task: &str) {
        self.pause_for(Question { text: task.to_owned(), wants_answer: true });
    }

    /// Pauses the run and says what it waits for, unless the run is about to end. Returns whether it is paused.
    pub fn pause_for(&self, question: Question) -> bool {
        let mut status = self.lock();
        if status.state.may_become(RunState::Paused) {
            status.state = RunState::Paused;
            let session = status.session.clone();
            let _ = self.events.send(Event::State { state: RunState::Paused, session });
        }
        if status.state == RunState::Paused {
            // What wants an answer is not forgotten for what needs none.
            if question.wants_answer || !status.question.as_ref().is_some_and(|asked| asked.wants_answer) {
                status.question = Some(question.clone());
            }
            let _ = self.events.send(Event::Ask(question));
        }
        status.state == RunState::Paused
    }

    /// Sets the session of the run that is being prepared.
    pub fn set_session(&self, session: PathBuf) {
        self.lock().session = Some(session);
    }

    /// Sets the summary of a film.
    pub fn set_film(&self, film: FilmSummary) {
        self.lock().film = Some(film);
    }

    /// Sets the latency of the camera's settings.
    pub fn set_settings_latency(&self, latency: Option<SettingsLatency>) {
        self.lock().settings_latency = latency;
    }

    /// Sets the quality of the VSYNC watcher's clock.
    pub fn set_vsync_clock(&self, clock: Option<ClockQuality>) {
        self.lock().vsync_clock = clock;
    }

    /// Sets the path of the live file.
    pub fn set_live(&self, file: PathBuf) {
        self.lock().live = Some(file);
    }

    /// Sets the error of a faulted run.
    pub fn set_error(&self, error: String) {
        self.lock().error = Some(error);
    }

    /// Sends an event, and updates what `status` shows.
    pub fn publish(&self, event: Event) {
        let mut status = self.lock();
        match &event {
            Event::Progress(progress) => status.progress = Some(progress.clone()),
            Event::Vsync(vsync) => status.vsync = Some(*vsync),
            Event::Viewfinder(values) => status.viewfinder = Some(values.clone()),
            Event::Film(estimate) => status.film = Some(estimate.film.clone()),
            Event::Finished { state, warnings, .. } => {
                (status.ended, status.warnings) = (Some(state.clone()), warnings.clone());
                status.viewfinder = None;
            }
            _ => {}
        }
        let _ = self.events.send(event);
    }
}
