//! One connection that follows the daemon for all browsers, and finds it again after a restart.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use axum::response::sse::Event as Line;
use futures_util::Stream;
use raysweep_proto::{Client, ClientError};
use serde_json::json;
use tokio::sync::broadcast::{self, error::RecvError};

/// Wait before the daemon is looked for again.
const PACE: Duration = Duration::from_secs(1);
/// Events that a slow browser may be behind; it is told how many it missed.
const WAITING: usize = 256;

/// What is known of the daemon.
#[derive(Default)]
struct Known {
    /// The event about the connection, for browsers that come later.
    connection: Arc<str>,
    live: Option<PathBuf>,
    /// Folders of the sessions, by name.
    sessions: BTreeMap<String, PathBuf>,
}

pub(super) struct Hub {
    socket: PathBuf,
    events: broadcast::Sender<Arc<str>>,
    known: Arc<Mutex<Known>>,
}

fn lock(known: &Mutex<Known>) -> MutexGuard<'_, Known> {
    known.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Hub {
    /// Starts to follow the daemon that listens on a socket, now or later.
    pub fn start(socket: &Path) -> io::Result<Self> {
        let (events, _) = broadcast::channel(WAITING);
        let known = Arc::new(Mutex::new(Known::default()));
        let hub = Self { socket: socket.to_owned(), events, known };
        let (socket, events, known) = (hub.socket.clone(), hub.events.clone(), hub.known.clone());
        thread::Builder::new().name("hub".into()).spawn(move || {
            loop {
                let lost = match connected(&socket, &events, &known) {
                    Ok(()) => continue,
                    Err(error) => error.to_string(),
                };
                tell(&events, &known, json!({ "event": "connection", "lost": lost }).to_string());
                thread::sleep(PACE);
            }
        })?;
        Ok(hub)
    }

    /// The daemon's events from now on, after what is known of the connection.
    pub fn follow(&self) -> impl Stream<Item = Result<Line, Infallible>> + use<> {
        let events = self.events.subscribe();
        let first = Some(lock(&self.known).connection.clone());
        futures_util::stream::unfold((first, events), |(first, mut events)| async move {
            let text = match first {
                Some(first) => first,
                None => match events.recv().await {
                    Ok(text) => text,
                    Err(RecvError::Lagged(missed)) => {
                        json!({ "event": "skipped", "events": missed }).to_string().into()
                    }
                    Err(RecvError::Closed) => return None,
                },
            };
            Some((Ok(Line::default().data(&*text)), (None, events)))
        })
    }

    /// The live file, if the daemon has one.
    pub fn live_file(&self) -> Option<PathBuf> {
        lock(&self.known).live.clone()
    }

    /// Folder of a session that the daemon has listed.
    pub fn known_session(&self, name: &str) -> Option<PathBuf> {
        lock(&self.known).sessions.get(name).cloned()
    }

    /// Folder of a session that the daemon lists now. Nothing else is ever read, whatever a browser asks for.
    pub fn session(&self, name: &str) -> Result<PathBuf, String> {
        let listed = Client::connect(&self.socket).and_then(|mut client| client.sessions());
        let listed = listed.map_err(|error| error.to_string())?;
        let named = listed
            .into_iter()
            .filter_map(|info| Some((info.session.file_name()?.to_str()?.to_owned(), info.session)));
        let mut known = lock(&self.known);
        known.sessions = named.collect();
        known.sessions.get(name).cloned().ok_or_else(|| format!("no session is called {name:?}"))
    }
}

/// Passes on events until the connection is lost.
fn connected(
    socket: &Path,
    events: &broadcast::Sender<Arc<str>>,
    known: &Mutex<Known>,
) -> Result<(), ClientError> {
    let subscription = Client::connect(socket)?.subscribe()?;
    let status = Client::connect(socket)?.status()?;
    lock(known).live = status.live;
    tell(events, known, json!({ "event": "connection", "lost": null }).to_string());
    for event in subscription {
        if let Ok(text) = serde_json::to_string(&event?) {
            // Nobody may be watching.
            let _ = events.send(text.into());
        }
    }
    Ok(())
}

/// Tells all browsers about the connection, those that come later too.
fn tell(events: &broadcast::Sender<Arc<str>>, known: &Mutex<Known>, text: String) {
    let text: Arc<str> = text.into();
    let before = std::mem::replace(&mut lock(known).connection, text.clone());
    if before != text {
        let _ = events.send(text);
    }
}
