//! One suite for all mirror drivers, with simulated controllers and faults of their wires.

use raysweep_core::{Mirror, MirrorPath};
use raysweep_drivers::mirror::{Mti, Optotune, OptotuneConfig};
use raysweep_sim::mirror::{
    Held, MechanicsConfig, MirrorPty, OptotuneController, PlayzerXControllerConfig, SerialLink, WireFaults,
};

use crate::points::{Lamp, assert_points, mti_config, mti_rig, rig};
use crate::rig::{LIMITS, Rig, codes};
use crate::suite::{BATCHES, mirror_conforms};

const FAULTS: WireFaults = WireFaults { seed: 5, garbage: 0.05, stalls: 0.0, stall_ms: 0 };

/// Runs the suite; the mirror must end parked and stay dark all the time.
fn conforms(rig: &Rig, mut mirror: impl Mirror) -> (MirrorPath, Vec<Held>) {
    let path = mirror_conforms(&mut mirror, 5_000.0);
    drop(mirror);
    rig.assert_parked();
    let truth = rig.pty.truth();
    assert_eq!((truth.underruns, truth.overfills), (0, 0));
    assert!(truth.held.iter().all(|held| held.light == 0));
    (path, truth.held)
}

#[test]
fn playzerx() {
    for faults in [WireFaults::default(), FAULTS] {
        let rig = Rig::playzerx(PlayzerXControllerConfig::default(), faults);
        let (path, held) = conforms(&rig, rig.open());
        let codes = codes(&path).repeat(BATCHES as usize);
        assert!(held.windows(codes.len()).any(|window| window == codes), "the path is not what was played");
    }
}

#[test]
fn mti() {
    for faults in [WireFaults::default(), FAULTS] {
        let rig = mti_rig(faults);
        let config = mti_config(rig.pty.path().to_owned(), rig.state(), rig.armed());
        let (path, held) = conforms(&rig, Mti::open(config).unwrap());
        assert_points(&held, &path, BATCHES as usize, |deg| deg / 6.5, 0);
    }
}

#[test]
fn optotune() {
    for faults in [WireFaults::default(), FAULTS] {
        let mechanics =
            MechanicsConfig { max_tilt: raysweep_core::MechanicalDeg(25.0), ..Default::default() };
        let link = SerialLink::Uart { baud: 256_000 };
        let rig = rig(MirrorPty::plug(OptotuneController::new(mechanics), link, faults).unwrap());
        let port = rig.pty.path().to_owned();
        let (state, light) = (rig.state(), rig.armed());
        let config = OptotuneConfig { port, laser_port: None, limits: LIMITS, state, light };
        let lamp = Lamp::default();
        let (path, held) = conforms(&rig, Optotune::open(config, Box::new(lamp.clone())).unwrap());
        let coordinate = |deg: f64| (2.0 * deg).to_radians().tan() / 50.0_f64.to_radians().tan();
        assert_points(&held, &path, BATCHES as usize, coordinate, 0);
        assert!(!lamp.was_lit());
    }
}
