//! The kernel's ioctls for modem lines (`tty_ioctl(4)`) and pulse-per-second sources (RFC 2783, `linux/pps.h`), which
//! no crate offers.

#![allow(unsafe_code, reason = "system calls; what each is handed is checked here")]

use std::os::fd::{AsFd, AsRawFd};
use std::time::Duration;

use nix::errno::Errno;
use nix::libc;

use raysweep_config::rig::vsync::ModemLineInput;

/// `struct serial_icounter_struct`: transitions of each line since the port appeared.
#[repr(C)]
#[derive(Default)]
struct SerialCounters {
    cts: i32,
    dsr: i32,
    ring: i32,
    carrier: i32,
    others: [i32; 7],
    reserved: [i32; 9],
}

/// `struct pps_ktime`.
#[repr(C)]
#[derive(Default, Clone, Copy)]
struct PpsTime {
    s: i64,
    ns: i32,
    flags: u32,
}

/// `struct pps_fdata`: the last event of each kind, and the timeout for waiting for a newer one.
#[repr(C)]
#[derive(Default)]
struct PpsFetch {
    assert_sequence: u32,
    clear_sequence: u32,
    assert: PpsTime,
    clear: PpsTime,
    mode: i32,
    timeout: PpsTime,
}

nix::ioctl_write_int_bad!(tiocmiwait, libc::TIOCMIWAIT);
nix::ioctl_read_bad!(tiocgicount, libc::TIOCGICOUNT, SerialCounters);
nix::ioctl_read_bad!(tiocmget, libc::TIOCMGET, libc::c_int);
// The kernel's header encodes the size of a pointer here, not that of the structure.
nix::ioctl_readwrite_bad!(
    pps_fetch,
    nix::request_code_readwrite!(b'p', 0xa4, size_of::<*const PpsFetch>()),
    PpsFetch
);

fn bit(line: ModemLineInput) -> libc::c_int {
    match line {
        ModemLineInput::Dcd => libc::TIOCM_CD,
        ModemLineInput::Cts => libc::TIOCM_CTS,
    }
}

/// Blocks until the line changes. There is no timeout; a hang-up ends it.
pub fn wait_for_change(port: impl AsFd, line: ModemLineInput) -> Result<(), Errno> {
    // SAFETY: the request takes an integer and touches no memory of ours; the descriptor is open for as long as `port`.
    unsafe { tiocmiwait(port.as_fd().as_raw_fd(), bit(line)) }.map(drop)
}

/// How often the line has changed since the port came up, wrapping.
pub fn transitions(port: impl AsFd, line: ModemLineInput) -> Result<u32, Errno> {
    let mut counters = SerialCounters::default();
    // SAFETY: the ioctl writes one `serial_icounter_struct`, whose layout `SerialCounters` has.
    unsafe { tiocgicount(port.as_fd().as_raw_fd(), &mut counters) }?;
    let count = match line {
        ModemLineInput::Dcd => counters.carrier,
        ModemLineInput::Cts => counters.cts,
    };
    Ok(count.cast_unsigned())
}

/// Whether the line is asserted.
pub fn is_asserted(port: impl AsFd, line: ModemLineInput) -> Result<bool, Errno> {
    let mut lines = 0;
    // SAFETY: the ioctl writes one `int`.
    unsafe { tiocmget(port.as_fd().as_raw_fd(), &mut lines) }?;
    Ok(lines & bit(line) != 0)
}

/// An event of a pulse-per-second source.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PpsEvent {
    /// Count of events of this kind, wrapping.
    pub sequence: u32,
    /// Time of the event on `CLOCK_REALTIME`.
    pub realtime_ns: i64,
}

/// The last assert event and the last clear event. Waits up to `timeout` for an event of either kind newer than this
/// call (not at all for zero). `ETIMEDOUT` if there is none.
pub fn fetch(source: impl AsFd, timeout: Duration) -> Result<[PpsEvent; 2], Errno> {
    let (s, ns) =
        (timeout.as_secs().min(i32::MAX as u64).cast_signed(), timeout.subsec_nanos().cast_signed());
    let mut fetch = PpsFetch { timeout: PpsTime { s, ns, flags: 0 }, ..PpsFetch::default() };
    // SAFETY: the ioctl reads and writes one `pps_fdata`, whose layout `PpsFetch` has.
    unsafe { pps_fetch(source.as_fd().as_raw_fd(), &mut fetch) }?;
    let event = |sequence, time: PpsTime| PpsEvent {
        sequence,
        realtime_ns: time.s * 1_000_000_000 + i64::from(time.ns),
    };
    Ok([event(fetch.assert_sequence, fetch.assert), event(fetch.clear_sequence, fetch.clear)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::mem::offset_of;

    #[test]
    fn structures_have_the_kernel_s_layout() {
        // linux/serial.h: 20 ints. linux/pps.h: pps_kinfo is 48 bytes long, with mode at offset 40.
        assert_eq!((size_of::<SerialCounters>(), offset_of!(SerialCounters, carrier)), (80, 12));
        assert_eq!((size_of::<PpsTime>(), size_of::<PpsFetch>()), (16, 64));
        assert_eq!((offset_of!(PpsFetch, mode), offset_of!(PpsFetch, timeout)), (40, 48));
    }
}
