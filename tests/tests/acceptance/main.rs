//! What an unknown rig costs: the error of the transport after one calibration, against that of the same rig fully
//! known. For more than the corner, by hand: `RAYSWEEP_SCENES=folder cargo test --test acceptance -- --ignored
//! --nocapture` holds the rendered scenes (`*.npz` with `T`) of a folder against it, and prints a table.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod coverage;

use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, ArrayView3, Axis, s};
use raysweep::rig::Rig;
use raysweep_processing::calibration::{KeptCalibration, ResponseOf, Scanning};
use raysweep_session::film::TransportFilm;
use raysweep_sim::PlaneRig;
use raysweep_tests::{Bench, Ended, rig_text, with_products};
use raysweep_transport::plane::{PixelResponse, RESPONSE_ROWS, relative_rows};
use raysweep_transport::quality::median_profile_error;

const ROW_TIME_US: f64 = 22.22;
/// What the camera's time stamps take the latency for.
const STATED_LATENCY_US: f64 = 8.0;
const SWEEP: &str = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\n\
                     exposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 8\n";
const EDGES: &str = include_str!("../../../deploy/plans/edges.toml");
const FILM: &str = "kind = \"film\"\n[film]\ncycles = 8\nexposure_us = 600\ndelay_us = [-1500, -1000, -640, -420, \
                    -333, -311, -289, 0, 289, 311, 333, 420, 640, 1000, 1500]\n";

/// Everything of which a rig file does not speak.
const UNKNOWN: &str = "[sim.projector]\nbeam = { kind = \"flat-top\", up_rows = 0.5, down_rows = 1.2 }\n\
                       row_table = { kind = \"kinked\", pieces = 8, amplitude_us = 20, percent = 2 }\n\
                       phase_jitter_us = JITTER\n\
                       [sim.sensor]\nvignetting_percent = 20.0\nprnu_percent = 1.0\n\
                       [sim.truth]\ncamera_row_time_us = 22.89\nrow_offset_rows = 0.4\nrotation_deg = 0.2\n\
                       trigger_latency_us = 30.0\n";

/// The board stays in view in the leftmost columns.
const STRIP: &str = "[calibration]\nstrip_columns = [0, 8]\n[sim.board]\nstrip_columns = [0, 8]\n";

fn scenes() -> Vec<PathBuf> {
    let folder = std::env::var_os("RAYSWEEP_SCENES").expect("RAYSWEEP_SCENES: a folder with rendered scenes");
    let mut scenes: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("p2r_")))
        .filter(|path| path.extension().is_some_and(|extension| extension == "npz"))
        .filter(|path| !path.to_string_lossy().contains("frames"))
        .collect();
    scenes.sort();
    scenes
}

fn bench(scene: &Path, more: &str) -> (Bench, Rig) {
    let bench = Bench::new(&rig_text(720, &format!("scene = {scene:?}"), more));
    let rig = Rig::load(&bench.folder.path().join("rig.toml")).unwrap();
    (bench, rig)
}

fn data_folder(bench: &Bench) -> PathBuf {
    bench.folder.path().join("sessions")
}

/// Median relative error of a transport, in the rows that it has within the sweep's reach.
fn error_of(found: ArrayView3<f32>, u_min: i64, sim: &PlaneRig) -> f64 {
    let most = (u_min + found.len_of(Axis(0)) as i64 - 1).min(94);
    let least = u_min.max(-94);
    let found = found.slice(s![(least - u_min) as usize..=(most - u_min) as usize, .., ..]);
    let scene = sim.scene().transport.index_axis(Axis(3), 0).to_owned();
    median_profile_error(found, relative_rows(scene.view(), &(least as i32..=most as i32)).view())
}

fn error_of_sweep(ended: &Ended, sim: &PlaneRig) -> f64 {
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let products = ended.session.join("products");
    let found: Array3<f32> = ndarray_npy::read_npy(products.join("transport.npy")).unwrap();
    let text = std::fs::read_to_string(products.join("transport.json")).unwrap();
    let metadata: serde_json::Value = serde_json::from_str(&text).unwrap();
    error_of(found.view(), metadata["u_min"].as_i64().unwrap(), sim)
}

/// The median over the cycles after those from which a film learns.
fn error_of_film(ended: &Ended, sim: &PlaneRig) -> f64 {
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let film = TransportFilm::open(&ended.session.join("transport_film.zarr")).unwrap();
    let u_min = film.attributes()["u_min"].as_i64().unwrap();
    let mut errors: Vec<f64> = (4..8)
        .filter_map(|cycle| film.read(cycle).unwrap())
        .map(|transport| error_of(transport.t.view(), u_min, sim))
        .collect();
    errors.sort_by(f64::total_cmp);
    errors[errors.len() / 2]
}

/// The calibration in which times, places and responses are the simulator's own.
fn known(found: &KeptCalibration, sim: &PlaneRig, beam: &[f64; RESPONSE_ROWS]) -> KeptCalibration {
    let truth = sim.truth();
    let (mut header, mut arrays) = (found.header.clone(), found.arrays.clone());
    let late_us = truth.trigger_latency_us - STATED_LATENCY_US;
    arrays.row_starts_us = sim.row_starts_us().unwrap().iter().map(|us| us - late_us).collect();
    arrays.place = Array2::from_shape_fn(arrays.place.dim(), |(t, s)| truth.place(t, s) as f32);
    let response = PixelResponse::with_beam(arrays.place.clone(), beam).unwrap();
    arrays.response = response.shares().to_owned();
    header.timing.camera_row_time_us[0] = truth.camera_row_time_us;
    header.timing.exposure_offset_us[0] = 0.0;
    header.timing.row_time_us[0] = ROW_TIME_US;
    KeptCalibration::new(header, arrays).unwrap()
}

/// A sweep of which only the transport is looked at: the usual products would take as long again.
fn sweep(bench: &Bench, plan: &str) -> Ended {
    bench.run(&with_products(&["kind = \"regular\""], plan))
}

/// The most that the error of a calibrated rig may be, as a multiple of that of the known one.
const MOST: f64 = 1.15;

/// A rig of which only the calibration tells: its bench, the simulator, and the calibration that is in use.
fn calibrated(scene: &Path, more: &str) -> (Bench, Rig, KeptCalibration) {
    calibrated_by("kind = \"calibration\"\n", scene, more)
}

fn calibrated_by(plan: &str, scene: &Path, more: &str) -> (Bench, Rig, KeptCalibration) {
    let (bench, rig) = bench(scene, more);
    let calibration = bench.run(plan);
    assert_eq!(calibration.state, "complete", "{:?}", calibration.error);
    let found = KeptCalibration::read(&calibration.session).unwrap().unwrap();
    (bench, rig, found)
}

/// Errors with the calibration in use, and then with the simulator's own truth in its place.
fn found_and_known<const N: usize>(
    (bench, rig, found): &(Bench, Rig, KeptCalibration),
    errors: impl Fn(&Bench, &PlaneRig) -> [f64; N],
) -> [(f64, f64); N] {
    let sim = rig.simulated().unwrap();
    let calibrated = errors(bench, sim);
    // A row that the beam spreads downwards by a row is seen there while the row above is drawn.
    let mut beam = [0.0; RESPONSE_ROWS];
    (beam[7], beam[6]) = (1.0 / 1.7, 0.7 / 1.7);
    known(found, sim, &beam).use_in(&data_folder(bench)).unwrap();
    let known = errors(bench, sim);
    std::array::from_fn(|index| (calibrated[index], known[index]))
}

#[test]
fn an_unknown_rig_sees_the_corner_like_a_known_one() {
    let rig = calibrated(&raysweep_tests::data("p2r_corner_half.npz"), &UNKNOWN.replace("JITTER", "5.0"));
    let [(calibrated, known)] =
        found_and_known(&rig, |bench, sim| [error_of_sweep(&sweep(bench, SWEEP), sim)]);
    println!("error of T: {calibrated:.4} calibrated, {known:.4} known");
    assert!(known < 0.035 && calibrated < MOST * known);
}

/// The rig file does not say that a spot draws the rows. The scene is seen at other columns of the projector than the
/// board.
#[test]
fn a_flying_spot_is_found_by_the_calibration() {
    let scene = raysweep_tests::data("p2r_corner_half.npz");
    for (spot, rows) in [("one-way", Scanning::OneWay), ("bidirectional", Scanning::Bidirectional)] {
        let unknown = UNKNOWN.replace("JITTER", "0.5");
        let unknown = unknown.replace("[sim.projector]\n", &format!("[sim.projector]\nspot = \"{spot}\"\n"));
        let rig = calibrated(&scene, &format!("{unknown}[sim.board]\nprojector_columns = [0.1, 0.6]\n"));
        let (_, loaded, found) = &rig;
        let drawing = found.header.drawing.clone().unwrap();
        assert_eq!(drawing.rows, rows);
        assert!(
            std::iter::zip(drawing.columns.unwrap(), [0.1, 0.6])
                .all(|(found, set)| (found - set).abs() < 0.01)
        );
        let late_us = loaded.simulated().unwrap().truth().trigger_latency_us - STATED_LATENCY_US;
        let starts_us = loaded.simulated().unwrap().row_starts_us().unwrap();
        let [first, end] = found.header.timing.seen_rows;
        let worst_us = (first..=end)
            .map(|v| (found.arrays.row_starts_us[v] - starts_us[v] + late_us).abs())
            .fold(0.0, f64::max);
        let [(calibrated, known)] =
            found_and_known(&rig, |bench, sim| [error_of_sweep(&sweep(bench, EDGES), sim)]);
        println!(
            "{spot}: rows {worst_us:.2} us off; error of T: {calibrated:.4} calibrated, {known:.4} known"
        );
        assert!(worst_us < 1.5 + 0.05 * ROW_TIME_US);
        assert!(known < 0.035 && calibrated < MOST * known);
    }
}

/// The first board spreads all of its light over some rows, the second none.
#[test]
fn a_second_board_tells_the_beam_from_the_board() {
    let scene = raysweep_tests::data("p2r_corner_half.npz");
    for scatter_rows in [0.3, 0.7] {
        let board = format!("[sim.board]\nscatter_rows = {scatter_rows}\nscatter_share = 1.0\n");
        let unknown = UNKNOWN.replace("JITTER", "0.5") + &board;
        let (alone, rig, found) = calibrated(&scene, &unknown);
        assert_eq!(found.header.light.response_of, Some(ResponseOf::BeamAndBoard));
        let told = calibrated_by("kind = \"calibration\"\n[calibration]\nboards = 2\n", &scene, &unknown);
        assert_eq!(told.2.header.light.response_of, Some(ResponseOf::Beam));
        // Widths add up as squares.
        let [wide, narrow] = [&found, &told.2].map(|kept| kept.arrays.response_width_rows());
        let spread_rows = (wide.powi(2) - narrow.powi(2)).sqrt();
        println!("{wide:.3} and {narrow:.3} rows wide, so the first board spreads by {spread_rows:.3} rows");
        assert!((spread_rows / scatter_rows - 1.0).abs() < 0.1);
        // Errors of sweeps, which take long, with the wider spread alone: there it is plain what one board misleads by.
        if scatter_rows < 0.5 {
            continue;
        }
        let misled = error_of_sweep(&sweep(&alone, SWEEP), rig.simulated().unwrap());
        let [(told, known)] =
            found_and_known(&told, |bench, sim| [error_of_sweep(&sweep(bench, SWEEP), sim)]);
        println!("{scatter_rows} rows: {misled:.4} by one board, {told:.4} by two, {known:.4} known");
        assert!(told < MOST * known && misled > told);
    }
}

#[test]
#[ignore = "minutes; needs a folder of scenes"]
fn an_unknown_rig_sees_all_scenes_like_a_known_one() {
    println!(
        "scene | light | sweep: uncalibrated | calibrated | known | edges: calibrated | known | film: calibrated | known"
    );
    let mut worse = Vec::new();
    for scene in scenes() {
        for (jitter_us, strip) in [("5.0", ""), ("5.0", STRIP), ("0.5", "")] {
            let more = UNKNOWN.replace("JITTER", jitter_us) + strip;
            let (unaware, rig) = bench(&scene, &more);
            let uncalibrated = error_of_sweep(&sweep(&unaware, SWEEP), rig.simulated().unwrap());
            let pairs = found_and_known(&calibrated(&scene, &more), |bench, sim| {
                let [sweep, edges] = [SWEEP, EDGES].map(|plan| error_of_sweep(&sweep(bench, plan), sim));
                [sweep, edges, error_of_film(&bench.run(FILM), sim)]
            });
            let columns = pairs.map(|(calibrated, known)| format!("{calibrated:.4} | {known:.4}"));
            let row = format!(
                "{} | {jitter_us} us{} | {uncalibrated:.4} | {}",
                scene.file_stem().unwrap().to_string_lossy(),
                if strip.is_empty() { "" } else { ", strip" },
                columns.join(" | "),
            );
            println!("{row}");
            // Edges of exposures that step over a pixel's own row demand to know when each image was taken.
            let edges_are_known = jitter_us == "0.5" || !strip.is_empty();
            let judged = [true, edges_are_known, true];
            if pairs.iter().zip(judged).any(|(&(found, known), judged)| judged && found > MOST * known) {
                worse.push(row);
            }
        }
    }
    assert!(worse.is_empty(), "more than {MOST} times the known rig's error:\n{}", worse.join("\n"));
}

/// Errors of plans without settings, which are chosen for the calibration: the tables of the documentation.
#[test]
#[ignore = "minutes; needs a folder of scenes"]
fn plans_without_settings_on_rigs_of_all_kinds() {
    println!("scene | spot | jitter | sweep: calibrated | known | film: calibrated | known");
    for scene in scenes() {
        for (spot, jitter_us) in ["uniform", "one-way", "bidirectional"]
            .into_iter()
            .flat_map(|spot| ["0.0", "1.0", "2.0", "5.0"].map(|jitter_us| (spot, jitter_us)))
        {
            let unknown = UNKNOWN.replace("JITTER", jitter_us);
            let unknown =
                unknown.replace("[sim.projector]\n", &format!("[sim.projector]\nspot = {spot:?}\n"));
            let more = format!("{unknown}[sim.board]\nprojector_columns = [0.1, 0.6]\n");
            let pairs = found_and_known(&calibrated(&scene, &more), |bench, sim| {
                let film = bench.run("kind = \"film\"\n[film]\ncycles = 8\n");
                [error_of_sweep(&sweep(bench, "kind = \"sweep\"\n"), sim), error_of_film(&film, sim)]
            });
            println!(
                "{} | {spot} | {jitter_us} us | {}",
                scene.file_stem().unwrap().to_string_lossy(),
                pairs.map(|(found, known)| format!("{found:.4} | {known:.4}")).join(" | ")
            );
        }
    }
}
