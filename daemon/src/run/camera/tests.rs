//! The sequencer on a camera that is played by a script, on a virtual clock.

use std::sync::Mutex;

use raysweep_core::{Applied, CameraCapabilities, ClockHandle, FirstFrame, PixelFormat, Readout, Shutter};
use raysweep_pipeline::{Policy, Role};

use super::*;
use crate::run::orders::Order;

const PERIOD_NS: i64 = 16_666_667;
const LATENCY_US: f64 = 8.0;

/// What the camera is like.
#[derive(Clone, Copy)]
struct Script {
    /// Frames that settings are late, drawn in turn.
    late: &'static [u64],
    /// What it promises: the frame itself, or any up to so many frames later than the next.
    promise: Option<u64>,
    /// Whether its frames carry their exposure.
    chunk: bool,
    /// How much longer than asked for the host sleeps, in turn, in ms.
    oversleep_ms: &'static [i64],
    /// Ids of frames that never arrive.
    lost: &'static [u64],
    /// Frames that are held up on their way to the host, as resends do, by so many ms; those behind them wait.
    held_up: &'static [(u64, i64)],
    /// How many sets its sequencer has.
    sets: usize,
    /// Frames of a sequence that have the set of the frame before once more.
    stutters: &'static [u64],
    /// Whether its sequencer stays with the first set.
    stuck: bool,
    /// Whether its frames say which set they have.
    says: Says,
}

/// What frames say of the sequencer's set that they have.
#[derive(Clone, Copy, PartialEq)]
enum Says {
    Nothing,
    Truth,
    /// The set of the frame after.
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

/// A camera whose every trigger is answered, and whose frames are on the host 18 ms after their exposure.
struct Scripted {
    script: Script,
    clock: ClockHandle,
    capabilities: CameraCapabilities,
    written: Vec<(u64, CameraSettings)>,
    /// From which frame on its sequencer goes through what.
    sequence: Option<(u64, Vec<CameraSettings>)>,
    changes: usize,
    /// The frames at which settings were written or a sequence was begun.
    told: Arc<Mutex<Vec<u64>>>,
    sleeps: usize,
    next_seq: u64,
    /// The settings of each frame, in truth.
    truth: Arc<Mutex<Vec<CameraSettings>>>,
}

impl Scripted {
    fn next_trigger(&self) -> u64 {
        self.clock.now_ns().unsigned_abs().div_ceil(PERIOD_NS.unsigned_abs())
    }

    /// The sequencer's set that a frame has; the first of `sets` where it is not of the sequence.
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
            // What is on its way has its sets.
            let under_way: Vec<_> = (self.next_seq..first_seq).map(|seq| (seq, self.settings(seq))).collect();
            self.written.extend(under_way);
            self.sequence = None;
        }
        self.written.retain(|(earlier_seq, _)| *earlier_seq < first_seq);
        self.written.push((first_seq, *settings));
        let first_frame = match self.script.promise {
            None => FirstFrame::Exactly(first_seq),
            // A driver knows which frames it has handed on, and how many triggers there may have been since.
            Some(late) => FirstFrame::Within { earliest: self.next_seq, certain: next_seq + late },
        };
        Ok(Applied { actual: *settings, first_frame })
    }

    fn sequence(&mut self, all: &[CameraSettings]) -> Result<Option<Vec<CameraSettings>>, DeviceError> {
        if all.len() > self.script.sets {
            return Ok(None);
        }
        // It keeps the settings before for some frames, as with any others.
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

/// What the sequencer made of a plan.
struct Played {
    latency: Option<SettingsLatency>,
    /// Point and id of each frame that was handed on as a point's.
    counted: Vec<(u32, u64)>,
    /// Points that ended without all their frames.
    short: Vec<u32>,
    truth: Vec<CameraSettings>,
    /// The frames at which settings were written or a sequence was begun.
    told: Vec<u64>,
}

impl Played {
    /// Frames from the first to the last that counted.
    fn frames(&self) -> u64 {
        let ids = || self.counted.iter().map(|(_, seq)| *seq);
        ids().max().unwrap() + 1 - ids().min().unwrap()
    }

    /// Ids of frames that were taken for another point's.
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

/// Takes the plan as a sweep of `frames` a point or, in `cycles`, as a film.
fn play(script: Script, frames: u32, cycles: Option<u32>) -> Played {
    play_plan(&plan(), script, frames, cycles, None)
}

/// Takes a plan, with a pause after so many frames that counted.
fn play_plan(
    plan: &[CameraSettings],
    script: Script,
    frames: u32,
    cycles: Option<u32>,
    pause_after: Option<usize>,
) -> Played {
    let told = Arc::new(Mutex::new(Vec::new()));
    let orders = Arc::new(Orders::default());
    let clock = Clock::simulated();
    let truth = Arc::new(Mutex::new(Vec::new()));
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
    let drive = Drive { clock, pace: Pace::Pipeline, line: Line::new(PERIOD_NS as f64 * 1e-3, 50.0, plan) };
    let (input, events) = Input::new(64, Policy::Wait);
    let follower = std::thread::spawn({
        let orders = orders.clone();
        move || follow(&events, frames, pause_after, &orders)
    });
    let mut sequencer = Sequencer::new(Box::new(camera), drive, input, orders);
    let latency = OnceLock::new();
    let ended = sequencer.work(Work::Probe(plan[0]), &latency);
    assert!(matches!(ended, Ended::Flushed(Ok(()))));
    let shot = |settings| Shot { settings, light_edges_later: 0 };
    let point = |index: u32, settings: CameraSettings| Point {
        role: Role::Sweep(index),
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
    assert!(matches!(sequencer.work(work, &latency), Ended::Flushed(Ok(()))));
    drop(sequencer);
    let (counted, short) = follower.join().unwrap();
    let (truth, told) = (truth.lock().unwrap().clone(), told.lock().unwrap().clone());
    Played { latency: latency.get().copied(), counted, short, truth, told }
}

fn follow(
    events: &raysweep_pipeline::Receiver<Event>,
    frames: u32,
    pause_after: Option<usize>,
    orders: &Orders,
) -> (Vec<(u32, u64)>, Vec<u32>) {
    let (mut counted, mut short) = (Vec::new(), Vec::new());
    let mut open: Option<(u32, u32)> = None;
    for event in events.iter() {
        match event {
            Event::Begin(job) => {
                assert!(open.is_none(), "a job begins within another");
                open = Some((job.id.point, 0));
            }
            Event::Frame(frame, Label::Counted) => {
                let (point, passed) = open.as_mut().expect("a job");
                *passed += 1;
                counted.push((*point, frame.stamp.seq));
                if Some(counted.len()) == pause_after {
                    orders.give(Order::Pause);
                }
            }
            Event::Idle => orders.give(Order::Go),
            Event::End => {
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
fn a_sweep_and_a_film_cost_no_frame_that_they_do_not_need() {
    for script in all_late() {
        let Script { late, promise, chunk, .. } = script;
        let what = format!("{late:?} frames late, {promise:?} promised, exposure carried: {chunk}");
        let sweep = play(script, 4, None);
        sweep.assert_true(&plan());
        assert_eq!((sweep.counted.len(), sweep.short.len()), (48, 0), "{what}");
        let late_frames = late[0] as u32;
        let found = SettingsLatency { min_frames: late_frames, max_frames: late_frames };
        assert_eq!(sweep.latency, Some(found), "{what}");
        // Where frames do not tell their exposure and the camera does not know, the one change of exposure costs the
        // frames until it is certain, and the first of those.
        let unknown = if promise.is_some() && !chunk { 3 + 1 } else { 0 };
        assert!((48..=48 + unknown).contains(&sweep.frames()), "{what}: {} frames", sweep.frames());
        let film = play(script, 1, Some(3));
        film.assert_true(&plan());
        assert_eq!((film.counted.len(), film.short.len()), (36, 0), "{what}");
        assert!((36..=36 + 5 * unknown).contains(&film.frames()), "{what}: {} frames", film.frames());
    }
}

#[test]
fn settings_that_are_late_now_and_then_mislabel_nothing() {
    let late = &[2, 0, 3, 1, 1, 3, 0, 2, 3, 0, 0, 1, 2];
    for chunk in [true, false] {
        let script = Script { late, chunk, promise: Some(3), ..EXACT };
        let sweep = play(script, 4, None);
        sweep.assert_true(&plan());
        assert_eq!(sweep.latency, Some(SettingsLatency { min_frames: 0, max_frames: 3 }));
        assert_eq!((sweep.counted.len(), sweep.short.len()), (48, 0));
        // By their stamps, frames count as soon as they may: 1.4 frames a point are late on average.
        let most = if chunk { 48 + 12 * 2 } else { 48 + 12 * 4 };
        assert!(sweep.frames() <= most, "exposure carried: {chunk}: {} frames", sweep.frames());
        let film = play(script, 1, Some(3));
        film.assert_true(&plan());
        assert_eq!((film.counted.len(), film.short.len()), (36, 0));
    }
}

#[test]
fn a_host_that_wakes_late_costs_a_film_nothing_while_it_is_late_by_less_than_half_a_period() {
    for script in all_late().into_iter().filter(|script| script.chunk) {
        let script = Script { oversleep_ms: &[0, 7, 3, 0, 6, 1, 7, 7], ..script };
        let film = play(script, 1, Some(5));
        film.assert_true(&plan());
        assert_eq!((film.counted.len(), film.frames()), (60, 60), "{:?} frames late", script.late);
    }
}

#[test]
fn a_host_that_wakes_later_still_costs_frames_and_no_settings() {
    for script in all_late() {
        let script = Script { oversleep_ms: &[0, 40, 3, 0, 0, 18, 1, 0, 25, 16, 2], ..script };
        let film = play(script, 1, Some(5));
        film.assert_true(&plan());
        assert_eq!((film.counted.len(), film.short.len()), (60, 0), "{:?} frames late", script.late);
        let order: Vec<u32> = film.counted.iter().map(|(point, _)| *point).collect();
        assert_eq!(order, (0..5).flat_map(|_| 0..12).collect::<Vec<_>>());
    }
}

#[test]
fn a_lost_frame_costs_its_own_point_at_the_most() {
    for script in all_late() {
        // Probe and lead-in are over by frame 70; the points are not before frame 95.
        let script = Script { lost: &[75, 76, 82, 86, 88, 90], ..script };
        let sweep = play(script, 4, None);
        sweep.assert_true(&plan());
        assert!(sweep.short.len() <= 6 && sweep.counted.len() >= 48 - 6, "{:?}", sweep.short);
        let film = play(script, 1, Some(5));
        film.assert_true(&plan());
        assert_eq!(film.short.len() + film.counted.len(), 60);
        assert!((1..=6).contains(&film.short.len()), "{:?}", film.short);
    }
}

#[test]
fn frames_that_are_held_up_on_their_way_keep_their_settings() {
    for script in all_late() {
        let Script { late, promise, chunk, .. } = script;
        let unknown = if promise.is_some() && !chunk { 3 + 1 } else { 0 };
        for held_ms in [20, 45, 90, 140, 200] {
            let held = [(72, held_ms), (77, held_ms), (90, held_ms)];
            let script = Script { held_up: Vec::leak(held.to_vec()), ..script };
            let what =
                format!("{held_ms} ms, {late:?} late, {promise:?} promised, exposure carried: {chunk}");
            let sweep = play(script, 4, None);
            sweep.assert_true(&plan());
            assert_eq!((sweep.counted.len(), sweep.short.len()), (48, 0), "{what}");
            // What two or three frames are late by, the clock bridges.
            assert!(held_ms > 45 || sweep.frames() <= 48 + unknown, "{what}: {} frames", sweep.frames());
            let film = play(script, 1, Some(5));
            film.assert_true(&plan());
            assert_eq!((film.counted.len(), film.short.len()), (60, 0), "{what}");
        }
    }
}

#[test]
fn settings_that_stamps_tell_apart() {
    let line = |plan: &[CameraSettings]| Line::new(16_666.667, 50.0, plan);
    let tells = |plan: &[CameraSettings]| line(plan).distinct;
    assert!(tells(&plan()));
    assert!(!tells(&[settings(100.0, 600.0), settings(149.0, 600.0)]));
    assert!(tells(&[settings(100.0, 600.0), settings(149.0, 900.0)]));
    // A period apart, a delay is seen at the same distance from an edge.
    assert!(!tells(&[settings(100.0, 600.0), settings(16_740.0, 600.0)]));
}

#[test]
fn a_frame_whose_stamps_leave_a_doubt_is_nobodys() {
    // Frame 1 has the first settings; frames 2 to 4 may have the second already.
    let owner = |second: CameraSettings, shown: CameraSettings, chunk: bool| {
        let mut ahead = Ahead::new(capabilities(), Line::new(PERIOD_NS as f64 * 1e-3, 50.0, &plan()));
        let see = |seq: u64, settings: CameraSettings, ahead: &mut Ahead| {
            let start_us = LATENCY_US + settings.trigger_delay_us;
            let start_ns = seq as i64 * PERIOD_NS + ns_from_us(start_us);
            let exposure_us = chunk.then_some(settings.exposure_us);
            let (device_ns, exposure_start_ns, host_ns) = (start_ns, start_ns, start_ns + 1_000_000);
            ahead.see(&FrameStamp { seq, device_ns, exposure_start_ns, host_ns, exposure_us }).owner
        };
        let first = settings(3_000.0, 600.0);
        ahead.push(Applied { actual: first, first_frame: FirstFrame::Exactly(1) }, (0, 0), None);
        assert_eq!(see(1, first, &mut ahead), Some(0));
        let first_frame = FirstFrame::Within { earliest: 2, certain: 5 };
        ahead.push(Applied { actual: second, first_frame }, (PERIOD_NS, PERIOD_NS), None);
        see(2, shown, &mut ahead)
    };
    let first = settings(3_000.0, 600.0);
    let second = settings(3_200.0, 600.0);
    assert_eq!((owner(second, first, true), owner(second, second, true)), (Some(0), Some(1)));
    assert_eq!((owner(second, first, false), owner(second, second, false)), (Some(0), Some(1)));
    assert_eq!(owner(second, settings(3_100.0, 600.0), true), None, "a delay that nobody asked for");
    assert_eq!(owner(second, settings(3_200.0, 900.0), true), None, "an exposure that nobody asked for");
    assert_eq!(owner(settings(3_010.0, 600.0), settings(3_005.0, 600.0), true), None, "either might be");
    let longer = settings(3_200.0, 900.0);
    assert_eq!(
        (owner(longer, longer, true), owner(longer, longer, false)),
        (Some(1), None),
        "who knows how long"
    );
}

/// Eight delays at one exposure: a film.
fn film_plan() -> Vec<CameraSettings> {
    [0.0, 60.0, 200.0, 400.0, 700.0, 500.0, 300.0, 120.0]
        .iter()
        .map(|us| settings(3_000.0 + us, 600.0))
        .collect()
}

/// Sequencers whose frames say which set they have, and such whose stamps must tell.
fn sequencers() -> Vec<Script> {
    let says = [Says::Nothing, Says::Truth, Says::First];
    let scripts = all_late().into_iter().map(|script| Script { sets: 8, ..script });
    scripts.flat_map(|script| says.map(|says| Script { says, ..script })).collect()
}

#[test]
fn a_film_by_the_sequencer_is_told_nothing_while_it_runs() {
    for script in sequencers() {
        // A host that is this late would cost a film that is written ahead frames.
        let script = Script { oversleep_ms: &[0, 40, 3, 0, 0, 18, 1, 0, 25, 16, 2], ..script };
        let film = play_plan(&film_plan(), script, 1, Some(5), None);
        film.assert_true(&film_plan());
        assert_eq!((film.counted.len(), film.short.len(), film.frames()), (40, 0, 40), "{:?}", script.late);
        let ids: Vec<u64> = film.counted.iter().map(|(_, seq)| *seq).collect();
        assert!(!film.told.iter().any(|told| (ids[0]..=ids[39]).contains(told)), "{:?}", film.told);
        // By their stamps, two cycles at the most until its place in the sequence is known and its cycle begins; one by
        // their own word.
        let begun = film.told.iter().filter(|told| **told < ids[0]).max().unwrap();
        let cycles = if script.says == Says::Truth { 1 } else { 2 };
        assert!(ids[0] - begun <= cycles * 8 + 6, "{begun} {ids:?}");
        assert!(film.told.last().unwrap() > &ids[39], "it is stopped");
    }
}

#[test]
fn a_lost_frame_of_a_sequence_takes_its_set_with_it() {
    for script in sequencers() {
        let script = Script { lost: &[75, 76, 82, 86, 88, 98], ..script };
        let film = play_plan(&film_plan(), script, 1, Some(6), None);
        film.assert_true(&film_plan());
        assert_eq!(film.short.len() + film.counted.len(), 48);
        let (first, last) = (film.counted[0].1, film.counted.last().unwrap().1);
        let lost = script.lost.iter().filter(|lost| (first..=last).contains(*lost)).count();
        assert!(lost >= 2, "{first} to {last}");
        assert_eq!(film.short.len(), lost);
    }
}

#[test]
fn a_sequence_that_stutters_is_found_again() {
    let script = Script { sets: 8, stutters: &[120], ..EXACT };
    let film = play_plan(&film_plan(), script, 1, Some(20), None);
    // What is wrong, the assembler sees by its delay: for less than two cycles.
    let wrong = film.wrong(&film_plan());
    assert!((1..=16).contains(&wrong.len()) && wrong[0] == 120, "{wrong:?}");
    assert_eq!(film.counted.len(), 160);
    let film = play_plan(&film_plan(), Script { says: Says::Truth, ..script }, 1, Some(20), None);
    film.assert_true(&film_plan());
    let last = film.counted.last().unwrap().1;
    assert_eq!((film.counted.len(), film.frames(), last > 120), (160, 161, true));
}

#[test]
fn a_sequencer_that_says_wrong_sets_is_found_out_by_its_stamps() {
    let script = Script { sets: 8, says: Says::Next, ..EXACT };
    let film = play_plan(&film_plan(), script, 1, Some(20), None);
    let (wrong, first) = (film.wrong(&film_plan()), film.counted[0].1);
    assert!((1..=16).contains(&wrong.len()) && wrong.iter().all(|seq| seq - first < 16), "{wrong:?}");
    assert_eq!(film.counted.len(), 160);
}

#[test]
fn a_pause_stops_the_sequence_and_a_cycle_is_whole_before_it() {
    let script = Script { sets: 8, ..EXACT };
    // The order comes by the events, of which 64 may lie ahead.
    let film = play_plan(&film_plan(), script, 1, Some(12), Some(11));
    film.assert_true(&film_plan());
    assert_eq!((film.counted.len(), film.short.len()), (96, 0));
    let gaps: Vec<usize> =
        (1..96).filter(|&place| film.counted[place].1 != film.counted[place - 1].1 + 1).collect();
    assert!(gaps.len() == 1 && gaps[0].is_multiple_of(8), "{gaps:?}");
    let (before, after) = (film.counted[gaps[0] - 1].1, film.counted[gaps[0]].1);
    assert_eq!(
        film.told.iter().filter(|told| (before..after).contains(*told)).count(),
        2,
        "stopped and begun"
    );
}

#[test]
fn a_film_that_the_sequencer_cannot_take_is_written_ahead() {
    let one_set_short = Script { sets: 7, ..EXACT };
    let film = play_plan(&film_plan(), one_set_short, 1, Some(3), None);
    film.assert_true(&film_plan());
    assert_eq!((film.counted.len(), film.frames()), (24, 24));
    for says in [Says::Nothing, Says::Truth] {
        let film = play_plan(&film_plan(), Script { sets: 8, stuck: true, says, ..EXACT }, 1, Some(3), None);
        film.assert_true(&film_plan());
        assert_eq!((film.counted.len(), film.frames()), (24, 24));
    }
    // Delays all round a period in equal steps: any set might be the first, unless frames say it.
    let round: Vec<_> = (0..6).map(|k| settings(f64::from(k) * PERIOD_NS as f64 / 6e3, 600.0)).collect();
    let film = play_plan(&round, Script { sets: 8, says: Says::Truth, ..EXACT }, 1, Some(3), None);
    film.assert_true(&round);
    let told = film.told.iter().filter(|told| **told > film.counted[0].1).count();
    assert_eq!((film.counted.len(), film.frames(), told), (18, 18, 1));
    let film = play_plan(&round, Script { sets: 8, ..EXACT }, 1, Some(3), None);
    film.assert_true(&round);
    assert_eq!(film.counted.len(), 18);
    assert!(film.told.len() > 18, "{:?}", film.told);
}
