//! The running estimate: a thread that solves the data so far while the sweep continues.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use ndarray::Array2;
use rayon::{ThreadPool, ThreadPoolBuilder};
use raysweep_pipeline::{Snapshot, message_of};
use raysweep_proto::Event;
use raysweep_transport::plane::Transport;
use serde_json::{Map, Value, json};

use super::{EPIPOLAR, INDIRECT, LiveError, LiveFile, TOTAL};
use crate::devices::priority;
use crate::run::board::StatusBoard;

/// Minimum pause between two estimates: no display or subscriber needs more.
const REST: Duration = Duration::from_millis(100);

/// Where the estimates of a run are published.
#[derive(Clone)]
pub struct Outlet {
    /// The file that clients map.
    pub file: Arc<LiveFile>,
    /// The board that notifies subscribers.
    pub board: Arc<StatusBoard>,
    /// The session's folder, as named in the metadata.
    pub session: String,
}

impl Outlet {
    /// Publishes a transport that was estimated from `points` of the sweep within `took`; `last` marks the sweep's
    /// final result.
    ///
    /// # Errors
    /// Those of [`LiveFile::publish`].
    pub fn show(
        &self,
        transport: &Transport,
        points: usize,
        took: Duration,
        last: bool,
    ) -> Result<(), LiveError> {
        let [epipolar, indirect, total] =
            [transport.epipolar(1), transport.non_epipolar(1), transport.total()];
        self.show_images([&epipolar, &indirect, &total], points, took, last)
    }

    /// Like [`Self::show`], given the transport's epipolar light, all other light, and both.
    ///
    /// # Errors
    /// Those of [`LiveFile::publish`].
    pub fn show_images(
        &self,
        images: [&Array2<f32>; 3],
        points: usize,
        took: Duration,
        last: bool,
    ) -> Result<(), LiveError> {
        let seconds = took.as_secs_f64();
        let mut sequence = 0;
        for (name, image) in [EPIPOLAR, INDIRECT, TOTAL].into_iter().zip(images) {
            let entries = [
                ("axes", json!(["t", "s"])),
                ("units", json!("1 = a white pixel lit by its own projector row")),
                ("session", json!(self.session)),
                ("points", json!(points)),
                ("seconds", json!(seconds)),
                ("last", json!(last)),
            ];
            let metadata: Map<String, Value> =
                entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
            sequence = self.file.publish(name, image.view().into_dyn(), &metadata)?;
        }
        self.board.publish(Event::Live { sequence, points, seconds });
        Ok(())
    }
}

/// The thread `live`. It takes the newest snapshot, solves it on a single thread, and then rests for as long as that
/// took, so that it uses at most half a processor. Dropping this ends the thread within the time of one camera row.
pub struct LiveEstimate {
    inbox: Arc<Inbox>,
    thread: Option<JoinHandle<()>>,
}

/// Holds the newest snapshot; older ones are dropped.
#[derive(Default)]
struct Inbox {
    content: Mutex<Content>,
    changed: Condvar,
}

#[derive(Default)]
struct Content {
    snapshot: Option<Box<dyn Snapshot>>,
    ended: bool,
}

impl LiveEstimate {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system's error, if the thread cannot be started.
    pub fn start(outlet: Outlet) -> Result<Self, Box<dyn std::error::Error + Send + Sync>> {
        let pool = ThreadPoolBuilder::new()
            .num_threads(1)
            .thread_name(|_| "live-solver".into())
            .start_handler(|_| priority::for_computing())
            .build()?;
        let inbox = Arc::new(Inbox::default());
        let thread = thread::Builder::new().name("live".into()).spawn({
            let inbox = inbox.clone();
            move || work(&inbox, &pool, &outlet)
        })?;
        Ok(Self { inbox, thread: Some(thread) })
    }

    /// Hands over a snapshot, replacing one that was not started. Never waits for the estimate.
    pub fn offer(&self, snapshot: Box<dyn Snapshot>) {
        // The previous snapshot is dropped after the lock is released.
        let _before = self.inbox.lock().snapshot.replace(snapshot);
        self.inbox.changed.notify_one();
    }
}

impl Drop for LiveEstimate {
    fn drop(&mut self) {
        self.inbox.lock().ended = true;
        self.inbox.changed.notify_one();
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the live thread panicked");
        }
    }
}

impl Inbox {
    fn lock(&self) -> MutexGuard<'_, Content> {
        self.content.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for `pause` or until the end; returns false at the end.
    fn rest(&self, pause: Duration) -> bool {
        let rested = self.changed.wait_timeout_while(self.lock(), pause, |content| !content.ended);
        !rested.unwrap_or_else(PoisonError::into_inner).0.ended
    }

    /// Waits for a snapshot; `None` at the end.
    fn next(&self) -> Option<Box<dyn Snapshot>> {
        let waiting = |content: &mut Content| content.snapshot.is_none() && !content.ended;
        let mut content =
            self.changed.wait_while(self.lock(), waiting).unwrap_or_else(PoisonError::into_inner);
        if content.ended { None } else { content.snapshot.take() }
    }
}

fn work(inbox: &Inbox, pool: &ThreadPool, outlet: &Outlet) {
    let mut before: Option<Transport> = None;
    while let Some(snapshot) = inbox.next() {
        let began = Instant::now();
        let go_on = || !inbox.lock().ended;
        let estimated =
            catch_unwind(AssertUnwindSafe(|| pool.install(|| snapshot.estimate(before.as_ref(), &go_on))));
        let why = match estimated {
            _ if !go_on() => return,
            Ok(Ok(transport)) => {
                let shown = outlet.show(&transport, snapshot.points(), began.elapsed(), false);
                before = Some(transport);
                shown.err().map(|error| error.to_string())
            }
            Ok(Err(error)) => Some(error.to_string()),
            Err(panic) => Some(format!("panicked: {}", message_of(&*panic))),
        };
        if let Some(why) = why {
            tracing::warn!("no live estimate for the rest of this run: {why}");
            return;
        }
        drop(snapshot);
        if !inbox.rest(REST.max(began.elapsed())) {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, Sender, channel};

    use ndarray::Array3;
    use raysweep_pipeline::NotSolved;
    use tokio::sync::broadcast;

    use super::super::LiveReader;
    use super::*;

    fn transport(value: f32) -> Transport {
        Transport::measured(Array3::from_elem((3, 2, 2), value), -1, Array2::from_elem((3, 2), true))
    }

    /// An estimate that signals its start and waits for permission to end.
    struct Scripted {
        points: usize,
        begun: Sender<usize>,
        may_end: Arc<Mutex<Receiver<()>>>,
    }

    impl Snapshot for Scripted {
        fn points(&self) -> usize {
            self.points
        }

        fn estimate(
            &self,
            _: Option<&Transport>,
            go_on: &(dyn Fn() -> bool + Sync),
        ) -> Result<Transport, NotSolved> {
            self.begun.send(self.points).unwrap();
            loop {
                match self.points {
                    0 => panic!("on purpose"),
                    1 => return Err(NotSolved { of: "scripted", what: "on purpose".into() }),
                    _ if !go_on() => {
                        return Err(NotSolved { of: "scripted", what: "stopped".into() });
                    }
                    _ if self.may_end.lock().unwrap().recv_timeout(Duration::from_millis(1)).is_ok() => {
                        return Ok(transport(self.points as f32));
                    }
                    _ => {}
                }
            }
        }
    }

    struct Stage {
        folder: tempfile::TempDir,
        live: LiveEstimate,
        events: broadcast::Receiver<Event>,
        begun: Receiver<usize>,
        end: Sender<()>,
        snapshot: Box<dyn Fn(usize) -> Box<dyn Snapshot>>,
    }

    fn stage() -> Stage {
        let folder = tempfile::tempdir().unwrap();
        let file = Arc::new(LiveFile::create(&folder.path().join("live")).unwrap());
        let board = Arc::new(StatusBoard::new("plane"));
        let events = board.subscribe();
        let live = LiveEstimate::start(Outlet { file, board, session: "s".into() }).unwrap();
        let (begin, begun) = channel();
        let (end, may_end) = channel();
        let may_end = Arc::new(Mutex::new(may_end));
        let snapshot = move |points| {
            Box::new(Scripted { points, begun: begin.clone(), may_end: may_end.clone() }) as Box<dyn Snapshot>
        };
        Stage { folder, live, events, begun, end, snapshot: Box::new(snapshot) }
    }

    #[test]
    fn the_newest_snapshot_is_estimated_and_those_it_replaces_never_are() {
        let mut stage = stage();
        stage.live.offer((stage.snapshot)(5));
        assert_eq!(stage.begun.recv().unwrap(), 5);
        for points in 6..60 {
            stage.live.offer((stage.snapshot)(points));
        }
        stage.end.send(()).unwrap();
        assert!(matches!(stage.events.blocking_recv().unwrap(), Event::Live { sequence: 3, points: 5, .. }));
        assert_eq!(stage.begun.recv().unwrap(), 59);
        stage.end.send(()).unwrap();
        assert!(matches!(stage.events.blocking_recv().unwrap(), Event::Live { sequence: 6, points: 59, .. }));
        let reader = LiveReader::open(&stage.folder.path().join("live")).unwrap();
        let pixel = |name: &str| reader.newest(name).unwrap().unwrap().image[[1, 0]];
        assert_eq!((pixel(EPIPOLAR), pixel(INDIRECT), pixel(TOTAL)), (59.0, 118.0, 177.0));
        let metadata = reader.newest(TOTAL).unwrap().unwrap().metadata;
        assert_eq!((&metadata["points"], &metadata["last"]), (&json!(59), &json!(false)));
    }

    #[test]
    fn the_end_stops_an_estimate_that_is_under_way() {
        let mut stage = stage();
        stage.live.offer((stage.snapshot)(5));
        stage.begun.recv().unwrap();
        drop(stage.live);
        assert!(stage.events.try_recv().is_err(), "what was stopped is not shown");
    }

    #[test]
    fn a_panic_and_an_error_end_the_estimates_and_nothing_else() {
        for failing in [0, 1] {
            let stage = stage();
            stage.live.offer((stage.snapshot)(failing));
            stage.begun.recv().unwrap();
            for points in 6..60 {
                stage.live.offer((stage.snapshot)(points));
            }
            drop(stage.live);
            assert!(stage.begun.try_recv().is_err());
        }
    }
}
