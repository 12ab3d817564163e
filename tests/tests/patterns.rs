//! `kind = "patterns"` on the simulated rig: direct and global light of scenes whose direct light is known from the
//! scene itself, pictures of all kinds, resumed and made again.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::path::Path;

use ndarray::{Array2, Array3};
use raysweep::control::Control;
use raysweep_core::Pattern;
use raysweep_session::products::Products;
use raysweep_sim::scene::{Scene, SceneSize, Window};
use raysweep_tests::{Bench, corner_rig, rig_text};

const ROWS: usize = 64;
const SIDE: usize = 128;
/// Columns of the simulated projector.
const COLUMNS: usize = 1280;

fn plan(exposures: &str, patterns: &str) -> String {
    format!("kind = \"patterns\"\n[patterns]\nexposure_us = {exposures}\naverage = 4\n{patterns}")
}

fn bench(scene: &str) -> Bench {
    let sim = format!("scene = \"{scene}\"\nscene_rows = {ROWS}\nscene_columns = {SIDE}\nseed = 3");
    Bench::new(&rig_text(ROWS, &sim, ""))
}

fn image(session: &Path, name: &str) -> Array2<f32> {
    Products::new(session.join("products")).read_image(name).unwrap()
}

/// The direct light of some pixels: what they see if only their own place is lit.
fn direct_light(scene: &Scene, pixels: &[(usize, usize)]) -> Vec<f32> {
    let columns = scene.projector_column.as_ref().unwrap();
    let own = |&(t, s): &(usize, usize)| {
        let between = |from: f32, to: f32| 0.5 * (from + to) * COLUMNS as f32;
        let middle = columns[[t, s]];
        let left = between(columns[[t, s - 1]], middle).floor() as usize;
        let right = between(middle, columns[[t, s + 1]]).ceil() as usize;
        let mut lit = Array2::zeros((scene.rows(), COLUMNS));
        lit.slice_mut(ndarray::s![t, left.saturating_sub(2)..(right + 2).min(COLUMNS)]).fill(1.0);
        let window = Window { rows: t..t + 1, columns: s..s + 1 };
        scene.render(lit.view(), &window).unwrap()[[0, 0, 0]]
    };
    pixels.iter().map(own).collect()
}

#[test]
fn gate_and_checkerboards_together_leave_the_least_indirect_light() {
    let bench = bench("v-groove");
    let board = "[[pattern]]\nkind = \"white\"\n[[pattern]]\nkind = \"black\"\n[[pattern]]\nkind = \"checkerboard\"\nshifts = 72\n";
    let ended = bench.run(&plan("[300]", board));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let size = SceneSize { rows: ROWS, columns: SIDE };
    let scene = Scene::builtin("v-groove", size, 3).unwrap();
    let pixels: Vec<(usize, usize)> =
        (6..ROWS - 6).step_by(7).flat_map(|t| (5..SIDE - 5).step_by(11).map(move |s| (t, s))).collect();
    let truth = direct_light(&scene, &pixels);
    let all = truth.iter().sum::<f32>();
    // 300 us are 13.5 rows.
    let [direct, epipolar] = ["direct", "epipolar-direct"].map(|name| image(&ended.session, name));
    let total = |prefix: &str| {
        image(&ended.session, &format!("{prefix}direct")) + image(&ended.session, &format!("{prefix}global"))
    };
    let indirect: f32 = pixels.iter().map(|&place| total("")[place]).sum::<f32>() - all;
    assert!(indirect > 0.1 * all, "the scene has indirect light: {indirect} of {all}");
    let left = |image: &Array2<f32>| {
        let errors = pixels.iter().zip(&truth).map(|(&place, truth)| image[place] - truth);
        errors.sum::<f32>() / indirect
    };
    let (gate, squares, both) = (left(&total("epipolar-")), left(&direct), left(&epipolar));
    println!("indirect light left: gate {gate:.3}, squares {squares:.3}, both {both:.3}");
    assert!(both.abs() < 0.1 && both < gate && squares.abs() < 0.1, "{gate}, {squares}, {both}");
    let mut errors: Vec<f32> =
        pixels.iter().zip(&truth).map(|(&place, truth)| (direct[place] / truth - 1.0).abs()).collect();
    errors.sort_by(f32::total_cmp);
    assert!(errors[errors.len() / 2] < 0.04, "median error of direct light {}", errors[errors.len() / 2]);

    // The images add up: both halves of the light are those under white.
    let white = image(&ended.session, "white-regular");
    let share = total("").sum() / white.sum();
    assert!((share - 1.0).abs() < 0.01, "{share} of the light under white");
    let page = fs::read_to_string(ended.session.join("report.html")).unwrap();
    assert!(page.contains("Direct and global light by squares of 24 pixels"));
}

#[test]
fn every_picture_has_its_images_and_sessions_are_resumed_to_the_same_bits() {
    let bench = Bench::new(&corner_rig(""));
    let series = "[[pattern]]\nkind = \"white\"\n[[pattern]]\nkind = \"line\"\nrow = 40\n\
                  [[pattern]]\nkind = \"stripes\"\nperiod_px = 16\n\
                  [[pattern]]\nkind = \"phase-shift\"\nperiod_px = 32\nsteps = 4\n\
                  [[pattern]]\nkind = \"gray-code\"\n";
    let plan = plan("[600, 1200.5]", series);
    let ended = bench.run(&plan);
    let (_, state) = ended.open();
    // 3 settings under 3 single pictures, 4 shifts, and 7 bits with their inverses.
    assert_eq!(
        (ended.state.as_str(), state.stored_points()),
        ("complete", 3 * (3 + 4 + 14)),
        "{:?}",
        ended.error
    );
    let read = |name: &str| fs::read(ended.session.join("products").join(name)).unwrap();
    let code: Array3<f32> = {
        use ndarray_npy::ReadNpyExt;
        Array3::read_npy(read("gray-code-rows-regular.npy").as_slice()).unwrap()
    };
    let white = image(&ended.session, "white-regular");
    // A bit and its inverse light all rows between them.
    for bit in 0..7 {
        let both =
            &code.index_axis(ndarray::Axis(0), 2 * bit) + &code.index_axis(ndarray::Axis(0), 2 * bit + 1);
        let error = (&both - &white).mapv(f32::abs).mean().unwrap() / white.mean().unwrap();
        assert!(error < 0.02, "bit {bit}: {error}");
    }
    let line = image(&ended.session, "line-40-regular");
    let brightest = (0..128).max_by(|&a, &b| line.row(a).sum().total_cmp(&line.row(b).sum())).unwrap();
    assert_eq!(brightest, 40, "the row that is lit");

    let files = [
        "stripes-regular.npy",
        "phase-shift-rows-delay_0us_exposure_1200p5us.npy",
        "line-40-regular_mask.npy",
    ];
    let before = files.map(read);
    let ledger = ended.session.join("ledger.jsonl");
    let lines: Vec<String> = fs::read_to_string(&ledger).unwrap().lines().map(str::to_owned).collect();
    fs::write(&ledger, lines[..lines.len() / 2].join("\n") + "\n").unwrap();
    let resumed = bench.resume(&ended.session);
    assert_eq!(resumed.state, "complete", "{:?}", resumed.error);
    assert!(files.map(read) == before, "resumed to other bits");
    let processed = raysweep_processing::process(&ended.session).unwrap();
    assert_eq!((processed.stored, processed.problems.len()), (63, 0), "{:?}", processed.problems);
    assert!(files.map(read) == before, "processed to other bits");
}

#[test]
fn what_makes_the_products_worse_is_in_the_ledger_when_it_ends() {
    let sim = "scene = \"v-groove\"\nscene_rows = 16\nscene_columns = 16\nseed = 5";
    let squares = "[[pattern]]\nkind = \"checkerboard\"\nsize_px = 4\nshifts = 32\n";
    let bench = Bench::new(&rig_text(16, sim, ""));
    let ended = bench.run(&plan("[200]", squares));
    let (session, state) = ended.open();
    let warnings = state.end.unwrap().warnings;
    let black = "the projector's black is not measured";
    assert!(warnings.iter().any(|warning| warning.starts_with(black)), "{warnings:?}");
    let page = fs::read_to_string(session.report_path()).unwrap();
    assert_eq!(page.matches(black).count(), 1, "no warning is said twice");
}

#[test]
fn points_that_fail_are_taken_again_under_their_own_picture() {
    let sim = "scene = \"v-groove\"\nscene_rows = 16\nscene_columns = 16\nseed = 5";
    let faults = "[sim.vsync]\nmissing = 0.02\nfalse_edges = 0.02\n[sim.camera]\ndropped = 0.03\nlate_frames_max = 2\n";
    let series =
        "[[pattern]]\nkind = \"gray-code\"\n[[pattern]]\nkind = \"checkerboard\"\nsize_px = 4\nshifts = 32\n";
    let bench = Bench::new(&rig_text(16, sim, faults));
    let ended = bench.run(&plan("[200]", series));
    let (_, state) = ended.open();
    assert_eq!((ended.state.as_str(), state.stored_points()), ("complete", 80), "{:?}", ended.error);
    assert!(state.counts.lost_total() > 0, "no frame was lost");
    let bench_without = Bench::new(&rig_text(16, sim, ""));
    let sound = bench_without.run(&plan("[200]", series));
    // Lost frames are taken again, with other noise, and the light stays the same.
    let cube = |session: &Path| {
        use ndarray_npy::ReadNpyExt;
        let file = fs::File::open(session.join("products/gray-code-rows-regular.npy")).unwrap();
        Array3::<f32>::read_npy(file).unwrap()
    };
    let (found, expected) = (cube(&ended.session), cube(&sound.session));
    for (picture, (found, expected)) in found.outer_iter().zip(expected.outer_iter()).enumerate() {
        let error = (&found - &expected).mapv(f32::abs).mean().unwrap();
        assert!(error < 0.03, "picture {picture}: {error}");
    }
    let error =
        (image(&ended.session, "global") - image(&sound.session, "global")).mapv(f32::abs).mean().unwrap();
    assert!(error < 0.01, "global light: {error}");
}

#[test]
fn a_scene_that_is_known_by_its_rows_says_what_it_cannot_show() {
    let ended = Bench::new(&corner_rig("")).run(&plan("[600]", "[[pattern]]\nkind = \"checkerboard\"\n"));
    assert_eq!(ended.state, "faulted");
    assert!(ended.error.unwrap().contains("known by its rows alone"));
    let line = Pattern::Line { row: 128 }.row_weights(128).unwrap_err().to_string();
    let bench = Bench::new(&corner_rig(""));
    let params = raysweep_proto::RunParams {
        plan: plan("[600]", "[[pattern]]\nkind = \"line\"\nrow = 128\n"),
        ..Default::default()
    };
    let refused = bench.runner.run(params).unwrap_err().to_string();
    assert!(refused.contains(&line) && refused.contains("128"), "{refused}");
}
