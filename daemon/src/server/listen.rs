//! The listening socket: our own, or one passed by the service manager.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind};
use std::os::fd::{FromRawFd, OwnedFd};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt, PermissionsExt};
use std::os::unix::net::{UnixListener as StdListener, UnixStream as StdStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use nix::fcntl::OFlag;
use nix::sys::socket::{getsockopt, sockopt::AcceptConn};
use raysweep_core::io_text;
use tokio::net::UnixListener;

/// Everybody may connect; [`super::Access`] decides who may operate the rig and who only observes.
const SOCKET_MODE: u32 = 0o666;

/// Why the daemon cannot listen.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// Another daemon is listening there.
    #[error("another raysweepd listens on {}: stop it, or choose another --socket", .0.display())]
    Taken(PathBuf),
    /// The path exists, but is not a socket.
    #[error("{} exists and is not a socket: remove it, or choose another --socket", .0.display())]
    NotASocket(PathBuf),
    /// The socket cannot be created.
    #[error("cannot listen on {}: {}; its folder must exist and be writable", path.display(), io_text(source))]
    Bind {
        /// Path of the socket.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The socket passed by the service manager is unusable.
    #[error("socket activation: {0}")]
    Inherited(String),
}

/// A listening socket. Must be created within a tokio runtime.
#[derive(Debug)]
pub struct Listening {
    /// For [`super::serve`].
    pub listener: UnixListener,
    /// The socket's file, if we must remove it.
    pub file: Option<SocketFile>,
}

/// The file of a socket that we created; it is removed when this is dropped.
#[derive(Debug)]
pub struct SocketFile {
    path: PathBuf,
    /// Locked until the socket is removed. It stays: if it were removed, two daemons could lock two files.
    _lock: File,
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_file(&self.path) {
            tracing::warn!(%error, path = %self.path.display(), "cannot remove the socket");
        }
    }
}

impl Listening {
    /// Creates a socket with mode 0666. A socket left by a dead daemon is replaced. A lock beside it, its name with
    /// `.lock` at the end, decides between daemons that start at once.
    ///
    /// # Errors
    /// [`ListenError::Taken`], [`ListenError::NotASocket`], [`ListenError::Bind`].
    pub fn bind(path: &Path) -> Result<Self, ListenError> {
        let failed = |source| ListenError::Bind { path: path.to_owned(), source };
        let lock = File::options()
            .write(true)
            .create(true)
            .truncate(false)
            .custom_flags(OFlag::O_NOFOLLOW.bits())
            .mode(0o600)
            .open(lock_of(path))
            .map_err(failed)?;
        lock.try_lock().map_err(|error| match error {
            TryLockError::WouldBlock => ListenError::Taken(path.to_owned()),
            TryLockError::Error(source) => failed(source),
        })?;
        remove_stale(path)?;
        let listener = UnixListener::bind(path).map_err(failed)?;
        let file = SocketFile { path: path.to_owned(), _lock: lock };
        fs::set_permissions(path, fs::Permissions::from_mode(SOCKET_MODE)).map_err(failed)?;
        Ok(Self { listener, file: Some(file) })
    }

    /// Takes over the socket that the service manager passes (`LISTEN_FDS`, sd_listen_fds(3)); `None` if it passes
    /// none, or if it was taken already.
    ///
    /// # Errors
    /// [`ListenError::Inherited`] unless it is one listening Unix stream socket.
    pub fn inherited() -> Result<Option<Self>, ListenError> {
        static TAKEN: AtomicBool = AtomicBool::new(false);
        let failed = |error: io::Error| ListenError::Inherited(error.to_string());
        let mut passed = sd_notify::listen_fds().map_err(failed)?;
        let fd = match (passed.next(), passed.next()) {
            (None, _) => return Ok(None),
            (Some(fd), None) => fd,
            (Some(_), Some(_)) => {
                let message = "several sockets were passed; the .socket unit must name one ListenStream=";
                return Err(ListenError::Inherited(message.into()));
            }
        };
        if TAKEN.swap(true, Ordering::Relaxed) {
            return Ok(None);
        }
        #[expect(
            unsafe_code,
            reason = "nothing safe turns the number of an inherited descriptor into its owner"
        )]
        // SAFETY: `listen_fds` found our own process id in LISTEN_PID and could set a flag of this descriptor, so it
        // is open and was passed to us to own; `TAKEN` ensures that nothing else in this process owns it.
        let fd = unsafe { OwnedFd::from_raw_fd(fd) };
        if !getsockopt(&fd, AcceptConn).unwrap_or(false) {
            let message =
                "the passed socket does not listen; the .socket unit needs ListenStream= and Accept=no";
            return Err(ListenError::Inherited(message.into()));
        }
        let listener = StdListener::from(fd);
        listener.local_addr().map_err(|error| {
            ListenError::Inherited(format!(
                "the passed socket is not a Unix socket ({error}); give ListenStream= a path"
            ))
        })?;
        listener.set_nonblocking(true).map_err(failed)?;
        Ok(Some(Self { listener: UnixListener::from_std(listener).map_err(failed)?, file: None }))
    }
}

fn lock_of(socket: &Path) -> PathBuf {
    let mut name = socket.as_os_str().to_owned();
    name.push(".lock");
    name.into()
}

/// Removes a socket that nobody listens on.
fn remove_stale(path: &Path) -> Result<(), ListenError> {
    let Ok(metadata) = fs::symlink_metadata(path) else { return Ok(()) };
    if !metadata.file_type().is_socket() {
        return Err(ListenError::NotASocket(path.to_owned()));
    }
    match StdStream::connect(path) {
        Err(error) if error.kind() == ErrorKind::ConnectionRefused => {
            fs::remove_file(path).map_err(|source| ListenError::Bind { path: path.to_owned(), source })
        }
        // A full queue or a lack of permission also means that somebody is listening.
        _ => Err(ListenError::Taken(path.to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_living_daemon_is_left_alone_and_a_dead_ones_socket_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("raysweepd.sock");
        let first = Listening::bind(&path).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o666);
        let taken = Listening::bind(&path).unwrap_err();
        assert!(matches!(taken, ListenError::Taken(_)), "{taken}");
        StdStream::connect(&path).expect("the first is still there");

        // A killed daemon removes nothing, and its locks end with it.
        let Listening { listener, file } = first;
        drop((listener, file));
        drop(StdListener::bind(&path).unwrap());
        assert!(path.exists());
        let second = Listening::bind(&path).unwrap();
        StdStream::connect(&path).unwrap();
        drop(second);
        assert!(!path.exists(), "a daemon that ends in order leaves nothing");
    }

    #[tokio::test]
    async fn of_daemons_that_start_at_once_one_listens() {
        let folder = tempfile::tempdir().unwrap();
        for round in 0..50 {
            let path = folder.path().join(format!("{round}.sock"));
            drop(StdListener::bind(&path).unwrap());
            let handle = tokio::runtime::Handle::current();
            let listening: Vec<_> = std::thread::scope(|scope| {
                let bind = || {
                    let _within = handle.enter();
                    Listening::bind(&path).ok()
                };
                let daemons: Vec<_> = (0..4).map(|_| scope.spawn(bind)).collect();
                daemons.into_iter().filter_map(|daemon| daemon.join().unwrap()).collect()
            });
            assert_eq!(listening.len(), 1, "round {round}");
            StdStream::connect(&path).expect("nobody has removed its socket");
        }
    }

    #[tokio::test]
    async fn a_daemon_whose_socket_was_made_by_an_earlier_version_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("raysweepd.sock");
        let _without_lock = StdListener::bind(&path).unwrap();
        assert!(matches!(Listening::bind(&path), Err(ListenError::Taken(_))));
        StdStream::connect(&path).unwrap();
    }

    #[tokio::test]
    async fn what_is_no_socket_is_not_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("precious");
        fs::write(&path, "data").unwrap();
        assert!(matches!(Listening::bind(&path), Err(ListenError::NotASocket(_))));
        assert_eq!(fs::read_to_string(&path).unwrap(), "data");
        let nowhere = folder.path().join("no/such/folder.sock");
        assert!(matches!(Listening::bind(&nowhere), Err(ListenError::Bind { .. })));
    }

    #[tokio::test]
    async fn without_a_service_manager_nothing_is_inherited() {
        assert!(Listening::inherited().unwrap().is_none());
    }
}
