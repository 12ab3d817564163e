//! A USB serial converter (FT232BM) whose DCD input carries a VSYNC.
//!
//! Each incoming packet starts with two bytes: modem status and line status. The chip sends a packet when a modem line
//! has changed and, without a change, each time its latency timer expires.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::{Speed, Stall, UsbDevice, UsbIdentity, UsbRequest};

const LATENCY: Duration = Duration::from_millis(16);
/// Modem status: a reserved bit that is always set, and DCD.
const MODEM_IDLE: u8 = 0x01;
const MODEM_DCD: u8 = 0x80;
/// Line status: transmitter empty.
const LINE_IDLE: u8 = 0x60;
/// Vendor requests that return data.
const GET_MODEM_STATUS: u8 = 5;
const GET_LATENCY_TIMER: u8 = 10;

/// The converter.
pub struct Ftdi {
    identity: UsbIdentity,
    period: Duration,
    pulse: Duration,
    began: Instant,
    told: Instant,
    dcd: bool,
    line: FtdiLine,
}

/// The test's handle to the converter's DCD line.
#[derive(Clone, Default)]
pub struct FtdiLine {
    pulses: Arc<AtomicU64>,
    toggles: Arc<AtomicBool>,
    asserted: Arc<AtomicBool>,
}

impl FtdiLine {
    /// Number of pulses whose start has been reported to the host.
    pub fn pulses(&self) -> u64 {
        self.pulses.load(Ordering::Relaxed)
    }

    /// State of the line last reported to the host.
    pub fn is_asserted(&self) -> bool {
        self.asserted.load(Ordering::Relaxed)
    }

    /// Starts the pulses; until then the line is clear.
    pub fn start(&self) {
        self.toggles.store(true, Ordering::Relaxed);
    }
}

impl Ftdi {
    /// A converter whose DCD, once started, is asserted for `pulse` in each `period`.
    pub fn new(period: Duration, pulse: Duration) -> (Self, FtdiLine) {
        let identity = UsbIdentity {
            speed: Speed::Full,
            vendor: 0x0403,
            product: 0x6001,
            release: 0x0400,
            strings: ["FTDI", "simulated VSYNC line", "RS000001"],
            endpoints: vec![0x81, 0x02],
        };
        let (now, line) = (Instant::now(), FtdiLine::default());
        (Self { identity, period, pulse, began: now, told: now, dcd: false, line: line.clone() }, line)
    }

    fn is_asserted(&self) -> bool {
        let phase_ns = self.began.elapsed().as_nanos() % self.period.as_nanos();
        self.line.toggles.load(Ordering::Relaxed) && phase_ns < self.pulse.as_nanos()
    }

    fn status(&self) -> Vec<u8> {
        vec![MODEM_IDLE | if self.dcd { MODEM_DCD } else { 0 }, LINE_IDLE]
    }
}

impl UsbDevice for Ftdi {
    fn identity(&self) -> &UsbIdentity {
        &self.identity
    }

    fn control(&mut self, request: &UsbRequest, _: &[u8]) -> Result<Vec<u8>, Stall> {
        match request.request {
            GET_MODEM_STATUS => {
                Ok(vec![MODEM_IDLE | if self.is_asserted() { MODEM_DCD } else { 0 }, LINE_IDLE])
            }
            GET_LATENCY_TIMER => Ok(vec![LATENCY.as_millis() as u8]),
            // Baud rate, flow control and the like have no effect here.
            _ if !request.is_in() => Ok(Vec::new()),
            _ => Err(Stall),
        }
    }

    fn bulk_in(&mut self, _: u8, _: usize) -> Option<Result<Vec<u8>, Stall>> {
        let asserted = self.is_asserted();
        if asserted == self.dcd && self.told.elapsed() < LATENCY {
            return None;
        }
        self.line.pulses.fetch_add(u64::from(asserted && !self.dcd), Ordering::Relaxed);
        self.line.asserted.store(asserted, Ordering::Relaxed);
        self.dcd = asserted;
        self.told = Instant::now();
        Some(Ok(self.status()))
    }

    fn bulk_out(&mut self, _: u8, _: &[u8]) -> Result<(), Stall> {
        Ok(())
    }
}
