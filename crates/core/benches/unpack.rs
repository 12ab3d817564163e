//! Compares unpacking with a `memcpy` of the same output in the same run, for each packing and instruction level, and
//! measures the cost of adding frames to a sum. Run it with `cargo xtask bench unpack`.

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot go on may panic")]

use std::hint::black_box;
use std::time::{Duration, Instant};

use raysweep_core::{Mosaic, Packing, PixelFormat, UnpackLevel};

/// The fastest repetition counts: the others were slowed down by other processes.
const REPETITIONS: usize = 60;

fn main() {
    // Cargo passes `--bench`.
    if let Some(unknown) = std::env::args().skip(1).find(|argument| argument != "--bench") {
        eprintln!("no option `{unknown}`: there are none");
        std::process::exit(2);
    }
    for (width, height) in [(1280, 720), (1600, 1200), (2048, 2048)] {
        frame(width, height);
    }
}

/// Measures frames of one size.
fn frame(width: usize, height: usize) {
    let pixels = width * height;
    let source: Vec<u16> = (0..pixels).map(|i| (i as u16).wrapping_mul(40_503)).collect();
    let mut unpacked = vec![0_u16; pixels];
    let mut sums = vec![0_u32; pixels];
    println!("\n{width} x {height}: {:.1} MB of unpacked pixels", pixels as f64 * 2e-6);
    print!("{:<16}{:>12}", "format", "memcpy us");
    for level in UnpackLevel::available() {
        print!("{:>14} us{:>8}", format!("{level:?}"), "ratio");
    }
    println!("{:>12}{:>12}", "add us", "in 2 passes");

    for packing in Packing::ALL {
        let format = PixelFormat::new(Mosaic::Mono, packing);
        let mut bytes = vec![0; format.frame_bytes(pixels)];
        format.pack_into(&source, &mut bytes).unwrap();

        let mut copied = Duration::MAX;
        let mut levels = vec![Duration::MAX; UnpackLevel::available().len()];
        let (mut fused, mut in_two_passes) = (Duration::MAX, Duration::MAX);
        for _ in 0..REPETITIONS {
            // In turn, so that other load on the machine affects all of them alike.
            fastest(&mut copied, || black_box(&mut unpacked).copy_from_slice(black_box(&source)));
            for (level, best) in UnpackLevel::available().iter().zip(&mut levels) {
                fastest(best, || {
                    format.unpack_with(*level, black_box(&bytes), black_box(&mut unpacked)).unwrap();
                });
            }
            fastest(&mut fused, || format.add_to(black_box(&bytes), black_box(&mut sums)).unwrap());
            fastest(&mut in_two_passes, || {
                format.unpack_into(black_box(&bytes), black_box(&mut unpacked)).unwrap();
                sums.iter_mut().zip(&unpacked).for_each(|(sum, &pixel)| *sum += u32::from(pixel));
                black_box(&mut sums);
            });
            sums.fill(0);
        }
        let microseconds = |time: Duration| time.as_secs_f64() * 1e6;
        print!("{:<16}{:>12.1}", format.to_string(), microseconds(copied));
        for time in levels {
            print!("{:>17.1}{:>8.2}", microseconds(time), copied.as_secs_f64() / time.as_secs_f64());
        }
        println!("{:>12.1}{:>12.1}", microseconds(fused), microseconds(in_two_passes));
    }
}

fn fastest(best: &mut Duration, work: impl FnOnce()) {
    let began = Instant::now();
    work();
    *best = began.elapsed().min(*best);
}
