//! Streams one sequence into the controller's FIFO.

use std::time::{Duration, Instant};

use raysweep_core::{DeviceError, DeviceErrorKind, MechanicalDeg, MirrorProgress, Tilt};

use super::REPLY_WAIT;
use super::protocol::{
    FIFO_SAMPLES, MirrorSample, PADDING, PlayzerXCommand, PlayzerXReply, SAMPLE_BYTES, parse_response,
};
use crate::mirror::error::fault;
use crate::mirror::sequence::Sequence;
use crate::mirror::state::{Sent, StateFile, of_state};
use crate::serial::port::Port;
use crate::serial::timeout::Timeout;

/// Samples per write, which is the uncertainty after a crash: 1.6 ms at 39,000 samples/s, too short for any mirror's
/// filter to pass.
const WRITE_SAMPLES: u64 = 64;
/// Writes per step: 0.4 s of motion, so that a busy host that comes by rarely feeds faster than the mirror plays; few
/// enough for the caller to attend to its other duties.
const WRITES_PER_STEP: usize = 256;
/// Part of the FIFO that is never used, in case the controller reserves some of it [A].
const SPARE_SAMPLES: u64 = 1000;
/// Interval of querying the samples left.
const ASK_EVERY: Duration = Duration::from_millis(10);
/// A rate that is less certain (relative standard error) is not stated.
const RATE_ERROR: f64 = 0.01;
/// Maximum time for an answer while the FIFO, of three seconds, plays on; after it, no more samples are sent.
const ANSWER_WAIT: Duration = Duration::from_secs(1);
/// The longest time between two steps of a host that is not busy.
const STEP: Duration = Duration::from_millis(20);
/// Maximum time that a controller may pause before it processes a command.
const HALT_WAIT: Duration = Duration::from_secs(1);
/// How long to wait after an answer for the answers to the other queries sent with it.
const QUIET: Duration = Duration::from_millis(3);
/// Number of position queries: an answer may be lost in garbage, and the FIFO can be emptied only once.
const QUESTIONS: usize = 3;
/// A controller that sends more replies than this is not answering.
const MOST_REPLIES: usize = 64;

/// Samples that may lie in the FIFO before a sequence: the one that switched the light off.
const DARK_SAMPLES: u64 = 1;

/// A query for the samples left.
struct Question {
    asked: Instant,
    /// Samples sent before it.
    sent: u64,
    timeout: Timeout,
}

/// A sequence being played.
pub struct SampleStream {
    sequence: Sequence,
    asked_rate_hz: f64,
    full_scale: MechanicalDeg,
    /// Bytes being written: samples from `certain` to `next`, then perhaps a query.
    out: Vec<u8>,
    written: usize,
    /// Samples sent completely before `out`.
    certain: u64,
    next: u64,
    /// The pending query.
    question: Option<Question>,
    asked: Instant,
    /// Samples sent before the query answered last, and the samples left at that time.
    answer: (u64, u64),
    /// Time of that query.
    answer_asked: Instant,
    played: u64,
    moved: Instant,
    began: Option<Instant>,
    rate: RateFit,
    /// Last time that the light's permission was checked.
    pub light_checked: Instant,
}

impl SampleStream {
    /// The FIFO must be empty but for [`DARK_SAMPLES`].
    pub fn new(sequence: Sequence, rate_hz: f64, full_scale: MechanicalDeg) -> Self {
        let now = Instant::now();
        Self {
            sequence,
            asked_rate_hz: rate_hz,
            full_scale,
            out: Vec::with_capacity(2 * WRITE_SAMPLES as usize * SAMPLE_BYTES),
            written: 0,
            certain: 0,
            next: 0,
            question: None,
            asked: now,
            answer: (0, 0),
            answer_asked: now,
            played: 0,
            moved: now,
            began: None,
            rate: RateFit::default(),
            light_checked: now,
        }
    }

    /// Reads replies and sends as many samples as fit; records in `record` what was sent.
    pub fn step(&mut self, port: &mut Port, record: Option<&StateFile>) -> Result<(), DeviceError> {
        let now = Instant::now();
        let is_over = self.question.as_mut().is_some_and(|question| question.timeout.look(now));
        while let Some(reply) = port.reply(parse_response)? {
            if let PlayzerXReply::Left(left) = reply {
                self.take_answer(u64::from(left))?;
            }
        }
        if is_over && self.question.is_some() {
            return Err(fault(
                DeviceErrorKind::Timeout,
                "the controller no longer answers: check its cable, or switch it off and on",
            ));
        }
        for _ in 0..WRITES_PER_STEP {
            if self.written == self.out.len() && !self.fill() {
                break;
            }
            if !self.write(port, record)? {
                break;
            }
        }
        self.check_motion()
    }

    /// Puts the next samples and queries into `out`; `false` if there is nothing to send now.
    fn fill(&mut self) -> bool {
        self.out.clear();
        self.written = 0;
        let (asked_after, left) = self.answer;
        let held_at_most = left + (self.next - asked_after);
        // Samples sent to a FIFO that ran dry would hide the gap; to a controller that restarted, they would be a step.
        let is_late = self.question.as_ref().is_some_and(|question| question.asked.elapsed() > ANSWER_WAIT);
        let is_in_doubt = is_late || self.may_have_run_dry();
        let room = match is_in_doubt {
            true => 0,
            false => (u64::from(FIFO_SAMPLES) - SPARE_SAMPLES).saturating_sub(held_at_most),
        };
        let samples = room.min(WRITE_SAMPLES).min(self.sequence.len() - self.next);
        for index in self.next..self.next + samples {
            let sample = MirrorSample::of(self.sequence.at(index), self.full_scale);
            PlayzerXCommand::Sample(sample).to_bytes(&mut self.out);
        }
        self.next += samples;
        // Nothing is asked once all are played: whoever uses the port next would get the answer.
        let may_ask = !self.is_played() && (is_in_doubt || self.asked.elapsed() >= ASK_EVERY);
        if self.question.is_none() && may_ask {
            PlayzerXCommand::SamplesLeft.to_bytes(&mut self.out);
        }
        !self.out.is_empty()
    }

    /// Writes as much of `out` as the port accepts; `false` if it accepts no more now.
    fn write(&mut self, port: &mut Port, record: Option<&StateFile>) -> Result<bool, DeviceError> {
        let note = |sent| record.map_or(Ok(()), |record| record.note_sent(sent).map_err(of_state));
        note(Sent { certainly: self.certain_now(), possibly: self.next })?;
        // Before the write: the controller may have played samples by the time that a busy host returns from it.
        let now = Instant::now();
        let written = port.write_some(&self.out[self.written..])?;
        self.written += written;
        if self.began.is_none() && written > 0 {
            (self.began, self.moved) = (Some(now), now);
        }
        if self.written < self.out.len() {
            return Ok(false);
        }
        let samples = self.next - self.certain;
        if self.out.len() > samples as usize * SAMPLE_BYTES {
            self.asked = now;
            let timeout = Timeout::new(ANSWER_WAIT, STEP, now);
            self.question = Some(Question { asked: now, sent: self.next, timeout });
        }
        self.certain = self.next;
        note(Sent { certainly: self.certain, possibly: self.certain })?;
        Ok(true)
    }

    /// Samples sent completely, including those of a partial write.
    fn certain_now(&self) -> u64 {
        (self.certain + (self.written / SAMPLE_BYTES) as u64).min(self.next)
    }

    fn take_answer(&mut self, left: u64) -> Result<(), DeviceError> {
        // An answer without a query, or with an impossible count, is garbage that looks like an answer.
        let Some(Question { asked, sent, .. }) = self.question else { return Ok(()) };
        let Some(played) = self.played_of(sent, left) else { return Ok(()) };
        self.question = None;
        (self.answer, self.answer_asked) = ((sent, left), asked);
        if played > self.played {
            self.moved = Instant::now();
        }
        self.played = played;
        if left > 0 {
            let (began, round_trip) = (self.began.unwrap_or(asked), asked.elapsed());
            let seconds = (asked.duration_since(began) + round_trip / 2).as_secs_f64();
            // The count was taken at any time of the round trip and of a sample.
            let within_s = round_trip.as_secs_f64().hypot(1.0 / self.asked_rate_hz);
            self.rate.push(seconds, played as f64, within_s);
        }
        if left == 0 && self.is_within_path(sent) {
            return Err(fault(
                DeviceErrorKind::Protocol,
                format!(
                    "the controller ran out of samples after {played}: the host was too slow; end other work on it or take a lower rate_hz"
                ),
            ));
        }
        Ok(())
    }

    /// Samples played, of the first `sent`, if `left` are left; `None` if that cannot be, by the clock.
    fn played_of(&self, sent: u64, left: u64) -> Option<u64> {
        let since = self.began.map_or(Duration::ZERO, |began| self.answer_asked.max(began).elapsed());
        let most = self.played as f64 + since.as_secs_f64() * self.asked_rate_hz * 1.1 + 2.0;
        let played = sent.saturating_sub(left);
        (left <= sent + DARK_SAMPLES && played >= self.played && played as f64 <= most).then_some(played)
    }

    /// Whether more samples must follow the first `sent` without a gap.
    fn is_within_path(&self, sent: u64) -> bool {
        self.sequence.path_len() > 0 && sent > self.sequence.lead_len() && sent < self.sequence.len()
    }

    /// Whether, by the clock, the FIFO may have drained since the last answer because the host was stalled.
    fn may_have_run_dry(&self) -> bool {
        let (asked_after, left) = self.answer;
        let held = left + (self.next - asked_after);
        let since = self.began.map_or(Duration::ZERO, |began| self.answer_asked.max(began).elapsed());
        self.is_within_path(self.next) && since.as_secs_f64() * self.asked_rate_hz * 1.1 >= held as f64
    }

    /// Returns an error if the FIFO does not drain, in which case the mirror does not move.
    fn check_motion(&self) -> Result<(), DeviceError> {
        let waiting = self.began.is_some() && self.played < self.certain;
        if waiting && self.answer_asked.saturating_duration_since(self.moved) > REPLY_WAIT {
            return Err(fault(
                DeviceErrorKind::Timeout,
                format!(
                    "the controller confirms no motion: it stands after {} samples; switch it off and on",
                    self.played
                ),
            ));
        }
        Ok(())
    }

    /// Empties the FIFO. Returns the mirror's position according to the controller; `None` if it does not tell it.
    pub fn halt(&mut self, port: &mut Port) -> Result<Option<Tilt>, DeviceError> {
        let certain = self.certain_now();
        let unanswered = usize::from(self.question.is_some());
        let left = halt(port, unanswered)?;
        // A controller that restarted has forgotten samples that it cannot have played yet.
        let played = left.and_then(|left| self.played_of(certain, left.into()));
        Ok(played.map(|played| self.sequence.after(played)))
    }

    pub fn is_played(&self) -> bool {
        self.played == self.sequence.len()
    }

    pub fn has_light(&self) -> bool {
        self.sequence.is_lit()
    }

    pub fn asked_rate_hz(&self) -> f64 {
        self.asked_rate_hz
    }

    /// The measured rate at which the FIFO drains.
    pub fn rate_hz(&self) -> Option<f64> {
        self.rate.rate_hz()
    }

    pub fn progress(&self) -> MirrorProgress {
        MirrorProgress {
            played: self.sequence.of_path(self.played),
            sent: self.sequence.of_path(self.certain),
            total: self.sequence.path_len(),
            parked: false,
            rate_hz: self.rate.rate_hz(),
        }
    }
}

/// Empties the FIFO. Returns how many samples it held just before; `None` if the controller does not tell it, and may
/// empty it at any later time. `unanswered` queries are still pending.
///
/// A controller that sends nothing at all has not processed the command yet, so there is time to wait for it. If it
/// answers the ping after the queries, it has processed them, and their answers are lost.
pub fn halt(port: &mut Port, unanswered: usize) -> Result<Option<u32>, DeviceError> {
    let mut bytes = PADDING.to_vec();
    (0..QUESTIONS).for_each(|_| PlayzerXCommand::SamplesLeft.to_bytes(&mut bytes));
    PlayzerXCommand::Clear.to_bytes(&mut bytes);
    PlayzerXCommand::Ping.to_bytes(&mut bytes);
    port.send(&bytes)?;
    let (mut answers, mut last) = (0, None);
    for _ in 0..MOST_REPLIES {
        // The last answer is the closest in time to the clearing.
        let known = last.filter(|_| answers > unanswered);
        let wait = if known.is_some() { QUIET } else { HALT_WAIT };
        match port.await_reply(wait, parse_response, Some)? {
            Some(PlayzerXReply::Left(left)) => (answers, last) = (answers + 1, Some(left)),
            Some(PlayzerXReply::Info { .. }) => {}
            Some(PlayzerXReply::Alive) | None => return Ok(known),
        }
    }
    Ok(None)
}

/// Fits a straight line through (seconds, samples), each weighted by the certainty of its time.
#[derive(Debug, Default)]
struct RateFit {
    count: u32,
    weight: f64,
    seconds: f64,
    samples: f64,
    seconds_squared: f64,
    product: f64,
}

impl RateFit {
    /// Minimum number of points for a rate.
    const FEWEST: u32 = 8;

    /// The time of a point lies anywhere within an interval of this length.
    fn push(&mut self, seconds: f64, samples: f64, within_s: f64) {
        // A stall holds the time at one end of the interval: its standard error is half of it.
        let weight = 4.0 / within_s.powi(2);
        self.count += 1;
        self.weight += weight;
        self.seconds += weight * seconds;
        self.samples += weight * samples;
        self.seconds_squared += weight * seconds * seconds;
        self.product += weight * seconds * samples;
    }

    fn rate_hz(&self) -> Option<f64> {
        let spread = self.seconds_squared - self.seconds * self.seconds / self.weight;
        (self.count >= Self::FEWEST && spread.sqrt().recip() < RATE_ERROR)
            .then(|| (self.product - self.seconds * self.samples / self.weight) / spread)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_the_slope_of_its_points() {
        let mut fit = RateFit::default();
        for n in 0..20 {
            assert_eq!(fit.rate_hz().is_some(), n >= 8);
            let seconds = f64::from(n) * 0.01;
            fit.push(seconds, 39_000.0 * seconds + 17.0, 0.001);
        }
        // An answer that was under way for long changes little.
        fit.push(0.2, 0.0, 10.0);
        assert!((fit.rate_hz().unwrap() / 39_000.0 - 1.0).abs() < 1e-4);
    }

    #[test]
    fn a_rate_between_late_answers_is_stated_once_it_is_certain() {
        let mut fit = RateFit::default();
        let (lates, late_s) = ([0.2, 0.9, 0.4, 0.7, 0.1, 0.6], 0.016);
        let mut stated = Vec::new();
        for n in 0..60 {
            let asked_s = f64::from(n) * late_s;
            // The controller counts at some time of the round trip.
            let samples = 10_000.0 * (asked_s + lates[n as usize % lates.len()] * late_s);
            fit.push(asked_s + late_s / 2.0, samples, late_s);
            stated.push(fit.rate_hz());
        }
        assert!(stated[15].is_none());
        assert!(stated.iter().flatten().count() > 20);
        assert!(stated.iter().flatten().all(|rate_hz| (rate_hz / 10_000.0 - 1.0).abs() < 2.0 * RATE_ERROR));
    }
}
