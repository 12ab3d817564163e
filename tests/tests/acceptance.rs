//! What an unknown rig costs, by hand: `RAYSWEEP_SCENES=folder cargo test --test acceptance -- --ignored --nocapture`
//! prints tables of errors for the rendered scenes (`*.npz` with `T`) of a folder.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, ArrayView3, Axis, s};
use raysweep::rig::Rig;
use raysweep_processing::calibration::KeptCalibration;
use raysweep_session::film::TransportFilm;
use raysweep_sim::PlaneRig;
use raysweep_tests::{Bench, Ended, rig_text};
use raysweep_transport::plane::{PixelResponse, RESPONSE_ROWS, relative_rows};
use raysweep_transport::quality::median_profile_error;

const ROW_TIME_US: f64 = 22.22;
/// What the camera's time stamps take the latency for.
const STATED_LATENCY_US: f64 = 8.0;
const SWEEP: &str = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\n\
                     exposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 8\n";
const EDGES: &str = include_str!("../../deploy/plans/edges.toml");
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
        .map(|transport| error_of(transport.view(), u_min, sim))
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

#[test]
#[ignore = "minutes; prints a table"]
fn an_unknown_rig_against_the_same_rig_known() {
    // A row that the beam spreads downwards by a row is seen there while the row above is drawn.
    let mut beam = [0.0; RESPONSE_ROWS];
    (beam[7], beam[6]) = (1.0 / 1.7, 0.7 / 1.7);
    println!(
        "scene | light | sweep: uncalibrated | calibrated | known | edges: calibrated | known | film: calibrated | known"
    );
    for scene in scenes() {
        for (jitter_us, strip) in [("5.0", ""), ("5.0", STRIP), ("0.5", "")] {
            let (bench, rig) = bench(&scene, &(UNKNOWN.replace("JITTER", jitter_us) + strip));
            let sim = rig.simulated().unwrap();
            let uncalibrated = error_of_sweep(&bench.run(SWEEP), sim);
            let calibration = bench.run("kind = \"calibration\"\n");
            assert_eq!(calibration.state, "complete", "{:?}", calibration.error);
            let found = KeptCalibration::read(&calibration.session).unwrap().unwrap();
            let errors = || {
                let [sweep, edges] = [SWEEP, EDGES].map(|plan| error_of_sweep(&bench.run(plan), sim));
                [sweep, edges, error_of_film(&bench.run(FILM), sim)]
            };
            let calibrated = errors();
            known(&found, sim, &beam).use_in(&data_folder(&bench)).unwrap();
            let known = errors();
            let pairs: Vec<String> = calibrated
                .iter()
                .zip(known)
                .map(|(found, known)| format!("{found:.4} | {known:.4}"))
                .collect();
            println!(
                "{} | {jitter_us} us{} | {uncalibrated:.4} | {}",
                scene.file_stem().unwrap().to_string_lossy(),
                if strip.is_empty() { "" } else { ", strip" },
                pairs.join(" | "),
            );
        }
    }
}
