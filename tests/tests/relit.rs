//! `raysweep relit`: a scene relit from a sweep beside captures of it, and the plans of `docs/plane`.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::path::{Path, PathBuf};

use ndarray::{Array2, Axis};
use raysweep_config::{Plan, Procedure, RigFile};
use raysweep_processing::patterns::PatternsTask;
use raysweep_processing::plane::KnownRig;
use raysweep_processing::relit;
use raysweep_processing::sweep::SweepTask;
use raysweep_session::products::Products;
use raysweep_sim::scene::{Scene, SceneSize};
use raysweep_tests::{Bench, Ended, rig_text};

const ROWS: usize = 48;
const COLUMNS: usize = 40;
const LINE: usize = 20;
const SWEEP: &str = "kind = \"sweep\"\n[sweep]\naverage = 8\n";

fn bench(rows: usize) -> Bench {
    let sim = format!("scene = \"candle\"\nscene_rows = {rows}\nscene_columns = {COLUMNS}\nseed = 5");
    Bench::new(&rig_text(rows, &sim, ""))
}

/// A line, stripes of rows and stripes of columns, which no transport of rows relights.
fn pictures(average: u32, more: &str) -> String {
    format!(
        "kind = \"patterns\"\n[patterns]\nexposure_us = [300]\naverage = {average}\n{more}\
         [[pattern]]\nkind = \"stripes\"\nperiod_px = 8\ndirection = \"columns\"\n\
         [[pattern]]\nkind = \"line\"\nrow = {LINE}\n\
         [[pattern]]\nkind = \"black\"\n\
         [[pattern]]\nkind = \"stripes\"\nperiod_px = 8\ndirection = \"rows\"\n"
    )
}

fn complete(ended: Ended) -> PathBuf {
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    ended.session
}

/// SNR of an image in dB.
fn snr_db(image: &Array2<f32>, truth: &Array2<f32>) -> f64 {
    let square = |image: &Array2<f32>| image.iter().map(|light| f64::from(light * light)).sum::<f64>();
    10.0 * (square(truth) / square(&(image - truth))).log10()
}

#[test]
fn a_relit_line_is_nearer_to_the_truth_than_one_frame_of_it() {
    let bench = bench(ROWS);
    let sweep = complete(bench.run(SWEEP));
    let [short, long] = [1, 48].map(|average| complete(bench.run(&pictures(average, ""))));
    let to = bench.folder.path().join("relit");
    let told = relit(&sweep, &[short.clone(), long.clone()], &to).unwrap();
    assert_eq!(told.len(), 2, "{told:?}");
    let truth = Scene::builtin("candle", SceneSize { rows: ROWS, columns: COLUMNS }, 5).unwrap().transport;
    let truth = truth.index_axis_move(Axis(3), 0);
    let lit = |is_lit: &dyn Fn(usize) -> bool| {
        let rows: Vec<usize> = (0..ROWS).filter(|row| is_lit(*row)).collect();
        truth.select(Axis(0), &rows).sum_axis(Axis(0))
    };
    let of_line = lit(&|row| row == LINE);
    let of_stripes = lit(&|row| row % 8 < 4);
    for (picture, truth, product) in [
        (&told[0], of_line, format!("line-{LINE}-regular")),
        (&told[1], of_stripes, "stripes-2-regular".into()),
    ] {
        let image = Products::new(&to).read_image(&picture.name).unwrap();
        let captured = |session: &Path| Products::new(session.join("products")).read_image(&product).unwrap();
        let (relit_db, short_db) = (snr_db(&image, &truth), snr_db(&captured(&short), &truth));
        let reference = captured(&long);
        println!("{}: relit {relit_db:.1} dB, one frame {short_db:.1} dB", picture.shows);
        assert!(relit_db > 20.0 && relit_db > short_db + 6.0, "{relit_db} {short_db}");
        assert_eq!((&picture.reference, picture.images.len()), (&long, 2));
        assert!((picture.reference_s - 0.8).abs() < 1e-6, "{}", picture.reference_s);
        // What it tells is against the long capture.
        for (told, image) in picture.images.iter().zip([&image, &captured(&short)]) {
            assert!((told.snr_db.unwrap() - snr_db(image, &reference)).abs() < 1e-3, "{told:?}");
            let (peak, pixels) = (reference.fold(0.0_f32, |most, v| most.max(*v)), reference.len() as f64);
            let error = (image - &reference).iter().map(|v| f64::from(v * v)).sum::<f64>();
            let psnr_db = 10.0 * (f64::from(peak * peak) * pixels / error).log10();
            assert!((told.psnr_db.unwrap() - psnr_db).abs() < 1e-3, "{told:?}, {psnr_db}");
        }
        assert!(picture.images[0].relit && picture.images[1].light_s.unwrap() < 0.02);
        assert!(to.join(format!("{}.png", picture.name)).exists());
    }
}

#[test]
fn sessions_that_do_not_fit_are_refused_by_name() {
    let (bench, other) = (bench(ROWS), bench(ROWS / 2));
    let sweep = complete(bench.run(SWEEP));
    let captured = complete(bench.run(&pictures(1, "")));
    let gated = complete(bench.run(&pictures(1, "regular = false\n")));
    let smaller = complete(other.run(&pictures(1, "")));
    let to = bench.folder.path().join("relit");
    let refusal =
        |sweep: &Path, capture: &Path| relit(sweep, &[capture.to_owned()], &to).unwrap_err().to_string();
    for (sweep, capture, named, why) in [
        (&captured, &captured, &captured, "is no sweep"),
        (&sweep, &sweep, &sweep, "kind \"patterns\""),
        (&sweep, &gated, &gated, "patterns.regular = true"),
        (&sweep, &smaller, &smaller, "shows 24 projector rows"),
    ] {
        let said = refusal(sweep, capture);
        assert!(said.contains(why) && said.contains(named.to_str().unwrap()), "{said}");
    }
    let twice = relit(&sweep, &[captured.clone(), captured.clone()], &to).unwrap_err().to_string();
    assert!(twice.contains("given twice"), "{twice}");
    // One changed digit of a plan, one flipped bit of a transport, and a transport that is gone.
    let plan = captured.join("plan.toml");
    let sound = fs::read_to_string(&plan).unwrap();
    fs::write(&plan, sound.replace("row = 20", "row = 21")).unwrap();
    assert!(refusal(&sweep, &captured).contains("plan.toml"));
    fs::write(&plan, sound).unwrap();
    let chunk = sweep.join("transport.zarr/transport/c.0.0.0");
    let mut bytes = fs::read(&chunk).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&chunk, &bytes).unwrap();
    assert!(refusal(&sweep, &captured).contains("transport.zarr/transport/c.0.0.0"));
    bytes[middle] ^= 1;
    fs::write(&chunk, &bytes).unwrap();
    assert!(!to.exists(), "nothing was written");
    fs::create_dir(&to).unwrap();
    assert!(refusal(&sweep, &captured).contains("already exists"));
    fs::remove_dir(&to).unwrap();
    fs::remove_dir_all(sweep.join("transport.zarr")).unwrap();
    assert!(refusal(&sweep, &captured).contains("transport.zarr/zarr.json"));
}

#[test]
fn the_plans_of_the_papers_figures_are_valid() {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/plane");
    let rig = fs::read_to_string(docs.join("../../deploy/rigs/patterns-sim.toml")).unwrap();
    let rig = RigFile::parse(&rig).unwrap();
    let known = || KnownRig { file: &rig, first_row: 0, size: (128, 128), calibration: None };
    let mut plans = 0;
    for file in fs::read_dir(docs).unwrap().map(|entry| entry.unwrap().path()) {
        if file.extension().is_some_and(|extension| extension == "toml") {
            let text = fs::read_to_string(&file).unwrap();
            let plan = Plan::parse(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
            let made = match plan.procedure.clone() {
                Procedure::Sweep(own) => SweepTask::new(&plan, own, &known()).processing().map(|_| ()),
                Procedure::Patterns(own) => PatternsTask::new(&plan, own, &known()).map(|_| ()),
                _ => panic!("{}: another kind", file.display()),
            };
            assert!(made.is_ok(), "{}: {:?}", file.display(), made.err());
            plans += 1;
        }
    }
    assert_eq!(plans, 6);
}
