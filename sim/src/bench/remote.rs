//! The daemon's side of the socket: devices of a rig that another process simulates.

use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use raysweep_core::{DeviceError, DeviceErrorKind, Edge, Pattern, Projector, Shown, Vsync, io_text};

use super::{MAX_LINE, Reply, Request, Truth};
use crate::gige::Faults;
use crate::subject::SubjectSwitch;

/// Longest wait for an answer: the first pattern that varies along rows takes the bench seconds to compute, on a busy machine
/// many.
const ANSWER: Duration = Duration::from_secs(60);

/// A connection to the bench.
struct Connection {
    device: &'static str,
    reader: BufReader<UnixStream>,
    text: Vec<u8>,
}

/// Whose a socket is that this process may not use, and what to do.
fn owner_advice(path: &Path) -> String {
    match path.metadata() {
        Ok(found) => format!(
            "it belongs to user {}: start raysweep-sim-camera as the user who runs raysweepd, or let that user write to it",
            found.uid()
        ),
        Err(_) => "no access to its folder: name another place in the rig file, for both programs".into(),
    }
}

impl Connection {
    fn open(device: &'static str, path: &Path) -> Result<Self, DeviceError> {
        let stream = UnixStream::connect(path).map_err(|error| {
            let advice = match error.kind() {
                ErrorKind::PermissionDenied => owner_advice(path),
                _ => "start raysweep-sim-camera first".into(),
            };
            let what = format!("sim.bench = {}: {}: {advice}", path.display(), io_text(&error));
            DeviceError::new(device, DeviceErrorKind::Disconnected, what)
        })?;
        Ok(Self { device, reader: BufReader::new(stream), text: Vec::new() })
    }

    fn gone(&self, what: impl ToString) -> DeviceError {
        let what = format!("the bench is gone ({}): start raysweep-sim-camera again", what.to_string());
        DeviceError::new(self.device, DeviceErrorKind::Disconnected, what)
    }

    fn send(&mut self, request: &Request) -> Result<(), DeviceError> {
        let mut line = serde_json::to_vec(request).map_err(|error| self.gone(error))?;
        line.push(b'\n');
        self.reader.get_mut().write_all(&line).map_err(|error| self.gone(error))
    }

    /// Returns the next line, or `None` if it is not complete within `timeout`.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Reply>, DeviceError> {
        // A zero timeout would mean to wait forever.
        let timeout = timeout.max(Duration::from_micros(1));
        self.reader.get_ref().set_read_timeout(Some(timeout)).map_err(|error| self.gone(error))?;
        match (&mut self.reader).take(MAX_LINE - self.text.len() as u64).read_until(b'\n', &mut self.text) {
            Ok(_) if self.text.ends_with(b"\n") => {}
            Ok(_) => return Err(self.gone("its end of the socket is closed")),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                return Ok(None);
            }
            Err(error) => return Err(self.gone(error)),
        }
        let reply = serde_json::from_slice(&self.text);
        self.text.clear();
        reply.map(Some).map_err(|error| DeviceError::new(self.device, DeviceErrorKind::Protocol, error))
    }

    fn ask(&mut self, request: &Request) -> Result<Reply, DeviceError> {
        self.send(request)?;
        match self.receive(ANSWER)? {
            Some(Reply::Error { kind, message }) => Err(DeviceError::new(self.device, kind, message)),
            Some(reply) => Ok(reply),
            None => Err(DeviceError::new(self.device, DeviceErrorKind::Timeout, "the bench does not answer")),
        }
    }

    fn unexpected(&self, reply: &Reply) -> DeviceError {
        let what = format!("the bench answered {reply:?}: both sides must be of one version");
        DeviceError::new(self.device, DeviceErrorKind::Protocol, what)
    }
}

/// The VSYNC monitor of a bench.
pub struct RemoteVsync(Connection);

impl RemoteVsync {
    /// Subscribes to the edges of the bench at `path`.
    ///
    /// # Errors
    /// `Disconnected` when there is no bench.
    pub fn open(path: &Path) -> Result<Self, DeviceError> {
        let mut connection = Connection::open("vsync", path)?;
        connection.send(&Request::Edges)?;
        Ok(Self(connection))
    }
}

impl Vsync for RemoteVsync {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let deadline = Instant::now() + timeout;
        // A line may arrive in several reads.
        loop {
            match self.0.receive(deadline.saturating_duration_since(Instant::now()))? {
                Some(Reply::Edge { seq, host_ns }) => return Ok(Some(Edge { seq, host_ns })),
                Some(reply) => return Err(self.0.unexpected(&reply)),
                None if Instant::now() >= deadline => return Ok(None),
                None => {}
            }
        }
    }
}

/// A bench's projector.
pub struct RemoteProjector(Connection);

impl RemoteProjector {
    /// Connects to the projector of the bench at `path`.
    ///
    /// # Errors
    /// `Disconnected` when there is no bench.
    pub fn open(path: &Path) -> Result<Self, DeviceError> {
        Ok(Self(Connection::open("projector", path)?))
    }

    fn shown(&mut self, request: &Request) -> Result<Shown, DeviceError> {
        match self.0.ask(request)? {
            Reply::Shown { not_before_ns } => Ok(Shown { not_before_ns }),
            reply => Err(self.0.unexpected(&reply)),
        }
    }
}

impl Projector for RemoteProjector {
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError> {
        self.shown(&Request::Show(pattern.clone()))
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        self.shown(&Request::Blank)
    }
}

/// Changes what is in front of the bench's camera, over a connection of its own.
///
/// # Errors
/// `Disconnected` when there is no bench.
pub fn remote_subject(path: &Path) -> Result<SubjectSwitch, DeviceError> {
    let connection = Mutex::new(Connection::open("subject", path)?);
    Ok(SubjectSwitch::new(move |subject| {
        // A connection on which something panicked is still one.
        let mut connection = connection.lock().unwrap_or_else(PoisonError::into_inner);
        match connection.ask(&Request::Place(subject))? {
            Reply::Placed(_) => Ok(()),
            reply => Err(connection.unexpected(&reply)),
        }
    }))
}

/// Reads a bench's ground truth and sets its faults, for tests only.
pub struct BenchProbe(Connection);

impl BenchProbe {
    /// Connects to the bench at `path`.
    ///
    /// # Errors
    /// `Disconnected` when there is no bench.
    pub fn open(path: &Path) -> Result<Self, DeviceError> {
        Ok(Self(Connection::open("bench", path)?))
    }

    /// Ground truth so far.
    ///
    /// # Errors
    /// `Disconnected` when the bench is gone.
    pub fn truth(&mut self) -> Result<Truth, DeviceError> {
        match self.0.ask(&Request::Truth)? {
            Reply::Truth(truth) => Ok(truth),
            reply => Err(self.0.unexpected(&reply)),
        }
    }

    /// The current faults.
    ///
    /// # Errors
    /// `Disconnected` when the bench is gone.
    pub fn faults(&mut self) -> Result<Faults, DeviceError> {
        match self.0.ask(&Request::Faults)? {
            Reply::Faults(faults) => Ok(faults),
            reply => Err(self.0.unexpected(&reply)),
        }
    }

    /// Changes the faults from now on.
    ///
    /// # Errors
    /// `Disconnected` when the bench is gone.
    pub fn set_faults(&mut self, faults: Faults) -> Result<(), DeviceError> {
        match self.0.ask(&Request::SetFaults(faults))? {
            Reply::Faults(_) => Ok(()),
            reply => Err(self.0.unexpected(&reply)),
        }
    }
}
