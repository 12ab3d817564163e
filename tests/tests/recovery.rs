//! Sweeps through the daemon recover the scene's transport. One scene is from an independent renderer, the others are
//! the simulator's own with different characters: the defaults must suit all of them.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, ArrayView3, Axis};
use raysweep::control::Control;
use raysweep_sim::scene::{Scene, SceneSize};
use raysweep_tests::{Bench, Ended, corner_rig, data, half_corner_rig, rig_text};
use raysweep_transport::plane::{RowTiming, Setting, reach, relative_rows};
use raysweep_transport::quality::{median_profile_error, relative_l2, share_near};
use serde_json::Value;

/// Sensor of the published figures: 8000 electrons, read noise of 15 electrons, no fixed pattern.
const SENSOR: &str = "[sim.sensor]\nfull_well_e = 8000.0\nread_noise_e = 15.0\nprnu_percent = 0.0\n";

/// The paper's delays and exposures.
const PAPER: &str = "kind = \"sweep\"\n[sweep]\naverage = ";

fn read_scene(path: &Path) -> Array3<f32> {
    let mut npz = ndarray_npy::NpzReader::new(std::fs::File::open(path).unwrap()).unwrap();
    npz.by_name("T").unwrap()
}

fn corner() -> Array3<f32> {
    read_scene(&data("p2r_corner.npz"))
}

/// Errors of a session's transport relative to a scene's.
#[derive(Debug)]
struct Errors {
    /// Median over pixels of the profile's relative error.
    profile: f64,
    /// Relative error of the u = 0 image.
    own_row: f64,
    /// Relative error of the total light, signed.
    total: f64,
    /// Error of the fraction of light at |u| <= 2, signed.
    near: f64,
    prior: String,
    beam_sigma_rows: f64,
}

fn product<D: ndarray::Dimension>(ended: &Ended, name: &str) -> ndarray::Array<f32, D> {
    ndarray_npy::read_npy(ended.session.join("products").join(name)).unwrap()
}

/// Runs a plan and compares the result with the true transport `scene`, `[v, t, s]`.
fn recover(bench: &Bench, plan: &str, scene: ArrayView3<f32>, longest: Setting) -> (Errors, Ended) {
    let ended = bench.run(plan);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let timing = RowTiming::new(scene.len_of(Axis(0)), 22.22, 16_666.667).unwrap();
    let both_ways = [-1.0, 1.0].map(|sign| Setting::new(sign * longest.delays_us[0], longest.exposure_us));
    let truth = relative_rows(scene, &reach(&timing, &both_ways).unwrap());
    let found: Array3<f32> = product(&ended, "transport.npy");
    assert_eq!(found.dim(), truth.dim());
    let metadata = std::fs::read(ended.session.join("products/transport.json")).unwrap();
    let metadata: Value = serde_json::from_slice(&metadata).unwrap();
    let u_min = metadata["u_min"].as_i64().unwrap() as i32;
    let total = |t: &Array3<f32>| t.iter().map(|&x| f64::from(x)).sum::<f64>();
    let near = |t: &Array3<f32>| share_near(t.view(), u_min, 2);
    let epipolar: Array2<f32> = product(&ended, "epipolar.npy");
    let errors = Errors {
        profile: median_profile_error(found.view(), truth.view()),
        own_row: relative_l2(epipolar.view(), truth.index_axis(Axis(0), -u_min as usize)),
        total: total(&found) / total(&truth) - 1.0,
        near: near(&found) - near(&truth),
        prior: metadata["prior"]["name"].as_str().unwrap().into(),
        beam_sigma_rows: metadata["beam_sigma_rows"].as_f64().unwrap(),
    };
    println!("{errors:?}");
    (errors, ended)
}

/// Recovers the corner scene with the paper's delays and exposures.
fn recover_corner(rig: &str, plan: &str) -> Errors {
    recover(&Bench::new(rig), plan, corner().view(), Setting::new(1500.0, 1200.0)).0
}

#[test]
fn the_papers_sweep_recovers_the_rendered_scene() {
    let plan = format!("{PAPER}8\n");
    let bench = Bench::new(&corner_rig(""));
    let (errors, ended) = recover(&bench, &plan, corner().view(), Setting::new(1500.0, 1200.0));
    assert!(errors.profile <= 0.02 && errors.own_row <= 0.02, "{errors:?}");
    assert!(errors.total.abs() < 0.01 && errors.near.abs() < 0.005, "{errors:?}");

    let (_, state) = ended.open();
    assert!(state.counts.balanced(), "{:?}", state.counts);
    assert_eq!(state.counts.averaged, (75 + 6 + 1) * 8);
    let (found, regular): (Array3<f32>, Array2<f32>) =
        (product(&ended, "transport.npy"), product(&ended, "regular.npy"));
    let total = |light: &mut dyn Iterator<Item = &f32>| light.map(|&x| f64::from(x)).sum::<f64>();
    let predicted = total(&mut found.iter()) / total(&mut regular.iter());
    assert!((predicted - 1.0).abs() < 0.02, "the model predicts {predicted} of the regular image");
}

#[test]
fn with_coupling_one_frame_is_as_good_as_eight_without() {
    let alone = "\n[[stage]]\nname = \"demux\"\ncoupling = false\n";
    let one = recover_corner(&corner_rig(SENSOR), &format!("{PAPER}1\n"));
    let eight = recover_corner(&corner_rig(SENSOR), &format!("{PAPER}8{alone}"));
    assert!(one.profile <= eight.profile && one.own_row <= eight.own_row, "{one:?} {eight:?}");
}

#[test]
fn fifteen_single_frames_with_delays_dense_near_zero() {
    let delays: Vec<f64> = (-7..=7)
        .map(|k: i32| f64::from(k.signum()) * 1500.0 * (f64::from(k.abs()) / 7.0).powf(1.7))
        .collect();
    let plan =
        format!("kind = \"sweep\"\n[sweep]\ndelay_us = {delays:?}\nexposure_us = [600]\naverage = 1\n");
    let (errors, _) =
        recover(&Bench::new(&corner_rig(SENSOR)), &plan, corner().view(), Setting::new(1500.0, 600.0));
    assert!(errors.profile <= 0.03, "{errors:?}");
}

#[test]
fn the_width_of_the_beam_is_found_in_the_images() {
    for sigma_rows in [0.7, 1.5] {
        let beam = format!("[sim.projector]\nbeam = {{ kind = \"gaussian\", sigma_rows = {sigma_rows} }}\n");
        let errors = recover_corner(&corner_rig(&format!("{SENSOR}{beam}")), &format!("{PAPER}8\n"));
        assert!(errors.profile <= 0.04, "{errors:?}");
        assert!((errors.beam_sigma_rows / sigma_rows - 1.0).abs() <= 0.05, "{errors:?}");
    }
}

/// A 64 x 64 scene of the simulator, and its file.
fn built_in(name: &str) -> (tempfile::TempDir, PathBuf, Array3<f32>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.npz");
    Scene::builtin(name, SceneSize { rows: 64, columns: 64 }, 1).unwrap().save(&path).unwrap();
    let scene = read_scene(&path);
    (folder, path, scene)
}

#[test]
fn the_defaults_suit_scenes_of_other_character() {
    for name in ["v-groove", "mirror-ball", "slab", "candle", "mix"] {
        let (_folder, path, scene) = built_in(name);
        // The beam must be known: under the slab's surface light spreads by a row, which images cannot tell from a
        // beam.
        let rig = rig_text(64, &format!("scene = {path:?}"), SENSOR);
        let bench = Bench::new(&rig.replace("[sim]", "beam_sigma_rows = 0.0\n[sim]"));
        let longest = || Setting::new(1500.0, 1200.0);
        let paper = "\n[[stage]]\nname = \"demux\"\nprior = \"paper\"\ncoupling = false\n";
        let (found, _) = recover(&bench, &format!("{PAPER}8\n"), scene.view(), longest());
        let (printed, _) = recover(&bench, &format!("{PAPER}8{paper}"), scene.view(), longest());
        println!("{name}: {:.4} against the paper's {:.4}", found.profile, printed.profile);
        assert!(found.profile <= printed.profile, "{name}: {found:?} {printed:?}");
        assert!(found.own_row <= printed.own_row, "{name}: {found:?} {printed:?}");
        assert!(found.total.abs() < 0.02, "{name}: {found:?}");
        assert_eq!(printed.prior, "paper");
    }
}

#[test]
fn a_flying_spot_costs_the_settings_that_it_cuts_and_nothing_else() {
    // In the first list, every exposure starts or ends on the direct row; in the second list, none does.
    let delays: Vec<f64> = [-1500.0, -1000.0, -600.0, 600.0, 1000.0, 1500.0]
        .into_iter()
        .chain((-6..=6).map(|k| 300.0 + f64::from(k) * 1.5))
        .chain((-9..=9).map(|k| f64::from(k) * 25.0 + 3.0))
        .collect();
    let plan = format!("kind = \"sweep\"\n[sweep]\ndelay_us = {delays:?}\nexposure_us = [600, 900]\n");
    let flying = "[sim.projector]\nspot = \"bidirectional\"\n";
    let scene = read_scene(&data("p2r_corner_half.npz"));
    let rig = half_corner_rig(128, &format!("{SENSOR}{flying}"));
    let known = rig.replace("row_time_us = 22.22\n[sim]", "row_time_us = 22.22\nspot = \"flying\"\n[sim]");
    let longest = || Setting::new(1500.0, 900.0);
    let bench = Bench::new(&known);
    let (dropped, ended) = recover(&bench, &plan, scene.view(), longest());
    let (ignored, _) = recover(&Bench::new(&rig), &plan, scene.view(), longest());
    assert!(dropped.profile < ignored.profile, "{dropped:?} {ignored:?}");
    assert!(dropped.profile < 0.03, "{dropped:?}");
    let report = |ended: &Ended| std::fs::read_to_string(ended.session.join("report.html")).unwrap();
    assert!(report(&ended).contains("images are left out"));

    // When the spot's path is known, all images are used.
    let modelled = known
        .replace("spot = \"flying\"", "spot = \"flying\"\nscan = \"bidirectional\"\nbeam_sigma_rows = 0.0")
        .replace("[vsync]", "projector_columns = [0, 1]\n[vsync]");
    let bench = Bench::new(&modelled);
    let (modelled, ended) = recover(&bench, &plan, scene.view(), longest());
    assert!(modelled.profile < 0.02 && modelled.own_row < 0.1, "{modelled:?}");
    assert!(report(&ended).contains("modelled in the"));
}

#[test]
fn the_sweep_that_check_proposes_errs_less_than_the_papers() {
    let bench = Bench::new(&corner_rig(""));
    let plan = format!("{PAPER}1\n");
    let report = bench.runner.check(&plan).unwrap();
    let better = report.advice.unwrap().better.unwrap();
    let proposed = plan.replace("[sweep]\naverage = 1\n", &better.table);
    // The prediction for the proposed sweep equals the check of that sweep.
    let again = bench.runner.check(&proposed).unwrap();
    assert_eq!(
        (again.points, again.frames, again.reach_rows),
        (better.points, better.frames, report.reach_rows)
    );
    assert_eq!(again.advice.unwrap().expected, better.expected);

    let longest = Setting::new(1500.0, 1200.0);
    let recover = |plan: &str| recover(&bench, plan, corner().view(), longest.clone()).0;
    for alone in ["", "[[stage]]\nname = \"demux\"\nprior = \"split\"\ncoupling = false\n"] {
        let (paper, better) = (recover(&format!("{plan}{alone}")), recover(&format!("{proposed}{alone}")));
        assert!(better.profile < paper.profile && better.own_row < paper.own_row, "{better:?} {paper:?}");
    }
}
