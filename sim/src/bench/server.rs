//! The bench's side of the socket.

use std::io::{self, BufRead, BufReader, ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use raysweep_core::{DeviceErrorKind, Edge, Projector, Shown, Vsync};

use super::{MAX_LINE, Reply, Request, Truth};
use crate::devices::{BenchDevices, TruthProbe};
use crate::gige::GigeCamera;
use crate::subject::SubjectSwitch;

/// Longest wait for a client or an edge, and so the longest delay of a stop.
const PATIENCE: Duration = Duration::from_millis(50);
/// Maximum number of clients; further ones are refused.
const MAX_CLIENTS: usize = 16;

/// Why the bench cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// Its socket cannot be created.
    #[error("sim.bench = {}: {source}; give a path in a folder that exists and that no other bench has", path.display())]
    Listen {
        /// The socket's path.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A thread cannot be started.
    #[error("cannot start the bench: {0}")]
    System(#[from] io::Error),
}

/// Serves the socket until it is dropped.
pub struct BenchServer {
    path: PathBuf,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

/// State shared by all clients.
struct Bench {
    projector: Mutex<Box<dyn Projector>>,
    subject: SubjectSwitch,
    truth: TruthProbe,
    camera: Arc<GigeCamera>,
    /// Clients subscribed to edges.
    watchers: Mutex<Vec<UnixStream>>,
    stop: Arc<AtomicBool>,
}

impl BenchServer {
    /// Serves these devices at `path`, for use with a separate camera.
    ///
    /// # Errors
    /// When the socket cannot be created at `path`.
    pub fn start(path: &Path, devices: BenchDevices, camera: Arc<GigeCamera>) -> Result<Self, BenchError> {
        let BenchDevices { vsync, projector, subject, truth } = devices;
        let listener = listen(path).map_err(|source| BenchError::Listen { path: path.to_owned(), source })?;
        let mut server = Self { path: path.to_owned(), stop: Arc::default(), threads: Vec::new() };
        let bench = Arc::new(Bench {
            projector: Mutex::new(projector),
            subject,
            truth,
            camera,
            watchers: Mutex::default(),
            stop: server.stop.clone(),
        });
        let told = bench.clone();
        server.threads.push(spawn("bench-vsync", move || told.tell_edges(vsync))?);
        server.threads.push(spawn("bench", move || accept(&listener, &bench))?);
        Ok(server)
    }
}

impl Drop for BenchServer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A panic was already reported on stderr.
            let _ = thread.join();
        }
        // It may have been removed already.
        let _ = std::fs::remove_file(&self.path);
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> io::Result<JoinHandle<()>> {
    std::thread::Builder::new().name(name.into()).spawn(work)
}

fn listen(path: &Path) -> io::Result<UnixListener> {
    let listener = match UnixListener::bind(path) {
        // A bench that was killed leaves its socket behind; nobody answers there.
        Err(error) if error.kind() == ErrorKind::AddrInUse && UnixStream::connect(path).is_err() => {
            std::fs::remove_file(path)?;
            UnixListener::bind(path)?
        }
        bound => bound?,
    };
    listener.set_nonblocking(true)?;
    Ok(listener)
}

fn accept(listener: &UnixListener, bench: &Arc<Bench>) {
    let mut clients: Vec<JoinHandle<()>> = Vec::new();
    while !bench.stop.load(Ordering::Relaxed) {
        let mut ready = [PollFd::new(listener.as_fd(), PollFlags::POLLIN)];
        // An interrupted wait counts as a completed one.
        let _ = poll(&mut ready, PollTimeout::try_from(PATIENCE).unwrap_or(PollTimeout::ZERO));
        clients.retain(|client| !client.is_finished());
        let Ok((stream, _)) = listener.accept() else { continue };
        if clients.len() < MAX_CLIENTS {
            let bench = bench.clone();
            clients.extend(spawn("bench-client", move || bench.serve(stream)));
        }
    }
    for client in clients {
        let _ = client.join();
    }
}

impl Bench {
    fn tell_edges(&self, mut vsync: Box<dyn Vsync>) {
        while !self.stop.load(Ordering::Relaxed) {
            let Ok(Some(Edge { seq, host_ns })) = vsync.next_edge(PATIENCE) else { continue };
            let line = line(&Reply::Edge { seq, host_ns });
            // A subscriber that does not read is disconnected rather than waited for; it sees the end of its stream.
            lock(&self.watchers).retain_mut(|watcher| watcher.write_all(&line).is_ok());
        }
    }

    fn serve(&self, stream: UnixStream) {
        if stream.set_nonblocking(false).is_err() || stream.set_read_timeout(Some(PATIENCE)).is_err() {
            return;
        }
        let mut reader = BufReader::new(stream);
        let mut text = Vec::new();
        while !self.stop.load(Ordering::Relaxed) {
            match (&mut reader).take(MAX_LINE - text.len() as u64).read_until(b'\n', &mut text) {
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => continue,
                Ok(_) if text.ends_with(b"\n") => {}
                // End of stream, or a line that is too long.
                _ => return,
            }
            let reply = match serde_json::from_slice(&text) {
                Ok(Request::Edges) => {
                    let stream = reader.into_inner();
                    if stream.set_nonblocking(true).is_ok() {
                        lock(&self.watchers).push(stream);
                    }
                    return;
                }
                Ok(request) => self.answer(request),
                Err(error) => {
                    Reply::Error { kind: DeviceErrorKind::Protocol, message: format!("no request: {error}") }
                }
            };
            if reader.get_mut().write_all(&line(&reply)).is_err() {
                return;
            }
            text.clear();
        }
    }

    fn answer(&self, request: Request) -> Reply {
        let shown = |Shown { not_before_ns }| Reply::Shown { not_before_ns };
        let answer = match request {
            Request::Show(pattern) => lock(&self.projector).show(&pattern).map(shown),
            Request::Blank => lock(&self.projector).blank().map(shown),
            Request::Place(subject) => self.subject.place(subject).map(|()| Reply::Placed(subject)),
            Request::SetFaults(faults) => {
                self.camera.set_faults(faults);
                return Reply::Faults(faults);
            }
            Request::Faults | Request::Edges => return Reply::Faults(self.camera.faults()),
            Request::Truth => {
                return Reply::Truth(Truth { line: self.truth.read(), wire: self.camera.truth() });
            }
        };
        answer.unwrap_or_else(|error| Reply::Error { kind: error.kind, message: error.source.to_string() })
    }
}

fn line(reply: &Reply) -> Vec<u8> {
    // Numbers and strings always serialise to JSON.
    let mut line = serde_json::to_vec(reply).unwrap_or_default();
    line.push(b'\n');
    line
}

// The guarded data are never left half changed, so a panic elsewhere does not corrupt them.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
