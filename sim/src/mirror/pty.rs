//! A controller, of a mirror or of anything else, at the far end of a pseudo-terminal or of another line, with the faults of its
//! wire.

use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::fcntl::OFlag;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::pty::{grantpt, posix_openpt, ptsname_r, unlockpt};
use raysweep_core::Clock;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

use super::plant::{MirrorTruth, lock};
use crate::keyed::{Purpose, keyed, uniform};

/// What a controller does with what comes over its wire.
pub trait Controller: Send + 'static {
    /// Lets time pass to `now_ns`, takes `bytes`, and appends what it answers to `replies`.
    fn run(&mut self, bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>);

    /// What it did so far.
    fn truth(&self) -> Arc<Mutex<MirrorTruth>>;
}

/// How fast the wire takes bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    /// A virtual serial port over USB: the baud rate means nothing.
    VirtualCom,
    /// A UART: ten bits a byte.
    Uart {
        /// Bits a second.
        baud: u32,
    },
}

/// What goes wrong on the wire, seeded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WireFaults {
    /// Seeds them.
    pub seed: u64,
    /// Share of replies with garbage of 1 to 16 bytes before them.
    pub garbage: f64,
    /// Share of the wire's milliseconds that begin a stall: nothing is read or answered.
    pub stalls: f64,
    /// How long a stall lasts.
    pub stall_ms: u32,
}

impl Default for WireFaults {
    fn default() -> Self {
        Self { seed: 1, garbage: 0.0, stalls: 0.0, stall_ms: 20 }
    }
}

/// What a device does with what comes over its wire: [`Controller::run`].
pub type Run = Box<dyn FnMut(&[u8], i64, &mut Vec<u8>) + Send>;

/// A device on a pseudo-terminal or another line. Dropping it unplugs it.
pub struct Pty {
    path: PathBuf,
    unplugged: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Pty {
    /// Plugs a device in.
    ///
    /// # Errors
    /// When there is no pseudo-terminal or no thread.
    pub fn plug(run: Run, link: Link, faults: WireFaults) -> io::Result<Self> {
        // Closed on exec: a process that a test starts must not keep an unplugged controller's port alive. The other end
        // is left to the driver, so that it can be opened and closed like a real port.
        let master = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let path = ptsname_r(&master)?.into();
        Self::start(File::from(OwnedFd::from(master)), path, run, link, faults, run_as_soon_as_awake)
    }

    /// Plugs a device in at one end of a line, opened without blocking, whose other end a driver opens at `path`.
    ///
    /// # Errors
    /// When there is no thread.
    pub fn attach(end: File, path: PathBuf, run: Run, link: Link, faults: WireFaults) -> io::Result<Self> {
        // In a guest whose one processor is emulated it would leave none for the driver.
        Self::start(end, path, run, link, faults, || ())
    }

    fn start(
        end: File,
        path: PathBuf,
        run: Run,
        link: Link,
        faults: WireFaults,
        begin: fn(),
    ) -> io::Result<Self> {
        let unplugged = Arc::new(AtomicBool::new(false));
        let mut wire = Wire {
            end,
            device: run,
            link,
            faults,
            unplugged: unplugged.clone(),
            clock: Clock::real(),
            replies: 0,
        };
        let work = move || {
            begin();
            wire.run();
        };
        let thread = std::thread::Builder::new().name("pty".into()).spawn(work)?;
        Ok(Self { path, unplugged, thread: Some(thread) })
    }

    /// The port that a driver opens.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Pulls the plug: the port goes away, and with it the power.
    pub fn unplug(&mut self) {
        self.unplugged.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A device that panicked has said so on stderr.
            let _ = thread.join();
        }
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        self.unplug();
    }
}

/// A mirror's controller on a pseudo-terminal or another line. Dropping it unplugs it.
pub struct MirrorPty {
    pty: Pty,
    truth: Arc<Mutex<MirrorTruth>>,
}

impl MirrorPty {
    /// Plugs a controller in.
    ///
    /// # Errors
    /// When there is no pseudo-terminal or no thread.
    pub fn plug(controller: impl Controller, link: Link, faults: WireFaults) -> io::Result<Self> {
        let truth = controller.truth();
        Ok(Self { pty: Pty::plug(run_of(controller), link, faults)?, truth })
    }

    /// Plugs a controller in at one end of a line without faults, opened without blocking, whose other end a driver opens at
    /// `path`.
    ///
    /// # Errors
    /// When there is no thread.
    pub fn attach(end: File, path: PathBuf, controller: impl Controller) -> io::Result<Self> {
        let truth = controller.truth();
        let faults = WireFaults::default();
        Ok(Self { pty: Pty::attach(end, path, run_of(controller), Link::VirtualCom, faults)?, truth })
    }

    /// The port that a driver opens.
    pub fn path(&self) -> &Path {
        self.pty.path()
    }

    /// What the controller did so far.
    pub fn truth(&self) -> MirrorTruth {
        lock(&self.truth).clone()
    }

    /// One figure of it, without a copy of all outputs.
    pub fn look<T>(&self, at: impl FnOnce(&MirrorTruth) -> T) -> T {
        at(&lock(&self.truth))
    }

    /// Pulls the plug: the port goes away, and with it the power.
    pub fn unplug(&mut self) {
        self.pty.unplug();
    }
}

fn run_of(mut controller: impl Controller) -> Run {
    Box::new(move |bytes: &[u8], now_ns, replies: &mut Vec<u8>| controller.run(bytes, now_ns, replies))
}

/// Has the calling thread run as soon as it wakes, where that is permitted: a controller has a processor of its own, and
/// answers in time whatever the host is busy with.
fn run_as_soon_as_awake() {
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let _ = set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, policy);
}

struct Wire {
    end: File,
    device: Run,
    link: Link,
    faults: WireFaults,
    unplugged: Arc<AtomicBool>,
    clock: Clock,
    replies: u64,
}

impl Wire {
    fn run(&mut self) {
        let start_ns = self.clock.now_ns();
        let (mut taken, mut stalled_until_ns, mut last_ms) = (0_u64, 0, 0);
        let mut buffer = [0; 4096];
        let mut replies = Vec::new();
        while !self.unplugged.load(Ordering::Relaxed) {
            self.wait();
            let now_ns = self.clock.now_ns();
            let ms = (now_ns - start_ns) / 1_000_000;
            let begins = |ms: i64| self.draw(&[0, ms.unsigned_abs()]) < self.faults.stalls;
            if now_ns >= stalled_until_ns && (last_ms + 1..=ms).any(begins) {
                stalled_until_ns = now_ns + i64::from(self.faults.stall_ms) * 1_000_000;
            }
            last_ms = ms;
            let stalled = now_ns < stalled_until_ns;
            let room = match self.link {
                _ if stalled => 0,
                Link::VirtualCom => buffer.len(),
                Link::Uart { baud } => {
                    // An idle line saves nothing up.
                    let carried = (now_ns - start_ns) as u64 / 1000 * u64::from(baud) / 10_000_000;
                    taken = taken.max(carried.saturating_sub(64));
                    (carried.saturating_sub(taken) as usize).min(buffer.len())
                }
            };
            let read = match room {
                0 => 0,
                // EIO: nobody has the port open. Either way there is nothing to take.
                _ => self.end.read(&mut buffer[..room]).unwrap_or(0),
            };
            taken += read as u64;
            (self.device)(&buffer[..read], self.clock.now_ns(), &mut replies);
            if !stalled && !replies.is_empty() {
                self.answer(&mut replies);
            }
        }
        // The power goes with the plug: whatever a mirror's controller held, the mirror springs back and the light goes out.
    }

    /// Until something comes, a millisecond at most, and never at full speed on a port that nobody has open.
    fn wait(&self) {
        let mut fds = [PollFd::new(self.end.as_fd(), PollFlags::POLLIN)];
        let ready = poll(&mut fds, PollTimeout::from(1_u8)).unwrap_or(0);
        let closed = fds[0].revents().is_some_and(|events| events.contains(PollFlags::POLLHUP));
        if closed || (ready > 0 && self.link != Link::VirtualCom) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn answer(&mut self, replies: &mut Vec<u8>) {
        self.replies += 1;
        if self.draw(&[1, self.replies]) < self.faults.garbage {
            let length = 1 + (self.draw(&[2, self.replies]) * 16.0) as u64;
            let garbage = (0..length).map(|n| (self.draw(&[3, self.replies, n]) * 256.0) as u8);
            replies.splice(0..0, garbage);
        }
        // A host that reads nothing loses replies, as on a real port.
        let _ = self.end.write(replies);
        replies.clear();
    }

    fn draw(&self, key: &[u64]) -> f64 {
        uniform(&mut keyed(self.faults.seed, Purpose::MirrorWire, key))
    }
}
