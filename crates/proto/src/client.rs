//! A small blocking client.

use std::collections::VecDeque;
use std::io::{self, BufRead, BufReader, ErrorKind, Write};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::unistd::{Gid, Group};
use raysweep_core::io_text;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::{
    CalibrationInfo, CheckParams, CheckReport, Description, DesignParams, DesignReport, DoctorParams,
    DoctorReport, Empty, Event, Id, Incoming, Method, Outcome, Request, ResumeParams, RpcError, RunParams,
    SessionInfo, Started, Status, UseCalibrationParams, ViewfinderParams,
};

/// Maximum time for an answer. No call waits for a run, so a longer wait means that the daemon hangs.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);

/// Why a call failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// No process listens on the socket.
    #[error("no raysweepd listens on {}: start it, or name its socket with --socket or RAYSWEEP_SOCKET", path.display())]
    NotRunning {
        /// The socket.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// This user may not use the socket.
    #[error("this user may not use {}: {advice}", path.display())]
    Permission {
        /// The socket.
        path: PathBuf,
        /// Which group to join.
        advice: String,
        /// The operating system's error.
        source: io::Error,
    },
    /// Connecting failed for another reason.
    #[error("cannot connect to {}: {}", path.display(), io_text(source))]
    Connect {
        /// The socket.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// The connection broke.
    #[error("the connection to {} was lost: {}; check whether raysweepd still runs", path.display(), io_text(source))]
    Lost {
        /// The socket.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// No answer arrived.
    #[error("raysweepd at {} has not answered `{method}` for {} s; see its log", path.display(), after.as_secs())]
    Timeout {
        /// The socket.
        path: PathBuf,
        /// The method called.
        method: &'static str,
        /// How long the client waited.
        after: Duration,
    },
    /// The daemon sent something that a daemon of this version does not send.
    #[error("the program that listens on {} is not a raysweepd of this version: {what}", path.display())]
    Protocol {
        /// The socket.
        path: PathBuf,
        /// What was wrong.
        what: String,
    },
    /// The daemon refused the call or failed.
    #[error(transparent)]
    Rpc(#[from] RpcError),
}

/// A connection to a daemon.
#[derive(Debug)]
pub struct Client {
    path: PathBuf,
    stream: BufReader<UnixStream>,
    /// The part of a line that was received before a timeout.
    partial: Vec<u8>,
    next_id: u64,
    /// Events that came before an answer; `None` before a subscription.
    events: Option<VecDeque<Event>>,
}

impl Client {
    /// Connects to the daemon that listens on this socket.
    ///
    /// # Errors
    /// [`ClientError::NotRunning`], [`ClientError::Permission`], [`ClientError::Connect`].
    pub fn connect(path: impl AsRef<Path>) -> Result<Self, ClientError> {
        let path = path.as_ref().to_owned();
        match UnixStream::connect(&path) {
            Ok(stream) => {
                let stream = BufReader::new(stream);
                Ok(Self { path, stream, partial: Vec::new(), next_id: 1, events: None })
            }
            Err(source) => Err(match source.kind() {
                ErrorKind::NotFound | ErrorKind::ConnectionRefused => {
                    ClientError::NotRunning { path, source }
                }
                ErrorKind::PermissionDenied => {
                    ClientError::Permission { advice: advice(&path), path, source }
                }
                _ => ClientError::Connect { path, source },
            }),
        }
    }

    /// Returns the methods, events, errors and limits of the daemon.
    ///
    /// # Errors
    /// As for every call: an error of the daemon ([`ClientError::Rpc`]) or of the connection.
    pub fn describe(&mut self) -> Result<Description, ClientError> {
        self.call(Method::Describe, &Empty {})
    }

    /// Returns what the daemon is doing.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn status(&mut self) -> Result<Status, ClientError> {
        self.call(Method::Status, &Empty {})
    }

    /// Returns what a plan would do.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn check(&mut self, plan: impl Into<String>) -> Result<CheckReport, ClientError> {
        self.call(Method::Check, &CheckParams { plan: plan.into() })
    }

    /// Returns a plan with better settings.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn design(&mut self, params: &DesignParams) -> Result<DesignReport, ClientError> {
        self.call(Method::Design, params)
    }

    /// Examines the rig and its host.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn doctor(&mut self, params: &DoctorParams) -> Result<DoctorReport, ClientError> {
        self.call(Method::Doctor, params)
    }

    /// Starts a run.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn run(&mut self, params: &RunParams) -> Result<Started, ClientError> {
        self.call(Method::Run, params)
    }

    /// Starts to acquire what a session lacks.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn resume(&mut self, session: impl Into<PathBuf>) -> Result<Started, ClientError> {
        self.call(Method::Resume, &ResumeParams { session: session.into() })
    }

    /// Pauses the run before its next point.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn pause(&mut self) -> Result<(), ClientError> {
        self.call(Method::Pause, &Empty {}).map(|Empty {}| ())
    }

    /// Continues after [`Client::pause`].
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn go_on(&mut self) -> Result<(), ClientError> {
        self.call(Method::Continue, &Empty {}).map(|Empty {}| ())
    }

    /// Ends the run in an orderly way.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn cancel(&mut self) -> Result<(), ClientError> {
        self.call(Method::Cancel, &Empty {}).map(|Empty {}| ())
    }

    /// Permits a mirror's light until the next boot.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn arm_light(&mut self) -> Result<(), ClientError> {
        self.call(Method::ArmLight, &Empty {}).map(|Empty {}| ())
    }

    /// Lists the sessions in the daemon's data folder, oldest first.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn sessions(&mut self) -> Result<Vec<SessionInfo>, ClientError> {
        self.call(Method::Sessions, &Empty {})
    }

    /// Lists the calibrations in the daemon's data folder, oldest first.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn calibrations(&mut self) -> Result<Vec<CalibrationInfo>, ClientError> {
        self.call(Method::Calibrations, &Empty {})
    }

    /// Makes a session's calibration the one that later runs use.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn use_calibration(&mut self, session: impl Into<PathBuf>) -> Result<(), ClientError> {
        let params = UseCalibrationParams { session: session.into() };
        self.call(Method::UseCalibration, &params).map(|Empty {}| ())
    }

    /// Changes what the running viewfinder shows.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn viewfinder(&mut self, params: &ViewfinderParams) -> Result<(), ClientError> {
        self.call(Method::Viewfinder, params).map(|Empty {}| ())
    }

    /// Streams all events from now on. Calls on the same connection go through [`Subscription::client`].
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn subscribe(mut self) -> Result<Subscription, ClientError> {
        self.events = Some(VecDeque::new());
        let Empty {} = self.call(Method::Subscribe, &Empty {})?;
        Ok(Subscription { client: self })
    }

    /// Calls a method with parameters of any type; the other functions are more convenient.
    ///
    /// # Errors
    /// As [`Client::describe`].
    pub fn call<R: DeserializeOwned>(
        &mut self,
        method: Method,
        params: &impl Serialize,
    ) -> Result<R, ClientError> {
        let id = self.next_id;
        self.next_id += 1;
        let params = match serde_json::to_value(params) {
            Ok(Value::Object(params)) => params,
            _ => Map::new(),
        };
        self.send(&Request::new(id, method.name(), params))?;
        let asked = Instant::now();
        let response = loop {
            // A timeout of zero would be none.
            let left = ANSWER_TIMEOUT.saturating_sub(asked.elapsed()).max(Duration::from_millis(1));
            match (self.receive(Some(left))?, &mut self.events) {
                (Some(Incoming::Response(response)), _) => break response,
                (Some(Incoming::Event(notice)), Some(events)) if asked.elapsed() < ANSWER_TIMEOUT => {
                    events.push_back(notice.params);
                }
                (Some(Incoming::Event(_)), None) => {
                    let method = method.name();
                    return Err(
                        self.protocol(format!("it sent an event instead of the answer to `{method}`"))
                    );
                }
                (None | Some(Incoming::Event(_)), _) => {
                    let (path, method) = (self.path.clone(), method.name());
                    return Err(ClientError::Timeout { path, method, after: ANSWER_TIMEOUT });
                }
            }
        };
        match response.outcome {
            // An error without an id concerns the connection: too many clients, or a line that is too long.
            Outcome::Error(error) => Err(error.into()),
            Outcome::Result(_) if response.id != Id::Number(id.into()) => {
                Err(self.protocol(format!("its answer to `{}` has the id of another request", method.name())))
            }
            Outcome::Result(value) => serde_json::from_value(value)
                .map_err(|error| self.protocol(format!("its result of `{}`: {error}", method.name()))),
        }
    }

    fn send(&mut self, request: &Request) -> Result<(), ClientError> {
        let mut line = serde_json::to_vec(request).map_err(|error| self.lost(error.into()))?;
        line.push(b'\n');
        let sent = self
            .stream
            .get_ref()
            .set_write_timeout(Some(ANSWER_TIMEOUT))
            .and_then(|()| self.stream.get_mut().write_all(&line));
        match sent {
            // A daemon that closes the connection while the client writes has sent the reason before: read
            // it.
            Err(error) if !matches!(error.kind(), ErrorKind::BrokenPipe | ErrorKind::ConnectionReset) => {
                Err(self.lost(error))
            }
            _ => Ok(()),
        }
    }

    /// The next message, or `None` if none arrived within `timeout`.
    fn receive(&mut self, timeout: Option<Duration>) -> Result<Option<Incoming>, ClientError> {
        self.stream.get_ref().set_read_timeout(timeout).map_err(|error| self.lost(error))?;
        match self.stream.read_until(b'\n', &mut self.partial) {
            Ok(_) if self.partial.last() != Some(&b'\n') => Err(self.lost(ErrorKind::UnexpectedEof.into())),
            Ok(_) => {
                let line = std::mem::take(&mut self.partial);
                let message = serde_json::from_slice(&line)
                    .map_err(|error| self.protocol(format!("it sent an invalid line: {error}")))?;
                Ok(Some(message))
            }
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => Ok(None),
            Err(error) => Err(self.lost(error)),
        }
    }

    fn lost(&self, source: io::Error) -> ClientError {
        ClientError::Lost { path: self.path.clone(), source }
    }

    fn protocol(&self, what: String) -> ClientError {
        ClientError::Protocol { path: self.path.clone(), what }
    }
}

/// Events as they happen. The iterator blocks until the next event and ends with an error when the daemon
/// exits.
#[derive(Debug)]
pub struct Subscription {
    client: Client,
}

impl Subscription {
    /// The connection, for calls. A run that is attached to it ends when nobody receives its events any more.
    pub fn client(&mut self) -> &mut Client {
        &mut self.client
    }

    /// The next event, or `None` if none arrived within `timeout`, which must not be zero.
    ///
    /// # Errors
    /// [`ClientError::Lost`] when the daemon exits, [`ClientError::Protocol`].
    pub fn next_within(&mut self, timeout: Duration) -> Result<Option<Event>, ClientError> {
        self.receive(Some(timeout))
    }

    fn receive(&mut self, timeout: Option<Duration>) -> Result<Option<Event>, ClientError> {
        if let Some(event) = self.client.events.as_mut().and_then(VecDeque::pop_front) {
            return Ok(Some(event));
        }
        match self.client.receive(timeout)? {
            Some(Incoming::Event(notice)) => Ok(Some(notice.params)),
            Some(Incoming::Response(response)) => match response.outcome {
                Outcome::Error(error) => Err(error.into()),
                Outcome::Result(_) => Err(self.client.protocol("it sent an unexpected answer".into())),
            },
            None => Ok(None),
        }
    }
}

impl Iterator for Subscription {
    type Item = Result<Event, ClientError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.receive(None).transpose()
    }
}

/// Tells a user without permission who may use the socket.
fn advice(path: &Path) -> String {
    let Ok(metadata) = std::fs::metadata(path) else {
        return "no access to its folder; ask the daemon's administrator".into();
    };
    match Group::from_gid(Gid::from_raw(metadata.gid())) {
        // Its members could do anything on this machine.
        Ok(_) if metadata.gid() == 0 => {
            "the daemon was started by root, and its socket is for root alone: start it with raysweepd.service, or as a user whose group you are in".into()
        }
        Ok(Some(group)) => {
            format!("join the group `{0}` (`usermod -aG {0} USER` as root) and log in again", group.name)
        }
        _ => format!(
            "its group, number {}, has no name on this machine; ask the daemon's administrator",
            metadata.gid()
        ),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixListener;
    use std::thread;

    use super::*;
    use crate::{ErrorCode, EventNotice};

    /// A daemon that reads one line, sends `answer` verbatim, and closes the connection.
    fn peer(answer: &'static str) -> (tempfile::TempDir, PathBuf, thread::JoinHandle<String>) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let listener = UnixListener::bind(&path).unwrap();
        let thread = thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut line = String::new();
            BufReader::new(stream.try_clone().unwrap()).read_line(&mut line).unwrap();
            stream.write_all(answer.as_bytes()).unwrap();
            line
        });
        (folder, path, thread)
    }

    #[test]
    fn a_missing_socket_and_a_dead_one_are_named_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("raysweepd.sock");
        let check = || {
            let error = Client::connect(&path).unwrap_err();
            assert!(
                matches!(&error, ClientError::NotRunning { path: named, .. } if *named == path),
                "{error}"
            );
        };
        check();
        drop(UnixListener::bind(&path).unwrap());
        assert!(path.exists());
        check();
    }

    #[test]
    fn the_advice_names_the_group_of_the_socket() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let users = Group::from_name("users").unwrap().map(|group| group.gid.as_raw());
        let is_given =
            users.is_some_and(|gid| std::os::unix::fs::chown(file.path(), None, Some(gid)).is_ok());
        let gid = Gid::from_raw(std::fs::metadata(file.path()).unwrap().gid());
        let name = Group::from_gid(gid).unwrap().unwrap().name;
        assert_eq!(name == "users", is_given);
        assert_eq!(advice(file.path()).contains(&format!("join the group `{name}`")), gid.as_raw() != 0);
    }

    #[test]
    fn nobody_is_told_to_join_the_group_of_root() {
        let advice = advice(Path::new("/"));
        assert!(advice.contains("started by root") && !advice.contains("join"), "{advice}");
    }

    #[test]
    fn a_call_is_one_line_and_its_error_comes_back_whole() {
        let answer = r#"{"jsonrpc":"2.0","id":1,"error":{"code":1,"message":"no","data":{"name":"invalid_plan","span":[3,5]}}}"#;
        let (_folder, path, peer) = peer(Box::leak(format!("{answer}\n").into_boxed_str()));
        let error = Client::connect(path).unwrap().check("a\nb").unwrap_err();
        let ClientError::Rpc(error) = error else { panic!("{error}") };
        assert_eq!((error.name(), error.data.unwrap().span), (Some(ErrorCode::InvalidPlan), Some((3, 5))));
        assert_eq!(
            peer.join().unwrap(),
            "{\"jsonrpc\":\"2.0\",\"id\":1,\"method\":\"check\",\"params\":{\"plan\":\"a\\nb\"}}\n"
        );
    }

    #[test]
    fn answers_that_are_none_are_refused() {
        for (answer, wanted) in [
            ("", "Lost"),
            ("{\"jsonrpc\":\"2.0\",\"id\":1,\"result\":{}}", "Lost"),
            ("HTTP/1.1 400 Bad Request\r\n", "Protocol"),
            ("{\"jsonrpc\":\"2.0\",\"id\":2,\"result\":{}}\n", "Protocol"),
            ("{\"jsonrpc\":\"2.0\",\"id\":1,\"result\":{\"sesion\":\"\"}}\n", "Protocol"),
            ("{\"jsonrpc\":\"2.0\",\"id\":null,\"error\":{\"code\":9,\"message\":\"full\"}}\n", "Rpc"),
        ] {
            let (_folder, path, peer) = peer(answer);
            let error = Client::connect(path).unwrap().cancel().unwrap_err();
            assert!(format!("{error:?}").starts_with(wanted), "{answer:?}: {error:?}");
            peer.join().unwrap();
        }
    }

    #[test]
    fn events_that_come_before_an_answer_are_kept() {
        let event = serde_json::to_string(&EventNotice::new(Event::Skipped { events: 3 })).unwrap();
        let subscribed = r#"{"jsonrpc":"2.0","id":1,"result":{}}"#;
        let answer = r#"{"jsonrpc":"2.0","id":2,"result":{}}"#;
        let lines = format!("{subscribed}\n{event}\n{answer}\n{event}\n");
        let (_folder, path, peer) = peer(Box::leak(lines.into_boxed_str()));
        let mut events = Client::connect(path).unwrap().subscribe().unwrap();
        events.client().pause().unwrap();
        for _ in 0..2 {
            assert_eq!(events.next().unwrap().unwrap(), Event::Skipped { events: 3 });
        }
        peer.join().unwrap();
    }

    #[test]
    fn an_event_that_comes_in_two_halves_is_one_event() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let listener = UnixListener::bind(&path).unwrap();
        let thread = thread::spawn(move || Client::connect(path).unwrap().subscribe().unwrap());
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(b"{\"jsonrpc\":\"2.0\",\"id\":1,\"result\":{}}\n").unwrap();
        let mut events = thread.join().unwrap();
        let wait = Duration::from_millis(1);
        assert_eq!(events.next_within(wait).unwrap(), None);
        stream.write_all(b"{\"jsonrpc\":\"2.0\",\"method\":\"event\",\"par").unwrap();
        assert_eq!(events.next_within(wait).unwrap(), None);
        stream.write_all(b"ams\":{\"event\":\"skipped\",\"events\":3}}\n").unwrap();
        assert_eq!(events.next().unwrap().unwrap(), Event::Skipped { events: 3 });
        drop(stream);
        assert!(matches!(events.next(), Some(Err(ClientError::Lost { .. }))));
    }
}
