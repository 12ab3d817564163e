//! What a calibration and a product state of their errors, held against rigs that differ in their noise alone. One run
//! proves nothing, because its pixels share the errors of its calibration and of its dark images.

use std::iter::zip;
use std::path::Path;

use ndarray::{Array2, Array3, Axis};
use ndarray_npy::read_npy;
use raysweep_config::sim::SimSensor;
use raysweep_processing::calibration::KeptCalibration;
use raysweep_sim::PlaneRig;
use raysweep_transport::plane::relative_rows;

use crate::{EDGES, STATED_LATENCY_US, SWEEP, UNKNOWN, calibrated};

/// Each kind of light, and its relative rows, both sides.
const LIGHT: [(&str, [i32; 2]); 4] =
    [("direct", [0, 0]), ("profile", [3, 3]), ("short", [1, 10]), ("long", [11, 40])];

/// The images of each kind of light, with their uncertainties and the size of the prior's bias.
fn products() -> String {
    let of = |kind: &str, name: &str, [from, to]: [i32; 2], end: &str| {
        format!("{{ kind = \"{kind}\", name = \"{name}{end}\", from_rows = {from}, to_rows = {to} }}")
    };
    let tables = LIGHT.iter().flat_map(|&(name, rows)| {
        [
            of("band", name, rows, ""),
            of("uncertainty", name, rows, "-sd"),
            of("prior-bias", name, rows, "-bias"),
        ]
    });
    format!("product = [{}]\n", tables.collect::<Vec<_>>().join(", "))
}

/// Errors of a calibration over their stated standard deviations, and shares of errors within one.
#[derive(Debug)]
struct Errors {
    /// Row time, camera row time, exposure offset, latency, electrons per count, read noise.
    sds: [f64; 6],
    /// Of rows, without their common offset and slope, and of places, without their common offset.
    within: [f64; 2],
}

const PARAMETERS: [&str; 6] =
    ["row time", "camera row time", "exposure offset", "latency", "electrons per count", "read noise"];

fn errors_of(found: &KeptCalibration, sim: &PlaneRig) -> Errors {
    let (timing, light, truth) = (&found.header.timing, &found.header.light, sim.truth());
    let sensor = SimSensor::default();
    let starts_us = sim.row_starts_us().unwrap();
    let [first, end] = timing.seen_rows;
    let late_us = truth.trigger_latency_us - STATED_LATENCY_US;
    let late: Vec<f64> =
        (first..=end).map(|v| found.arrays.row_starts_us[v] - (starts_us[v] - late_us)).collect();
    let tau_us = (starts_us[end] - starts_us[first]) / (end - first) as f64;
    let [rows, columns] = found.header.valid_for.size;
    // The light of the middle camera row: the camera's own row time moves it.
    let middle = rows / 2;
    let place = truth.place(middle, columns / 2) as usize;
    let latency_us =
        late[place - first] - middle as f64 * (timing.camera_row_time_us[0] - truth.camera_row_time_us);
    let of = |[found, sd]: [f64; 2], truth: f64| (found - truth) / sd;

    let middle_row = (first + end) as f64 / 2.0;
    let mean = late.iter().sum::<f64>() / late.len() as f64;
    let slope = zip(first..=end, &late).map(|(v, late)| (v as f64 - middle_row) * (late - mean)).sum::<f64>()
        / (first..=end).map(|v| (v as f64 - middle_row).powi(2)).sum::<f64>();
    // The first modes are the offset and the slope.
    let modes = found.arrays.row_starts_modes.rows();
    let sd_us = |v: usize| modes.clone().into_iter().skip(4).map(|mode| mode[v].powi(2)).sum::<f64>().sqrt();
    let rest =
        zip(first..=end, &late).map(|(v, late)| (late - mean - slope * (v as f64 - middle_row)) / sd_us(v));

    let lit: Vec<(f64, f64)> = found
        .arrays
        .place
        .indexed_iter()
        .filter(|(_, place)| place.is_finite())
        .map(|((t, s), &place)| {
            (f64::from(place) - truth.place(t, s), f64::from(found.arrays.place_sd[[t, s]]))
        })
        .collect();
    let offset = lit.iter().map(|(off, _)| off).sum::<f64>() / lit.len() as f64;
    Errors {
        sds: [
            of(timing.row_time_us, tau_us),
            of(timing.camera_row_time_us, truth.camera_row_time_us),
            of(timing.exposure_offset_us, 0.0),
            latency_us / timing.latency_sd_us,
            of(light.electrons_per_dn, sensor.electrons_per_dn),
            of(light.read_noise_e, sensor.read_noise_e),
        ],
        within: [share(rest), share(lit.iter().map(|(off, sd)| (off - offset) / sd))],
    }
}

/// The share of errors within one standard deviation.
fn share(sds: impl Iterator<Item = f64>) -> f64 {
    let within: Vec<bool> = sds.map(|sds| sds.abs() < 1.0).collect();
    within.iter().filter(|within| **within).count() as f64 / within.len() as f64
}

/// Light, standard deviation and bias of each kind of light, `[t, s]`.
fn measured(session: &Path) -> Vec<[Array2<f32>; 3]> {
    let image =
        |name: &str, end: &str| read_npy(session.join("products").join(format!("{name}{end}.npy"))).unwrap();
    LIGHT.iter().map(|(name, _)| ["", "-sd", "-bias"].map(|end| image(name, end))).collect()
}

fn true_light(sim: &PlaneRig, [from, to]: [i32; 2]) -> Array2<f32> {
    let scene = sim.scene().transport.index_axis(Axis(3), 0).to_owned();
    let rows: Array3<f32> = relative_rows(scene.view(), &(-to..=to));
    let far = rows.axis_iter(Axis(0)).zip(-to..=to).filter(|(_, u)| u.abs() >= from);
    far.fold(Array2::zeros((rows.len_of(Axis(1)), rows.len_of(Axis(2)))), |sum, (row, _)| sum + row)
}

fn print_calibrations(calibrations: &[Errors]) {
    let runs = calibrations.len() as f64;
    println!("calibration: shares within one standard deviation, root mean square, mean");
    for (index, name) in PARAMETERS.iter().enumerate() {
        let sds = calibrations.iter().map(|errors| errors.sds[index]);
        let rms = (sds.clone().map(|sds| sds * sds).sum::<f64>() / runs).sqrt();
        let mean = sds.clone().sum::<f64>() / runs;
        println!("  {name}: {:.2}, {rms:.2}, {mean:.2}", share(sds));
    }
    for (index, name) in ["rows", "places"].iter().enumerate() {
        let mean = calibrations.iter().map(|errors| errors.within[index]).sum::<f64>() / runs;
        println!("  {name}: {mean:.2}");
    }
}

/// A number from the environment.
fn number(name: &str, usual: u64) -> u64 {
    std::env::var(name).map_or(usual, |given| given.parse().unwrap())
}

/// `RUNS` calibrations (400) from seed `FIRST` (1) on: prints shares within one standard deviation, of which 68 % would be
/// right.
#[test]
#[ignore = "hours"]
fn what_calibrations_state_covers() {
    let (first, runs) = (number("FIRST", 1), number("RUNS", 400));
    let unknown = UNKNOWN.replace("JITTER", "5.0");
    let scene = raysweep_tests::data("p2r_corner.npz");
    let of_seed = |seed| {
        let (_bench, rig, found) = calibrated(&scene, &format!("seed = {seed}\n{unknown}"));
        let errors = errors_of(&found, rig.simulated().unwrap());
        println!("{seed}: {errors:.2?}");
        errors
    };
    print_calibrations(&(first..first + runs).map(of_seed).collect::<Vec<_>>());
}

/// `RUNS` pairs of a calibration and a run (50) from seed `FIRST` (1) on, of `PLAN` `sweep` or `edges`: prints shares within
/// one standard deviation, of which 68 % would be right, and of biases within what is stated of them.
#[test]
#[ignore = "an hour"]
fn what_is_stated_covers() {
    let (first, runs) = (number("FIRST", 1), number("RUNS", 50));
    let plan = if std::env::var("PLAN").is_ok_and(|plan| plan == "edges") { EDGES } else { SWEEP };
    let scene = std::env::var_os("SCENE")
        .map_or_else(|| raysweep_tests::data("p2r_corner.npz"), std::path::PathBuf::from);
    let mut calibrations: Vec<Errors> = Vec::new();
    let mut pairs = Vec::new();
    let mut truths = Vec::new();
    for seed in first..first + runs {
        let unknown = UNKNOWN.replace("JITTER", "5.0");
        let (bench, rig, found) = calibrated(&scene, &format!("seed = {seed}\n{unknown}"));
        let sim = rig.simulated().unwrap();
        let errors = errors_of(&found, sim);
        println!("{seed}: {errors:.2?}");
        calibrations.push(errors);
        let ended = bench.run(&format!("{}{plan}", products()));
        assert_eq!(ended.state, "complete", "{:?}", ended.error);
        pairs.push(measured(&ended.session));
        if truths.is_empty() {
            truths = LIGHT.iter().map(|&(_, rows)| true_light(sim, rows)).collect();
        }
    }
    print_calibrations(&calibrations);
    println!(
        "light: within one standard deviation of the mean, of dim pixels, sd over light; within the bias"
    );
    for (index, (name, _)) in LIGHT.iter().enumerate() {
        let mean =
            pairs.iter().fold(Array2::<f32>::zeros(truths[index].raw_dim()), |sum, of| sum + &of[index][0])
                / runs as f32;
        // A measurement is nearer to the mean of all than to the truth.
        let nearer = (1.0 - 1.0 / runs as f32).sqrt();
        let mut levels: Vec<f32> = mean.iter().copied().collect();
        levels.sort_by(f32::total_cmp);
        let [dim, median] = [4, 2].map(|part| levels[levels.len() / part]);
        let (mut all, mut faint, mut widths) = (Vec::new(), Vec::new(), Vec::new());
        for of in &pairs {
            let [light, sd, _] = &of[index];
            for ((light, sd), mean) in light.iter().zip(sd).zip(&mean) {
                let sds = f64::from((light - mean) / sd / nearer);
                widths.push(*sd);
                all.push(sds);
                if *mean < dim {
                    faint.push(sds);
                }
            }
        }
        widths.sort_by(f32::total_cmp);
        let bias = &pairs[0][index][2];
        let mut biased: Vec<f64> = mean
            .iter()
            .zip(&truths[index])
            .zip(bias)
            .map(|((mean, truth), bias)| f64::from((mean - truth) / bias).abs())
            .collect();
        biased.sort_by(f64::total_cmp);
        let mut biases: Vec<f32> = bias.iter().copied().collect();
        biases.sort_by(f32::total_cmp);
        println!(
            "  {name}: {:.2}, {:.2}, {:.3}; {:.2}, {:.3}, {:.1}",
            share(all.into_iter()),
            share(faint.into_iter()),
            widths[widths.len() / 2] / median,
            share(biased.iter().copied()),
            biases[biases.len() / 2] / median,
            biased[biased.len() * 95 / 100]
        );
    }
}
