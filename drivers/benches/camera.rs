//! The driver `aravis` beside `arv-camera-test-0.8` on the same simulated camera in the same run: frames a second, processor
//! time of a frame, and how long after its last packet a frame is in the pool. `cargo xtask bench camera` runs it.

#[path = "../tests/support/mod.rs"]
mod support;

use std::error::Error;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeVal;
use raysweep_core::{Camera, CameraSettings, Clock, FramePool, PixelFormat, SettingsId, Shutter};
use raysweep_drivers::camera::aravis::{AravisCamera, AravisConfig, RigFacts};
use raysweep_sim::gige::{DeviceClock, Faults, GigeCamera, GigeSetup, Look};

use support::{ADDRESS, own_network};

type Done<T> = Result<T, Box<dyn Error>>;

/// Columns, rows, format and frames a second.
const CASES: [(usize, usize, &str, u32); 3] =
    [(512, 512, "Mono8", 120), (1024, 1024, "Mono12p", 60), (1600, 1200, "Mono12p", 60)];
const PACKET_BYTES: [u32; 2] = [1_500, 9_000];
/// More than any client takes.
const FLAT_OUT_HZ: u32 = 10_000;
const DURATION: Duration = Duration::from_secs(3);
/// Each is measured as often, in turn, and its best taken: whatever else the machine does only adds.
const REPEATS: usize = 3;
/// Frames whose way is timed.
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

/// What streaming cost and gave.
#[derive(Clone, Copy)]
struct Streamed {
    cpu_us_per_frame: f64,
    frames_per_s: f64,
}

impl Streamed {
    const NOTHING: Self = Self { cpu_us_per_frame: f64::INFINITY, frames_per_s: 0.0 };

    fn best(self, other: Self) -> Self {
        Self {
            cpu_us_per_frame: self.cpu_us_per_frame.min(other.cpu_us_per_frame),
            frames_per_s: self.frames_per_s.max(other.frames_per_s),
        }
    }
}

/// Frames before those that are timed: more than wait in buffers while the camera is opened.
const WARM_UP_FRAMES: usize = 100;

/// The camera has noted by then that a frame has left, and the next has not: less than a period.
const NOTED_WITHIN: Duration = Duration::from_millis(2);

/// A simulated camera of test pictures in a process of its own.
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

fn cpu_us(who: UsageWho) -> Done<f64> {
    let usage = getrusage(who)?;
    let us = |time: TimeVal| time.tv_sec() as f64 * 1e6 + time.tv_usec() as f64;
    Ok(us(usage.user_time()) + us(usage.system_time()))
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
        };
        let mut camera = AravisCamera::open(&config, facts)?;
        let settings =
            CameraSettings { shutter: Shutter::Rolling, exposure_us: 1_000.0, trigger_delay_us: 0.0 };
        camera.configure(SettingsId { point: 0, attempt: 0 }, &settings)?;
        camera.arm()?;
        Ok((camera, FramePool::new(1, format.frame_bytes(self.width * self.height))))
    }

    /// Streams for a while with the driver.
    fn ours(self) -> Done<Streamed> {
        let (mut camera, pool) = self.open()?;
        let mut buf = pool.take();
        camera.next_frame(&mut buf, Duration::from_secs(1))?;
        let (begun, begun_us, mut frames) = (Instant::now(), cpu_us(UsageWho::RUSAGE_SELF)?, 0_u32);
        while begun.elapsed() < DURATION {
            frames += u32::from(camera.next_frame(&mut buf, Duration::from_secs(1))?.is_some());
        }
        let frames = f64::from(frames);
        Ok(Streamed {
            cpu_us_per_frame: (cpu_us(UsageWho::RUSAGE_SELF)? - begun_us) / frames,
            frames_per_s: frames / begun.elapsed().as_secs_f64(),
        })
    }

    /// Processor time and frames of the library's own client, on the same kind of socket.
    fn client(self, seconds: u64) -> Done<(f64, f64)> {
        let before_us = cpu_us(UsageWho::RUSAGE_CHILDREN)?;
        let features = format!("PixelFormat={} AcquisitionFrameRate={}", self.format, self.rate_hz);
        let (width, height) = (self.width.to_string(), self.height.to_string());
        let output = Command::new("arv-camera-test-0.8")
            .args(["-n", ADDRESS, "--auto", "--no-packet-socket", "-w", &width, "-h", &height])
            .args(["--features", &features, "-j", "never", "-i", &self.packet_bytes.to_string()])
            .args(["--duration", &seconds.to_string()])
            .output()
            .map_err(|error| format!("arv-camera-test-0.8 (Debian: aravis-tools): {error}"))?;
        let text = String::from_utf8(output.stdout)?;
        let line = text.lines().find(|line| line.starts_with("n_completed_buffers"));
        let line = line.ok_or_else(|| format!("arv-camera-test-0.8 had no frames:\n{text}"))?;
        let frames = line.rsplit(' ').next().unwrap_or_default().parse()?;
        Ok((cpu_us(UsageWho::RUSAGE_CHILDREN)? - before_us, frames))
    }

    /// The same with the library's own client, beyond its start.
    fn theirs(self) -> Done<Streamed> {
        let (short_us, short_frames) = self.client(1)?;
        let (long_us, long_frames) = self.client(1 + DURATION.as_secs())?;
        let frames = long_frames - short_frames;
        Ok(Streamed {
            cpu_us_per_frame: (long_us - short_us) / frames,
            frames_per_s: frames / DURATION.as_secs_f64(),
        })
    }

    /// From the moment when a frame's last packet leaves until the frame is in the pool, in us, in rising order. The
    /// camera lives in this process, because nobody else knows when its packets left.
    fn latencies_us(self) -> Done<Vec<f64>> {
        let setup = GigeSetup {
            address: ADDRESS.parse()?,
            serial: "1".into(),
            clock: DeviceClock::default(),
            faults: Faults::default(),
            zipped: false,
        };
        let device = GigeCamera::start(&setup, Look::at_test_pictures((self.height, self.width)))?;
        let (mut camera, pool) = self.open()?;
        let mut buf = pool.take();
        let clock = Clock::real();
        let mut latencies_us = Vec::with_capacity(TIMED_FRAMES);
        // The first frames may come late.
        for _ in 0..WARM_UP_FRAMES {
            camera.next_frame(&mut buf, Duration::from_secs(1))?;
        }
        // A frame's id, and how many had left by then.
        let mut first = None;
        while latencies_us.len() < TIMED_FRAMES {
            let Some(stamp) = camera.next_frame(&mut buf, Duration::from_secs(1))? else { continue };
            let taken_ns = clock.now_ns();
            let (first_seq, left) = *first.get_or_insert_with(|| {
                std::thread::sleep(NOTED_WITHIN);
                (stamp.seq, device.truth().frames)
            });
            let number = stamp.seq - first_seq + left;
            // The camera notes a frame when all of it has left.
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

/// What the command line asks for.
struct Arguments {
    camera: String,
    json: bool,
}

fn arguments() -> Done<Arguments> {
    let (mut camera, mut json) = (None, false);
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        match word.as_str() {
            "--camera" => camera = words.next(),
            "--json" => json = true,
            // Cargo's own.
            "--bench" => {}
            unknown => return Err(format!("no option `{unknown}`: there are --camera and --json").into()),
        }
    }
    let camera =
        camera.ok_or("--camera names the program raysweep-sim-camera: `cargo xtask bench camera`")?;
    Ok(Arguments { camera, json })
}

fn main() -> Done<()> {
    let Arguments { camera, json } = arguments()?;
    if nix::unistd::geteuid().is_root() {
        own_network();
    }
    for (width, height, format, rate_hz) in CASES {
        for packet_bytes in PACKET_BYTES {
            let case = Case { width, height, format, rate_hz, packet_bytes };
            let flat_out = Case { rate_hz: FLAT_OUT_HZ, ..case };
            let (mut ours, mut theirs) = (Streamed::NOTHING, Streamed::NOTHING);
            let (mut ours_flat_out, mut theirs_flat_out) = (Streamed::NOTHING, Streamed::NOTHING);
            {
                let _device = Simulated::start(&camera, case)?;
                for _ in 0..REPEATS {
                    ours = ours.best(case.ours()?);
                    theirs = theirs.best(case.theirs()?);
                }
                ours_flat_out = ours_flat_out.best(flat_out.ours()?);
                theirs_flat_out = theirs_flat_out.best(flat_out.theirs()?);
            }
            let latencies_us = case.latencies_us()?;
            let percentile = |percent: usize| latencies_us[latencies_us.len() * percent / 100];
            let (p50_us, p99_us) = (percentile(50), percentile(99));
            let ratio = ours.cpu_us_per_frame / theirs.cpu_us_per_frame;
            let name = format!("{width}x{height} {format}, packets of {packet_bytes}");
            if json {
                println!(
                    "{{\"bench\":\"camera\",\"case\":\"{name}\",\"rate_hz\":{rate_hz},\"frames_per_s\":{:.1},\
                     \"flat_out_frames_per_s\":{:.1},\"peer_flat_out_frames_per_s\":{:.1},\"cpu_us\":{:.1},\
                     \"peer_cpu_us\":{:.1},\"ratio\":{ratio:.3},\"p50_us\":{p50_us:.0},\"p99_us\":{p99_us:.0}}}",
                    ours.frames_per_s,
                    ours_flat_out.frames_per_s,
                    theirs_flat_out.frames_per_s,
                    ours.cpu_us_per_frame,
                    theirs.cpu_us_per_frame,
                );
            } else {
                println!(
                    "{name}: {:.1} of {rate_hz} frames/s, flat out {:.0} (arv-camera-test-0.8 {:.0}); a frame costs {:.0} us of \
                     processor time (arv-camera-test-0.8 {:.0}): {ratio:.2} times; in the pool {p50_us:.0} us after its last \
                     packet left (p99 {p99_us:.0})",
                    ours.frames_per_s,
                    ours_flat_out.frames_per_s,
                    theirs_flat_out.frames_per_s,
                    ours.cpu_us_per_frame,
                    theirs.cpu_us_per_frame,
                );
            }
        }
    }
    Ok(())
}
