//! Measures the time for a simulated frame on one core, and how much of it is sensor noise.
//!
//!     RAYON_NUM_THREADS=1 cargo run --release -p raysweep-sim --example frame_time

use std::path::Path;
use std::time::{Duration, Instant};

use raysweep_config::sim::SimConfig;
use raysweep_core::{FramePool, Pattern, PixelFormat, Raster};
use raysweep_sim::{PlaneDevices, PlaneRig, PlaneSetup};

const FRAMES: u32 = 1000;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    for noise in [true, false] {
        let mut config = SimConfig { scene: "v-groove".into(), ..SimConfig::default() };
        config.sensor.noise = noise;
        let setup = PlaneSetup {
            raster: Raster { rows: 128, row_time_us: 22.22, first_row_us: 2200.0, period_us: 16_666.667 },
            camera_row_time_us: 22.22,
            row_pitch: 1.0,
            white_dn: 2500.0,
            black_dn: 64.0,
            format: PixelFormat::Mono12,
            first_row: None,
        };
        let PlaneDevices { mut camera, vsync, mut projector, .. } =
            PlaneRig::new(config, setup, Path::new(""))?.open();
        drop(vsync);
        camera.arm()?;
        projector.show(&Pattern::White)?;
        let mut frame = FramePool::new(1, 128 * 128 * 2).take();
        let began = Instant::now();
        for _ in 0..FRAMES {
            camera.next_frame(&mut frame, Duration::from_secs(1))?.ok_or("no frame")?;
        }
        let each_ms = began.elapsed().as_secs_f64() * 1e3 / f64::from(FRAMES);
        println!("128 x 128 pixels, 128 rows, noise {noise}: {each_ms:.3} ms a frame");
    }
    Ok(())
}
