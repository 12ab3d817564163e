//! State on disk while a mirror is away from rest: enough to know its position after the process is gone.
//!
//! `NAME` contains the sequence; it is written, fsynced and renamed before the first sample is sent. `NAME.sent`
//! contains three numbers: samples that have certainly left the process, samples that may have left it, and the number
//! of the sequence that they belong to; of any other sequence, none has left. So a process that is killed between the
//! writes of the two files leaves a state that is true. `NAME.sent` is written before and after each write to the port,
//! without fsync: it only has to survive the process, and a crash of the machine is detected by the boot id. Before a
//! mirror is moved from a place that the files do not tell, it says so. `NAME.lock` is locked by the process that
//! drives the mirror.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg};
use raysweep_core::{DeviceError, DeviceErrorKind, MechanicalDeg, MirrorLimits};
use serde::{Deserialize, Serialize};

use super::light::{LightGuard, LightState, boot_id};
use super::sequence::Sequence;

/// Characters of `NAME.sent`: three numbers of 20 digits, two spaces and a newline.
const SENT_BYTES: usize = 63;

/// Why a mirror's state cannot be stored or read.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// A file cannot be written or read.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// The operation.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// The file is not a valid state.
    #[error("{} is not the state of a mirror: {source}: switch the mirror's controller off and on, then delete the file", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// Another process drives the mirror.
    #[error("{} is locked: another process drives the mirror and parks it itself; stop that process", path.display())]
    Locked {
        /// The lock file.
        path: PathBuf,
    },
}

impl StateError {
    fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}

/// How to reach the controller without the rig file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "driver", rename_all = "lowercase", deny_unknown_fields)]
pub(super) enum Reach {
    PlayzerX {
        port: PathBuf,
        /// [`node_of`] the port when it was opened.
        node: Option<u64>,
        full_scale: MechanicalDeg,
    },
    Mti {
        port: PathBuf,
        full_scale: MechanicalDeg,
    },
    Optotune {
        port: PathBuf,
        /// As for a PlayzerX.
        node: Option<u64>,
        laser_port: Option<PathBuf>,
    },
}

/// The content of `NAME`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MirrorState {
    pub boot_id: String,
    pub reach: Reach,
    pub limits: MirrorLimits,
    pub rate_hz: f64,
    /// The number of this state, another for each; 0 in files of earlier versions.
    #[serde(default)]
    pub number: u64,
    /// The sequence being played; `None` if the mirror is at rest.
    pub playing: Option<Sequence>,
}

/// Number of samples of a sequence that have left the process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sent {
    pub certainly: u64,
    pub possibly: u64,
}

impl Sent {
    /// What was sent does not tell the place any more.
    pub const UNKNOWN: Self = Self { certainly: u64::MAX, possibly: u64::MAX };
}

/// The files of one mirror, locked.
pub struct StateFile {
    path: PathBuf,
    sent: File,
    /// Number of the state on disk.
    number: AtomicU64,
    _lock: Flock<File>,
}

impl StateFile {
    /// Takes the lock; waits up to `patience` for another process to release it.
    ///
    /// # Errors
    /// `Locked`, or an error if the folder is not writable.
    pub fn open(path: &Path, patience: Duration) -> Result<Self, StateError> {
        let lock_path = beside(path, "lock");
        let deadline = Instant::now() + patience;
        let mut file = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .open(&lock_path)
            .map_err(StateError::io("open", &lock_path))?;
        let lock = loop {
            match Flock::lock(file, FlockArg::LockExclusiveNonblock) {
                Ok(lock) => break lock,
                Err((back, Errno::EWOULDBLOCK)) if Instant::now() < deadline => {
                    file = back;
                    std::thread::sleep(Duration::from_millis(1));
                }
                Err((_, Errno::EWOULDBLOCK)) => return Err(StateError::Locked { path: lock_path }),
                Err((_, errno)) => return Err(StateError::io("lock", &lock_path)(errno.into())),
            }
        };
        let sent_path = beside(path, "sent");
        let sent = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .read(true)
            .open(&sent_path)
            .map_err(StateError::io("open", &sent_path))?;
        // A damaged state is told by whoever reads it.
        let number = read(path).ok().flatten().map_or(0, |(state, _)| state.number);
        Ok(Self { path: path.to_owned(), sent, number: number.into(), _lock: lock })
    }

    /// Path of the state file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes a state to disk, with no samples sent.
    pub(super) fn write(&self, state: &MirrorState) -> Result<(), StateError> {
        let number = self.number.load(Ordering::Relaxed).wrapping_add(1);
        let state = MirrorState { number, ..state.clone() };
        let temporary = beside(&self.path, "new");
        let write = || -> io::Result<()> {
            let mut file = File::create(&temporary)?;
            file.write_all(&serde_json::to_vec(&state)?)?;
            file.sync_all()?;
            fs::rename(&temporary, &self.path)?;
            self.number.store(number, Ordering::Relaxed);
            let folder = self.path.parent().filter(|folder| !folder.as_os_str().is_empty());
            File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
        };
        write().map_err(StateError::io("write", &self.path))?;
        self.note_sent(Sent { certainly: 0, possibly: 0 })
    }

    /// Records that the files do not tell the mirror's place from now on. A disk that does not take this must not keep
    /// anybody from parking.
    pub(super) fn note_unknown(&self) {
        if let Err(error) = self.note_sent(Sent::UNKNOWN) {
            tracing::error!(%error, "a kill in the next moments would leave a wrong place");
        }
    }

    /// Records how much was sent.
    pub(super) fn note_sent(&self, sent: Sent) -> Result<(), StateError> {
        let mut line = [0; SENT_BYTES];
        // 20 digits fit any u64, so the line has a constant length.
        let number = self.number.load(Ordering::Relaxed);
        let _ = writeln!(&mut line[..], "{:020} {:020} {number:020}", sent.certainly, sent.possibly);
        self.sent.write_all_at(&line, 0).map_err(StateError::io("write", &beside(&self.path, "sent")))
    }

    /// The state and how much of it was sent; `None` if there never was one.
    pub(super) fn read(&self) -> Result<Option<(MirrorState, Sent)>, StateError> {
        read(&self.path)
    }
}

fn read(path: &Path) -> Result<Option<(MirrorState, Sent)>, StateError> {
    let text = match read_regular(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        read => read.map_err(StateError::io("read", path))?,
    };
    let state: MirrorState = serde_json::from_slice(&text)
        .map_err(|source| StateError::Damaged { path: path.to_owned(), source })?;
    let sent_path = beside(path, "sent");
    let sent = read_regular(&sent_path).map_err(StateError::io("read", &sent_path))?;
    let sent = String::from_utf8(sent).map_err(|error| {
        StateError::io("read", &sent_path)(io::Error::new(io::ErrorKind::InvalidData, error))
    })?;
    let mut numbers = sent.split_whitespace().map(|number| number.parse().unwrap_or(0));
    let mut next = || numbers.next().unwrap_or(0);
    let (sent, number) = (Sent { certainly: next(), possibly: next() }, next());
    let sent = if number == state.number { sent } else { Sent { certainly: 0, possibly: 0 } };
    Ok(Some((state, sent)))
}

/// Reads a file that somebody may have named: a pipe would block, a device has no end.
fn read_regular(path: &Path) -> io::Result<Vec<u8>> {
    match fs::metadata(path)?.is_file() {
        true => fs::read(path),
        false => Err(io::Error::new(io::ErrorKind::InvalidInput, "it is not a regular file")),
    }
}

/// `NAME.extension`: appended, so that the files of two mirrors never clash.
fn beside(path: &Path, extension: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(extension);
    name.into()
}

/// What `status` reports about a mirror and its light.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct MirrorReport {
    /// Whether the mirror is at the origin with the light off, according to the files.
    pub parked: bool,
    /// Whether samples with light may be playing.
    pub laser: bool,
    /// Whether a process is driving the mirror.
    pub driven: bool,
    /// Whether light is permitted, and by what.
    pub light: LightState,
}

impl MirrorReport {
    /// Reads the files of a mirror, even while a process drives it. A file that cannot be read counts as not parked.
    pub fn read(state: &Path, guard: &LightGuard) -> Self {
        let driven = matches!(StateFile::open(state, Duration::ZERO), Err(StateError::Locked { .. }));
        let (parked, laser) = match read(state) {
            Ok(None) => (true, false),
            Ok(Some((state, sent))) => match state.playing {
                None => (true, false),
                Some(sequence) => (false, sequence.is_lit() && sequence.of_path(sent.possibly) > 0),
            },
            Err(_) => (false, true),
        };
        Self { parked, laser, driven, light: guard.state() }
    }
}

impl MirrorState {
    /// A state of the current boot.
    pub fn new(
        reach: Reach,
        limits: MirrorLimits,
        rate_hz: f64,
        playing: Option<Sequence>,
    ) -> Result<Self, StateError> {
        let boot_id = boot_id().map_err(StateError::io("read", Path::new("boot_id")))?;
        Ok(Self { boot_id, reach, limits, rate_hz, number: 0, playing })
    }

    /// Whether data written without fsync are still valid.
    fn is_of_this_boot(&self) -> bool {
        boot_id().is_ok_and(|boot_id| boot_id == self.boot_id)
    }

    /// Whether the cable at `port` has stayed plugged in since `node` was recorded. If not, sent samples, and perhaps
    /// the controller's power, were lost.
    pub fn is_plugged_in_since(&self, port: &Path, node: Option<u64>) -> bool {
        self.is_of_this_boot() && node.is_some() && node == node_of(port)
    }
}

/// Inode of the device node that a port's name leads to: the kernel creates a new node whenever a cable is plugged
/// in.
pub(super) fn node_of(port: &Path) -> Option<u64> {
    fs::metadata(port).ok().map(|node| node.ino())
}

/// Converts to a device error of the mirror.
pub(super) fn of_state(error: StateError) -> DeviceError {
    let kind = match error {
        StateError::Locked { .. } => DeviceErrorKind::Busy,
        _ => DeviceErrorKind::NotReady,
    };
    DeviceError::new("mirror", kind, error)
}
