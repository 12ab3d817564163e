//! Resonances found again in the movement of a simulated mirror.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use std::f64::consts::TAU;
use std::ops::RangeInclusive;

use raysweep_core::Tilt;
use raysweep_sim::mirror::{Mechanics, MechanicsConfig};

use raysweep_transport::dots::identify::{IdentifyError, Transfer, chirp, direction, identify, transfer};

const RATE_HZ: f64 = 39_000.0;
const BAND: RangeInclusive<f64> = 100.0..=900.0;

/// What a simulated mirror measures when it is commanded a chirp, x and y.
fn measure(config: MechanicsConfig, noise_deg: f64) -> (Vec<f64>, [Vec<f64>; 2]) {
    let commanded = chirp(&BAND, 0.1, 0.8, 0.3, RATE_HZ);
    let mut mechanics = Mechanics::new(config, RATE_HZ);
    let mut noise = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut uniform = || (noise.next_u64() >> 11) as f64 / (1_u64 << 53) as f64 - 0.5;
    let mut measured = [Vec::new(), Vec::new()];
    for &command in &commanded {
        let moved = mechanics.hold(Tilt::new(command, command)).deg();
        (0..2).for_each(|axis| measured[axis].push(moved[axis] + noise_deg * uniform()));
    }
    (commanded, measured)
}

#[test]
fn resonances_are_found_again_through_the_controllers_filter_and_noise() {
    let config = MechanicsConfig { filter_hz: 5000.0, q: [30.0, 12.0], ..Default::default() };
    for (noise_deg, tolerance) in [(0.0, 0.01), (0.05, 0.03)] {
        let (commanded, measured) = measure(config, noise_deg);
        for (axis, measured) in measured.iter().enumerate() {
            let found = identify(&commanded, measured, RATE_HZ, &BAND).unwrap();
            let (f0, q) = (found.resonance.f0_hz / config.f0_hz[axis], found.resonance.q / config.q[axis]);
            assert!((f0 - 1.0).abs() < tolerance / 10.0, "axis {axis}: {found:?}");
            assert!((q - 1.0).abs() < 2.0 * tolerance && (found.gain - 1.0).abs() < tolerance, "{found:?}");
            // The Bessel filter's delay at low frequencies, and half a sample of holding.
            let delay_s = 2.703_395 / (TAU * 5000.0) - 0.5 / RATE_HZ;
            assert!((found.delay_s - delay_s).abs() < 0.5 / RATE_HZ, "{} against {delay_s}", found.delay_s);
        }
    }
}

#[test]
fn a_low_filter_hides_no_resonance_and_a_mirrored_axis_has_a_negative_gain() {
    // The filter takes nine tenths of the movement at the resonance, and bends the rest of the band.
    let config = MechanicsConfig { filter_hz: 200.0, q: [30.0, 20.0], ..Default::default() };
    let (commanded, measured) = measure(config, 0.002);
    for (axis, measured) in measured.iter().enumerate() {
        let mirrored: Vec<f64> = measured.iter().map(|deg| -deg).collect();
        let found = identify(&commanded, &mirrored, RATE_HZ, &BAND).unwrap();
        let (f0, q) = (found.resonance.f0_hz / config.f0_hz[axis], found.resonance.q / config.q[axis]);
        assert!((f0 - 1.0).abs() < 0.01 && (q - 1.0).abs() < 0.05, "axis {axis}: {found:?}");
        let [low_hz, high_hz] = found.band_hz;
        assert!(high_hz - low_hz < 0.5 * found.resonance.f0_hz, "not the whole band: {found:?}");
    }
    let config = MechanicsConfig { filter_hz: 5000.0, ..Default::default() };
    let (commanded, [x, _]) = measure(config, 0.0);
    let mirrored: Vec<f64> = x.iter().map(|deg| -2.0 * deg).collect();
    let found = identify(&commanded, &mirrored, RATE_HZ, &BAND).unwrap();
    assert!((found.gain / -2.0 - 1.0).abs() < 0.01 && found.delay_s < 0.001, "{found:?}");
    for Transfer { hz, amplitude, .. } in transfer(&commanded, &mirrored, RATE_HZ, &BAND).unwrap() {
        let fitted = found.at(hz).amplitude;
        assert!((amplitude / fitted - 1.0).abs() < 0.1, "{amplitude}, fitted {fitted} at {hz} Hz");
    }
}

#[test]
fn a_track_moves_along_its_line_whatever_drifts() {
    let (_, [x, _]) = measure(MechanicsConfig { filter_hz: 5000.0, ..Default::default() }, 0.0);
    let (sin, cos) = 0.3_f64.sin_cos();
    let a: Vec<f64> = x.iter().map(|x| cos * x).collect();
    let b: Vec<f64> = x.iter().enumerate().map(|(n, x)| sin * x + 1e-5 * n as f64).collect();
    let [along_a, along_b] = direction([&a, &b], RATE_HZ, &BAND);
    assert!((along_b / along_a - sin / cos).abs() < 0.02, "{along_a} {along_b}");
}

#[test]
fn what_is_no_resonator_is_refused() {
    let (commanded, _) = measure(MechanicsConfig::default(), 0.0);
    let still = vec![0.0; commanded.len()];
    assert!(matches!(identify(&commanded, &still, RATE_HZ, &BAND), Err(IdentifyError::Still { .. })));
    assert!(matches!(identify(&still, &commanded, RATE_HZ, &BAND), Err(IdentifyError::Still { .. })));
    assert!(matches!(
        identify(&commanded, &commanded[1..], RATE_HZ, &BAND),
        Err(IdentifyError::Lengths { .. })
    ));
    let wrong = 900.0..=100.0;
    assert!(matches!(identify(&commanded, &commanded, RATE_HZ, &wrong), Err(IdentifyError::Band { .. })));
    // A mirror that is where it is commanded to be, and one whose resonance lies above the band.
    let exact = identify(&commanded, &commanded, RATE_HZ, &BAND);
    assert!(matches!(exact, Err(IdentifyError::NoResonance { .. })), "{exact:?}");
    let config = MechanicsConfig { filter_hz: 5000.0, f0_hz: [1500.0, 1500.0], ..Default::default() };
    let (commanded, [x, _]) = measure(config, 0.0);
    let above = identify(&commanded, &x, RATE_HZ, &BAND);
    assert!(matches!(above, Err(IdentifyError::NoResonance { .. })), "{above:?}");
    let nonsense: Vec<f64> = (0..commanded.len()).map(|n| ((n * n * 7919) % 1013) as f64 / 1013.0).collect();
    assert!(identify(&commanded, &nonsense, RATE_HZ, &BAND).is_err());
}
