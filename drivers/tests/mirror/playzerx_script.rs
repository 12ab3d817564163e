//! A PlayzerX's stream, frame by frame as documented by the maker, with a simple model of the FIFO: streaming, the
//! count of samples left, parking, health. Uses no encoding code of the driver or the simulator.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use raysweep_core::{DeviceErrorKind, Mirror, MirrorPath, Tilt};
use raysweep_drivers::mirror::{self, PlayzerX};
use raysweep_sim::mirror::WireFaults;

use crate::rig::LIMITS;
use crate::scripts::{Script, frame, play};

/// The controller's description, and its answer to a ping.
const INFO: &[u8] = b"pl-info\nPX1\nPLX-2.1.0.0\nXYM\n";
const ALIVE: &[u8] = b"pl-ok\n";
/// FIFO size of a monochrome controller in samples.
const FIFO_SAMPLES: u64 = 125_000;

/// The origin, dark: X = Y = 2048.
const AT_ORIGIN: &[u8] = b"pld\x09\x00\x80\x80\x00\n";
const LEFT: &[u8] = b"plg\x05\n";
const CLEAR: &[u8] = b"plc\x05\n";
const PING: &[u8] = b"plp\x05\n";

/// How the controller takes samples from the FIFO.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Drain {
    /// This many per second.
    ByClock(f64),
    /// One between any two queries.
    ByQuestion,
    /// None; this many samples are left.
    Holds(u64),
}

/// State of the script.
struct Desk {
    drain: Drain,
    frames: Vec<Vec<u8>>,
    sent: u64,
    /// Samples played when the FIFO was last empty, and the time of the next sample.
    base: u64,
    began_ns: i64,
    asked: u64,
    most_held: u64,
    /// Sent before each answer.
    noise: &'static [u8],
    /// Pause before it processes the next padding.
    pause: Option<Duration>,
    /// How it goes on once its FIFO is cleared, if not as before.
    once_cleared: Option<Drain>,
}

impl Desk {
    fn left(&mut self, now_ns: i64) -> u64 {
        match self.drain {
            Drain::Holds(left) => left,
            Drain::ByQuestion => {
                self.asked += 1;
                let left = self.sent - self.base - self.asked.min(self.sent - self.base);
                self.most_held = self.most_held.max(left + 1);
                left
            }
            Drain::ByClock(rate_hz) => {
                let played = ((now_ns - self.began_ns) as f64 * 1e-9 * rate_hz) as u64;
                (self.sent - self.base).saturating_sub(played)
            }
        }
    }

    fn answer(&mut self, message: &[u8], now_ns: i64) -> Vec<u8> {
        if message == [0] {
            std::thread::sleep(self.pause.take().unwrap_or_default());
            return Vec::new();
        }
        self.frames.push(message.to_vec());
        let answer = match message[2] {
            b'd' => {
                if matches!(self.drain, Drain::ByClock(_)) && self.left(now_ns) == 0 {
                    (self.base, self.began_ns) = (self.sent, now_ns);
                }
                self.sent += 1;
                return Vec::new();
            }
            b'c' => {
                (self.base, self.asked) = (self.sent, 0);
                self.drain = self.once_cleared.take().unwrap_or(self.drain);
                return Vec::new();
            }
            b'n' => INFO.to_vec(),
            b'p' => ALIVE.to_vec(),
            b'g' => {
                let [low, middle, high, ..] = self.left(now_ns).to_le_bytes();
                [b"pl-", &[low, middle, high][..]].concat()
            }
            _ => return Vec::new(),
        };
        [self.noise, &answer].concat()
    }
}

struct Lab {
    script: Script,
    desk: Arc<Mutex<Desk>>,
}

impl Lab {
    fn new(rate_hz: f64) -> Self {
        Self::on_wire(rate_hz, WireFaults::default())
    }

    fn on_wire(rate_hz: f64, faults: WireFaults) -> Self {
        let desk = Arc::new(Mutex::new(Desk {
            drain: Drain::ByClock(rate_hz),
            frames: Vec::new(),
            sent: 0,
            base: 0,
            began_ns: 0,
            asked: 0,
            most_held: 0,
            noise: b"",
            pause: None,
            once_cleared: None,
        }));
        let answering = desk.clone();
        let answer = move |message: &[u8], now_ns| answering.lock().unwrap().answer(message, now_ns);
        Self { script: Script::on_wire(faults, frame, answer), desk }
    }

    fn open(&self) -> PlayzerX {
        let config = mirror::PlayzerXConfig {
            port: self.script.pty.path().to_owned(),
            link: mirror::PlayzerXLink::VirtualCom,
            full_scale: LIMITS.max_tilt,
            limits: LIMITS,
            state: self.script.state(),
            light: self.script.light(),
        };
        PlayzerX::open(config).unwrap()
    }

    fn frames(&self) -> Vec<Vec<u8>> {
        self.desk.lock().unwrap().frames.clone()
    }

    fn drain(&self, drain: Drain) {
        self.desk.lock().unwrap().drain = drain;
    }
}

fn is_sample(frame: &[u8]) -> bool {
    frame.starts_with(b"pld\x09")
}

fn samples(frames: &[Vec<u8>]) -> Vec<Vec<u8>> {
    frames.iter().filter(|frame| is_sample(frame)).cloned().collect()
}

/// Feeds until so many samples are played; returns when that began.
fn feed_until_played(mirror: &mut PlayzerX, samples: u64) -> Instant {
    let began = Instant::now();
    while mirror.feed().unwrap().played < samples {
        assert!(began.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(1));
    }
    began
}

/// A dark path that takes seconds.
fn turn(samples: usize, rate_hz: f64) -> MirrorPath {
    let path = MirrorPath::lissajous(Tilt::new(1.0, 0.5), [1, 1], samples, rate_hz, &LIMITS).unwrap();
    path.with_light(|_| 0)
}

#[test]
fn a_stream_is_the_documented_frames_in_order() {
    let lab = Lab::new(100.0);
    let mut mirror = lab.open();
    play(&mut mirror);
    drop(mirror);
    let frames = lab.frames();
    let begin = frames.iter().position(|frame| is_sample(frame)).unwrap();
    // Reports off, description, nothing left to play; then 100 samples/s, little endian.
    let heard: Vec<&[u8]> = frames[..begin].iter().map(Vec::as_slice).collect();
    assert_eq!(heard, [b"plu\x07\x00\x00\n", b"pln\x05\n" as &[u8], LEFT, b"plr\x08\x64\x00\x00\n"]);
    // 0.13 degrees of 6.5 are 41 codes of 2047, -0.26 are -82: X = 0x829, Y = 0x800 and 0x7AE.
    let samples: Vec<&[u8]> = frames.iter().map(Vec::as_slice).filter(|frame| is_sample(frame)).collect();
    let places: [&[u8]; 2] = [b"pld\x09\x29\x80\x80\x00\n", b"pld\x09\x29\x8E\x7A\x00\n"];
    assert!(samples.windows(2).any(|pair| pair == places), "{samples:x?}");
    assert_eq!((samples[0], samples[samples.len() - 1]), (AT_ORIGIN, AT_ORIGIN));
    assert!(frames[begin..].iter().all(|frame| is_sample(frame) || frame == LEFT), "nothing else is said");
}

#[test]
fn the_fifo_is_filled_and_never_overfilled_by_the_controllers_own_count() {
    let lab = Lab::new(39_000.0);
    let mut mirror = lab.open();
    mirror.load(&turn(6500, 39_000.0)).unwrap();
    {
        let mut desk = lab.desk.lock().unwrap();
        (desk.drain, desk.base) = (Drain::ByQuestion, desk.sent);
    }
    mirror.start(100).unwrap();
    let most = |lab: &Lab| lab.desk.lock().unwrap().most_held;
    let began = Instant::now();
    let mut full = None;
    // Continues for a while in which the FIFO could overflow.
    while full.is_none_or(|full: Instant| full.elapsed() < Duration::from_millis(300)) {
        mirror.feed().unwrap();
        if most(&lab) > FIFO_SAMPLES - 2000 {
            full.get_or_insert_with(Instant::now);
        }
        assert!(began.elapsed() < Duration::from_secs(60), "{} samples", most(&lab));
        std::thread::sleep(Duration::from_micros(100));
    }
    assert!(most(&lab) <= FIFO_SAMPLES, "{} samples", most(&lab));
    lab.drain(Drain::ByClock(39_000.0));
    mirror.park().unwrap();
}

#[test]
fn a_host_that_stands_still_is_no_fault_of_the_controller() {
    let lab = Lab::new(1000.0);
    let mut mirror = lab.open();
    mirror.load(&turn(2000, 1000.0)).unwrap();
    mirror.start(2).unwrap();
    feed_until_played(&mut mirror, 100);
    // The FIFO contains more than a second of samples, and no answer may be pending for longer than that.
    for _ in 0..5 {
        std::thread::sleep(Duration::from_millis(400));
        mirror.feed().unwrap();
        std::thread::sleep(Duration::from_millis(2));
        mirror.feed().unwrap();
    }
    mirror.park().unwrap();
}

#[test]
fn parking_empties_the_fifo_and_ramps_from_the_sample_that_the_count_tells() {
    let lab = Lab::new(1000.0);
    let mut mirror = lab.open();
    mirror.load(&turn(2000, 1000.0)).unwrap();
    mirror.start(2).unwrap();
    feed_until_played(&mut mirror, 700);
    // The controller stops, and works again when it is parked.
    let left = {
        let mut desk = lab.desk.lock().unwrap();
        let left = desk.left(raysweep_core::Clock::real().now_ns());
        desk.drain = Drain::Holds(left);
        desk.once_cleared = Some(Drain::ByClock(1000.0));
        left
    };
    mirror.park().unwrap();
    let frames = lab.frames();
    let clearing = frames.iter().position(|frame| frame == CLEAR).unwrap();
    // The count is queried three times, since an answer may be lost; the ping shows that all queries have arrived.
    assert_eq!(frames[clearing - 3..clearing], [LEFT, LEFT, LEFT]);
    assert_eq!(frames[clearing + 1], PING);
    let (before, after) = (samples(&frames[..clearing]), samples(&frames[clearing..]));
    let place = &before[before.len() - left as usize - 1];
    assert_ne!(place, AT_ORIGIN);
    assert_eq!(&after[0], place, "dark where it stands");
    assert_eq!(after.last().unwrap(), AT_ORIGIN);
    let code = |frame: &[u8]| {
        let high = u16::from(frame[5]);
        [u16::from(frame[4]) | (high & 0xF0) << 4, high & 0x0F | u16::from(frame[6]) << 4].map(i32::from)
    };
    for pair in after.windows(2) {
        let (a, b) = (code(&pair[0]), code(&pair[1]));
        // The mirror's limit, and rounding at both ends.
        let allowed = (LIMITS.max_step.0 / 6.5 * 2047.0) as i32 + 2;
        assert!((0..2).all(|axis| (a[axis] - b[axis]).abs() <= allowed), "{a:?} then {b:?}");
    }
}

#[test]
fn an_answer_to_a_killed_process_does_not_tell_the_place_to_whoever_parks_next() {
    // After a stall, the samples that darken the mirror and move it come at once, and the questions with them.
    for (pause_ms, stalls) in [(8, 0.0), (60, 0.0), (8, 0.03)] {
        let faults = WireFaults { stalls, stall_ms: 30, ..WireFaults::default() };
        let lab = Lab::on_wire(1000.0, faults);
        let mut mirror = lab.open();
        mirror.load(&turn(2000, 1000.0)).unwrap();
        mirror.start(2).unwrap();
        let began = feed_until_played(&mut mirror, 700);
        // What a killed process leaves: its state, its samples in the FIFO, and the answer to its last query.
        let left_behind = lab.script.state().with_file_name("left.json");
        for end in ["", ".sent"] {
            let file = |path: &Path| PathBuf::from(format!("{}{end}", path.display()));
            std::fs::copy(file(&lab.script.state()), file(&left_behind)).unwrap();
        }
        drop(mirror);
        lab.drain(Drain::Holds(3500));
        let before = lab.frames();
        let clearing = before.iter().position(|frame| frame == CLEAR).unwrap();
        let sent = samples(&before[..clearing]);
        let parked_by_drop = before.len();
        std::fs::write(lab.script.pty.path(), LEFT).unwrap();
        while lab.frames().len() == parked_by_drop {
            assert!(began.elapsed() < Duration::from_secs(60));
            std::thread::sleep(Duration::from_millis(1));
        }
        {
            let mut desk = lab.desk.lock().unwrap();
            desk.drain = Drain::Holds(3000);
            desk.once_cleared = Some(Drain::ByClock(1000.0));
            desk.pause = Some(Duration::from_millis(pause_ms));
        }
        assert!(matches!(mirror::park(&left_behind).unwrap(), mirror::Parked::From(_)));
        let after = samples(&lab.frames()[parked_by_drop..]);
        assert_eq!(after[0], sent[sent.len() - 3000 - 1], "dark where it stands");
        assert_eq!(after.last().unwrap(), AT_ORIGIN);
    }
}

#[test]
fn a_controller_that_plays_nothing_is_told_by_its_count() {
    let lab = Lab::new(1000.0);
    let mut mirror = lab.open();
    mirror.load(&turn(2000, 1000.0)).unwrap();
    mirror.start(2).unwrap();
    mirror.feed().unwrap();
    // The count stays at about 4000 samples in all answers.
    let began = feed_until_played(&mut mirror, 100);
    let left = {
        let mut desk = lab.desk.lock().unwrap();
        let now_ns = raysweep_core::Clock::real().now_ns();
        let left = desk.left(now_ns);
        desk.drain = Drain::Holds(left);
        // When the driver parks after the error, the controller works again.
        desk.once_cleared = Some(Drain::ByClock(1000.0));
        left
    };
    assert!(left > 1000);
    let error = loop {
        if let Err(error) = mirror.feed() {
            break error;
        }
        assert!(began.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(1));
    };
    assert!(error.kind == DeviceErrorKind::Timeout && error.to_string().contains("no motion"), "{error}");
}

#[test]
fn noise_before_each_answer_is_counted_and_costs_nothing() {
    let lab = Lab::new(100.0);
    // The beginning of an invalid answer, and half a word.
    lab.desk.lock().unwrap().noise = b"pl-ixpl";
    let mut mirror = lab.open();
    play(&mut mirror);
    let questions =
        lab.frames().iter().filter(|frame| [LEFT, b"pln\x05\n" as &[u8]].contains(&frame.as_slice())).count();
    assert!(questions > 3);
    // The last answer may still be on its way when the path ends, and is then not read.
    let unread = questions as u64 * 7 - mirror.garbage_bytes();
    assert!(unread <= 7, "{unread} of {questions} times 7 bytes were not counted");
}
