//! CPU time of a frame in this driver and in `arv-camera-test-0.8`, both on the same `arv-fake-gv-camera-0.8`:
//! `cargo run --release -p raysweep-drivers --features aravis --example frame_cost`, as root.

#[path = "../tests/support/mod.rs"]
mod support;

use std::error::Error;
use std::process::Command;
use std::time::{Duration, Instant};

use nix::sys::resource::{UsageWho, getrusage};
use raysweep_core::{Camera, CameraSettings, FramePool, PixelFormat, SettingsId, Shutter};
use raysweep_drivers::camera::aravis::{AravisCamera, AravisConfig, Region, RigFacts};

use support::{ADDRESS, FakeCamera, own_network};

const DURATION: Duration = Duration::from_secs(3);
/// Each is measured as often and its best taken: whatever else the machine does only adds.
const REPEATS: usize = 4;

fn cpu_us(who: UsageWho) -> Result<f64, Box<dyn Error>> {
    let usage = getrusage(who)?;
    let us = |time: nix::sys::time::TimeVal| time.tv_sec() as f64 * 1e6 + time.tv_usec() as f64;
    Ok(us(usage.user_time()) + us(usage.system_time()))
}

/// Streams for a while; returns CPU time a frame.
fn ours(size: u32, period_us: u32, packet_size: u32) -> Result<f64, Box<dyn Error>> {
    let config = AravisConfig {
        address: Some(ADDRESS.into()),
        features: vec![format!("R[0x138]={period_us}")],
        region: Some(Region { x: 0, y: 0, width: size, height: size }),
        trigger_source: "off".into(),
        packet_size: Some(packet_size),
        ..AravisConfig::default()
    };
    let facts = RigFacts {
        format: PixelFormat::Mono8,
        row_time_us: 10.0,
        trigger_period_us: f64::from(period_us),
        trigger_margin_us: 100.0,
        reopen: Duration::from_secs(5),
    };
    let mut camera = AravisCamera::open(&config, facts)?;
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us: 10_000.0, trigger_delay_us: 0.0 };
    camera.configure(SettingsId { point: 0, attempt: 0 }, &settings)?;
    let pool = FramePool::new(1, PixelFormat::Mono8.frame_bytes((size * size) as usize));
    let mut buf = pool.take();
    camera.arm()?;
    let (begun, begun_us, mut frames) = (Instant::now(), cpu_us(UsageWho::RUSAGE_SELF)?, 0_u64);
    while begun.elapsed() < DURATION {
        frames += u64::from(camera.next_frame(&mut buf, Duration::from_secs(1))?.is_some());
    }
    Ok((cpu_us(UsageWho::RUSAGE_SELF)? - begun_us) / frames as f64)
}

/// CPU time and frames of the library's own client, on the same kind of socket.
fn client(size: u32, packet_size: u32, seconds: u64) -> Result<(f64, f64), Box<dyn Error>> {
    let before_us = cpu_us(UsageWho::RUSAGE_CHILDREN)?;
    let size = size.to_string();
    let output = Command::new("arv-camera-test-0.8")
        .args(["-n", ADDRESS, "--auto", "--no-packet-socket", "-w", &size, "-h", &size])
        .args(["-j", "never", "-i", &packet_size.to_string(), "--duration", &seconds.to_string()])
        .output()?;
    let text = String::from_utf8(output.stdout)?;
    let line = text.lines().find(|line| line.starts_with("n_completed_buffers")).ok_or("no frames")?;
    let frames = line.rsplit(' ').next().unwrap_or_default().parse()?;
    Ok((cpu_us(UsageWho::RUSAGE_CHILDREN)? - before_us, frames))
}

/// What a frame costs the library's own client beyond its start.
fn theirs(size: u32, packet_size: u32) -> Result<f64, Box<dyn Error>> {
    let (short_us, short_frames) = client(size, packet_size, 1)?;
    let (long_us, long_frames) = client(size, packet_size, 1 + DURATION.as_secs())?;
    Ok((long_us - short_us) / (long_frames - short_frames))
}

fn main() -> Result<(), Box<dyn Error>> {
    own_network();
    let _device = FakeCamera::start(&[]);
    for (size, period_us) in [(128, 16_667), (512, 5_000), (1024, 10_000)] {
        for packet_size in [1_500, 9_000] {
            let (mut ours_us, mut theirs_us) = (f64::INFINITY, f64::INFINITY);
            for _ in 0..REPEATS {
                ours_us = ours_us.min(ours(size, period_us, packet_size)?);
                theirs_us = theirs_us.min(theirs(size, packet_size)?);
            }
            println!(
                "{size} x {size} Mono8 in packets of {packet_size}: {ours_us:.0} us a frame, arv-camera-test-0.8 {theirs_us:.0} us: {:.2} times",
                ours_us / theirs_us
            );
        }
    }
    Ok(())
}
