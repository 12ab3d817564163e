//! The driver of Mirrorcle's PlayzerX: streams samples into the controller's FIFO.
//!
//! FIFO accounting: at most one query `g` for the samples left is on the wire. The controller processes its input in
//! order, so its answer counts every sample sent before the query, and the FIFO holds at most that many plus those
//! sent since. This bound keeps the FIFO from overflowing. Samples played = samples sent before the query - samples
//! left.

pub mod protocol;
mod stream;

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

pub use raysweep_config::rig::dots::PlayzerXLink;
use raysweep_core::{
    DeviceError, DeviceErrorKind, MechanicalDeg, Mirror, MirrorCapabilities, MirrorLimits, MirrorPath,
    MirrorProgress, Tilt,
};

use self::protocol::{FIFO_SAMPLES, PADDING, PlayzerXCommand, PlayzerXReply, SAMPLE_BYTES, parse_response};
use self::stream::SampleStream;
use super::error::{DEVICE, fault};
use super::light::LightGuard;
use super::rules;
use super::sequence::Sequence;
use super::state::{MirrorState, Reach, Sent, StateFile, node_of, of_state};
use crate::serial::port::Port;

/// The controller's baud rate; a virtual serial port ignores it.
const BAUD: u32 = 921_600;
/// Sample rates that the controller supports.
const RATE_HZ: RangeInclusive<f64> = 50.0..=50_000.0;
/// Maximum time for an answer.
const REPLY_WAIT: Duration = Duration::from_millis(300);
/// Time during which the controller ignores input after a reset.
const RESET_WAIT: Duration = Duration::from_millis(2500);
/// Interval of checking the light's permission.
const LIGHT_CHECK: Duration = Duration::from_millis(50);
/// Maximum relative deviation of the controller's actual rate from the requested one; includes the measurement error.
const RATE_TOLERANCE: f64 = 0.03;
/// If the approach does not show that the rate is kept, the mirror rests for these multiples of the rest after it, one
/// after the other.
const REST_MULTIPLES: [u32; 3] = [2, 4, 8];

/// Which PlayzerX, and what it may do.
#[derive(Debug, Clone, PartialEq)]
pub struct PlayzerXConfig {
    /// Its serial port.
    pub port: PathBuf,
    /// How it is connected.
    pub link: PlayzerXLink,
    /// Tilt of the mirror at the controller's full scale.
    pub full_scale: MechanicalDeg,
    /// Limits of its mirror.
    pub limits: MirrorLimits,
    /// File for the state that must survive a crash.
    pub state: PathBuf,
    /// Permission for light.
    pub light: LightGuard,
}

/// A PlayzerX controller with its mirror.
pub struct PlayzerX {
    port: Port,
    node: Option<u64>,
    config: PlayzerXConfig,
    capabilities: MirrorCapabilities,
    state: StateFile,
    phase: Phase,
}

/// State of the mirror's use.
enum Phase {
    /// At the origin, dark, FIFO empty.
    Parked,
    /// At the first point of this path, dark, FIFO empty.
    Ready(MirrorPath),
    /// Samples are being played.
    Moving(Box<SampleStream>),
    /// Anywhere: the controller did not do what it was told.
    Lost,
}

impl PlayzerX {
    /// Opens the controller of a mirror that is parked.
    pub(super) fn open_parked(config: PlayzerXConfig, state: StateFile) -> Result<Self, DeviceError> {
        let mut port = Port::open(DEVICE, &config.port, BAUD)?;
        let node = node_of(&config.port);
        let device = hello(&mut port)?;
        let left = samples_left(&mut port, REPLY_WAIT)?;
        if left != Some(0) {
            return Err(fault(
                DeviceErrorKind::NotReady,
                format!(
                    "the controller at {} has samples to play that this daemon did not send: end the other program, or switch the controller off and on",
                    config.port.display()
                ),
            ));
        }
        let top_hz = match config.link {
            PlayzerXLink::VirtualCom => *RATE_HZ.end(),
            PlayzerXLink::Uart => f64::from(BAUD / 10) / SAMPLE_BYTES as f64,
        };
        let capabilities = MirrorCapabilities {
            model: device,
            limits: config.limits,
            rate_hz: *RATE_HZ.start()..=top_hz,
            fifo_samples: FIFO_SAMPLES,
        };
        Ok(Self { port, node, config, capabilities, state, phase: Phase::Parked })
    }

    /// Number of received bytes that belonged to no reply: a measure of the connection's quality.
    pub fn garbage_bytes(&self) -> u64 {
        self.port.garbage_bytes()
    }

    fn state(&self, rate_hz: f64, playing: Option<Sequence>) -> Result<MirrorState, DeviceError> {
        let PlayzerXConfig { port, full_scale, limits, .. } = &self.config;
        let reach = Reach::PlayzerX { port: port.clone(), node: self.node, full_scale: *full_scale };
        MirrorState::new(reach, *limits, rate_hz, playing).map_err(of_state)
    }

    /// Writes a sequence to disk, which must happen before any of its samples is sent.
    fn record(&self, sequence: &Sequence, rate_hz: f64) -> Result<(), DeviceError> {
        self.state.write(&self.state(rate_hz, Some(sequence.clone()))?).map_err(of_state)
    }

    fn stream(&self, sequence: Sequence, rate_hz: f64) -> Box<SampleStream> {
        Box::new(SampleStream::new(sequence, rate_hz, self.config.full_scale))
    }

    /// Sends a sequence and waits until it is played; returns the measured rate.
    fn play_out(
        &mut self,
        sequence: Sequence,
        rate_hz: f64,
        recorded: bool,
    ) -> Result<Option<f64>, DeviceError> {
        self.phase = Phase::Moving(self.stream(sequence, rate_hz));
        let Phase::Moving(stream) = &mut self.phase else { return Ok(None) };
        play_out(stream, &mut self.port, recorded.then_some(&self.state))?;
        Ok(stream.rate_hz())
    }

    /// Records that the mirror is at the origin, dark.
    fn note_parked(&mut self) -> Result<(), DeviceError> {
        self.phase = Phase::Parked;
        self.state.write(&self.state(*RATE_HZ.start(), None)?).map_err(of_state)
    }

    fn load_fallibly(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        let limits = self.config.limits;
        let path = rules::fitting(path, &limits)?;
        let rate_hz = path.rate_hz();
        if rate_hz.fract() != 0.0 || !self.capabilities.rate_hz.contains(&rate_hz) {
            let (low, high) = self.capabilities.rate_hz.clone().into_inner();
            return Err(fault(
                DeviceErrorKind::OutOfRange,
                format!(
                    "rate_hz = {rate_hz}: the controller takes whole numbers from {low} to {high:.0} over this link"
                ),
            ));
        }
        if path
            .points()
            .iter()
            .any(|point| point.tilt.deg().iter().any(|deg| deg.abs() > self.config.full_scale.0))
        {
            return Err(fault(
                DeviceErrorKind::OutOfRange,
                format!("the path goes beyond full_scale = {} degrees", self.config.full_scale.0),
            ));
        }
        let mut set_rate = Vec::new();
        PlayzerXCommand::SetRate(rate_hz as u32).to_bytes(&mut set_rate);
        self.port.send(&set_rate)?;
        let place = path.at(0).tilt;
        let mut sequence = Sequence::approach(Tilt::ORIGIN, place, rate_hz, &limits);
        let mut multiples = REST_MULTIPLES.into_iter();
        let is_kept = |actual_hz: &f64| (actual_hz / rate_hz - 1.0).abs() <= RATE_TOLERANCE;
        let mut measured_hz = None;
        let actual_hz = loop {
            self.record(&sequence, rate_hz)?;
            measured_hz = self.play_out(sequence, rate_hz, true)?.or(measured_hz);
            match (measured_hz.filter(is_kept), multiples.next()) {
                (Some(actual_hz), _) => break actual_hz,
                // A host that stands still within the approach makes the controller look slower than it is.
                (None, Some(multiple)) => sequence = Sequence::rest(place, rate_hz, multiple),
                (None, None) => return Err(rate_not_kept(rate_hz, measured_hz)),
            }
        };
        self.phase = Phase::Ready(path);
        Ok(actual_hz)
    }

    fn feed_fallibly(&mut self) -> Result<MirrorProgress, DeviceError> {
        let Phase::Moving(stream) = &mut self.phase else {
            return Err(rules::nothing_played());
        };
        if stream.has_light() && stream.light_checked.elapsed() >= LIGHT_CHECK {
            self.config.light.permits().map_err(|no| fault(DeviceErrorKind::NotReady, no.to_string()))?;
            stream.light_checked = Instant::now();
        }
        stream.step(&mut self.port, Some(&self.state))?;
        let mut progress = stream.progress();
        if stream.is_played() {
            self.note_parked()?;
            progress.parked = true;
        }
        Ok(progress)
    }

    /// Parks after an error and returns that error.
    fn park_after(&mut self, error: DeviceError) -> DeviceError {
        if let Err(second) = self.park() {
            tracing::error!(error = %second, "the mirror could not be parked");
        }
        error
    }
}

impl Mirror for PlayzerX {
    fn capabilities(&self) -> &MirrorCapabilities {
        &self.capabilities
    }

    fn load(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        self.park()?;
        self.load_fallibly(path).map_err(|error| self.park_after(error))
    }

    fn start(&mut self, batches: u32) -> Result<(), DeviceError> {
        let Phase::Ready(path) = &self.phase else { return Err(rules::nothing_loaded()) };
        rules::may_start(path, batches, &self.config.light)?;
        let rate_hz = path.rate_hz();
        let sequence = Sequence::play(path, batches, &self.config.limits);
        self.record(&sequence, rate_hz).map_err(|error| self.park_after(error))?;
        self.phase = Phase::Moving(self.stream(sequence, rate_hz));
        Ok(())
    }

    fn feed(&mut self) -> Result<MirrorProgress, DeviceError> {
        self.feed_fallibly().map_err(|error| self.park_after(error))
    }

    fn park(&mut self) -> Result<(), DeviceError> {
        if let Phase::Parked = self.phase {
            return Ok(());
        }
        self.state.note_unknown();
        // The place is told once: whoever asks again after an error hears of a FIFO that was emptied.
        let halted = match std::mem::replace(&mut self.phase, Phase::Lost) {
            Phase::Parked | Phase::Lost => None,
            Phase::Ready(path) => Some((path.at(0).tilt, path.rate_hz())),
            Phase::Moving(mut stream) => {
                stream.halt(&mut self.port)?.map(|place| (place, stream.asked_rate_hz()))
            }
        };
        let Some((place, rate_hz)) = halted else {
            reset(&mut self.port)?;
            return self.note_parked();
        };
        darken(&mut self.port, place, self.config.full_scale)?;
        let sequence = Sequence::travel(place, Tilt::ORIGIN, rate_hz, &self.config.limits);
        // A full disk must not prevent parking.
        let recorded = self.record(&sequence, rate_hz);
        if recorded.is_err() {
            self.state.note_unknown();
        }
        self.play_out(sequence, rate_hz, recorded.is_ok())?;
        self.note_parked().and(recorded)
    }
}

impl Drop for PlayzerX {
    fn drop(&mut self) {
        if let Err(error) = self.park() {
            tracing::error!(%error, "the mirror could not be parked");
        }
    }
}

/// Asks the controller at this port what it is.
pub(super) fn greet(port: &Path) -> Result<String, DeviceError> {
    hello(&mut Port::open(DEVICE, port, BAUD)?)
}

/// Completes a frame that a cut-off write may have left on the wire, and asks for the controller's description.
fn hello(port: &mut Port) -> Result<String, DeviceError> {
    let mut bytes = PADDING.to_vec();
    PlayzerXCommand::SetReport(0).to_bytes(&mut bytes);
    PlayzerXCommand::Info.to_bytes(&mut bytes);
    for _ in 0..3 {
        port.send(&bytes)?;
        let info = port.await_reply(REPLY_WAIT, parse_response, |reply| match reply {
            PlayzerXReply::Info { device, firmware, format } => Some((device, firmware, format)),
            _ => None,
        })?;
        match info {
            Some((device, firmware, format)) if format == "XYM" => {
                return Ok(format!("{device}, firmware {firmware}"));
            }
            Some((device, _, format)) => {
                return Err(fault(
                    DeviceErrorKind::Unsupported,
                    format!("{device} takes {format}: this driver drives monochrome controllers (XYM)"),
                ));
            }
            None => {}
        }
    }
    Err(fault(
        DeviceErrorKind::Timeout,
        "no PlayzerX answers: check the rig file's port and the controller's power",
    ))
}

/// Why a path is refused whose rate the controller does not keep, or is not known to keep.
fn rate_not_kept(rate_hz: f64, measured_hz: Option<f64>) -> DeviceError {
    match measured_hz {
        Some(actual_hz) => fault(
            DeviceErrorKind::OutOfRange,
            format!(
                "rate_hz = {rate_hz}: the controller plays {actual_hz:.0} samples/s instead; take a rate that it keeps"
            ),
        ),
        None => fault(
            DeviceErrorKind::Timeout,
            "nothing tells whether the controller keeps the rate, for its answers come too late: end other work on this computer, and shorten the serial adapter's latency timer",
        ),
    }
}

/// Queries the samples left up to three times, waiting `timeout` each time.
fn samples_left(port: &mut Port, timeout: Duration) -> Result<Option<u32>, DeviceError> {
    let mut question = Vec::new();
    PlayzerXCommand::SamplesLeft.to_bytes(&mut question);
    for _ in 0..3 {
        port.send(&question)?;
        if let Some(left) = port.await_reply(timeout, parse_response, left_of)? {
            return Ok(Some(left));
        }
    }
    Ok(None)
}

fn left_of(reply: PlayzerXReply) -> Option<u32> {
    match reply {
        PlayzerXReply::Left(left) => Some(left),
        _ => None,
    }
}

/// Parks a mirror of unknown position: the reset switches off light and drive, and the mirror springs back, damped by
/// the drive's own filter. An error if the controller does not answer afterwards.
fn reset(port: &mut Port) -> Result<(), DeviceError> {
    let mut bytes = PADDING.to_vec();
    PlayzerXCommand::Reset.to_bytes(&mut bytes);
    let send = |port: &mut Port| {
        port.send(&bytes)?;
        std::thread::sleep(RESET_WAIT);
        hello(port)
    };
    // A controller that hangs may lose what it is sent: only a reset of one that answers is believed.
    let answers = hello(port).is_ok();
    let answered = send(port)?;
    if !answers {
        send(port)?;
    }
    tracing::warn!(controller = answered, "reset, because nothing told where the mirror was");
    Ok(())
}

/// Switches the light off at the mirror's position. The FIFO is empty, so the sample is played at once.
fn darken(port: &mut Port, place: Tilt, full_scale: MechanicalDeg) -> Result<(), DeviceError> {
    let mut bytes = Vec::new();
    let point = raysweep_core::MirrorPoint { tilt: place, light: 0 };
    PlayzerXCommand::Sample(protocol::MirrorSample::of(point, full_scale)).to_bytes(&mut bytes);
    port.send(&bytes)
}

/// Parks a mirror that a process left behind. Returns where it was found; `None` if that was unknown and the
/// controller was restarted instead.
pub(super) fn recover(
    file: &StateFile,
    state: &MirrorState,
    sent: Sent,
) -> Result<Option<Tilt>, DeviceError> {
    let (Reach::PlayzerX { port: name, node, full_scale }, Some(sequence)) = (&state.reach, &state.playing)
    else {
        return Ok(None);
    };
    let mut port = Port::open(DEVICE, name, BAUD)?;
    let is_known = state.is_plugged_in_since(name, *node) && sent != Sent::UNKNOWN;
    file.note_unknown();
    // The process may have died with a query pending.
    let left = if is_known { stream::halt(&mut port, 1)? } else { None };
    // A FIFO that ran dry looks like that of a controller that restarted.
    let Some(left) = left.filter(|&left| left > 0 && u64::from(left) <= sent.possibly) else {
        reset(&mut port)?;
        return Ok(None);
    };
    // If the process died during a write, the midpoint of what may have been sent is within one write of the truth.
    let gone = u64::midpoint(sent.certainly, sent.possibly);
    let place = sequence.after(gone.saturating_sub(u64::from(left)));
    darken(&mut port, place, *full_scale)?;
    let sequence = Sequence::travel(place, Tilt::ORIGIN, state.rate_hz, &state.limits);
    let travelling = MirrorState { playing: Some(sequence.clone()), ..state.clone() };
    let recorded = file.write(&travelling).map_err(of_state);
    if recorded.is_err() {
        file.note_unknown();
    }
    let mut stream = SampleStream::new(sequence, state.rate_hz, *full_scale);
    play_out(&mut stream, &mut port, recorded.is_ok().then_some(file))?;
    recorded.map(|()| Some(place))
}

/// Sends samples and reads replies until all are played.
fn play_out(
    stream: &mut SampleStream,
    port: &mut Port,
    record: Option<&StateFile>,
) -> Result<(), DeviceError> {
    loop {
        stream.step(port, record)?;
        if stream.is_played() {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}
