//! VSYNC on a modem line of a serial port: waits with `TIOCMIWAIT`, counts with `TIOCGICOUNT`.
//!
//! Timestamps are taken when the waiting thread wakes: about 10 us late on an on-board port, up to a millisecond with
//! a USB converter. If the line is DCD, the kernel's own timestamps ([`super::pps`]) are better.
//!
//! The kernel counts transitions, not edges of one direction. A level read after a wait may have changed in between,
//! and over USB it does not arrive together with the count. So edges are identified by the parity of the count. While
//! the caller waits for an edge, in the quiet time between two pulses, parity and level are compared.

use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::fcntl::{OFlag, open};
use nix::sys::stat::Mode;
use nix::sys::termios::{ControlFlags, SetArg, cfmakeraw, tcgetattr, tcsetattr};
pub use raysweep_config::rig::vsync::ModemLineInput;
use raysweep_config::rig::vsync::Polarity;
use raysweep_core::{Clock, DeviceError, DeviceErrorKind, Edge, Vsync};

use super::{DEVICE, ioctl, system_error};

/// Maximum number of edges that wait for the reader: 4 s at 60 Hz. Any more are lost, which shows in their numbers.
const QUEUE: usize = 256;

/// Interval of comparing parity and level while no edge arrives; a VSYNC is quiet for longer between its pulses.
const QUIET: Duration = Duration::from_millis(4);

/// This many mismatches in a row mean an uncounted transition. Fewer can be caused by a late count, over USB or on a
/// busy machine.
const DOUBTS: u8 = 8;

/// How long closing waits for the thread, which wakes up at the next transition.
const CLOSE_PATIENCE: Duration = Duration::from_millis(100);

/// A VSYNC line on a serial port.
pub struct ModemLine {
    path: PathBuf,
    line: ModemLineInput,
    watch: Arc<Watch>,
    edges: Receiver<Result<Edge, DeviceError>>,
    thread: Option<JoinHandle<()>>,
}

struct Watch {
    port: OwnedFd,
    state: Mutex<Transitions>,
    closing: AtomicBool,
}

impl ModemLine {
    /// Opens the port and starts watching. Edges are numbered from 1.
    ///
    /// # Errors
    /// `Disconnected` if there is no such port, `Unsupported` if it has no modem lines that can be waited for.
    pub fn open(path: &Path, line: ModemLineInput, edge: Polarity) -> Result<Self, DeviceError> {
        let failed = |call| move |errno| system_error(path, call, errno);
        // Without NONBLOCK, open waits for a carrier, which is the very line that toggles here.
        let flags = OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC;
        let port = open(path, flags, Mode::empty()).map_err(failed("open"))?;
        let mut terminal = tcgetattr(&port).map_err(failed("tcgetattr"))?;
        cfmakeraw(&mut terminal);
        // Otherwise the end of each pulse on DCD would cause a hang-up.
        terminal.control_flags.insert(ControlFlags::CLOCAL);
        terminal.control_flags.remove(ControlFlags::CRTSCTS | ControlFlags::HUPCL);
        tcsetattr(&port, SetArg::TCSANOW, &terminal).map_err(failed("tcsetattr"))?;
        let count = ioctl::transitions(&port, line).map_err(failed("TIOCGICOUNT"))?;
        let asserted = ioctl::is_asserted(&port, line).map_err(failed("TIOCMGET"))?;
        // Read during a pulse, these two may disagree; the first quiet moment corrects that.
        let state = Mutex::new(Transitions { count, asserted, edges: 0, edge, doubts: 0 });
        let watch = Arc::new(Watch { port, state, closing: AtomicBool::new(false) });
        let (sender, edges) = sync_channel(QUEUE);
        let thread = std::thread::Builder::new()
            .name("vsync-line".into())
            .spawn({
                let (watch, path) = (Arc::clone(&watch), path.to_owned());
                move || watch.follow(&path, line, &sender)
            })
            .map_err(|error| DeviceError::new(DEVICE, DeviceErrorKind::NotReady, error))?;
        Ok(Self { path: path.to_owned(), line, watch, edges, thread: Some(thread) })
    }

    /// Compares the level with the parity of the count.
    fn check_level(&self) -> Result<(), Errno> {
        let asserted = ioctl::is_asserted(&self.watch.port, self.line)?;
        let count = ioctl::transitions(&self.watch.port, self.line)?;
        if self.watch.lock().compare(count, asserted) {
            tracing::warn!(
                port = %self.path.display(),
                "a transition of the VSYNC line went uncounted: the pulse is too short for this port"
            );
        }
        Ok(())
    }

    fn gone(&self) -> DeviceError {
        system_error(&self.path, "TIOCMIWAIT", Errno::ENODEV)
    }
}

impl Vsync for ModemLine {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        match self.edges.try_recv() {
            Ok(edge) => return edge.map(Some),
            Err(TryRecvError::Disconnected) => return Err(self.gone()),
            Err(TryRecvError::Empty) => {}
        }
        let deadline = Instant::now() + timeout;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.edges.recv_timeout(left.min(QUIET)) {
                Ok(edge) => return edge.map(Some),
                Err(RecvTimeoutError::Disconnected) => return Err(self.gone()),
                Err(RecvTimeoutError::Timeout) if left > QUIET => {
                    self.check_level().map_err(|errno| system_error(&self.path, "TIOCMGET", errno))?;
                }
                Err(RecvTimeoutError::Timeout) => return Ok(None),
            }
        }
    }
}

impl Drop for ModemLine {
    fn drop(&mut self) {
        self.watch.closing.store(true, Ordering::Relaxed);
        let deadline = Instant::now() + CLOSE_PATIENCE;
        while let Ok(_) | Err(RecvTimeoutError::Timeout) =
            self.edges.recv_timeout(deadline.saturating_duration_since(Instant::now()))
        {
            if Instant::now() >= deadline {
                // Only a transition ends TIOCMIWAIT. On a line without transitions, the thread is left waiting for
                // the next one or for the port to disappear. It holds nothing but the port.
                return;
            }
        }
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has already been reported.
            let _ = thread.join();
        }
    }
}

impl Watch {
    fn lock(&self) -> MutexGuard<'_, Transitions> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Hands on edges until the port ends or nobody wants them.
    fn follow(&self, path: &Path, line: ModemLineInput, edges: &SyncSender<Result<Edge, DeviceError>>) {
        let clock = Clock::real();
        while !self.closing.load(Ordering::Relaxed) {
            let waited = ioctl::wait_for_change(&self.port, line);
            let host_ns = clock.now_ns();
            match waited.and_then(|()| ioctl::transitions(&self.port, line)) {
                Ok(count) => {
                    let seq = self.lock().advance(count);
                    // If the queue is full, the edge is lost, which shows in the next one's number.
                    seq.map(|seq| edges.try_send(Ok(Edge { seq, host_ns })));
                }
                Err(Errno::EINTR) => {}
                Err(errno) => {
                    // Blocks only while the queue is full. If the receiver is gone, nobody needs the error.
                    let _ = edges.send(Err(system_error(path, "TIOCMIWAIT", errno)));
                    return;
                }
            }
        }
    }
}

/// The state of a line, derived from its count of transitions.
struct Transitions {
    count: u32,
    asserted: bool,
    edges: u64,
    edge: Polarity,
    /// Number of consecutive mismatches between level and count.
    doubts: u8,
}

impl Transitions {
    /// Takes a new count. Returns the number of the last edge unless the line has changed back since; so an edge's
    /// timestamp is late by less than the pulse length. In doubt, it returns `None`, because the edge might be the
    /// pulse's other end. Edges that are not returned are lost, which shows in the next one's number.
    fn advance(&mut self, count: u32) -> Option<u64> {
        let transitions = count.wrapping_sub(self.count);
        let was_after_edge = self.is_after_edge();
        self.count = count;
        self.asserted ^= transitions % 2 == 1;
        let edges = if was_after_edge { transitions / 2 } else { transitions.div_ceil(2) };
        self.edges += u64::from(edges);
        (edges > 0 && self.is_after_edge() && self.doubts == 0).then_some(self.edges)
    }

    /// Compares the state with the level read at a count. After enough consecutive mismatches, assumes that one
    /// transition, and with it an edge, went uncounted; returns whether it did.
    fn compare(&mut self, count: u32, asserted: bool) -> bool {
        if count != self.count {
            return false;
        }
        self.doubts = if asserted == self.asserted { 0 } else { self.doubts + 1 };
        let uncounted = self.doubts == DOUBTS;
        if uncounted {
            self.asserted = asserted;
            self.edges += 1;
            self.doubts = 0;
        }
        uncounted
    }

    fn is_after_edge(&self) -> bool {
        self.asserted == (self.edge == Polarity::Assert)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::pty::openpty;

    fn line(asserted: bool, edge: Polarity) -> Transitions {
        Transitions { count: u32::MAX - 1, asserted, edges: 0, edge, doubts: 0 }
    }

    #[test]
    fn every_second_transition_is_an_edge_over_the_counter_s_wrap() {
        for (asserted, edge) in [(false, Polarity::Assert), (true, Polarity::Clear)] {
            let mut line = line(asserted, edge);
            let seen: Vec<_> = (0..4).map(|k| line.advance(u32::MAX.wrapping_add(k))).collect();
            assert_eq!(seen, [Some(1), None, Some(2), None]);
        }
        let mut line = line(true, Polarity::Assert);
        let seen: Vec<_> = (0..4).map(|k| line.advance(u32::MAX.wrapping_add(k))).collect();
        assert_eq!(seen, [None, Some(1), None, Some(2)]);
    }

    #[test]
    fn an_edge_that_is_over_is_lost_and_counted() {
        let mut line = line(false, Polarity::Assert);
        let base = line.count;
        // A whole pulse at once; the next one's rising edge; then its falling edge, two pulses and a rising edge at
        // once.
        assert_eq!(line.advance(base.wrapping_add(2)), None);
        assert_eq!(line.advance(base.wrapping_add(3)), Some(2));
        assert_eq!(line.advance(base.wrapping_add(9)), Some(5));
        assert_eq!(line.advance(base.wrapping_add(9)), None, "nothing happened");
    }

    #[test]
    fn an_uncounted_transition_costs_edges_and_never_shows_a_pulse_s_end_as_one() {
        let mut line = line(false, Polarity::Assert);
        let mut count = line.count;
        // Rising and falling edge counted as one transition: the line seems asserted until its level is compared
        // while quiet.
        count = count.wrapping_add(1);
        assert_eq!(line.advance(count), Some(1));
        for k in 1..DOUBTS {
            assert!(!line.compare(count, false));
            if k == 4 {
                // A pulse while in doubt: its falling edge would look like an edge.
                assert_eq!(line.advance(count.wrapping_add(1)), None);
                assert_eq!(line.advance(count.wrapping_add(2)), None);
                count = count.wrapping_add(2);
            }
        }
        assert!(line.compare(count, false), "no longer a doubt");
        assert_eq!(line.advance(count.wrapping_add(1)), Some(4));
        assert_eq!(line.advance(count.wrapping_add(2)), None);
    }

    #[test]
    fn a_level_that_comes_before_its_count_changes_nothing() {
        let mut line = line(false, Polarity::Assert);
        let rise = line.count.wrapping_add(1);
        assert!(!line.compare(line.count, true), "the line has risen, the count is on its way");
        assert_eq!(line.advance(rise), None, "in doubt");
        assert!(!line.compare(rise, true), "agreement ends the doubt");
        assert_eq!(line.advance(rise.wrapping_add(2)), Some(2));
        assert!(!line.compare(rise, false), "a level of another count says nothing");
        assert_eq!(line.doubts, 0);
    }

    #[test]
    fn what_has_no_modem_lines_is_refused() {
        let pty = openpty(None, None).unwrap();
        let path = nix::unistd::ttyname(&pty.slave).unwrap();
        let refused = ModemLine::open(&path, ModemLineInput::Dcd, Polarity::Assert).err().unwrap();
        assert_eq!(refused.kind, DeviceErrorKind::Unsupported);
        assert!(refused.to_string().contains(&path.display().to_string()), "{refused}");
        let missing =
            ModemLine::open(Path::new("/dev/ttyNONE"), ModemLineInput::Cts, Polarity::Clear).err().unwrap();
        assert_eq!(missing.kind, DeviceErrorKind::Disconnected);
    }
}
