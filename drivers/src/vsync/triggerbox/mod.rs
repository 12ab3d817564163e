//! A box that generates the VSYNC: strawlab's triggerbox, an Arduino whose timer pulses with the rig's period.
//!
//! The box does not report its pulses by itself. The host requests the box's time, fits a line to the replies
//! ([`ClockModel`]), and computes from that line when each pulse began. On a UART, the bytes of request and reply
//! take known times, and the box reads its clock between the two; without this correction the line would be off by a
//! third of a millisecond.

pub mod protocol;

use std::path::Path;
use std::time::{Duration, Instant};

pub use raysweep_config::rig::vsync::{TriggerBoxConfig, TriggerBoxLink};
use raysweep_core::{
    Clock, ClockModel, ClockQuality, DeviceError, DeviceErrorKind, Edge, RoundTrip, Vsync, ns_from_us,
};

use self::protocol::{
    QUESTION_BYTES, REPLY_BYTES, TriggerBoxCommand, TriggerBoxReply, TriggerBoxTimer, VERSION, parse_reply,
};
use super::DEVICE;
use crate::serial::port::Port;

const BAUD: u32 = 115_200;
/// Opening the port resets an Arduino; its bootloader and handshake then take up to 7 s.
const HELLO_PATIENCE: Duration = Duration::from_secs(10);
const HELLO_EVERY: Duration = Duration::from_millis(500);
/// Round trips in the fit.
const ROUND_TRIPS: usize = 100;
/// Minimum number of round trips before the fit is used.
const MIN_ROUND_TRIPS: usize = 8;
/// Request interval before and after `MIN_ROUND_TRIPS`: no multiple of a usual period, so that replies cover all its
/// phases.
const ASK_EVERY: [Duration; 2] = [Duration::from_millis(13), Duration::from_millis(97)];
/// Maximum wait for a reply.
const ANSWER_WAIT: Duration = Duration::from_millis(200);
/// After this long without a good reply, the times of the box's pulses are unknown.
const SILENCE: Duration = Duration::from_secs(3);
/// A reply further from the line than this, beyond what its own round trip allows, is an outlier.
const STRAY_NS: i64 = 1_000_000;
/// This many outliers in a row mean that the clock has changed: the box was reset.
const STRAYS: u32 = 5;

/// How long bytes take on their way to the box or back.
fn bytes_ns(link: TriggerBoxLink, bytes: usize) -> i64 {
    match link {
        // Ten bits a byte.
        TriggerBoxLink::Uart => bytes as i64 * 10 * 1_000_000_000 / i64::from(BAUD),
        TriggerBoxLink::Usb => 0,
    }
}

/// Asks the box at a serial port for its firmware's version; `None` if no box answers. Its pulses stay as they are.
pub fn firmware(port: &Path) -> Option<u8> {
    let mut port = Port::open(DEVICE, port, BAUD).ok()?;
    let (mut hello, deadline) = (Hello::default(), Instant::now() + HELLO_PATIENCE);
    while Instant::now() <= deadline {
        hello.ask(&mut port).ok()?;
        if let Some(version) = hello.await_version(&mut port, HELLO_EVERY).ok()? {
            return Some(version);
        }
    }
    None
}

/// The questions that find a box. The firmware reads pairs of bytes, and others may have left it with half a pair: every
/// second question begins with half a pair. Each has a number, which the answer repeats. So it is known that the box has
/// read the last one to its end, and a late answer to an earlier one does not hide that a pair is open again.
#[derive(Default)]
struct Hello {
    asked: Option<Instant>,
    questions: u8,
    version: Option<u8>,
}

impl Hello {
    /// Sends a question, unless the last was sent a moment ago.
    fn ask(&mut self, port: &mut Port) -> Result<(), DeviceError> {
        if self.asked.is_some_and(|asked| asked.elapsed() < HELLO_EVERY) {
            return Ok(());
        }
        self.asked = Some(Instant::now());
        self.questions = self.questions.wrapping_add(1);
        let mut bytes = if self.questions.is_multiple_of(2) { b"?".to_vec() } else { Vec::new() };
        bytes.extend(TriggerBoxCommand::Version.to_bytes());
        bytes.extend(TriggerBoxCommand::Time(self.number()).to_bytes());
        port.send(&bytes)
    }

    /// Numbers fall from 255: those of [`Running`] rise from 0, and no late answer is taken for one of theirs.
    fn number(&self) -> u8 {
        u8::MAX.wrapping_sub(self.questions)
    }

    /// Waits for the version of a box that has read the last question, or of one with another protocol.
    fn await_version(&mut self, port: &mut Port, timeout: Duration) -> Result<Option<u8>, DeviceError> {
        let last = self.number();
        port.await_reply(timeout, parse_reply, |reply| match reply {
            TriggerBoxReply::Version(version) => {
                self.version = Some(version);
                self.version.filter(|&version| version != VERSION)
            }
            TriggerBoxReply::Time { number, .. } => self.version.filter(|_| number == last),
        })
    }
}

/// Why a box cannot be used, or cannot be used any longer.
#[derive(Debug, thiserror::Error)]
enum TriggerBoxError {
    #[error("vsync.period_us = {0}: a triggerbox makes 2000 to 262144; choose another period or driver")]
    Period(f64),
    #[error(
        "{port}: unsupported firmware version {found} (this driver was tested with {VERSION}): flash firmware {VERSION}"
    )]
    Firmware { port: String, found: u8 },
    #[error("{port}: no answer within {HELLO_PATIENCE:?} ({garbage} bytes of garbage): is it a triggerbox?")]
    NoHello { port: String, garbage: u64 },
    #[error(
        "{port}: no usable answer for {SILENCE:?} ({garbage} bytes of garbage so far): check its cable; of a box with its own USB say vsync.triggerbox.link = \"usb\""
    )]
    Silent { port: String, garbage: u64 },
    #[error("{port}: the box was reset: its clock began anew")]
    Reset { port: String },
}

/// A triggerbox.
pub struct TriggerBox {
    config: TriggerBoxConfig,
    timer: TriggerBoxTimer,
    port: Port,
    clock: Clock,
    stage: Stage,
}

enum Stage {
    /// The box has not reported its version yet.
    Greeting(Hello),
    Running(Running),
}

struct Running {
    model: ClockModel,
    trips: usize,
    number: u8,
    /// When the pending request was sent, if there is one.
    asked_ns: Option<i64>,
    next_question: Instant,
    last_good: Instant,
    strays: u32,
    /// Pulse count of the last reply.
    pulses: i64,
    /// The last pulse that was reported, or that began before the fit was usable.
    told: i64,
}

impl TriggerBox {
    /// Opens the box and starts pulses with the nearest possible period. Edges have the numbers of the box's pulses.
    ///
    /// # Errors
    /// `Disconnected` or `Busy` if the port cannot be opened, `Timeout` if no box answers, `Unsupported` for another
    /// firmware, `OutOfRange` for an impossible period.
    pub fn open(config: TriggerBoxConfig, period_us: f64) -> Result<Self, DeviceError> {
        let mut device = Self::connect(config, period_us)?;
        let deadline = Instant::now() + HELLO_PATIENCE;
        while matches!(device.stage, Stage::Greeting(_)) {
            device.greet(HELLO_EVERY)?;
            if Instant::now() > deadline {
                let garbage = device.port.garbage_bytes();
                return Err(
                    device.error(DeviceErrorKind::Timeout, |port| TriggerBoxError::NoHello { port, garbage })
                );
            }
        }
        Ok(device)
    }

    /// Opens the port and leaves the handshake to [`Vsync::next_edge`]: a box that was plugged in again takes its
    /// time.
    ///
    /// # Errors
    /// As [`Self::open`], except for a box that does not answer.
    pub fn connect(config: TriggerBoxConfig, period_us: f64) -> Result<Self, DeviceError> {
        let Some(timer) = TriggerBoxTimer::with_period_us(period_us) else {
            let error = TriggerBoxError::Period(period_us);
            return Err(DeviceError::new(DEVICE, DeviceErrorKind::OutOfRange, error));
        };
        let port = Port::open(DEVICE, &config.port, BAUD)?;
        Ok(Self { config, timer, port, clock: Clock::real(), stage: Stage::Greeting(Hello::default()) })
    }

    fn error(&self, kind: DeviceErrorKind, what: impl FnOnce(String) -> TriggerBoxError) -> DeviceError {
        DeviceError::new(DEVICE, kind, what(self.config.port.display().to_string()))
    }

    /// Requests the version and waits for it for up to `timeout`, then starts the timer.
    fn greet(&mut self, timeout: Duration) -> Result<(), DeviceError> {
        let Stage::Greeting(hello) = &mut self.stage else { return Ok(()) };
        hello.ask(&mut self.port)?;
        let version = hello.await_version(&mut self.port, timeout)?;
        match version {
            None => Ok(()),
            Some(VERSION) => {
                for command in
                    [TriggerBoxCommand::Stop, TriggerBoxCommand::Period(self.timer), TriggerBoxCommand::Start]
                {
                    self.port.send(&command.to_bytes())?;
                }
                self.stage = Stage::Running(Running::new());
                Ok(())
            }
            Some(found) => {
                Err(self
                    .error(DeviceErrorKind::Unsupported, |port| TriggerBoxError::Firmware { port, found }))
            }
        }
    }

    /// Processes replies, waiting for them until `until_ns`, and sends the next request when it is due.
    fn converse(&mut self, until_ns: i64) -> Result<(), DeviceError> {
        let Stage::Running(running) = &mut self.stage else { return Ok(()) };
        let now_ns = self.clock.now_ns();
        if running.asked_ns.is_some_and(|at_ns| now_ns - at_ns > ANSWER_WAIT.as_nanos() as i64) {
            running.asked_ns = None;
        }
        if running.asked_ns.is_none() && Instant::now() >= running.next_question {
            running.number = running.number.wrapping_add(1);
            running.next_question = Instant::now() + ASK_EVERY[usize::from(running.trips >= MIN_ROUND_TRIPS)];
            running.asked_ns = Some(self.clock.now_ns());
            self.port.send(&TriggerBoxCommand::Time(running.number).to_bytes())?;
        }
        let wait = Duration::from_nanos(u64::try_from(until_ns - now_ns).unwrap_or(0));
        if running.asked_ns.is_none() {
            let quiet = running.next_question.saturating_duration_since(Instant::now());
            std::thread::sleep(wait.min(quiet));
            return Ok(());
        }
        self.port.wait(wait.min(ANSWER_WAIT))?;
        let receive_ns = self.clock.now_ns();
        while let Some(reply) = self.port.reply(parse_reply)? {
            let TriggerBoxReply::Time { number, pulses, ticks } = reply else { continue };
            if number == running.number
                && let Some(asked_ns) = running.asked_ns.take()
            {
                let link = self.config.link;
                let request_ns = asked_ns + bytes_ns(link, QUESTION_BYTES);
                let receive_ns = receive_ns - bytes_ns(link, REPLY_BYTES);
                running.take(self.timer, pulses, ticks, (request_ns, receive_ns));
            }
        }
        let (strays, silence) = (running.strays, running.last_good.elapsed());
        if strays >= STRAYS {
            return Err(self.error(DeviceErrorKind::Disconnected, |port| TriggerBoxError::Reset { port }));
        }
        if silence > SILENCE {
            let garbage = self.port.garbage_bytes();
            return Err(
                self.error(DeviceErrorKind::Timeout, |port| TriggerBoxError::Silent { port, garbage })
            );
        }
        Ok(())
    }
}

impl Running {
    fn new() -> Self {
        let now = Instant::now();
        Self {
            model: ClockModel::new(ROUND_TRIPS),
            trips: 0,
            number: 0,
            asked_ns: None,
            next_question: now,
            last_good: now,
            strays: 0,
            pulses: 0,
            told: 0,
        }
    }

    /// Adds a reply to the fit if its time is unambiguous.
    fn take(
        &mut self,
        timer: TriggerBoxTimer,
        pulses: u32,
        ticks: u16,
        (request_ns, receive_ns): (i64, i64),
    ) {
        if !timer.is_counted(ticks) || receive_ns < request_ns {
            return;
        }
        // The box counts pulses with 32 bits.
        let since = pulses.wrapping_sub(self.pulses as u32).cast_signed();
        let pulses = self.pulses + i64::from(since);
        let trip = RoundTrip { request_ns, device_ns: timer.device_ns(pulses, ticks), receive_ns };
        let expected_ns = self.model.host_ns(trip.device_ns).filter(|_| self.trips >= MIN_ROUND_TRIPS);
        if expected_ns.is_some_and(|ns| !(request_ns - STRAY_NS..=receive_ns + STRAY_NS).contains(&ns)) {
            self.strays += 1;
            return;
        }
        self.pulses = pulses;
        self.model.add(trip);
        self.trips += 1;
        if self.trips <= MIN_ROUND_TRIPS {
            self.told = pulses;
        }
        self.strays = 0;
        self.last_good = Instant::now();
    }

    /// The next pulse to report and when it began, or will begin.
    fn next_edge(&self, timer: TriggerBoxTimer) -> Option<Edge> {
        if self.trips < MIN_ROUND_TRIPS {
            return None;
        }
        let pulse = self.told + 1;
        Some(Edge {
            seq: u64::try_from(pulse).ok()?,
            host_ns: self.model.host_ns(timer.device_ns(pulse, 0))?,
        })
    }
}

impl Vsync for TriggerBox {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let deadline_ns = self.clock.now_ns() + ns_from_us(timeout.as_secs_f64() * 1e6);
        loop {
            let now_ns = self.clock.now_ns();
            let (timer, mut until_ns) = (self.timer, deadline_ns);
            match &mut self.stage {
                Stage::Greeting(_) => {
                    let left_ns = (deadline_ns - now_ns).max(0).unsigned_abs();
                    self.greet(HELLO_EVERY.min(Duration::from_nanos(left_ns)))?;
                }
                Stage::Running(running) => {
                    if let Some(edge) = running.next_edge(timer) {
                        if edge.host_ns <= now_ns {
                            running.told += 1;
                            return Ok(Some(edge));
                        }
                        until_ns = until_ns.min(edge.host_ns);
                    }
                    self.converse(until_ns)?;
                }
            }
            if self.clock.now_ns() >= deadline_ns {
                return Ok(None);
            }
        }
    }

    fn clock(&self) -> Option<ClockQuality> {
        match &self.stage {
            Stage::Greeting(_) => None,
            Stage::Running(running) => running.model.quality(),
        }
    }
}
