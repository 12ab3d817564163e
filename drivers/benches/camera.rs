//! Compares the driver `aravis` with `arv-camera-test-0.8` on the same simulated camera in the same run:
//! frames per second, processor time per frame, and the delay from a frame's last packet to its arrival in
//! the pool. Run it with `cargo xtask bench camera`.

#[path = "../tests/support/mod.rs"]
mod support;

use std::error::Error;
use std::fmt;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::time::{ClockId, clock_getcpuclockid};
use nix::unistd::Pid;
use raysweep_core::{Camera, CameraSettings, Clock, FramePool, PixelFormat, SettingsId, Shutter};
use raysweep_drivers::camera::aravis::{AravisCamera, AravisConfig, RigFacts};
use raysweep_sim::gige::{CameraClock, Faults, GigeCamera, GigeSetup, Look};

use support::{ADDRESS, own_network};

type Done<T> = Result<T, Box<dyn Error>>;

/// Columns, rows, format and frames per second.
const CASES: [(usize, usize, &str, u32); 3] =
    [(512, 512, "Mono8", 120), (1024, 1024, "Mono12p", 60), (1600, 1200, "Mono12p", 60)];
const PACKET_BYTES: [u32; 2] = [1_500, 9_000];
/// More than any client can take.
const FLAT_OUT_HZ: u32 = 10_000;
/// Seconds measured one by one in each turn, after the first, in which the client starts.
const SECONDS: usize = 4;
/// Turns of the driver and of the other client.
const TURNS: usize = 3;
/// Number of frames whose latency is measured.
const TIMED_FRAMES: usize = 600;

/// One camera and how it is read.
#[derive(Clone, Copy)]
struct Case {
    width: usize,
    height: usize,
    format: &'static str,
    rate_hz: u32,
    packet_bytes: u32,
}

/// Cost and yield of streaming, second by second.
#[derive(Default)]
struct Streamed {
    cpu_us_per_frame: Vec<f64>,
    frames_per_s: Vec<f64>,
}

impl Streamed {
    fn note(&mut self, frames: f64, cpu_us: f64, elapsed: Duration) {
        self.cpu_us_per_frame.push(cpu_us / frames);
        self.frames_per_s.push(frames / elapsed.as_secs_f64());
    }

    fn cpu_us(&self) -> Spread {
        Spread::of(&self.cpu_us_per_frame)
    }

    fn rate_hz(&self) -> Spread {
        Spread::of(&self.frames_per_s)
    }
}

/// Median and spread of some seconds.
struct Spread {
    lowest: f64,
    median: f64,
    highest: f64,
}

impl Spread {
    fn of(values: &[f64]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let at = |place: usize| sorted.get(place).copied().unwrap_or(f64::NAN);
        Self { lowest: at(0), median: at(sorted.len() / 2), highest: at(sorted.len().saturating_sub(1)) }
    }
}

impl fmt::Display for Spread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.0} ({:.0} to {:.0})", self.median, self.lowest, self.highest)
    }
}

/// Frames before the timed ones: more than can wait in buffers while the camera is opened.
const WARM_UP_FRAMES: usize = 100;

/// Within this time the camera has recorded that a frame has left, and the next one has not left yet: less
/// than a period.
const NOTED_WITHIN: Duration = Duration::from_millis(2);

/// A simulated camera with test pictures in its own process.
struct Simulated(Child);

impl Simulated {
    fn start(program: &str, case: Case) -> Done<Self> {
        let size = format!("{}x{}", case.width, case.height);
        let child = Command::new(program)
            .args(["--test-pictures", &size, "--address", ADDRESS])
            .stdout(Stdio::null())
            .spawn()
            .map_err(|error| format!("{program}: {error}"))?;
        std::thread::sleep(Duration::from_millis(300));
        Ok(Self(child))
    }
}

impl Drop for Simulated {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Processor time used by a process.
fn cpu_us(clock: ClockId) -> Done<f64> {
    Ok(Duration::from(clock.now()?).as_secs_f64() * 1e6)
}

impl Case {
    fn pixel_format(self) -> Done<PixelFormat> {
        let named = PixelFormat::all().find(|format| format.to_string() == self.format);
        named.ok_or_else(|| format!("no pixel format {}", self.format).into())
    }

    /// The camera, armed and running freely.
    fn open(self) -> Done<(AravisCamera, FramePool)> {
        let format = self.pixel_format()?;
        let config = AravisConfig {
            address: Some(ADDRESS.into()),
            features: vec![format!("AcquisitionFrameRate={}", self.rate_hz)],
            trigger_source: "off".into(),
            packet_size: Some(self.packet_bytes),
            ..AravisConfig::default()
        };
        let facts = RigFacts {
            format,
            row_time_us: 10.0,
            trigger_period_us: 1e6 / f64::from(self.rate_hz),
            trigger_margin_us: 100.0,
            reopen: Duration::from_secs(5),
            free_hz: None,
        };
        let mut camera = AravisCamera::open(&config, facts)?;
        let settings =
            CameraSettings { shutter: Shutter::Rolling, exposure_us: 1_000.0, trigger_delay_us: 0.0 };
        camera.configure(SettingsId { point: 0, attempt: 0 }, &settings)?;
        camera.arm()?;
        Ok((camera, FramePool::new(1, format.frame_bytes(self.width * self.height))))
    }

    fn name(self) -> String {
        format!("{}x{} {}, packets of {}", self.width, self.height, self.format, self.packet_bytes)
    }

    /// Streams with our driver.
    fn ours(self, streamed: &mut Streamed) -> Done<()> {
        let (mut camera, pool) = self.open()?;
        let mut buf = pool.take();
        let clock = ClockId::CLOCK_PROCESS_CPUTIME_ID;
        for second in 0..=SECONDS {
            let (begun, begun_us, mut frames) = (Instant::now(), cpu_us(clock)?, 0_u32);
            while begun.elapsed() < Duration::from_secs(1) {
                frames += u32::from(camera.next_frame(&mut buf, Duration::from_secs(1))?.is_some());
            }
            if second > 0 {
                streamed.note(frames.into(), cpu_us(clock)? - begun_us, begun.elapsed());
            }
        }
        Ok(())
    }

    /// The same with the library's own client, on the same kind of socket. It prints the number of frames
    /// each second.
    fn theirs(self, streamed: &mut Streamed) -> Done<()> {
        let features = format!("PixelFormat={} AcquisitionFrameRate={}", self.format, self.rate_hz);
        let (width, height) = (self.width.to_string(), self.height.to_string());
        // It starts in the first second and ends in the last.
        let duration_s = (SECONDS + 2).to_string();
        let mut client = Command::new("stdbuf")
            .args(["-oL", "arv-camera-test-0.8", "-n", ADDRESS, "--auto", "--no-packet-socket"])
            .args(["-w", &width, "-h", &height, "--features", &features])
            .args(["-j", "never", "-i", &self.packet_bytes.to_string(), "--duration", &duration_s])
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| {
                format!("stdbuf arv-camera-test-0.8 (Debian: coreutils, aravis-tools): {error}")
            })?;
        let clock = clock_getcpuclockid(Pid::from_raw(client.id().try_into()?))?;
        let (mut said, mut seconds, mut before) = (String::new(), 0, None);
        for line in BufReader::new(client.stdout.take().ok_or("no output")?).lines() {
            let line = line?;
            let frames = line.split_once(" frame").and_then(|(frames, _)| frames.trim().parse().ok());
            if let Some(frames) = frames.filter(|_| seconds < SECONDS) {
                let now = (Instant::now(), cpu_us(clock)?);
                if let Some((begun, begun_us)) = before.replace(now) {
                    streamed.note(frames, now.1 - begun_us, now.0 - begun);
                    seconds += 1;
                }
            }
            said += &line;
            said.push('\n');
        }
        client.wait()?;
        if seconds == SECONDS {
            Ok(())
        } else {
            Err(format!("arv-camera-test-0.8 had no frames:\n{said}").into())
        }
    }

    /// Times from the departure of a frame's last packet to the frame's arrival in the pool, in us,
    /// ascending. The camera runs in this process, because only the camera knows when its packets left.
    fn latencies_us(self) -> Done<Vec<f64>> {
        let setup = GigeSetup {
            address: ADDRESS.parse()?,
            serial: "1".into(),
            clock: CameraClock::default(),
            faults: Faults::default(),
            zipped: false,
        };
        let device = GigeCamera::start(&setup, Look::at_test_pictures((self.height, self.width)))?;
        let (mut camera, pool) = self.open()?;
        let mut buf = pool.take();
        let clock = Clock::real();
        let mut latencies_us = Vec::with_capacity(TIMED_FRAMES);
        // The first frames may be late.
        for _ in 0..WARM_UP_FRAMES {
            camera.next_frame(&mut buf, Duration::from_secs(1))?;
        }
        // A frame's id, and how many frames had left by then.
        let mut first = None;
        while latencies_us.len() < TIMED_FRAMES {
            let Some(stamp) = camera.next_frame(&mut buf, Duration::from_secs(1))? else { continue };
            let taken_ns = clock.now_ns();
            let (first_seq, left) = *first.get_or_insert_with(|| {
                std::thread::sleep(NOTED_WITHIN);
                (stamp.seq, device.truth().frames)
            });
            let number = stamp.seq - first_seq + left;
            // The camera records a frame when all of it has left.
            let truth = loop {
                let truth = device.truth();
                if truth.frames >= number {
                    break truth;
                }
                std::thread::yield_now();
            };
            if truth.frames == number {
                latencies_us.push((taken_ns - truth.last_left_ns) as f64 * 1e-3);
            }
        }
        latencies_us.sort_by(f64::total_cmp);
        Ok(latencies_us)
    }
}

/// The arguments of the command line.
struct Arguments {
    camera: String,
    /// Part of the names of the cases to measure.
    only: String,
    json: bool,
}

fn arguments() -> Done<Arguments> {
    let (mut camera, mut only, mut json) = (None, String::new(), false);
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        match word.as_str() {
            "--camera" => camera = words.next(),
            "--only" => only = words.next().ok_or("--only takes a part of a case's name")?,
            "--json" => json = true,
            // Passed by cargo itself.
            "--bench" => {}
            unknown => {
                let what = format!("no option `{unknown}`: there are --camera, --only and --json");
                return Err(what.into());
            }
        }
    }
    let camera =
        camera.ok_or("--camera names the program raysweep-sim-camera: `cargo xtask bench camera`")?;
    Ok(Arguments { camera, only, json })
}

fn main() -> Done<()> {
    let Arguments { camera, only, json } = arguments()?;
    if nix::unistd::geteuid().is_root() {
        own_network();
    }
    let cases = CASES.into_iter().flat_map(|(width, height, format, rate_hz)| {
        PACKET_BYTES.map(|packet_bytes| Case { width, height, format, rate_hz, packet_bytes })
    });
    for case in cases.filter(|case| case.name().contains(&only)) {
        measure(case, &camera, json)?;
    }
    Ok(())
}

/// Measures one case and prints the results.
fn measure(case: Case, camera: &str, json: bool) -> Done<()> {
    let flat_out = Case { rate_hz: FLAT_OUT_HZ, ..case };
    let (mut ours, mut theirs) = (Streamed::default(), Streamed::default());
    let (mut ours_flat_out, mut theirs_flat_out) = (Streamed::default(), Streamed::default());
    {
        let _device = Simulated::start(camera, case)?;
        for _ in 0..TURNS {
            case.ours(&mut ours)?;
            case.theirs(&mut theirs)?;
        }
        flat_out.ours(&mut ours_flat_out)?;
        flat_out.theirs(&mut theirs_flat_out)?;
    }
    let latencies_us = case.latencies_us()?;
    let percentile = |percent: usize| latencies_us[latencies_us.len() * percent / 100];
    let (p50_us, p99_us) = (percentile(50), percentile(99));
    let (cpu_us, peer_cpu_us) = (ours.cpu_us(), theirs.cpu_us());
    let ratio = cpu_us.median / peer_cpu_us.median;
    let frames_per_s = ours.rate_hz().median;
    let (rate_hz, name) = (case.rate_hz, case.name());
    if json {
        println!(
            "{{\"bench\":\"camera\",\"case\":\"{name}\",\"rate_hz\":{rate_hz},\"frames_per_s\":{frames_per_s:.1},\
             \"flat_out_frames_per_s\":{:.1},\"peer_flat_out_frames_per_s\":{:.1},\"cpu_us\":{:.1},\
             \"peer_cpu_us\":{:.1},\"ratio\":{ratio:.3},\"p50_us\":{p50_us:.0},\"p99_us\":{p99_us:.0}}}",
            ours_flat_out.rate_hz().median,
            theirs_flat_out.rate_hz().median,
            cpu_us.median,
            peer_cpu_us.median,
        );
    } else {
        println!(
            "{name}: {frames_per_s:.1} of {rate_hz} frames/s, flat out {} (arv-camera-test-0.8 {}); a frame costs \
             {cpu_us} us of processor time (arv-camera-test-0.8 {peer_cpu_us}): {ratio:.2} times; in the pool \
             {p50_us:.0} us after its last packet left (p99 {p99_us:.0})",
            ours_flat_out.rate_hz(),
            theirs_flat_out.rate_hz(),
        );
    }
    Ok(())
}
