//! One client: reads its lines, and sends responses and events.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use raysweep_core::io_text;
use raysweep_proto::{ErrorCode, Event, EventNotice, Id, Method, Request, Response, Role, RpcError};
use serde::Serialize;
use tokio::io::{AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::broadcast::{self, error::RecvError, error::TryRecvError};
use tokio_util::bytes::BytesMut;
use tokio_util::codec::{Decoder, LinesCodec, LinesCodecError};
use tokio_util::sync::CancellationToken;

use super::seats::Seat;
use super::{Desk, dispatch};

/// Serves a client until it hangs up, violates the line protocol, stops reading, or `stop` is set.
pub(super) async fn attend(stream: UnixStream, mut seat: Seat, desk: Arc<Desk>, stop: CancellationToken) {
    let peer = seat.peer;
    let asked = desk.clone();
    // Looking up groups may query a server over the network.
    let role = tokio::task::spawn_blocking(move || asked.access.role(peer)).await.unwrap_or(Role::Observer);
    tracing::debug!(uid = peer.uid, ?role, "a client has connected");
    if role == Role::Observer
        && let Err(error) = seat.observe()
    {
        return super::turn_away(stream, error, desk.limits).await;
    }
    let (reader, writer) = stream.into_split();
    let lines = Lines::new(reader, desk.limits.message_bytes);
    let mut connection = Connection { lines, writer, desk, seat, role, stop, events: None, attached: None };
    let conversed = connection.converse().await;
    connection.abandon().await;
    match conversed {
        Ok(()) => tracing::debug!(uid = peer.uid, "a client has gone"),
        // Clients end in this way whenever they exit before they have read everything.
        Err(error) if is_gone(&error) => tracing::debug!(uid = peer.uid, "a client has disconnected"),
        Err(error) => {
            tracing::info!(error = io_text(&error), uid = peer.uid, "a client was disconnected");
        }
    }
}

struct Connection {
    lines: Lines,
    writer: OwnedWriteHalf,
    desk: Arc<Desk>,
    seat: Seat,
    role: Role,
    stop: CancellationToken,
    events: Option<broadcast::Receiver<Event>>,
    /// The session of a run that ends with this connection.
    attached: Option<PathBuf>,
}

impl Connection {
    async fn converse(&mut self) -> io::Result<()> {
        loop {
            tokio::select! {
                () = self.stop.cancelled() => return self.farewell().await,
                line = self.lines.next() => match line? {
                    Line::Text(text) => self.answer(&text).await?,
                    Line::NotUtf8 => {
                        let message = "not UTF-8: encode JSON as UTF-8";
                        self.refuse(ErrorCode::ParseError, message).await?;
                    }
                    Line::TooLong => {
                        let bytes = self.desk.limits.message_bytes;
                        let message = format!("the message is longer than {bytes} bytes, which is the limit");
                        return self.refuse(ErrorCode::TooLong, message).await;
                    }
                    Line::End => return Ok(()),
                },
                event = next_event(&mut self.events) => self.notify(event).await?,
            }
        }
    }

    async fn answer(&mut self, text: &str) -> io::Result<()> {
        let request = match Request::parse(text) {
            Ok(request) => request,
            Err(response) => return self.send(&*response).await,
        };
        let id = request.id.clone();
        let outcome = self.call(request).await;
        match id {
            Some(id) => self.send(&Response::new(id, outcome)).await,
            None => Ok(()),
        }
    }

    async fn call(&mut self, request: Request) -> Result<serde_json::Value, RpcError> {
        let Some(method) = Method::from_name(&request.method) else {
            let message = format!("unknown method `{}`; `describe` lists the methods", request.method);
            return Err(RpcError::new(ErrorCode::MethodNotFound, message).of_field("method"));
        };
        if method.role() == Role::Operator && self.role != Role::Operator {
            return Err(self.desk.access.forbidden(method, self.seat.peer));
        }
        let _turn = match dispatch::computes(method) {
            true => tokio::select! {
                turn = self.seat.turn() => turn,
                () = self.stop.cancelled() => return Err(RpcError::new(ErrorCode::Busy, "the daemon is shutting down")),
            },
            false => None,
        };
        let control = self.desk.control.clone();
        let caller = dispatch::Caller { role: self.role, operators: self.desk.access.operators() };
        let call = move || dispatch::carry_out(&*control, method, caller, request.params);
        let reply = tokio::task::spawn_blocking(call).await.map_err(|error| {
            let name = method.name();
            tracing::error!(%error, method = name, "a call failed in the daemon");
            let message =
                format!("`{name}` failed because of a bug in the daemon, which keeps running; see its log");
            RpcError::new(ErrorCode::Internal, message)
        })??;
        if let Some(events) = reply.events {
            self.events = Some(events);
        }
        // Only one run is in progress at a time, so an earlier one is over.
        self.attached = reply.attached.or_else(|| self.attached.take());
        Ok(reply.result)
    }

    async fn notify(&mut self, event: Result<Event, RecvError>) -> io::Result<()> {
        match event {
            Ok(event) => self.send(&EventNotice::new(event)).await,
            Err(RecvError::Lagged(events)) => self.send(&EventNotice::new(Event::Skipped { events })).await,
            Err(RecvError::Closed) => {
                self.events = None;
                Ok(())
            }
        }
    }

    /// Sends the pending events: if the daemon is stopped during a run, they include the end of that run.
    async fn farewell(&mut self) -> io::Result<()> {
        let Some(mut events) = self.events.take() else { return Ok(()) };
        loop {
            match events.try_recv() {
                Ok(event) => self.notify(Ok(event)).await?,
                Err(TryRecvError::Lagged(skipped)) => self.notify(Err(RecvError::Lagged(skipped))).await?,
                Err(TryRecvError::Empty | TryRecvError::Closed) => return Ok(()),
            }
        }
    }

    /// Ends the run that is attached to this connection.
    async fn abandon(&mut self) {
        let Some(session) = self.attached.take() else { return };
        let control = self.desk.control.clone();
        if tokio::task::spawn_blocking(move || control.abandon(&session)).await.is_err() {
            tracing::error!("a run without its client was not cancelled: see the messages before");
        }
    }

    async fn refuse(&mut self, code: ErrorCode, message: impl Into<String>) -> io::Result<()> {
        self.send(&Response::error(Id::Null, RpcError::new(code, message))).await
    }

    async fn send(&mut self, message: &impl Serialize) -> io::Result<()> {
        send(&mut self.writer, message, self.desk.limits.write_timeout).await
    }
}

/// Whether the client itself has closed the connection.
fn is_gone(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::ConnectionReset | io::ErrorKind::BrokenPipe)
}

/// The next event; never returns for a client that has not subscribed.
async fn next_event(events: &mut Option<broadcast::Receiver<Event>>) -> Result<Event, RecvError> {
    match events {
        Some(events) => events.recv().await,
        None => std::future::pending().await,
    }
}

/// Sends one message as one line.
pub(super) async fn send(
    writer: &mut (impl AsyncWrite + Unpin),
    message: &impl Serialize,
    timeout: Duration,
) -> io::Result<()> {
    let mut line = serde_json::to_vec(message)?;
    line.push(b'\n');
    tokio::time::timeout(timeout, writer.write_all(&line)).await?
}

enum Line {
    Text(String),
    NotUtf8,
    TooLong,
    End,
}

/// The lines of a client, with limited length.
struct Lines {
    reader: OwnedReadHalf,
    codec: LinesCodec,
    buffer: BytesMut,
}

impl Lines {
    fn new(reader: OwnedReadHalf, max_bytes: usize) -> Self {
        Self { reader, codec: LinesCodec::new_with_max_length(max_bytes), buffer: BytesMut::new() }
    }

    /// The next line; cancel-safe. Text at the end without a line feed counts as a line, so that a one-line script
    /// need not send one; a truncated message is not valid JSON anyway.
    async fn next(&mut self) -> io::Result<Line> {
        let mut ended = false;
        loop {
            let decoded = match ended {
                true => self.codec.decode_eof(&mut self.buffer),
                false => self.codec.decode(&mut self.buffer),
            };
            match decoded {
                Ok(Some(text)) => return Ok(Line::Text(text)),
                Ok(None) if ended => return Ok(Line::End),
                Ok(None) => ended = self.reader.read_buf(&mut self.buffer).await? == 0,
                Err(LinesCodecError::MaxLineLengthExceeded) => return Ok(Line::TooLong),
                Err(LinesCodecError::Io(error)) if error.kind() == io::ErrorKind::InvalidData => {
                    return Ok(Line::NotUtf8);
                }
                Err(LinesCodecError::Io(error)) => return Err(error),
            }
        }
    }
}
