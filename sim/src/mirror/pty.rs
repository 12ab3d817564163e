//! Runs a simulated controller, of a mirror or any other device, at the far end of a pseudo-terminal or another serial
//! line, with line faults.

use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::fcntl::OFlag;
use nix::mount::{MsFlags, mount};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::pty::{grantpt, posix_openpt, ptsname_r, unlockpt};
use nix::sched::{CloneFlags, unshare};
use raysweep_core::Clock;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

use super::plant::{MirrorTruth, lock};
use crate::keyed::{Purpose, keyed, uniform};

/// A device's response to bytes on its serial line.
pub trait Controller: Send + 'static {
    /// Advances time to `now_ns`, handles `bytes`, and appends answers to `replies`.
    fn run(&mut self, bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>);

    /// The ground truth so far.
    fn truth(&self) -> Arc<Mutex<MirrorTruth>>;
}

/// Speed of the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SerialLink {
    /// A virtual serial port over USB: the baud rate has no effect.
    VirtualCom,
    /// A UART with ten bits per byte.
    Uart {
        /// Bits per second.
        baud: u32,
    },
}

/// Faults of the line, seeded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WireFaults {
    /// Seed of the faults.
    pub seed: u64,
    /// Fraction of replies preceded by 1 to 16 garbage bytes.
    pub garbage: f64,
    /// Fraction of milliseconds in which a stall starts: nothing is read or answered.
    pub stalls: f64,
    /// Duration of a stall.
    pub stall_ms: u32,
}

impl Default for WireFaults {
    fn default() -> Self {
        Self { seed: 1, garbage: 0.0, stalls: 0.0, stall_ms: 20 }
    }
}

/// A device's handler for bytes on its line, see [`Controller::run`].
pub type Run = Box<dyn FnMut(&[u8], i64, &mut Vec<u8>) + Send>;

/// A device at the end of a pseudo-terminal or another line. Dropping it unplugs it.
pub struct Pty {
    path: PathBuf,
    unplugged: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Pty {
    /// Plugs in a device. If permitted, at a pseudo-terminal that only the calling thread sees, and what it starts from
    /// then on.
    ///
    /// # Errors
    /// When a pseudo-terminal or a thread cannot be created.
    pub fn plug(run: Run, link: SerialLink, faults: WireFaults) -> io::Result<Self> {
        OWN_TERMINALS.with(|()| ());
        // Close-on-exec: a process started by a test must not keep an unplugged controller's port alive. The other end
        // is left to the driver, which can open and close it like a real port.
        let master = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let path = ptsname_r(&master)?.into();
        Self::start(File::from(OwnedFd::from(master)), path, run, link, faults, LineEnd::Terminal)
    }

    /// Plugs in a device at a guest's port, opened not to block; a driver opens the line's other end at `path`.
    ///
    /// # Errors
    /// When a thread cannot be created.
    pub fn attach(
        end: File,
        path: PathBuf,
        run: Run,
        link: SerialLink,
        faults: WireFaults,
    ) -> io::Result<Self> {
        Self::start(end, path, run, link, faults, LineEnd::Port)
    }

    fn start(
        end: File,
        path: PathBuf,
        run: Run,
        link: SerialLink,
        faults: WireFaults,
        at: LineEnd,
    ) -> io::Result<Self> {
        let unplugged = Arc::new(AtomicBool::new(false));
        let mut wire = Wire {
            end,
            device: run,
            link,
            faults,
            at,
            unplugged: unplugged.clone(),
            clock: Clock::real(),
            replies: 0,
        };
        let work = move || {
            if at == LineEnd::Terminal {
                run_as_soon_as_awake();
            }
            wire.run();
        };
        let thread = std::thread::Builder::new().name("pty".into()).spawn(work)?;
        Ok(Self { path, unplugged, thread: Some(thread) })
    }

    /// The port for the driver to open.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Unplugs the device: the port disappears, and the device loses power.
    pub fn unplug(&mut self) {
        self.unplugged.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic was already reported on stderr.
            let _ = thread.join();
        }
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        self.unplug();
    }
}

/// A mirror controller at the end of a pseudo-terminal or another line. Dropping it unplugs it.
pub struct MirrorPty {
    pty: Pty,
    truth: Arc<Mutex<MirrorTruth>>,
}

impl MirrorPty {
    /// Plugs in a controller.
    ///
    /// # Errors
    /// When a pseudo-terminal or a thread cannot be created.
    pub fn plug(controller: impl Controller, link: SerialLink, faults: WireFaults) -> io::Result<Self> {
        let truth = controller.truth();
        Ok(Self { pty: Pty::plug(run_of(controller), link, faults)?, truth })
    }

    /// Plugs in a controller at a guest's port, opened not to block; a driver opens the line's other end at `path`.
    ///
    /// # Errors
    /// When a thread cannot be created.
    pub fn attach(end: File, path: PathBuf, controller: impl Controller) -> io::Result<Self> {
        let truth = controller.truth();
        let faults = WireFaults::default();
        Ok(Self { pty: Pty::attach(end, path, run_of(controller), SerialLink::VirtualCom, faults)?, truth })
    }

    /// The port for the driver to open.
    pub fn path(&self) -> &Path {
        self.pty.path()
    }

    /// The controller's ground truth so far.
    pub fn truth(&self) -> MirrorTruth {
        lock(&self.truth).clone()
    }

    /// Reads a value from the ground truth without copying all outputs.
    pub fn look<T>(&self, at: impl FnOnce(&MirrorTruth) -> T) -> T {
        at(&lock(&self.truth))
    }

    /// Unplugs the controller: the port disappears, and the controller loses power.
    pub fn unplug(&mut self) {
        self.pty.unplug();
    }
}

fn run_of(mut controller: impl Controller) -> Run {
    Box::new(move |bytes: &[u8], now_ns, replies: &mut Vec<u8>| controller.run(bytes, now_ns, replies))
}

thread_local! {
    /// The kernel gives the number of an unplugged terminal to the next one. Whoever still holds the path of a device
    /// that is gone, such as a guardian that wants to park it, would then talk to the device of another test.
    static OWN_TERMINALS: () = {
        // Without the permission, terminals are shared with the rest of the machine.
        let _ = own_terminals();
    };
}

/// Mounts an instance of devpts for the calling thread alone.
fn own_terminals() -> nix::Result<()> {
    unshare(CloneFlags::CLONE_NEWNS)?;
    let none = None::<&str>;
    mount(none, "/", none, MsFlags::MS_REC | MsFlags::MS_PRIVATE, none)?;
    mount(
        Some("devpts"),
        "/dev/pts",
        Some("devpts"),
        MsFlags::empty(),
        Some("newinstance,ptmxmode=0666,mode=620"),
    )
}

/// Gives the calling thread real-time priority, if permitted: a real controller has its own processor and answers in
/// time however busy the host is. For hosts that must not be late, too.
pub fn run_as_soon_as_awake() {
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let _ = set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, policy);
}

/// The line's end at which the controller is.
#[derive(Clone, Copy, PartialEq)]
enum LineEnd {
    /// A pseudo-terminal. What the host does not read is lost, as on a real port.
    Terminal,
    /// A port of an emulated guest, which takes one write at a time: replies wait for room, up to a second, in which the
    /// controller does nothing else. It has no real-time priority, for with one processor it would starve the driver.
    Port,
}

struct Wire {
    end: File,
    device: Run,
    link: SerialLink,
    faults: WireFaults,
    at: LineEnd,
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
                SerialLink::VirtualCom => buffer.len(),
                SerialLink::Uart { baud } => {
                    // An idle line accumulates no credit.
                    let carried = (now_ns - start_ns) as u64 / 1000 * u64::from(baud) / 10_000_000;
                    taken = taken.max(carried.saturating_sub(64));
                    (carried.saturating_sub(taken) as usize).min(buffer.len())
                }
            };
            let read = match room {
                0 => 0,
                // EIO: nobody has the port open. In either case there is nothing to read.
                _ => self.end.read(&mut buffer[..room]).unwrap_or(0),
            };
            taken += read as u64;
            (self.device)(&buffer[..read], self.clock.now_ns(), &mut replies);
            if !stalled && !replies.is_empty() {
                self.answer(&mut replies);
            }
        }
        // Unplugging cuts the power: whatever the outputs were, the mirror springs back and the light goes out.
    }

    /// Waits for input, at most a millisecond, and never busily on a port that nobody has open.
    fn wait(&self) {
        let mut fds = [PollFd::new(self.end.as_fd(), PollFlags::POLLIN)];
        let ready = poll(&mut fds, PollTimeout::from(1_u8)).unwrap_or(0);
        let closed = fds[0].revents().is_some_and(|events| events.contains(PollFlags::POLLHUP));
        if closed || (ready > 0 && self.link != SerialLink::VirtualCom) {
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
        if self.at == LineEnd::Port {
            let mut fds = [PollFd::new(self.end.as_fd(), PollFlags::POLLOUT)];
            let _ = poll(&mut fds, PollTimeout::from(1000_u16));
        }
        let _ = self.end.write(replies);
        replies.clear();
    }

    fn draw(&self, key: &[u64]) -> f64 {
        uniform(&mut keyed(self.faults.seed, Purpose::MirrorWire, key))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A device that sends what it hears back, with a mark of its own.
    fn echo(mark: u8) -> Pty {
        let run = move |bytes: &[u8], _: i64, replies: &mut Vec<u8>| {
            replies.extend(bytes.iter().flat_map(|byte| [mark, *byte]));
        };
        Pty::plug(Box::new(run), SerialLink::VirtualCom, WireFaults::default()).unwrap()
    }

    #[test]
    fn the_path_of_an_unplugged_device_does_not_lead_to_that_of_another_thread() {
        if std::thread::spawn(own_terminals).join().unwrap().is_err() {
            return eprintln!("SKIPPED: this machine forbids mounts of one's own");
        }
        let (mut gone, other) = (echo(b'a'), std::thread::spawn(|| echo(b'b')));
        let path = gone.path().to_owned();
        gone.unplug();
        let other = other.join().unwrap();
        // Each has the first number, for neither sees the other's.
        assert_eq!((path.as_path(), other.path()), (Path::new("/dev/pts/0"), Path::new("/dev/pts/0")));
        assert!(!path.exists());
    }
}
