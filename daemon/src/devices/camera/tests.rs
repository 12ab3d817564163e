//! Tests the acquisition with a scripted camera on a virtual clock.

mod ahead;
mod sets;

use std::sync::Mutex;

use raysweep_core::{Applied, CameraCapabilities, ClockHandle, FirstFrame, PixelFormat, Readout, Shutter};
use raysweep_pipeline::{PointRole, Policy};

use super::*;
use crate::run::orders::Order;

const PERIOD_NS: i64 = 16_666_667;
const LATENCY_US: f64 = 8.0;

/// Behaviour of the camera.
#[derive(Clone, Copy)]
struct Script {
    /// Latencies of settings in frames, used in turn.
    late: &'static [u64],
    /// What the camera promises: the exact frame, or a range up to this many frames after the next.
    promise: Option<u64>,
    /// Whether its frames carry their exposure.
    chunk: bool,
    /// How much longer than requested the host sleeps, in turn, in ms.
    oversleep_ms: &'static [i64],
    /// Ids of frames that never arrive.
    lost: &'static [u64],
    /// Frames that are delayed in transit, as by resends, in ms; those behind them wait.
    held_up: &'static [(u64, i64)],
    /// Number of sets of its sequencer.
    sets: usize,
    /// Frames of a sequence that repeat the set of the frame before.
    stutters: &'static [u64],
    /// Whether its sequencer stays at the first set.
    stuck: bool,
    /// Which set its frames report.
    says: Says,
}

/// The sequencer's set that frames report.
#[derive(Clone, Copy, PartialEq)]
enum Says {
    Nothing,
    Truth,
    /// The set of the next frame.
    Next,
    /// Always the first.
    First,
}

const EXACT: Script = Script {
    late: &[0],
    promise: None,
    chunk: true,
    oversleep_ms: &[0],
    lost: &[],
    held_up: &[],
    sets: 0,
    stutters: &[],
    stuck: false,
    says: Says::Nothing,
};

/// A camera that answers every trigger and whose frames reach the host 18 ms after their exposure.
struct Scripted {
    script: Script,
    clock: ClockHandle,
    capabilities: CameraCapabilities,
    written: Vec<(u64, CameraSettings)>,
    /// First frame and sets of its sequence.
    sequence: Option<(u64, Vec<CameraSettings>)>,
    changes: usize,
    /// The frames at which settings were written or a sequence was begun.
    told: Arc<Mutex<Vec<u64>>>,
    sleeps: usize,
    next_seq: u64,
    /// The true settings of each frame.
    truth: Arc<Mutex<Vec<CameraSettings>>>,
}

impl Scripted {
    fn next_trigger(&self) -> u64 {
        self.clock.now_ns().unsigned_abs().div_ceil(PERIOD_NS.unsigned_abs())
    }

    /// The sequencer's set of a frame; the first of `sets` for frames outside the sequence.
    fn set_of(&self, seq: u64, (first_seq, sets): &(u64, Vec<CameraSettings>)) -> usize {
        let stutters = self.script.stutters.iter().filter(|stutter| **stutter <= seq).count();
        let taken = seq.saturating_sub(*first_seq) as usize;
        if self.script.stuck { 0 } else { taken.saturating_sub(stutters) % sets.len() }
    }

    fn settings(&self, seq: u64) -> CameraSettings {
        if let Some(sequence) = self.sequence.as_ref().filter(|(first_seq, _)| seq >= *first_seq) {
            return sequence.1[self.set_of(seq, sequence)];
        }
        let written = self.written.iter().rev().find(|(first_seq, _)| *first_seq <= seq);
        written.map_or(settings(0.0, 100.0), |(_, settings)| *settings)
    }
}

impl Camera for Scripted {
    fn capabilities(&self) -> &CameraCapabilities {
        &self.capabilities
    }

    fn state(&self) -> DeviceState {
        DeviceState::Streaming
    }

    fn configure(&mut self, _: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        let next_seq = self.next_trigger();
        let first_seq = next_seq + self.script.late[self.changes % self.script.late.len()];
        self.changes += 1;
        self.told.lock().unwrap().push(next_seq);
        if self.sequence.is_some() {
            // Frames in transit keep their sets.
            let under_way: Vec<_> = (self.next_seq..first_seq).map(|seq| (seq, self.settings(seq))).collect();
            self.written.extend(under_way);
            self.sequence = None;
        }
        self.written.retain(|(earlier_seq, _)| *earlier_seq < first_seq);
        self.written.push((first_seq, *settings));
        let first_frame = match self.script.promise {
            None => FirstFrame::Exactly(first_seq),
            // A driver knows which frames it has delivered, and how many triggers there may have been since.
            Some(late) => FirstFrame::Within { earliest: self.next_seq, certain: next_seq + late },
        };
        Ok(Applied { actual: *settings, first_frame })
    }

    fn sequence(&mut self, all: &[CameraSettings]) -> Result<Option<Vec<CameraSettings>>, DeviceError> {
        if all.len() > self.script.sets {
            return Ok(None);
        }
        // The previous settings stay for some frames, as with any others.
        let first_seq = self.next_trigger() + self.script.late[0];
        self.told.lock().unwrap().push(first_seq);
        self.sequence = Some((first_seq, all.to_vec()));
        Ok(Some(all.to_vec()))
    }

    fn active_set(&self) -> Option<usize> {
        let (newest_seq, sequence) = (self.next_seq - 1, self.sequence.as_ref()?);
        let set = self.set_of(newest_seq, sequence);
        match self.script.says {
            Says::Nothing => None,
            Says::Truth => Some(set),
            Says::Next => Some((set + 1) % sequence.1.len()),
            Says::First => Some(0),
        }
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }

    fn next_frame(&mut self, _: &mut FrameBuf, timeout: Duration) -> Result<Option<FrameStamp>, DeviceError> {
        let deadline_ns = self.clock.now_ns() + i64::try_from(timeout.as_nanos()).unwrap();
        loop {
            let seq = self.next_seq;
            let settings = self.settings(seq);
            let start_us = LATENCY_US + settings.trigger_delay_us;
            let start_ns = seq as i64 * PERIOD_NS + ns_from_us(start_us);
            let held_ms = self.script.held_up.iter().find(|(held, _)| *held == seq).map_or(0, |(_, ms)| *ms);
            let way_ns = ns_from_us(settings.exposure_us + 18_000.0) + held_ms * 1_000_000;
            let host_ns = (start_ns + way_ns).max(self.clock.now_ns());
            if host_ns > deadline_ns {
                let late_ms = self.script.oversleep_ms[self.sleeps % self.script.oversleep_ms.len()];
                self.sleeps += 1;
                self.clock.sleep_until(deadline_ns + late_ms * 1_000_000);
                return Ok(None);
            }
            self.clock.sleep_until(host_ns);
            self.next_seq += 1;
            let mut truth = self.truth.lock().unwrap();
            assert_eq!(truth.len() as u64, seq);
            truth.push(settings);
            if !self.script.lost.contains(&seq) {
                let exposure_us = self.script.chunk.then_some(settings.exposure_us);
                let (device_ns, exposure_start_ns) = (start_ns, start_ns);
                return Ok(Some(FrameStamp { seq, device_ns, exposure_start_ns, host_ns, exposure_us }));
            }
        }
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }
}

fn settings(trigger_delay_us: f64, exposure_us: f64) -> CameraSettings {
    CameraSettings { shutter: Shutter::Rolling, exposure_us, trigger_delay_us }
}

fn capabilities() -> CameraCapabilities {
    CameraCapabilities {
        model: "scripted".into(),
        width: 1,
        height: 1,
        format: PixelFormat::Mono8,
        row_time_us: 10.0,
        trigger_latency_us: LATENCY_US,
        readout_us: 1_000.0,
        readout: Readout::Sequential,
        exposure_us: 1.0..=1e6,
        trigger_delay_us: 0.0..=1e6,
    }
}

/// Two exposures with six delays each.
fn plan() -> Vec<CameraSettings> {
    let delays = || (0..6).map(|k| 3_000.0 + 200.0 * f64::from(k));
    [600.0, 900.0].iter().flat_map(|&exposure_us| delays().map(move |us| settings(us, exposure_us))).collect()
}

/// Result of playing a plan.
struct Played {
    latency: Option<SettingsLatency>,
    /// Point and id of each frame that was handed on as a point's own.
    counted: Vec<(u32, u64)>,
    /// Points that ended without all their frames.
    short: Vec<u32>,
    truth: Vec<CameraSettings>,
    /// The frames at which settings were written or a sequence was begun.
    told: Vec<u64>,
}

impl Played {
    /// Number of frames from the first to the last that counted.
    fn frames(&self) -> u64 {
        let ids = || self.counted.iter().map(|(_, seq)| *seq);
        ids().max().unwrap() + 1 - ids().min().unwrap()
    }

    /// Ids of frames that were attributed to the wrong point.
    fn wrong(&self, plan: &[CameraSettings]) -> Vec<u64> {
        let is_wrong = |&&(point, seq): &&(u32, u64)| self.truth[seq as usize] != plan[point as usize];
        self.counted.iter().filter(is_wrong).map(|(_, seq)| *seq).collect()
    }

    fn assert_true(&self, plan: &[CameraSettings]) {
        for &(point, seq) in &self.counted {
            assert_eq!(
                self.truth[seq as usize],
                plan[point as usize % plan.len()],
                "frame {seq} of point {point}"
            );
        }
    }
}

/// Plays the plan as a sweep with `frames` per point or, given `cycles`, as a film.
fn play(script: Script, frames: u32, cycles: Option<u32>) -> Played {
    play_plan(&plan(), script, frames, cycles, None)
}

type Shared<T> = Arc<Mutex<Vec<T>>>;

/// The acquisition of a plan, with the true settings of each frame and the frames at which settings were written.
fn acquisition(
    plan: &[CameraSettings],
    script: Script,
    input: Input<DeviceEvent>,
    orders: Arc<Orders>,
) -> (Acquisition, Shared<CameraSettings>, Shared<u64>) {
    let (told, truth) = (Shared::default(), Shared::default());
    let clock = Clock::simulated();
    let camera = Scripted {
        script,
        clock: clock.register(),
        capabilities: capabilities(),
        written: Vec::new(),
        sequence: None,
        changes: 0,
        told: told.clone(),
        sleeps: 0,
        next_seq: 0,
        truth: truth.clone(),
    };
    let drive =
        Drive { clock, pace: Pace::Pipeline, line: TriggerLine::new(PERIOD_NS as f64 * 1e-3, 50.0, plan) };
    (Acquisition::new(Box::new(camera), drive, input, orders), truth, told)
}

/// Plays a plan, with a pause after the given number of counted frames.
fn play_plan(
    plan: &[CameraSettings],
    script: Script,
    frames: u32,
    cycles: Option<u32>,
    pause_after: Option<usize>,
) -> Played {
    let (input, events) = Input::new(64, Policy::Wait);
    let orders = Arc::new(Orders::default());
    let (mut acquisition, truth, told) = acquisition(plan, script, input, orders.clone());
    let follower = std::thread::spawn({
        let orders = orders.clone();
        move || follow(&events, frames, pause_after, &orders)
    });
    let latency = OnceLock::new();
    let ended = acquisition.work(Work::Probe(plan[0]), &latency);
    assert!(matches!(ended, Ended::Flushed(Ok(()))));
    let shot = |settings| Shot { settings, light_edges_later: 0 };
    let point = |index: u32, settings: CameraSettings| Point {
        role: PointRole::Sweep(index),
        delay_us: settings.trigger_delay_us,
        exposure_us: settings.exposure_us,
        frames,
    };
    let work = match cycles {
        None => Work::Pass(Pass {
            attempts: (0..)
                .zip(plan)
                .map(|(index, &settings)| Attempt {
                    id: SettingsId { point: index, attempt: 0 },
                    point: point(index, settings),
                    shot: shot(settings),
                    interruptions: 0,
                })
                .collect(),
            not_before_ns: 0,
        }),
        Some(cycles) => Work::Film(FilmPass {
            settings: (0..)
                .zip(plan)
                .map(|(index, &settings)| FilmSetting {
                    ordinal: index,
                    point: point(index, settings),
                    shot: shot(settings),
                    periods_from_last: 1,
                })
                .collect(),
            cycles,
            not_before_ns: 0,
        }),
    };
    assert!(matches!(acquisition.work(work, &latency), Ended::Flushed(Ok(()))));
    drop(acquisition);
    let (counted, short) = follower.join().unwrap();
    let (truth, told) = (truth.lock().unwrap().clone(), told.lock().unwrap().clone());
    Played { latency: latency.get().copied(), counted, short, truth, told }
}

fn follow(
    events: &raysweep_pipeline::Receiver<DeviceEvent>,
    frames: u32,
    pause_after: Option<usize>,
    orders: &Orders,
) -> (Vec<(u32, u64)>, Vec<u32>) {
    let (mut counted, mut short) = (Vec::new(), Vec::new());
    let mut open: Option<(u32, u32)> = None;
    for event in events.iter() {
        match event {
            DeviceEvent::Begin(job) => {
                assert!(open.is_none(), "a job begins within another");
                open = Some((job.id.point, 0));
            }
            DeviceEvent::Frame(frame, Label::Counted | Label::CountedUnless { .. }) => {
                let (point, passed) = open.as_mut().expect("a job");
                *passed += 1;
                counted.push((*point, frame.stamp.seq));
                if Some(counted.len()) == pause_after {
                    orders.give(Order::Pause);
                }
            }
            DeviceEvent::Idle => orders.give(Order::Go),
            DeviceEvent::End | DeviceEvent::Interrupt => {
                let (point, passed) = open.take().expect("a job");
                if passed < frames {
                    short.push(point);
                }
            }
            _ => {}
        }
    }
    (counted, short)
}

fn all_late() -> Vec<Script> {
    let mut scripts = Vec::new();
    for late in [&[0][..], &[1], &[2], &[3]] {
        for chunk in [true, false] {
            scripts.push(Script { late, chunk, ..EXACT });
            scripts.push(Script { late, chunk, promise: Some(3), ..EXACT });
        }
    }
    scripts
}

#[test]
fn a_pipeline_that_keeps_all_buffers_does_not_keep_the_end_of_a_run() {
    let (input, _events) = Input::new(64, Policy::Wait);
    let orders = Arc::new(Orders::default());
    let (mut acquisition, ..) = acquisition(&plan(), EXACT, input, orders.clone());
    let held: Vec<FrameBuf> = std::iter::from_fn(|| acquisition.pool.try_take()).collect();
    assert_eq!(held.len(), POOL_BUFFERS);
    let (told, ended) = std::sync::mpsc::channel();
    std::thread::spawn(move || told.send(matches!(acquisition.receive(POLL), Ok(None))));
    assert!(ended.recv_timeout(3 * POLL).is_err(), "it waits");
    orders.give(Order::Cancel);
    assert_eq!(ended.recv_timeout(600 * POLL), Ok(true));
}
