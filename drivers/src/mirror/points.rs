//! Mirrors that take one point at a time and acknowledge it: the host's clock is the sample clock.

use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

use raysweep_core::{
    DeviceError, DeviceErrorKind, Mirror, MirrorCapabilities, MirrorLimits, MirrorPath, MirrorPoint,
    MirrorProgress, Tilt,
};

use super::error::fault;
use super::light::LightGuard;
use super::rules;
use super::sequence::Sequence;
use super::state::{MirrorState, Reach, Sent, StateFile, of_state};

/// Interval of checking the light's permission.
const LIGHT_CHECK: Duration = Duration::from_millis(50);
/// Maximum time that the light may stay on one point because the host is late [A].
const LONGEST_LATE: Duration = Duration::from_millis(100);

/// A controller that takes one point at a time.
pub trait PointController: Send {
    /// Supported range of points per second.
    const RATE_HZ: RangeInclusive<f64>;

    /// Goes to a point; returns when the controller has acknowledged it.
    ///
    /// # Errors
    /// Errors of the connection, or a refusal of the controller.
    fn go(&mut self, point: MirrorPoint) -> Result<(), DeviceError>;

    /// Releases a mirror at rest: switches the drive off if there is one.
    ///
    /// # Errors
    /// Errors of the connection.
    fn release(&mut self) -> Result<(), DeviceError>;
}

/// Driver of a mirror that takes one point at a time.
pub struct PointMirror<C: PointController> {
    controller: C,
    reach: Reach,
    capabilities: MirrorCapabilities,
    light: LightGuard,
    state: StateFile,
    phase: Phase,
}

enum Phase {
    Parked,
    Ready(MirrorPath),
    Moving(Pace),
}

/// A sequence being sent point by point.
struct Pace {
    sequence: Sequence,
    period: Duration,
    sent: u64,
    due: Instant,
    /// Time of the acknowledgement of the path's first point.
    first: Option<Instant>,
    last: Instant,
    light_checked: Instant,
}

impl Pace {
    fn new(sequence: Sequence, rate_hz: f64) -> Self {
        let now = Instant::now();
        let period = Duration::from_secs_f64(1.0 / rate_hz);
        Self { sequence, period, sent: 0, due: now, first: None, last: now, light_checked: now }
    }

    /// Sends the point that is due; a late point delays all following ones, so that none is skipped.
    fn step<C: PointController>(
        &mut self,
        controller: &mut C,
        record: Option<&StateFile>,
    ) -> Result<(), DeviceError> {
        if self.sent == self.sequence.len() || Instant::now() < self.due {
            return Ok(());
        }
        let note = |sent| record.map_or(Ok(()), |record| record.note_sent(sent).map_err(of_state));
        note(Sent { certainly: self.sent, possibly: self.sent + 1 })?;
        controller.go(self.sequence.at(self.sent))?;
        self.sent += 1;
        self.last = Instant::now();
        if self.sent == self.sequence.lead_len() + 1 {
            self.first = Some(self.last);
        }
        self.due = (self.due + self.period).max(self.last);
        note(Sent { certainly: self.sent, possibly: self.sent })
    }

    fn play_out<C: PointController>(
        &mut self,
        controller: &mut C,
        record: Option<&StateFile>,
    ) -> Result<(), DeviceError> {
        while self.sent < self.sequence.len() {
            std::thread::sleep(self.due.saturating_duration_since(Instant::now()));
            self.step(controller, record)?;
        }
        Ok(())
    }

    fn progress(&self) -> MirrorProgress {
        let played = self.sequence.of_path(self.sent);
        let seconds = self.first.map(|first| self.last.duration_since(first).as_secs_f64());
        MirrorProgress {
            played,
            sent: played,
            total: self.sequence.path_len(),
            parked: false,
            rate_hz: seconds
                .filter(|s| {
                    *s > 0.0 && played > 1 && self.sent <= self.sequence.lead_len() + self.sequence.path_len()
                })
                .map(|seconds| (played - 1) as f64 / seconds),
        }
    }
}

impl<C: PointController> PointMirror<C> {
    /// A parked mirror with this controller, of this name.
    pub(super) fn parked(
        state: StateFile,
        limits: MirrorLimits,
        light: LightGuard,
        reach: Reach,
        controller: C,
        model: String,
    ) -> Self {
        let capabilities = MirrorCapabilities { model, limits, rate_hz: C::RATE_HZ, fifo_samples: 1 };
        Self { controller, reach, capabilities, light, state, phase: Phase::Parked }
    }

    fn record(&self, rate_hz: f64, playing: Option<&Sequence>) -> Result<(), DeviceError> {
        MirrorState::new(self.reach.clone(), self.capabilities.limits, rate_hz, playing.cloned())
            .and_then(|state| self.state.write(&state))
            .map_err(of_state)
    }

    fn play_out(&mut self, sequence: Sequence, rate_hz: f64, recorded: bool) -> Result<(), DeviceError> {
        self.phase = Phase::Moving(Pace::new(sequence, rate_hz));
        match &mut self.phase {
            Phase::Moving(pace) => pace.play_out(&mut self.controller, recorded.then_some(&self.state)),
            Phase::Parked | Phase::Ready(_) => Ok(()),
        }
    }

    fn load_fallibly(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        let limits = self.capabilities.limits;
        let path = rules::fitting(path, &limits)?;
        let rate_hz = path.rate_hz();
        if !C::RATE_HZ.contains(&rate_hz) {
            let (low, high) = C::RATE_HZ.into_inner();
            let what = format!("rate_hz = {rate_hz}: this controller takes {low} to {high} points/s");
            return Err(fault(DeviceErrorKind::OutOfRange, what));
        }
        let sequence = Sequence::travel(Tilt::ORIGIN, path.at(0).tilt, rate_hz, &limits);
        self.record(rate_hz, Some(&sequence))?;
        self.play_out(sequence, rate_hz, true)?;
        self.phase = Phase::Ready(path);
        Ok(rate_hz)
    }

    fn feed_fallibly(&mut self) -> Result<MirrorProgress, DeviceError> {
        let Phase::Moving(pace) = &mut self.phase else {
            return Err(rules::nothing_played());
        };
        let lit = pace.sequence.is_lit() && pace.first.is_some();
        if pace.sequence.is_lit() && pace.light_checked.elapsed() >= LIGHT_CHECK {
            self.light.permits().map_err(|no| fault(DeviceErrorKind::NotReady, no.to_string()))?;
            pace.light_checked = Instant::now();
        }
        if lit && pace.last.elapsed() > pace.period + LONGEST_LATE {
            return Err(fault(
                DeviceErrorKind::Protocol,
                format!(
                    "no point for {} ms: the host was too slow; end other work on it or take a lower rate_hz",
                    pace.last.elapsed().as_millis()
                ),
            ));
        }
        pace.step(&mut self.controller, Some(&self.state))?;
        let mut progress = pace.progress();
        if pace.sent == pace.sequence.len() {
            self.phase = Phase::Parked;
            self.record(1.0, None)?;
            progress.parked = true;
        }
        Ok(progress)
    }

    fn park_after(&mut self, error: DeviceError) -> DeviceError {
        if let Err(second) = self.park() {
            tracing::error!(error = %second, "the mirror could not be parked");
            self.release();
        }
        error
    }

    /// Releases the mirror, parked or not.
    fn release(&mut self) {
        if let Err(error) = self.controller.release() {
            tracing::error!(%error, "the mirror could not be released: its drive and its light may be on");
        }
    }
}

impl<C: PointController> Mirror for PointMirror<C> {
    fn capabilities(&self) -> &MirrorCapabilities {
        &self.capabilities
    }

    fn load(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        self.park()?;
        self.load_fallibly(path).map_err(|error| self.park_after(error))
    }

    fn start(&mut self, batches: u32) -> Result<(), DeviceError> {
        let Phase::Ready(path) = &self.phase else { return Err(rules::nothing_loaded()) };
        rules::may_start(path, batches, &self.light)?;
        let rate_hz = path.rate_hz();
        let sequence = Sequence::play(path, batches, &self.capabilities.limits);
        self.record(rate_hz, Some(&sequence)).map_err(|error| self.park_after(error))?;
        self.phase = Phase::Moving(Pace::new(sequence, rate_hz));
        Ok(())
    }

    fn feed(&mut self) -> Result<MirrorProgress, DeviceError> {
        self.feed_fallibly().map_err(|error| self.park_after(error))
    }

    fn park(&mut self) -> Result<(), DeviceError> {
        let (place, rate_hz) = match &self.phase {
            Phase::Parked => return Ok(()),
            Phase::Ready(path) => (path.at(0).tilt, path.rate_hz()),
            Phase::Moving(pace) => (pace.sequence.after(pace.sent), 1.0 / pace.period.as_secs_f64()),
        };
        self.state.note_unknown();
        self.controller.go(MirrorPoint { tilt: place, light: 0 })?;
        let sequence = Sequence::travel(place, Tilt::ORIGIN, rate_hz, &self.capabilities.limits);
        // A full disk must not prevent parking.
        let recorded = self.record(rate_hz, Some(&sequence));
        if recorded.is_err() {
            self.state.note_unknown();
        }
        self.play_out(sequence, rate_hz, recorded.is_ok())?;
        self.phase = Phase::Parked;
        self.record(1.0, None).and(recorded)
    }
}

impl<C: PointController> Drop for PointMirror<C> {
    fn drop(&mut self) {
        if let Err(error) = self.park() {
            tracing::error!(%error, "the mirror could not be parked");
        }
        self.release();
    }
}

/// Moves a mirror that a process left behind to the origin, dark. Returns where it was found.
pub(super) fn recover<C: PointController>(
    controller: &mut C,
    file: &StateFile,
    state: &MirrorState,
    sent: Sent,
) -> Result<Option<Tilt>, DeviceError> {
    let Some(sequence) = &state.playing else { return Ok(None) };
    // Whoever comes after a kill on the way home finds the mirror on that way.
    file.note_unknown();
    // The controller may or may not have taken the last point; the two cases are one step apart, which is safe for
    // any mirror.
    let place = sequence.after(sent.possibly);
    controller.go(MirrorPoint { tilt: place, light: 0 })?;
    let sequence = Sequence::travel(place, Tilt::ORIGIN, state.rate_hz, &state.limits);
    Pace::new(sequence, state.rate_hz).play_out(controller, None)?;
    controller.release()?;
    Ok(Some(place))
}
