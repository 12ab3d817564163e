//! The dot rig from plan to videos, through the daemon's core in virtual time.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::process::Command;
use std::time::Duration;

use ndarray::{Array3, Axis, s};
use raysweep::control::Control;
use raysweep::rig::DotRig;
use raysweep_config::{Plan, Procedure};
use raysweep_core::{CameraSettings, FramePool, LossCause, SettingsId, Shutter, Subject};
use raysweep_processing::process;
use raysweep_session::dots::BatchEntry;
use raysweep_tests::dots::{plan, rig};
use raysweep_tests::{Bench, Ended, data};
use raysweep_transport::quality::snr_db;

fn entries(ended: &Ended) -> Vec<BatchEntry> {
    ended.open().1.batches().cloned().collect()
}

#[test]
fn one_command_makes_the_videos_of_a_moving_scene() {
    let bench = Bench::dots(&rig(""));
    let ended = bench.run(&plan("", 3));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (session, state) = ended.open();
    assert_eq!(state.batches().count(), 7);
    assert!(state.counts.lost.is_empty(), "{:?}", state.counts);
    for video in [
        "floodlit",
        "relit",
        "neighbours-direct",
        "neighbours-global",
        "epipolar-direct",
        "epipolar-global",
        "dual",
    ] {
        for file in [format!("{video}.npy"), format!("{video}/0002.png"), format!("{video}/0002.exr")] {
            assert!(session.products_path().join(&file).exists(), "{file}");
        }
        assert!(!session.products_path().join(format!("{video}/0003.png")).exists());
    }
    assert!(session.report_path().exists() && session.manifest_path().exists());
}

#[test]
fn lost_and_repeated_frames_cost_their_dots_alone() {
    let bench =
        Bench::dots(&rig("[sim.dots.camera]\ndropped = 0.01\nduplicated = 0.01\nsaturated = 0.005\n"));
    let ended = bench.run(&plan("", 3));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let entries = entries(&ended);
    assert_eq!(entries.len(), 7);
    let counts = ended.open().1.counts;
    assert!(counts.lost[&LossCause::CameraGap] > 5 && counts.lost[&LossCause::Saturated] > 1, "{counts:?}");
    assert!(entries.iter().map(|entry| entry.duplicates).sum::<u64>() > 5);
    assert!(entries.iter().all(|entry| entry.missing.len() < 20 && entry.counts.balanced()));
}

/// A video of one channel, `[k, t, s]`.
fn video(ended: &Ended, name: &str) -> Array3<f32> {
    let path = ended.open().0.products_path().join(format!("{name}.npy"));
    ndarray_npy::read_npy(path).unwrap()
}

/// Noise-free light of the scene's batches, summed over all dots on the scene, `[k, t, s]` in counts.
fn true_floodlit(plan: &str, rig_text: &str) -> Array3<f32> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig_text).unwrap();
    let rig = DotRig::load(&folder.path().join("rig.toml")).unwrap();
    let Procedure::Batches(plan) = Plan::parse(plan).unwrap().procedure else { panic!("batches") };
    let path = plan.mirror_path(&rig.file.limits()).unwrap();
    let mut devices = rig.open(folder.path(), plan.camera_rate_hz()).unwrap();
    let (mut mirror, truth) = (devices.mirror.unwrap(), devices.truth.unwrap());
    devices.stand.place(Subject::Scene).unwrap();
    let settings =
        CameraSettings { shutter: Shutter::Global, exposure_us: plan.exposure_us, trigger_delay_us: 0.0 };
    devices.camera.configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    devices.camera.arm().unwrap();
    mirror.load(&path).unwrap();
    mirror.start(plan.count + 1).unwrap();
    let mut sum = Array3::<f32>::zeros((plan.count as usize, 112, 128));
    let mut buffer = FramePool::new(1, 2 * 128 * 128).take();
    let mut dots = 0;
    while let Some(stamp) = devices.camera.next_frame(&mut buffer, Duration::from_millis(100)).unwrap() {
        let frame = truth.frame(stamp.seq).unwrap();
        // The first batch is not stored.
        if frame.batch > 0 && ![0, 299].contains(&frame.index) {
            let (direct, global) = truth.light(stamp.seq, plan.exposure_us).unwrap();
            let mut image = sum.index_axis_mut(Axis(0), frame.batch as usize - 1);
            let light = direct.iter().zip(&global).map(|(direct, global)| 2500.0 * (direct + global));
            image.iter_mut().zip(light).for_each(|(sum, light)| *sum += light);
            dots += 1;
        }
    }
    assert_eq!(dots, 298 * plan.count);
    sum
}

#[test]
fn the_residual_brings_back_the_light_that_discs_leave_behind() {
    let truth = true_floodlit(&plan("", 3), &rig(""));
    let bench = Bench::dots(&rig(""));
    let stage = |residual: bool| format!("[[stage]]\nname = \"denoise\"\nresidual = {residual}\n");
    let whole = bench.run(&(plan("", 3) + &stage(true)));
    let bare = bench.run(&(plan("", 3) + &stage(false)));
    for image in 0..3 {
        let truth = truth.index_axis(Axis(0), image).insert_axis(Axis(2)).to_owned();
        let snr = |ended: &Ended| {
            let video = video(ended, "floodlit");
            let light = video.slice(s![image, ..112, ..]).insert_axis(Axis(2)).to_owned();
            (snr_db(light.view(), truth.view()), light.sum() / truth.sum())
        };
        let ((with, energy), (without, bare_energy)) = (snr(&whole), snr(&bare));
        println!(
            "image {image}: {with:.1} dB, energy {energy:.4}; discs alone {without:.1} dB, {bare_energy:.4}"
        );
        assert!((energy - 1.0).abs() < 0.01, "{energy}");
        assert!(with >= without + 5.0, "{with} dB with the residual, {without} without");
    }
}

#[test]
fn products_made_again_have_the_same_bits() {
    let bench = Bench::dots(&rig("[sim.dots.camera]\ndropped = 0.01\n"));
    let ended = bench.run(&plan("", 2));
    let (session, _) = ended.open();
    let names = ["floodlit", "relit", "neighbours-direct", "epipolar-global", "dual", "confusion", "dots"];
    let bytes = |name: &str| std::fs::read(session.products_path().join(format!("{name}.npy"))).unwrap();
    let before: Vec<_> = names.map(bytes).into();
    std::fs::remove_dir_all(session.products_path()).unwrap();
    let made = process(&ended.session).unwrap();
    assert_eq!((made.stored, made.points), (6, 6));
    assert!(names.iter().zip(&before).all(|(name, before)| bytes(name) == *before));
}

#[test]
fn python_reads_the_columns_as_the_docs_show() {
    let python = std::env::var_os("RAYSWEEP_PYTHON").expect(
        "RAYSWEEP_PYTHON names a Python with tests/python/requirements.txt: `cargo xtask test` makes one",
    );
    let bench = Bench::dots(&rig(""));
    let ended = bench.run(&plan("", 1));
    let script = data("").join("../python/read_dots.py");
    let output = Command::new(python).arg(script).arg(&ended.session).arg("4").output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    let read: serde_json::Value =
        serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{errors}"));
    let stored = ended.open().0.dots().unwrap().read(4).unwrap();
    assert_eq!(read["shape"], serde_json::json!([300, 128 * 128]));
    let zeros = stored.values.iter().filter(|value| **value == 0.0).count();
    let pixels = read["pixels"].as_u64().unwrap() as usize;
    assert!(pixels == stored.values.len() || pixels == stored.values.len() - zeros);
    let mut first = 0;
    for (dot, light) in read["dots"].as_array().unwrap().iter().enumerate() {
        let words = stored.word_offsets[dot] as usize..stored.word_offsets[dot + 1] as usize;
        let end = first + stored.masks[words].iter().map(|mask| mask.count_ones() as usize).sum::<usize>();
        let expected: f64 = stored.values[first..end].iter().map(|&value| f64::from(value)).sum();
        assert!((light.as_f64().unwrap() - expected).abs() < 1e-3 * expected.abs().max(1.0), "dot {dot}");
        first = end;
    }
}

#[test]
fn what_a_dot_rig_cannot_do_is_said_before_anything_moves() {
    let bench = Bench::dots(&rig(""));
    let report = bench.runner.check(&plan("", 2)).unwrap();
    let batches = report.batches.unwrap();
    assert_eq!((report.points, batches.planes, batches.dots), (6, vec![2, 2], 300));
    // Two batches of dark frames, and two spare batches in each pass.
    assert_eq!(report.frames, 300 * (2 + 4 + 4 + 4));
    assert!((batches.batch_s - 0.05).abs() < 1e-12);
}
