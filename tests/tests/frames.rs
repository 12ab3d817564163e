//! Six frames of the rolling-shutter rig, computed outside the project by time stepping; simulated camera and daemon
//! must reproduce them. (The forward matrix is checked against them in `raysweep-transport`.)

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs::File;
use std::path::Path;

use ndarray::{Array1, Array2, Array3, Axis};
use ndarray_npy::NpzReader;
use raysweep_config::sim::SimConfig;
use raysweep_core::{PixelFormat, Raster};
use raysweep_session::stack::ArrayName;
use raysweep_sim::{PlaneRig, PlaneSetup};
use raysweep_tests::{Bench, corner_rig, data};

struct Reference {
    frames: Array3<f32>,
    delay_us: Vec<f64>,
    exposure_us: Vec<f64>,
}

fn reference() -> Reference {
    let mut npz = NpzReader::new(File::open(data("p2r_corner_frames.npz")).unwrap()).unwrap();
    let numbers = |array: Array1<f64>| array.to_vec();
    Reference {
        frames: npz.by_name("frames").unwrap(),
        delay_us: numbers(npz.by_name("delay_us").unwrap()),
        exposure_us: numbers(npz.by_name("exposure_us").unwrap()),
    }
}

fn largest(image: &Array2<f32>) -> f32 {
    image.iter().fold(0.0, |largest, &x| x.abs().max(largest))
}

#[test]
fn the_simulators_light_is_the_references() {
    let setup = PlaneSetup {
        raster: Raster { rows: 128, row_time_us: 22.22, first_row_us: 555.5, period_us: 16_666.667 },
        camera_row_time_us: 22.22,
        row_pitch: 1.0,
        white_dn: 2500.0,
        black_dn: 64.0,
        format: PixelFormat::Mono12,
        first_row: None,
    };
    let config = SimConfig { scene: data("p2r_corner.npz"), ..SimConfig::default() };
    let rig = PlaneRig::new(config, setup, Path::new("")).unwrap();
    let reference = reference();
    for (k, frame) in reference.frames.axis_iter(Axis(0)).enumerate() {
        let frame = frame.to_owned();
        let light = rig.noise_free(reference.delay_us[k], reference.exposure_us[k]).unwrap();
        let off = largest(&(&light - &frame)) / largest(&frame);
        println!("delay {} exposure {}: {off:.1e}", reference.delay_us[k], reference.exposure_us[k]);
        assert!(off < 1e-3, "frame {k} is off by {off}");
    }
}

#[test]
fn the_daemon_stores_the_references_frames() {
    let bench = Bench::new(&corner_rig("[sim.sensor]\nnoise = false\n[sim.vsync]\njitter_us = 0\n"));
    let reference = reference();
    for (k, frame) in reference.frames.axis_iter(Axis(0)).enumerate() {
        let plan = format!(
            "kind = \"sweep\"\n[sweep]\naverage = 2\ndelay_us = [{:?}]\nexposure_us = [{:?}]\n",
            reference.delay_us[k], reference.exposure_us[k]
        );
        let ended = bench.run(&plan);
        assert_eq!(ended.state, "complete", "{:?}", ended.error);
        let light = (ended.mean(ArrayName::Sum, 0) - ended.mean(ArrayName::Dark, 0)) / 2500.0;
        let frame = frame.to_owned();
        // Without noise as dither, the converter rounds to half a count of 2500.
        let allowed = 1e-3 * largest(&frame) + 0.5 / 2500.0;
        let off = largest(&(light.mapv(|x| x as f32) - &frame));
        assert!(off < allowed, "frame {k} is off by {off}, allowed is {allowed}");
    }
}
