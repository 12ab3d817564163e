//! A rendered still life under flying dots, with its calibration planes from files: many dots miss the plane, and many
//! mirror directions lie beside it. Through the daemon, with noise.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs::File;

use ndarray::{Array2, Array3, Array4, ArrayD, Axis, Zip};
use ndarray_npy::NpzReader;
use raysweep_tests::{Bench, data};
use serde_json::Value;

/// Dots along a side of the scan, from the left in even rows, from the right in odd ones.
const SIDE: usize = 16;
/// Frames for the way back, whose light goes into the beam dump.
const BACK: usize = 14;
/// Half the field of view, in degrees of the beam.
const HALF_DEG: [f64; 2] = [9.27 / 2.0, 5.25 / 2.0];

/// Tilts of the mirror, in degrees, that throw the dots to their centres, and back to the first.
fn path() -> Vec<[f64; 2]> {
    let centre = |dot: usize| {
        let (row, step) = (dot / SIDE, dot % SIDE);
        [if row % 2 == 0 { step } else { SIDE - 1 - step }, row].map(|at| (at as f64 + 0.5) / SIDE as f64)
    };
    // A mirror that the beam meets head on turns it by twice its own angle.
    let tilt = |uv: [f64; 2]| {
        let [x, y] = [0, 1].map(|axis| (2.0 * uv[axis] - 1.0) * HALF_DEG[axis].to_radians().tan());
        let (radius, half) = (x.hypot(y), (x.hypot(y).atan() / 2.0).tan());
        [x, y].map(|part| (part / radius * half).atan().to_degrees())
    };
    let mut tilts: Vec<[f64; 2]> = (0..SIDE * SIDE).map(|dot| tilt(centre(dot))).collect();
    let (last, first) = (tilts[tilts.len() - 1], tilts[0]);
    // The trailing dot, then the beam dump.
    tilts.extend((0..BACK).map(|step| {
        let share = (step.max(1)) as f64 / BACK as f64;
        [0, 1].map(|axis| last[axis] + share * (first[axis] - last[axis]))
    }));
    tilts
}

fn array(file: &str, name: &str) -> ArrayD<f32> {
    NpzReader::new(File::open(data(file)).unwrap()).unwrap().by_name(name).unwrap()
}

#[test]
fn dots_that_miss_the_plane_are_relit_and_separated_like_the_others() {
    let dots = SIDE * SIDE;
    let dump: Vec<usize> = (dots + 1..dots + BACK).collect();
    let rig = format!(
        "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n[sim.dots]\nscene = {:?}\n\
         plane_files = [{:?}]\nseed = 3\ntrailing_index = {dots}\ndump_indices = {dump:?}\ndot = {{ ghost = 0 }}\n\
         mirror = {{ mechanics = false }}\n",
        data("fd_still.npz"),
        data("fd_planes.npz"),
    );
    let plan = format!(
        "kind = \"batches\"\n[batches]\ncount = 1\ndots = {}\nexposure_us = 25\ndark_frames = 64\n\
         trailing_index = {dots}\nbackground_indices = {dump:?}\ntrailing_region = [96, 112, 32, 64]\n\
         [batches.path]\nshape = \"points\"\nrate_hz = 250\npoints_deg = {:?}\n\
         [[batches.calibration]]\nbatches = 1\n[[batches.calibration]]\nbatches = 1\n\
         [[product]]\nkind = \"floodlit\"\n[[product]]\nkind = \"relight\"\npattern = \"white\"\n\
         [[product]]\nkind = \"direct-global\"\n[[product]]\nkind = \"direct-global\"\nmethod = \"epipolar\"\n",
        dots + BACK,
        path(),
    );
    let bench = Bench::dots(&rig);
    let ended = bench.run(&plan);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let products = ended.open().0.products_path();
    let image = |name: &str| -> Array2<f64> {
        let path = products.join(format!("{name}.npy"));
        let video = ndarray_npy::read_npy::<_, Array3<f32>>(&path).map(|video| video.insert_axis(Axis(3)));
        let video: Array4<f32> = video.or_else(|_| ndarray_npy::read_npy(&path)).unwrap();
        video.index_axis(Axis(0), 0).index_axis(Axis(2), 0).slice(ndarray::s![..96, ..]).mapv(f64::from)
    };

    // The truth: what the dots' images add up to, and the share of it that the renderer calls direct.
    let share = array("fd_still.npz", "direct_share").mapv(f64::from);
    let floodlit = image("floodlit");
    let is_lit = |share: f64| share > 0.0;
    let light: f64 = Zip::from(&floodlit)
        .and(&share.view().into_dimensionality::<ndarray::Ix2>().unwrap())
        .fold(0.0, |sum, &light, &share| sum + if is_lit(share) { light } else { 0.0 });
    let relit = image("relit");
    let differs = (&relit - &floodlit).mapv(f64::abs).sum() / floodlit.sum();
    assert!(differs < 1e-4, "white light differs from all dots by {differs}");
    let truth = array("fd_still.npz", "white").mapv(f64::from);
    let truth = truth.into_dimensionality::<ndarray::Ix2>().unwrap();
    let scale = (&floodlit * &truth).sum() / (&truth * &truth).sum();
    let truth = scale * truth;
    let snr_db = -10.0 * ((&floodlit - &truth).mapv(|off| off * off).sum() / (&truth * &truth).sum()).log10();
    println!("floodlit: {snr_db:.1} dB");
    // Of which residuals in blocks of 32 x 32, and a background with the noise of 64 frames, take 4 dB.
    assert!(snr_db > 28.5, "{snr_db}");
    for (name, most, most_off) in [("neighbours", 0.06, 0.34), ("epipolar", 0.06, 0.38)] {
        let direct = image(&format!("{name}-direct"));
        let global = image(&format!("{name}-global"));
        let mut off: Vec<f64> = Zip::from(&global)
            .and(&truth)
            .and(&share.view().into_dimensionality::<ndarray::Ix2>().unwrap())
            .map_collect(|&global, &light, &share| {
                let expected = (1.0 - share) * light;
                if is_lit(share) { (global - expected).abs() / expected } else { f64::NAN }
            })
            .into_iter()
            .filter(|off| off.is_finite())
            .collect();
        off.sort_by(f64::total_cmp);
        let off = off[off.len() / 2];
        println!("{name}: global light off by {off:.3} (median)");
        assert!(off < most_off, "{name}: {off}");
        let share = share.view().into_dimensionality::<ndarray::Ix2>().unwrap();
        let wrong =
            Zip::from(&direct).and(&floodlit).and(&share).fold(0.0, |sum, &direct, &light, &share| {
                sum + if is_lit(share) { (direct - share * light).abs() } else { 0.0 }
            }) / light;
        println!("{name}: {wrong:.4} of the light is misassigned");
        assert!(wrong < most, "{name}: {wrong}");
    }
    let about: Value = serde_json::from_slice(&std::fs::read(products.join("dots.json")).unwrap()).unwrap();
    assert!(about["epipole"].is_array(), "{about}");
}
