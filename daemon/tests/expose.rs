//! `raysweep expose`: what it proposes holds on the rig, and nobody else's run suffers from it.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails the test")]

mod daemon;
mod process;
mod program;

use std::io::Read;
use std::path::Path;
use std::process::Stdio;

use nix::sys::signal::Signal;
use process::{Process, wait_for};
use program::Program;
use raysweep::rig::Rig;
use raysweep_core::FinderPicture;
use raysweep_proto::{Event, RunParams, RunState, ViewfinderParams};
use raysweep_sim::scene::Scene;

/// What `expose` proposes for the plan, the exposure of it, and the rig.
fn proposed(program: &Program) -> (serde_json::Value, f64, Rig) {
    let output = program.raysweep(&["--json", "expose", "plan.toml"]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{said} {}", String::from_utf8_lossy(&output.stderr));
    let proposed: serde_json::Value = serde_json::from_str(&said).unwrap();
    let exposure_us = proposed["exposure_us"].as_f64().unwrap();
    (proposed, exposure_us, Rig::load(&program.folder.path().join("rig.toml")).unwrap())
}

/// Share of saturated pixels in 30 pictures of the viewfinder.
fn saturated(program: &mut Program, [exposure_us, delay_us]: [f64; 2]) -> f64 {
    let mut client = program.client();
    let events = program.client().subscribe().unwrap();
    let params = RunParams { plan: "kind = \"viewfinder\"\n".into(), ..RunParams::default() };
    client.run(&params).unwrap();
    wait_for("a picture", || client.status().unwrap().viewfinder);
    let (exposure, delay) = (Some(exposure_us), Some(delay_us));
    let wanted = ViewfinderParams { exposure_us: exposure, delay_us: delay, ..ViewfinderParams::default() };
    client.viewfinder(&wanted).unwrap();
    let shares = events.filter_map(|event| match event.unwrap() {
        Event::Viewfinder(values) if (values.exposure_us, values.delay_us) == (exposure_us, delay_us) => {
            Some(values.saturated)
        }
        _ => None,
    });
    let saturated = shares.take(30).sum::<f64>() / 30.0;
    client.cancel().unwrap();
    wait_for("the end", || client.status().unwrap().state.is_over().then_some(()));
    saturated
}

/// A scene whose white is brighter than the rig file says.
const BRIGHT: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
                      [sim]\nscene = \"mix\"\nscene_rows = 96\nscene_columns = 96\nseed = 9\n[sim.truth]\nwhite_dn = 2800\n";

/// What the sensor makes of the scene in an exposure, from the light alone and the sensor's data: the share of samples
/// above the limit, and the median signal over noise.
fn brute_force(rig: &Rig, delay_us: f64, exposure_us: f64) -> (f64, f64) {
    with_gain(rig, Gain { white_dn: 2800.0, electrons_per_dn: 1.66 }, delay_us, exposure_us)
}

/// Share of a normal distribution above so many standard deviations, to a few percent of it (the upper bound of Komatsu).
fn tail(z: f64) -> f64 {
    let bound = |z: f64| {
        let (pi, square) = (std::f64::consts::PI, z * z);
        (2.0 / pi).sqrt() * (-square / 2.0).exp() / (z + (square + 8.0 / pi).sqrt())
    };
    if z < 0.0 { 1.0 - bound(-z) } else { bound(z) }
}

/// A white pixel's counts above black in one row's time, and what a count stands for.
#[derive(Clone, Copy)]
struct Gain {
    white_dn: f64,
    electrons_per_dn: f64,
}

fn with_gain(rig: &Rig, gain: Gain, delay_us: f64, exposure_us: f64) -> (f64, f64) {
    let Gain { white_dn, electrons_per_dn } = gain;
    let light = rig.simulated().unwrap().noise_free(delay_us, exposure_us).unwrap();
    let signals_e: Vec<f64> =
        light.iter().map(|&light| f64::from(light) * white_dn * electrons_per_dn).collect();
    let noise_e = |e: f64| (81.0 + e).sqrt();
    let limit_e = (0.97 * 4095.0 - 64.0) * electrons_per_dn;
    let above = |e: f64| tail((limit_e - e) / noise_e(e));
    let share = signals_e.iter().map(|&e| above(e)).sum::<f64>() / signals_e.len() as f64;
    let mut ratios: Vec<f64> = signals_e.iter().map(|&e| e / noise_e(e)).collect();
    ratios.sort_by(f64::total_cmp);
    (share, ratios[ratios.len() / 2])
}

#[test]
fn no_exposure_is_proposed_of_a_scene_that_is_not_seen() {
    let program = Program::start(&BRIGHT.replace("white_dn = 2800", "white_dn = 1"));
    program.plan("kind = \"sweep\"\n[sweep]\ndelay_us = [0]\nexposure_us = [100, 1000]\n");
    let output = program.raysweep(&["expose", "plan.toml"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && said.contains("sees hardly any light"), "{said}");
}

#[test]
fn the_proposed_exposure_saturates_nothing_and_is_as_good_as_the_best_of_all() {
    let mut program = Program::start(BRIGHT);
    program.plan("kind = \"sweep\"\nname = \"mine\"\n[sweep]\ndelay_us = [-300, 0, 300]\nexposure_us = [100, 1000, 15000]\n");
    let (proposed, exposure_us, rig) = proposed(&program);
    let (_, ratio) = brute_force(&rig, 0.0, exposure_us);
    let best = (0..=100)
        .map(|step| 100.0 * 150_f64.powf(f64::from(step) / 100.0))
        .map(|us| (us, brute_force(&rig, 0.0, us)))
        .filter(|(_, (share, _))| *share <= 1e-4)
        .max_by(|(_, (_, a)), (_, (_, b))| a.total_cmp(b))
        .unwrap();
    let saturated = saturated(&mut program, [exposure_us, 0.0]);
    println!("{exposure_us} us: {saturated:.1e} saturated, SNR {ratio:.2}; best {best:?}; {proposed}");
    assert!(saturated <= 1e-4, "{saturated} in {exposure_us} us");
    assert!(ratio >= 0.95 * best.1.1, "{ratio} in {exposure_us} us; best {best:?}");
    assert!(best.0 < 14_000.0, "the longest exposure saturates, or nothing was to be found");
    // The plan is whole, and has no longer exposure.
    let plan = proposed["plan"].as_str().unwrap();
    let plan = raysweep_config::Plan::parse(plan).unwrap();
    let raysweep_config::Procedure::Sweep(sweep) = &plan.procedure else { panic!("{plan:?}") };
    let kept = [100.0, 1000.0, 15_000.0].into_iter().filter(|us| *us < exposure_us).chain([exposure_us]);
    assert_eq!((plan.name.as_str(), sweep.exposure_us.values()), ("mine", kept.collect()));
    assert_eq!(proposed["average"], sweep.average);
    assert!(proposed["expected"]["noise"]["median"].as_f64().unwrap() > 0.0);
    // It has left the daemon idle, and says so to people too.
    assert!(String::from_utf8(program.raysweep(&["status"]).stdout).unwrap().contains("idle"));
    program.plan("kind = \"darks\"\n");
    let refused = program.raysweep(&["expose", "plan.toml"]);
    assert!(String::from_utf8(refused.stderr).unwrap().contains("no exposures to choose"));
}

/// The rig with a scene in which its own row lights a pixel so much, and each of five rows, from so many further down on.
fn with_indirect_light(rig: &str, folder: &Path, own: f32, down: usize, each: f32) -> String {
    const ROWS: usize = 96;
    let scene = folder.join("scene.npz");
    let light = |v: usize, t: usize| match v.checked_sub(t) {
        Some(0) => own,
        Some(rows) if (down..down + 5).contains(&rows) => each,
        _ => 0.0,
    };
    let transport = ndarray::Array4::from_shape_fn((ROWS, ROWS, 24, 1), |(v, t, _, _)| light(v, t));
    Scene::from_transport(transport, None).unwrap().save(&scene).unwrap();
    let changed = rig
        .replace("\"mix\"\nscene_rows = 96\nscene_columns = 96", &format!("{:?}", scene.to_str().unwrap()));
    assert_ne!(changed, rig);
    changed
}

/// At delay 0, no exposure of the plan saturates.
#[test]
fn the_proposed_exposure_suits_the_delay_at_which_the_scene_is_brightest() {
    let folder = tempfile::tempdir().unwrap();
    let rig = with_indirect_light(BRIGHT, folder.path(), 0.05, 14, 0.4);
    let program = Program::start(&rig);
    program.plan(
        "kind = \"sweep\"\n[sweep]\ndelay_us = [-355, 0, 355]\nexposure_us = [20, 40, 80, 160, 320, 500]\n",
    );
    let (_, exposure_us, rig) = proposed(&program);
    let share = |delay_us, exposure_us| brute_force(&rig, delay_us, exposure_us).0;
    assert!(share(0.0, 500.0) < 1e-4, "delay 0 tells nothing");
    let shares = [exposure_us, 1.1 * exposure_us].map(|us| share(355.0, us));
    println!("{exposure_us} us: saturated {shares:?}");
    assert!(shares[0] <= 1e-4 && shares[1] > 1e-4, "{shares:?} in {exposure_us} us and a tenth more");
}

#[test]
fn a_scene_that_saturates_in_every_exposure_needs_less_light() {
    let program = Program::start(&BRIGHT.replace("white_dn = 2800", "white_dn = 9000"));
    program.plan("kind = \"sweep\"\n[sweep]\ndelay_us = [-300, 0, 300]\nexposure_us = [600]\n");
    let refused = program.raysweep(&["expose", "plan.toml"]);
    let said = String::from_utf8(refused.stderr).unwrap();
    assert_eq!(refused.status.code(), Some(1), "{said}");
    assert!(
        said.contains("even in the shortest exposure, 150 us") && said.contains("close the aperture"),
        "{said}"
    );
}

/// A rig whose gain is turned up by what `expose` proposes does not saturate, and with a fifth more it would, or a white
/// board would be too bright to be calibrated by.
#[test]
fn the_gain_that_is_proposed_fits() {
    let folder = tempfile::tempdir().unwrap();
    let (of_boards, of_scene) =
        (BRIGHT.to_owned(), with_indirect_light(BRIGHT, folder.path(), 0.05, 14, 0.4));
    for (rig, delay_us, exposure_us, is_scene_the_limit) in
        [(of_boards, 0.0, 200.0, false), (of_scene, 355.0, 500.0, true)]
    {
        let rig_with = |Gain { white_dn, electrons_per_dn }: Gain| {
            let rig = rig.replace("white_dn = 2800", &format!("white_dn = {white_dn:?}"));
            let rig = rig.replace("[camera]\n", &format!("[camera]\nwhite_dn = {white_dn:?}\n"));
            format!("{rig}[sim.sensor]\nelectrons_per_dn = {electrons_per_dn:?}\n")
        };
        let before = Gain { white_dn: 900.0, electrons_per_dn: 1.66 };
        let program = Program::start(&rig_with(before));
        program.plan(&format!(
            "kind = \"sweep\"\n[sweep]\ndelay_us = [{delay_us:?}]\nexposure_us = [{exposure_us:?}]\n"
        ));
        let (answer, tried_us, rig) = proposed(&program);
        assert_eq!(tried_us, exposure_us, "nothing saturates");
        let factor = answer["gain_factor"].as_f64().unwrap();
        let gain = |factor: f64| Gain {
            white_dn: before.white_dn * factor,
            electrons_per_dn: before.electrons_per_dn / factor,
        };
        let share = |factor: f64| with_gain(&rig, gain(factor), delay_us, exposure_us).0;
        let board = |factor: f64| (64.0 + gain(factor).white_dn) / 4095.0;
        println!("{exposure_us} us: {factor}, saturated {:.1e}, board {:.3}", share(factor), board(factor));
        assert!(factor > 1.3 && share(factor) <= 1e-4 && board(factor) <= 0.65 + 1e-9, "{answer}");
        match is_scene_the_limit {
            true => assert!(share(1.2 * factor) > 1e-4 && board(factor) < 0.64),
            false => assert!(board(factor) > 0.64),
        }
        // On the rig itself.
        let mut turned_up = Program::start(&rig_with(gain(factor)));
        let saturated = saturated(&mut turned_up, [exposure_us, delay_us]);
        assert!(saturated <= 1e-4, "{saturated} with {factor} times the gain");
    }
}

/// In which nothing saturates, so that noise decides nothing.
#[test]
fn a_proposal_is_proposed_again_as_it_is() {
    let program = Program::start(&BRIGHT.replace("white_dn = 2800", "white_dn = 900"));
    program.plan("# Mine.\nkind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\nexposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 2\n");
    let proposal = || {
        let output = program.raysweep(&["--quiet", "expose", "plan.toml"]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let settings = |text: &str| {
        let own = text.lines().filter(|line| !line.starts_with("#   "));
        own.map(str::to_owned).collect::<Vec<_>>()
    };
    let first = proposal();
    assert!(!first.contains("average = 2\n"), "another number of frames: {first}");
    program.plan(&first);
    let second = proposal();
    assert_eq!(settings(&first), settings(&second), "{first}\n{second}");
    assert_eq!(
        (second.matches("# Proposed by").count(), second.matches("# Mine.").count()),
        (1, 1),
        "{second}"
    );
}

/// So many delays that it tries them for seconds.
const LONG: &str = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 121 }\nexposure_us = [1000]\n";

#[test]
fn somebody_else_who_changes_the_viewfinder_is_told_of() {
    let mut program = Program::start(BRIGHT);
    program.plan(LONG);
    let mut client = program.client();
    let mut command = program.command(&["--json", "expose", "plan.toml"]);
    let (mut expose, mut output) = Process::with_output(command.stdout(Stdio::piped()).stderr(Stdio::null()));
    wait_for("a picture", || client.status().unwrap().viewfinder);
    let other = FinderPicture::Black;
    // Once: what it asks for afterwards comes with this picture.
    client.viewfinder(&ViewfinderParams { picture: Some(other), ..ViewfinderParams::default() }).unwrap();
    assert!(!expose.wait().success());
    let mut said = String::new();
    output.read_to_string(&mut said).unwrap();
    assert!(said.contains("but of black"), "{said}");
}

/// It was stopped for so long that the daemon ended its viewfinder, and somebody began another one meanwhile.
#[test]
fn a_viewfinder_that_somebody_else_has_begun_goes_on() {
    let mut program = Program::start(BRIGHT);
    program.plan(LONG);
    let mut client = program.client();
    let mut expose =
        Process::start(program.command(&["expose", "plan.toml"]).stdout(Stdio::null()).stderr(Stdio::null()));
    wait_for("a picture", || client.status().unwrap().viewfinder);
    expose.signal(Signal::SIGSTOP);
    wait_for("its end", || client.status().unwrap().state.is_over().then_some(()));
    let plan = "kind = \"viewfinder\"\n[viewfinder]\nexposure_us = 123\n".into();
    let session = client.run(&RunParams { plan, ..RunParams::default() }).unwrap().session;
    wait_for("a picture", || client.status().unwrap().viewfinder);
    expose.signal(Signal::SIGCONT);
    assert!(!expose.wait().success());
    let status = client.status().unwrap();
    assert_eq!((status.state, status.session), (RunState::Running, Some(session)));
    client.cancel().unwrap();
}

/// A film has a single exposure, which is shortened with its delays.
#[test]
fn a_films_exposure_is_shortened() {
    let program = Program::start(BRIGHT);
    program.plan("kind = \"film\"\n[film]\ndelay_us = [-150, 0, 150]\nexposure_us = 400\n");
    let (answer, exposure_us, rig) = proposed(&program);
    let share = brute_force(&rig, 0.0, exposure_us).0;
    assert!(exposure_us < 400.0 && share <= 1e-4, "{share}: {answer}");
    let plan = raysweep_config::Plan::parse(answer["plan"].as_str().unwrap()).unwrap();
    let raysweep_config::Procedure::Film(film) = &plan.procedure else { panic!("{plan:?}") };
    assert_eq!(film.exposure_us, exposure_us);
}

/// A delay at which a shorter exposure misses the own row is moved with the exposure, so that it meets it again.
#[test]
fn delays_that_a_shorter_exposure_moves_are_tried_too() {
    let folder = tempfile::tempdir().unwrap();
    let program = Program::start(&with_indirect_light(BRIGHT, folder.path(), 0.95, 45, 0.1));
    program.plan("kind = \"sweep\"\n[sweep]\ndelay_us = [0]\nexposure_us = [20, 300]\n[[sweep.extra]]\ndelay_us = [560]\nexposure_us = [1200]\n");
    let (answer, exposure_us, rig) = proposed(&program);
    let plan = raysweep_config::Plan::parse(answer["plan"].as_str().unwrap()).unwrap();
    let raysweep_config::Procedure::Sweep(sweep) = &plan.procedure else { panic!("{plan:?}") };
    let [delay_us] = sweep.extra[0].delay_us.values()[..] else { panic!("{sweep:?}") };
    let shares = [560.0, delay_us].map(|delay_us| brute_force(&rig, delay_us, exposure_us).0);
    println!("{exposure_us} us, extra delay {delay_us} us: {shares:?}");
    assert!(exposure_us < 1200.0 && delay_us < 560.0 && shares[1] <= 1e-4, "{shares:?}: {answer}");
}
