//! A ball of mirrors whose highlights saturate: what a sweep says of them, and what a bracket measures.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs::File;
use std::path::Path;

use ndarray::{Array2, Axis, Zip};
use ndarray_npy::NpzWriter;
use raysweep::rig::Rig;
use raysweep_pipeline::mask::BOUND_ONLY;
use raysweep_sim::scene::{Scene, SceneSize};
use raysweep_tests::{Bench, Ended, rig_text};
use raysweep_transport::plane::relative_rows;
use raysweep_transport::quality::relative_l2;

const SWEEP: &str = "product = [{ kind = \"epipolar\" }]\nkind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\n\
                     exposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 8\n";
const IDEAL: &str = "{ kind = \"ideal\" }";
const SKEWED: &str = "{ kind = \"flat-top\", up_rows = 0.5, down_rows = 1.2 }";
/// Light that counts, of a white pixel: errors of darker pixels by 5 % are noise.
const LEAST_LIGHT: f32 = 0.5;

fn image<A: ndarray_npy::ReadableElement>(ended: &Ended, name: &str) -> Array2<A> {
    ndarray_npy::read_npy(ended.session.join("products").join(format!("{name}.npy"))).unwrap()
}

/// A ball of mirrors on which 72 pixels shine 1.2 to 12 times as bright as white.
fn write_ball(path: &Path) {
    let size = SceneSize { rows: 128, columns: 128 };
    let ball = Scene::builtin("mirror-ball", size, 1).unwrap();
    let mut transport = ball.transport.index_axis_move(Axis(3), 0);
    for k in 0..72 {
        let (t, s) = (3 + 17 * k % 122, 5 + 41 * k % 119);
        transport[[t, t, s]] = 1.2 * 1.033_f32.powi(k as i32);
    }
    let mut npz = NpzWriter::new(File::create(path).unwrap());
    npz.add_array("T", &transport).unwrap();
    npz.finish().unwrap();
}

#[test]
fn highlights_are_marked_and_a_bracket_measures_them() {
    for beam in [IDEAL, SKEWED] {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("ball.npz");
        write_ball(&scene);
        let text = rig_text(720, &format!("scene = {scene:?}"), &format!("[sim.projector]\nbeam = {beam}\n"));
        let bench = Bench::new(&text);
        let rig = Rig::load(&bench.folder.path().join("rig.toml")).unwrap();
        let sim = rig.simulated().unwrap();
        assert_eq!(bench.run("kind = \"calibration\"\n").state, "complete");
        let scene = sim.scene().transport.index_axis(Axis(3), 0).to_owned();
        let direct = relative_rows(scene.view(), &(0..=0)).index_axis_move(Axis(0), 0);

        let alone = bench.run(SWEEP);
        let bracketed = bench.run(&format!("{SWEEP}bracket = {{ light = 0.125 }}\n"));
        let [found, measured] = [&alone, &bracketed].map(|ended| image::<f32>(ended, "epipolar"));
        let [mask, of_bracket] = [&alone, &bracketed].map(|ended| image::<u8>(ended, "epipolar_mask"));
        // Where the prior errs, it does so with a bracket, too.
        let (mut off, mut unmarked) = (0, 0);
        Zip::from(&found).and(&measured).and(&direct).and(&mask).for_each(|found, measured, direct, mask| {
            let is_off = *direct > LEAST_LIGHT && (found / measured - 1.0).abs() > 0.05;
            off += usize::from(is_off);
            unmarked += usize::from(is_off && mask & BOUND_ONLY == 0);
        });
        let bounds = |mask: &Array2<u8>| mask.iter().filter(|mask| **mask & BOUND_ONLY != 0).count();
        let errors = [&found, &measured].map(|image| relative_l2(image.view(), direct.view()));
        println!(
            "{beam}: errors of the u = 0 image {errors:.4?}; {off} pixels off by 5 % without a bracket, {unmarked} of \
             them not marked; bounds: {} without, {} with",
            bounds(&mask),
            bounds(&of_bracket)
        );
        assert!(unmarked == 0 && off > 50 && errors[0] > 0.2);
        assert!(errors[1] <= 0.02 && bounds(&of_bracket) == 0);
    }
}
