//! The socket: JSON-RPC 2.0, one message per line, for several clients at once.
//!
//! One task serves one client, one request after another, so that at most [`Limits::clients`] calls are in progress.
//! Calls run on tokio's blocking threads; events arrive over a broadcast channel that never waits for a reader, so
//! that no client slows down the run.

mod access;
mod connection;
mod dispatch;
mod listen;

use std::future::Future;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use nix::errno::Errno;
use raysweep_proto::{ErrorCode, Id, MAX_CLIENTS, MAX_MESSAGE_BYTES, Response, RpcError};
use tokio::net::{UnixListener, UnixStream};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

pub use self::access::{Access, Peer};
pub use self::listen::{ListenError, Listening, SocketFile};
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
    /// How long a client may take to make room for a message before it is dropped.
    pub write_timeout: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            message_bytes: MAX_MESSAGE_BYTES,
            clients: MAX_CLIENTS,
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
                Ok((stream, _)) if clients.len() < limits.clients => {
                    clients.spawn(connection::attend(stream, desk.clone(), stop.clone()));
                }
                Ok((stream, _)) => turn_away(stream, limits).await,
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

/// Tells a client that the server is full. A new socket's buffer is empty, so this does not wait.
async fn turn_away(mut stream: UnixStream, limits: Limits) {
    let message =
        format!("{} clients are already connected; close one of them, or try again later", limits.clients);
    let response = Response::error(Id::Null, RpcError::new(ErrorCode::TooManyClients, message));
    if let Err(error) = connection::send(&mut stream, &response, limits.write_timeout).await {
        tracing::debug!(%error, "a client that was turned away did not listen");
    }
}
