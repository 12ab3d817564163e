//! What is on disk while a mirror is away from rest: enough to know where it is when the process is gone.
//!
//! `NAME` holds the sequence, written, fsynced and renamed before its first sample leaves. `NAME.sent` holds two
//! numbers: samples that have certainly left the process, and samples that may have. It is written before and after
//! each write to the port, without fsync: it must outlive the process, and a machine that went down as well is told by
//! its boot id. `NAME.lock` is locked by whoever drives the mirror.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg};
use raysweep_core::{DeviceError, DeviceErrorKind, MechanicalDeg, MirrorLimits};
use serde::{Deserialize, Serialize};

use super::light::{LightGuard, LightState, boot_id};
use super::sequence::Sequence;

/// Characters of `NAME.sent`: two numbers of 20 digits, a space and a line's end.
const SENT_BYTES: usize = 42;

/// Why a mirror's state cannot be kept or read.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// A file cannot be written or read.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The file is no state.
    #[error("{} is not the state of a mirror: {source}: switch the mirror's controller off and on, then delete the file", path.display())]
    Damaged {
        /// Which file.
        path: PathBuf,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// Somebody drives the mirror.
    #[error("{} is locked: another process drives the mirror and parks it itself; stop that process", path.display())]
    Locked {
        /// The lock's file.
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
        /// [`node_of`] the port while it was open.
        node: Option<u64>,
        full_scale: MechanicalDeg,
    },
    Mti {
        port: PathBuf,
        full_scale: MechanicalDeg,
    },
    Optotune {
        port: PathBuf,
        /// As of a PlayzerX.
        node: Option<u64>,
        laser_port: Option<PathBuf>,
    },
}

/// What `NAME` holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MirrorState {
    pub boot_id: String,
    pub reach: Reach,
    pub limits: MirrorLimits,
    pub rate_hz: f64,
    /// What is being played; none when the mirror is at rest.
    pub playing: Option<Sequence>,
}

/// How many samples of a sequence have left the process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sent {
    pub certainly: u64,
    pub possibly: u64,
}

/// The files of one mirror, locked.
pub struct StateFile {
    path: PathBuf,
    sent: File,
    _lock: Flock<File>,
}

impl StateFile {
    /// Takes the lock; waits `patience` for whoever has it.
    ///
    /// # Errors
    /// `Locked`, or when the folder cannot be written.
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
        Ok(Self { path: path.to_owned(), sent, _lock: lock })
    }

    /// Where the state is kept.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Puts a state on disk, with nothing of it sent.
    pub(super) fn write(&self, state: &MirrorState) -> Result<(), StateError> {
        self.note_sent(Sent { certainly: 0, possibly: 0 })?;
        let temporary = beside(&self.path, "new");
        let write = || -> io::Result<()> {
            let mut file = File::create(&temporary)?;
            file.write_all(&serde_json::to_vec(state)?)?;
            file.sync_all()?;
            fs::rename(&temporary, &self.path)?;
            let folder = self.path.parent().filter(|folder| !folder.as_os_str().is_empty());
            File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
        };
        write().map_err(StateError::io("write", &self.path))
    }

    /// Notes how much was sent.
    pub(super) fn note_sent(&self, sent: Sent) -> Result<(), StateError> {
        let mut line = [0; SENT_BYTES];
        // 20 digits hold any u64, so the line has its length always.
        let _ = writeln!(&mut line[..], "{:020} {:020}", sent.certainly, sent.possibly);
        self.sent.write_all_at(&line, 0).map_err(StateError::io("write", &beside(&self.path, "sent")))
    }

    /// The state, and how much of it was sent; none when there never was one.
    pub(super) fn read(&self) -> Result<Option<(MirrorState, Sent)>, StateError> {
        read(&self.path)
    }
}

fn read(path: &Path) -> Result<Option<(MirrorState, Sent)>, StateError> {
    let text = match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        read => read.map_err(StateError::io("read", path))?,
    };
    let state = serde_json::from_slice(&text)
        .map_err(|source| StateError::Damaged { path: path.to_owned(), source })?;
    let sent_path = beside(path, "sent");
    let sent = fs::read_to_string(&sent_path).map_err(StateError::io("read", &sent_path))?;
    let mut numbers = sent.split_whitespace().map(|number| number.parse().unwrap_or(0));
    let mut next = || numbers.next().unwrap_or(0);
    Ok(Some((state, Sent { certainly: next(), possibly: next() })))
}

/// `NAME.extension`: appended, so that two mirrors' files never meet.
fn beside(path: &Path, extension: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(extension);
    name.into()
}

/// What `status` says of a mirror and its light.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct MirrorReport {
    /// Whether the mirror is at the origin with the light off, as far as the files tell.
    pub parked: bool,
    /// Whether samples with light may be playing.
    pub laser: bool,
    /// Whether a process drives the mirror.
    pub driven: bool,
    /// Whether there may be light, and by whose word.
    pub light: LightState,
}

impl MirrorReport {
    /// Reads the files of a mirror, whoever drives it. A file that cannot be read is not a parked mirror.
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
    /// A state of this boot.
    pub fn new(
        reach: Reach,
        limits: MirrorLimits,
        rate_hz: f64,
        playing: Option<Sequence>,
    ) -> Result<Self, StateError> {
        let boot_id = boot_id().map_err(StateError::io("read", Path::new("boot_id")))?;
        Ok(Self { boot_id, reach, limits, rate_hz, playing })
    }

    /// Whether what was noted without fsync is still true.
    fn is_of_this_boot(&self) -> bool {
        boot_id().is_ok_and(|boot_id| boot_id == self.boot_id)
    }

    /// Whether the cable at `port` has been in its place since `node` was noted, and with it what was sent and perhaps
    /// the controller's power.
    pub fn is_plugged_in_since(&self, port: &Path, node: Option<u64>) -> bool {
        self.is_of_this_boot() && node.is_some() && node == node_of(port)
    }
}

/// Which device node a port's name leads to: the kernel makes a new one whenever a cable is plugged in.
pub(super) fn node_of(port: &Path) -> Option<u64> {
    fs::metadata(port).ok().map(|node| node.ino())
}

/// As an error of the mirror.
pub(super) fn of_state(error: StateError) -> DeviceError {
    let kind = match error {
        StateError::Locked { .. } => DeviceErrorKind::Busy,
        _ => DeviceErrorKind::NotReady,
    };
    DeviceError::new("mirror", kind, error)
}
