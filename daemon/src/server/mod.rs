//! The socket: JSON-RPC 2.0, one message per line, for several clients at once.
//!
//! One task serves one client, one request after another, so that at most [`Limits::clients`] calls are in progress.
//! Of each user, one call at a time computes.
//! Calls run on tokio's blocking threads; events arrive over a broadcast channel that never waits for a reader, so
//! that no client slows down the run.

mod access;
mod connection;
mod dispatch;
mod listen;
mod seats;

use std::future::Future;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use nix::errno::Errno;
use raysweep_proto::{
    CLIENTS_OF_OPERATORS, Id, MAX_CLIENTS, MAX_CLIENTS_PER_USER, MAX_MESSAGE_BYTES, Response, RpcError,
};
use tokio::net::{UnixListener, UnixStream};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

pub use self::access::{Access, Peer};
pub use self::listen::{ListenError, Listening, SocketFile};
use self::seats::Seats;
use crate::control::Control;

/// How long clients may take, after shutdown, to read what is left for them.
const FAREWELL: Duration = Duration::from_secs(2);

/// Limits of the server.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// The longest request, without its line feed.
    pub message_bytes: usize,
    /// How many clients may be connected at once.
    pub clients: usize,
    /// How many connections one user may have.
    pub clients_per_user: usize,
    /// How many of the connections only operators may take.
    pub clients_of_operators: usize,
    /// How long a client may take to make room for a message before it is dropped.
    pub write_timeout: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            message_bytes: MAX_MESSAGE_BYTES,
            clients: MAX_CLIENTS,
            clients_per_user: MAX_CLIENTS_PER_USER,
            clients_of_operators: CLIENTS_OF_OPERATORS,
            write_timeout: Duration::from_secs(10),
        }
    }
}

/// Shared by the tasks of all clients.
struct Desk {
    control: Arc<dyn Control>,
    access: Access,
    limits: Limits,
}

/// Serves clients until `shutdown`; then every subscriber still receives its pending events, and all connections are
/// closed within about 2 s.
///
/// # Errors
/// When the listener cannot accept any more. Errors of a single client affect only that client.
pub async fn serve(
    listener: UnixListener,
    control: Arc<dyn Control>,
    access: Access,
    shutdown: impl Future<Output = ()>,
) -> io::Result<()> {
    serve_within(Limits::default(), listener, control, access, shutdown).await
}

/// Like [`serve`], with other limits.
///
/// # Errors
/// Those of [`serve`].
pub async fn serve_within(
    limits: Limits,
    listener: UnixListener,
    control: Arc<dyn Control>,
    access: Access,
    shutdown: impl Future<Output = ()>,
) -> io::Result<()> {
    let desk = Arc::new(Desk { control, access, limits });
    let seats = Seats::new(limits);
    let stop = CancellationToken::new();
    let mut clients = JoinSet::new();
    tokio::pin!(shutdown);
    let outcome = loop {
        tokio::select! {
            () = &mut shutdown => break Ok(()),
            Some(ended) = clients.join_next() => {
                if let Err(error) = ended {
                    tracing::error!(%error, "a client's task failed");
                }
            }
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => match desk.access.peer(&stream).map(|peer| seats.take(peer)) {
                    Ok(Ok(seat)) => {
                        clients.spawn(connection::attend(stream, seat, desk.clone(), stop.clone()));
                    }
                    Ok(Err(error)) => turn_away(stream, error, limits).await,
                    Err(error) => tracing::warn!(%error, "a client without credentials is dropped"),
                },
                Err(error) if passes(&error) => {
                    tracing::warn!(%error, "cannot accept a client now");
                    tokio::time::sleep(Duration::from_millis(100)).await;
                }
                Err(error) => break Err(error),
            },
        }
    };
    stop.cancel();
    let farewell = async { while clients.join_next().await.is_some() {} };
    if tokio::time::timeout(FAREWELL, farewell).await.is_err() {
        tracing::warn!(clients = clients.len(), "clients that did not read in time are dropped");
    }
    outcome
}

/// Whether accepting may succeed later: the client has disconnected, or descriptors or memory are short.
fn passes(error: &io::Error) -> bool {
    let errno = error.raw_os_error().map(Errno::from_raw);
    matches!(
        errno,
        Some(
            Errno::ECONNABORTED
                | Errno::EMFILE
                | Errno::ENFILE
                | Errno::ENOBUFS
                | Errno::ENOMEM
                | Errno::EPERM
        )
    )
}

/// Tells a client that there is no place for it. A new socket's buffer is empty, so this does not wait.
async fn turn_away(mut stream: UnixStream, error: RpcError, limits: Limits) {
    let response = Response::error(Id::Null, error);
    if let Err(error) = connection::send(&mut stream, &response, limits.write_timeout).await {
        tracing::debug!(%error, "a client that was turned away did not listen");
    }
}
