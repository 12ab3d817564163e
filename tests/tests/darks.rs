//! `kind = "darks"` on the simulated rig: noise, pattern and dark current as the sensor has them, resumed and made
//! again.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::path::Path;

use raysweep_tests::{Bench, rig_text};

const PLAN: &str = "kind = \"darks\"\n[darks]\nexposure_us = [1000, 15000]\nframes = 8\n";
const SENSOR: &str =
    "[sim.sensor]\nread_noise_e = 6\ndsnu_e = 4\nhot_pixels = 0.004\ndark_current_e_per_s = 200\n";

/// The rows of a table of numbers, without its header.
fn table(session: &Path, name: &str) -> Vec<Vec<f64>> {
    let text = fs::read_to_string(session.join("products").join(name)).unwrap();
    let numbers = |line: &str| line.split(',').map(|number| number.parse().unwrap()).collect();
    text.lines().skip(1).map(numbers).collect()
}

#[test]
fn the_sensor_is_found_again() {
    let bench = Bench::new(&rig_text(720, "scene_rows = 96\nscene_columns = 128", SENSOR));
    let ended = bench.run(PLAN);
    assert_eq!((ended.state.as_str(), ended.open().1.stored_points()), ("complete", 4), "{:?}", ended.error);
    let levels = table(&ended.session, "darks.csv");
    assert_eq!(levels.len(), 2);
    let pixels = 96.0 * 128.0;
    for level in &levels {
        let [exposure_us, mean_dn, noise_dn, _, hot] = level[..] else { panic!("{level:?}") };
        // 1.66 electrons a count, 64 counts of black; 50,000 electrons/s of a hot pixel, 200 of the others.
        let hot_dn = 0.004 * 50_000.0 * exposure_us * 1e-6 / 1.66;
        let expected_dn = 64.0 + 200.0 * exposure_us * 1e-6 / 1.66 + hot_dn;
        assert!((mean_dn - expected_dn).abs() < 0.3, "{mean_dn} against {expected_dn} DN");
        // Rounding to counts adds a twelfth.
        let electrons = 36.0 + 200.0 * exposure_us * 1e-6 + 0.004 * 50_000.0 * exposure_us * 1e-6;
        let expected_dn = (electrons / 1.66_f64.powi(2) + 1.0 / 12.0).sqrt();
        assert!((noise_dn / expected_dn - 1.0).abs() < 0.05, "{noise_dn} against {expected_dn} DN");
        if exposure_us > 10_000.0 {
            assert!((hot / (0.004 * pixels) - 1.0).abs() < 0.5, "{hot} hot pixels");
        }
    }
    // Without the hot pixels' part: 4 electrons.
    assert!((levels[0][3] / (4.0 / 1.66) - 1.0).abs() < 0.3, "{levels:?}");

    let before = fs::read(ended.session.join("products/dark.npy")).unwrap();
    let processed = raysweep_processing::process(&ended.session).unwrap();
    assert_eq!((processed.stored, processed.problems.len()), (4, 0));
    assert_eq!(fs::read(ended.session.join("products/dark.npy")).unwrap(), before);
    let page = fs::read_to_string(processed.report).unwrap();
    assert!(page.contains("Dark images") && page.contains("hot pixels"));
}

#[test]
fn what_is_missing_is_acquired_again() {
    let bench = Bench::new(&rig_text(720, "scene_rows = 16\nscene_columns = 16", SENSOR));
    let whole = bench.run(PLAN);
    let ledger = whole.session.join("ledger.jsonl");
    let dark = fs::read(whole.session.join("products/dark.npy")).unwrap();
    let lines: Vec<String> = fs::read_to_string(&ledger).unwrap().lines().map(str::to_owned).collect();
    let second = lines.iter().position(|line| line.contains("\"index\":1")).unwrap();
    fs::write(&ledger, lines[..=second].join("\n") + "\n").unwrap();
    let resumed = bench.resume(&whole.session);
    assert_eq!(
        (resumed.state.as_str(), resumed.open().1.stored_points()),
        ("complete", 4),
        "{:?}",
        resumed.error
    );
    assert_eq!(fs::read(whole.session.join("products/dark.npy")).unwrap(), dark);

    // What is damaged is named, and acquired again too.
    fs::write(whole.session.join("stack.zarr/dark/c.3.0.0"), b"nothing of this kind").unwrap();
    let refused = raysweep_processing::process(&whole.session).unwrap_err().to_string();
    assert!(refused.contains("dark 3 is damaged"), "{refused}");
    assert_eq!(fs::read(whole.session.join("products/dark.npy")).unwrap(), dark);
    assert_eq!(bench.resume(&whole.session).state, "complete");
    assert_eq!(raysweep_processing::process(&whole.session).unwrap().problems, [""; 0]);
}
