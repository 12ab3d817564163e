//! Films of moving scenes, through the daemon's core in virtual time: each frame matches its setting and time, each
//! cycle's transport matches the scene at that time, and a loss affects only its own cycle.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use ndarray::{Array2, Array3, Axis, s};
use raysweep::Runner;
use raysweep::control::Control;
use raysweep::live::{EPIPOLAR, INDIRECT, LiveFile, LiveReader};
use raysweep::rig::Rig;
use raysweep_config::RigFile;
use raysweep_core::{FilmSummary, LossCause, PixelFormat};
use raysweep_processing as process;
use raysweep_proto::{ErrorCode, Event, ResumeParams, RunParams, RunState};
use raysweep_session::film::{CycleEntry, TransportFilm};
use raysweep_session::manifest;
use raysweep_sim::{PlaneRig, PlaneSetup};
use raysweep_tests::{Bench, Ended, HUNG, data, end_of, next_event, rig_text};
use raysweep_transport::plane::relative_rows;
use raysweep_transport::quality::median_profile_error;

const ROWS: usize = 24;
const COLUMNS: usize = 16;
const PERIOD_NS: i64 = 16_666_667;

fn plan(cycles: u32) -> String {
    format!("kind = \"film\"\n[film]\ncycles = {cycles}\n")
}

/// A pendulum with a period of `swing_s` (there and back), without sensor noise but with jitter.
fn rig(swing_s: f64, more: &str) -> String {
    let sim = format!(
        "scene = \"pendulum\"\nscene_rows = {ROWS}\nscene_columns = {COLUMNS}\nseed = 5\nmotion_period_s = {swing_s}"
    );
    rig_text(720, &sim, &format!("[sim.sensor]\nnoise = false\n{more}"))
}

fn truth(rig_toml: &str) -> PlaneRig {
    let rig = RigFile::parse(rig_toml).unwrap();
    let setup = PlaneSetup {
        raster: rig.raster(),
        camera_row_time_us: rig.camera_row_time_us(),
        row_pitch: 1.0,
        white_dn: rig.camera.white_dn(),
        black_dn: rig.camera.black_dn(),
        format: PixelFormat::Mono12,
        first_row: None,
    };
    PlaneRig::new(rig.sim, setup, Path::new("")).unwrap()
}

/// All frames of the stored cycles: time in VSYNC periods after the first frame, true delay, and counts above black. A
/// cycle steps through its settings in descending order, one per period.
fn frames(ended: &Ended) -> Vec<(i64, f64, Array2<f32>)> {
    let (session, state) = ended.open();
    let film = session.film().unwrap();
    let mut frames = Vec::new();
    for CycleEntry { cycle, start_s, delays_us, .. } in state.cycles() {
        let raw: Array3<u16> = film.read(*cycle).unwrap().unwrap();
        let first = (start_s * 1e9 / PERIOD_NS as f64).round() as i64;
        for (setting, (frame, &delay_us)) in raw.outer_iter().zip(delays_us).enumerate() {
            let period = first + (delays_us.len() - 1 - setting) as i64;
            frames.push((period, delay_us, frame.mapv(|counts| f32::from(counts) - 64.0)));
        }
    }
    frames
}

/// Largest deviation, in counts, of a frame from the light at a given time.
fn deviation(truth: &PlaneRig, time_ns: i64, delay_us: f64, frame: &Array2<f32>) -> f32 {
    // Evaluate the light in the middle of its frame, because its edge jitters.
    let light = truth.noise_free_at(time_ns, delay_us, 600.0).unwrap() * 2500.0;
    (frame - &light.mapv(|dn| dn.min(4095.0 - 64.0))).iter().fold(0.0, |most, off| off.abs().max(most))
}

/// Time of the film's first frame on the devices' clock: the only time at which all frames match the scene.
fn film_start_ns(truth: &PlaneRig, frames: &[(i64, f64, Array2<f32>)]) -> i64 {
    let is_true = |start: i64| {
        frames.iter().all(|(period, delay_us, frame)| {
            deviation(truth, (start + period) * PERIOD_NS, *delay_us, frame) < 2.0
        })
    };
    let starts: Vec<i64> = (0..120).filter(|&start| is_true(start)).collect();
    let (Some(first), Some(last)) = (starts.first(), starts.last()) else {
        panic!("no moment makes every frame the frame of its setting")
    };
    assert!(last - first < 12, "several moments would do: {starts:?}");
    (first + last) / 2 * PERIOD_NS
}

#[test]
fn every_frame_is_that_of_its_setting_and_its_moment_and_every_trigger_is_answered() {
    // A key position of the scene lasts 4 frames, so a cycle of 15 frames covers several.
    let rig = rig(2.1, "");
    let bench = Bench::new(&rig);
    let ended = bench.run(&plan(6));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (_, state) = ended.open();
    assert_eq!(state.cycles().count(), 6);
    assert_eq!(state.counts.lost_total(), 0, "{:?}", state.counts);
    for cycle in state.cycles() {
        assert_eq!(cycle.counts.averaged, 15);
        let expected_s = cycle.cycle as f64 * 15.0 * PERIOD_NS as f64 * 1e-9;
        assert!((cycle.start_s - expected_s).abs() < 1e-3, "a cycle a quarter of a second, without pause");
    }
    film_start_ns(&truth(&rig), &frames(&ended));
    let film = state.film.unwrap();
    assert_eq!((film.cycles_stored, film.transports, film.transports_missing), (6, 6, 0));
    assert!((film.cycles_per_s.unwrap() - 4.0).abs() < 0.01 && film.latency_ms.is_none());
}

#[test]
fn settings_that_take_effect_frames_later_are_written_ahead() {
    for late in [1, 2, 3] {
        let rig = rig(2.1, &format!("[sim.camera]\nlate_frames_min = {late}\nlate_frames_max = {late}\n"));
        let bench = Bench::new(&rig);
        let ended = bench.run(&plan(3));
        let (_, state) = ended.open();
        assert_eq!(state.cycles().count(), 3);
        let starts: Vec<f64> = state.cycles().map(|cycle| cycle.start_s).collect();
        assert!((starts[2] - 0.5).abs() < 1e-3, "{late} frames late: {starts:?}");
        film_start_ns(&truth(&rig), &frames(&ended));
    }
}

#[test]
fn settings_that_take_effect_no_one_knows_when_cost_time_and_nothing_else() {
    let rig = rig(60.0, "[sim.camera]\nlate_frames_max = 2\n");
    let bench = Bench::new(&rig);
    let ended = bench.run(&plan(2));
    let (_, state) = ended.open();
    assert_eq!((state.cycles().count(), state.counts.lost_total()), (2, 0));
    let truth = truth(&rig);
    for (_, delay_us, frame) in frames(&ended) {
        // The scene is almost at rest; its key position does not matter here.
        let off = (0..16).map(|key| deviation(&truth, key * 1_900_000_000, delay_us, &frame));
        assert!(off.fold(f32::INFINITY, f32::min) < 2.0, "{delay_us} us");
    }
}

#[test]
fn the_transport_of_a_cycle_is_the_scenes_at_that_time() {
    // Slow enough that a cycle covers one key position or two neighbouring ones.
    let rig = rig(24.0, "");
    let bench = Bench::new(&rig);
    let ended = bench.run(&plan(40));
    let (session, state) = ended.open();
    let truth = truth(&rig);
    let start_ns = film_start_ns(&truth, &frames(&ended));
    let transports = TransportFilm::open(&session.transport_film_path()).unwrap();
    let u_min = transports.attributes()["u_min"].as_i64().unwrap();
    let direct_at = |time_ns: i64| {
        let scene = &truth.scene_at(time_ns).transport;
        Array2::from_shape_fn((ROWS, COLUMNS), |(t, s)| scene[[t, t, s, 0]])
    };
    let distance = |a: &Array2<f32>, b: &Array2<f32>| {
        let norm = |x: &Array2<f32>| x.iter().map(|x| x * x).sum::<f32>().sqrt();
        norm(&(a - b)) / norm(b)
    };
    for cycle in state.cycles() {
        let transport = transports.read(cycle.cycle).unwrap().unwrap().t;
        let epipolar = transport.slice(s![-u_min as usize, .., ..]).to_owned();
        let middle_ns = start_ns + ((cycle.start_s + 0.12) * 1e9) as i64;
        let own = distance(&epipolar, &direct_at(middle_ns));
        // Half a swing later the ball is elsewhere.
        let other = distance(&epipolar, &direct_at(middle_ns + 6_000_000_000));
        assert!(own < 0.1 && own < other, "cycle {}: {own} of its own time, {other} of another", cycle.cycle);
    }
}

#[test]
fn a_lost_frame_costs_its_own_cycle_and_is_counted_with_its_cause() {
    let late = "late_frames_min = 2\nlate_frames_max = 2\n";
    let rig = rig(60.0, &format!("[sim.camera]\n{late}dropped = 0.02\n[sim.vsync]\nunseen = 0.01\n"));
    let bench = Bench::new(&rig);
    let mut events = bench.runner.events();
    bench.runner.run(RunParams { plan: plan(20), ..RunParams::default() }).unwrap();
    let mut lost_events = 0;
    let (session, film) = loop {
        match events.blocking_recv() {
            Ok(Event::Lost { .. }) => lost_events += 1,
            Ok(Event::Finished { session, film, state, .. }) => {
                assert_eq!(state, "complete");
                break (session, film.unwrap());
            }
            Ok(_) | Err(tokio::sync::broadcast::error::RecvError::Lagged(_)) => {}
            Err(error) => panic!("{error}"),
        }
    };
    let ended = Ended { session, state: "complete".into(), error: None };
    let (_, state) = ended.open();
    assert!(state.counts.balanced(), "{:?}", state.counts);
    let lost = &state.counts.lost;
    assert!(
        lost.contains_key(&LossCause::CameraGap) && lost.contains_key(&LossCause::EdgeMissing),
        "{lost:?}"
    );
    assert!(film.cycles_incomplete > 0 && film.cycles_stored > 5 && lost_events > 0, "{film:?}");
    assert_eq!(film.cycles_stored + film.cycles_incomplete, 20);
    let ledger = std::fs::read_to_string(ended.session.join("ledger.jsonl")).unwrap();
    let incomplete: Vec<&str> = ledger.lines().filter(|line| line.contains("\"cycle_lost\"")).collect();
    assert_eq!(incomplete.len(), film.cycles_incomplete);
    assert!(incomplete.iter().all(|line| !line.contains("\"missing\":[]")), "{incomplete:?}");
    // All other cycles are unaffected.
    let truth = truth(&rig);
    for (_, delay_us, frame) in frames(&ended) {
        let off = (0..16).map(|key| deviation(&truth, key * 1_900_000_000, delay_us, &frame));
        assert!(off.fold(f32::INFINITY, f32::min) < 2.0, "{delay_us} us");
    }
    for cycle in state.cycles() {
        assert!(
            cycle
                .delays_us
                .iter()
                .zip(0..)
                .all(|(delay_us, place)| { (delay_us - state_delay_us(place)).abs() < 50.0 })
        );
    }
}

fn state_delay_us(setting: usize) -> f64 {
    let delays_us = [-1500, -1000, -640, -420, -333, -311, -289, 0, 289, 311, 333, 420, 640, 1000, 1500];
    f64::from(delays_us[setting])
}

#[test]
fn a_cancelled_film_is_a_short_one() {
    let bench = Bench::new(&rig(4.0, ""));
    let mut events = bench.runner.events();
    bench.runner.run(RunParams { plan: plan(5000), ..RunParams::default() }).unwrap();
    wait_for(&bench, |film| film.transports >= 2);
    bench.runner.cancel().unwrap();
    let ended = end_of(&mut events);
    assert_eq!(ended.state, "cancelled");
    let (session, state) = ended.open();
    assert!(state.counts.balanced(), "{:?}", state.counts);
    let stored = state.cycles().count();
    assert!((2..5000).contains(&stored));
    assert_eq!(state.film.as_ref().unwrap().transports, stored, "what waited for the solver is solved");
    let differences = manifest::verify(&session).unwrap();
    assert!(differences.is_empty(), "{differences:?}");
    let report = std::fs::read_to_string(session.report_path()).unwrap();
    assert!(report.contains("epipolar") && report.contains("indirect"), "the report shows some cycles");

    let refused = bench.runner.resume(ResumeParams { session: ended.session.clone() }).unwrap_err();
    assert_eq!(refused.name(), Some(ErrorCode::NoSession));
}

#[test]
fn processing_a_film_again_gives_the_same_bits_and_names_what_is_damaged() {
    let bench = Bench::new(&rig(4.0, ""));
    // The last two cycles are solved by what the first four showed.
    let ended = bench.run(&plan(6));
    let folder = ended.session.join("transport_film.zarr");
    let learned = || {
        let page = std::fs::read_to_string(ended.session.join("report.html")).unwrap();
        let start = page.find("How the cycles were demultiplexed").unwrap();
        page[start..start + page[start..].find("Pace").unwrap()].to_owned()
    };
    let said = learned();
    assert!(said.contains("noise of a frame") && said.contains("prior"), "{said}");
    let files = |folder: &Path| {
        let files = std::fs::read_dir(folder.join("transport")).unwrap().map(|file| file.unwrap().path());
        let mut files: Vec<_> = files.map(|path| (path.clone(), std::fs::read(path).unwrap())).collect();
        files.sort();
        files
    };
    let before = files(&folder);
    assert_eq!(before.len(), 7, "six cycles and the metadata");
    std::fs::remove_dir_all(&folder).unwrap();
    let processed = process::process(&ended.session).unwrap();
    assert_eq!((processed.stored, processed.points, processed.problems), (6, 6, Vec::new()));
    assert!(files(&folder) == before, "the bits differ");
    assert_eq!(learned(), said);

    let shard = ended.session.join("film.zarr/film/c.2.0.0.0");
    let mut bytes = std::fs::read(&shard).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(&shard, bytes).unwrap();
    let refused = process::process(&ended.session).unwrap_err().to_string();
    assert!(refused.contains("cycle 2 is damaged") && files(&folder) == before, "{refused}");
    let accepting = process::Asked { accept_damage: true, ..process::Asked::default() };
    let processed = process::process_asked(&ended.session, &accepting).unwrap();
    assert_eq!((processed.stored, processed.points), (5, 6));
    assert!(
        processed.problems.iter().any(|what| what.contains("cycle 2 is damaged")),
        "{:?}",
        processed.problems
    );
    let transports = TransportFilm::open(&folder).unwrap();
    assert!(transports.read(2).unwrap().is_none() && transports.read(3).unwrap().is_some());
}

#[test]
fn the_views_of_a_film_are_in_the_live_file() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig(4.0, "")).unwrap();
    let loaded = Rig::load(&folder.path().join("rig.toml")).unwrap();
    let path = folder.path().join("live");
    let runner = Runner::new(loaded, folder.path().join("sessions")).unwrap();
    let runner = runner.with_live(LiveFile::create(&path).unwrap());
    let mut events = runner.events();
    runner.run(RunParams { plan: plan(3), ..RunParams::default() }).unwrap();
    let ended = end_of(&mut events);
    let (session, _) = ended.open();
    let last = TransportFilm::open(&session.transport_film_path()).unwrap().read(2).unwrap().unwrap().t;
    let reader = LiveReader::open(&path).unwrap();
    let shown = |name: &str| reader.newest(name).unwrap().unwrap();
    let indirect = shown(INDIRECT);
    assert_eq!(indirect.metadata["cycle"], 2);
    let sum = |image: &ndarray::ArrayD<f32>| image.iter().map(|&x| f64::from(x)).sum::<f64>();
    let total = last.sum_axis(Axis(0)).iter().map(|&x| f64::from(x)).sum::<f64>();
    assert!((sum(&indirect.image) + sum(&shown(EPIPOLAR).image) - total).abs() < 1e-4 * total);
}

#[test]
fn check_says_how_many_transports_a_second_the_camera_allows() {
    let check = |more: &str| Bench::new(&rig(4.0, more)).runner.check(&plan(240)).unwrap();
    let free = check("");
    let film = free.film.unwrap();
    assert_eq!((film.settings, film.cycles, film.periods_per_cycle), (15, 240, 15));
    assert!((film.transports_per_s - 4.0).abs() < 0.001);
    assert_eq!((free.points, free.extra_points, free.frames), (240, 1, 240 * 15 + 32));
    // Per pixel: 15 frames of 2 bytes, and per row of the transport 4 bytes and 1 of the mask.
    let (first_row, last_row) = free.reach_rows.unwrap();
    let reach = f64::from(last_row - first_row + 1);
    let minute = 240.0 * (ROWS * COLUMNS) as f64 * (30.0 + 5.0 * reach);
    assert!((film.disk_bytes_per_minute as f64 / minute - 1.0).abs() < 0.001);
    let held = check("[sim.camera]\nreadout = \"overlapped\"\nreadout_us = 16_100\n").film.unwrap();
    assert_eq!(held.periods_per_cycle, 15, "downwards no trigger is missed");
    let slow = check("[sim.camera]\nreadout = \"overlapped\"\nreadout_us = 16_500\n").film.unwrap();
    assert_eq!(slow.periods_per_cycle, 16);
    assert!((slow.transports_per_s - 3.75).abs() < 0.001 && slow.reason.contains("readout"), "{slow:?}");
    let sequential = check("[sim.camera]\nreadout_us = 16_100\n").film.unwrap();
    assert!((sequential.transports_per_s - 2.0).abs() < 0.001 && sequential.reason.contains("15 triggers"));
}

#[test]
fn a_camera_with_a_long_readout_keeps_the_pace_that_check_foretells() {
    // If a trigger is missed and frames arrive after the next trigger, the clock tells which trigger a frame belongs
    // to.
    for (readout_us, periods) in [(16_100, 15), (16_500, 16)] {
        let rig = rig(60.0, &format!("[sim.camera]\nreadout = \"overlapped\"\nreadout_us = {readout_us}\n"));
        let bench = Bench::new(&rig);
        let ended = bench.run(&plan(3));
        let (_, state) = ended.open();
        let counts = &state.counts;
        assert_eq!((state.cycles().count(), counts.lost_total()), (3, 0), "{counts:?}");
        let starts: Vec<f64> = state.cycles().map(|cycle| cycle.start_s).collect();
        let cycle_s = f64::from(periods) * PERIOD_NS as f64 * 1e-9;
        assert!((starts[2] - 2.0 * cycle_s).abs() < 1e-3, "{readout_us} us: {starts:?}");
    }
}

/// Waits until the current film has reached a state.
fn wait_for(bench: &Bench, is_reached: impl Fn(&FilmSummary) -> bool) {
    let began = Instant::now();
    while !bench.runner.status().film.is_some_and(|film| is_reached(&film)) {
        assert!(began.elapsed() < HUNG, "{:?}", bench.runner.status());
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_film_is_held_between_two_cycles_and_goes_on() {
    for more in ["", "[sim.camera]\nlate_frames_min = 2\nlate_frames_max = 2\n"] {
        let rig = rig(60.0, more);
        let bench = Bench::new(&rig);
        let mut events = bench.runner.events();
        bench.runner.run(RunParams { plan: plan(400), ..RunParams::default() }).unwrap();
        for cycles in [3, 9] {
            wait_for(&bench, |film| film.transports >= cycles);
            bench.runner.pause().unwrap();
            // Work in progress is completed, however long that takes; then nothing more arrives.
            let mut held = bench.runner.status().film;
            let mut since = Instant::now();
            let under_way = |film: &FilmSummary| film.transports < film.cycles_stored;
            while since.elapsed() < Duration::from_millis(300) || held.as_ref().is_some_and(under_way) {
                assert!(since.elapsed() < HUNG, "{held:?}");
                std::thread::sleep(Duration::from_millis(20));
                let now = bench.runner.status().film;
                if now != held {
                    (held, since) = (now, Instant::now());
                }
            }
            assert_eq!(bench.runner.status().state, RunState::Paused);
            let held = held.unwrap();
            assert_eq!((held.transports, held.cycles_incomplete), (held.cycles_stored, 0));
            assert!(held.cycles_stored < 400, "{held:?}");
            bench.runner.go_on().unwrap();
            wait_for(&bench, |film| film.transports > held.transports);
        }
        bench.runner.cancel().unwrap();
        let ended = end_of(&mut events);
        assert_eq!(ended.state, "cancelled");
        let (_, state) = ended.open();
        assert!(state.counts.balanced() && state.counts.lost_total() == 0, "{:?}", state.counts);
        let ledger = std::fs::read_to_string(ended.session.join("ledger.jsonl")).unwrap();
        assert!(!ledger.contains("\"cycle_lost\""), "{ledger}");
        let truth = truth(&rig);
        for (_, delay_us, frame) in frames(&ended) {
            let off = (0..16).map(|key| deviation(&truth, key * 1_900_000_000, delay_us, &frame));
            assert!(off.fold(f32::INFINITY, f32::min) < 2.0, "{delay_us} us");
        }
    }
}

#[test]
fn between_its_cycles_a_film_shows_sliding_estimates_where_there_is_time() {
    // A solver that takes a few ms, and a line so slow that a cycle takes one and a half seconds of real time, so that
    // there is enough time even on a busy machine.
    let rig = rig(60.0, "")
        .replace("seed = 5", "seed = 5\nrealtime = true")
        .replace("[vsync]\ndriver = \"sim\"\n", "[vsync]\ndriver = \"sim\"\nperiod_us = 100_000\n");
    assert!(rig.contains("period_us"), "{rig}");
    let bench = Bench::new(&rig);
    let mut events = bench.runner.events();
    bench.runner.run(RunParams { plan: plan(4000), ..RunParams::default() }).unwrap();
    wait_for(&bench, |film| film.sliding_estimates >= 3 && film.transports >= 2);
    bench.runner.cancel().unwrap();
    let (mut sliding, mut whole) = (0, 0);
    let session = loop {
        match next_event(&mut events) {
            Event::Film(estimate) if estimate.sliding => sliding += 1,
            Event::Film(_) => whole += 1,
            Event::Finished { session, .. } => break session,
            _ => {}
        }
    };
    let ended = Ended { session, state: "cancelled".into(), error: None };
    let (_, state) = ended.open();
    let film = state.film.unwrap();
    assert_eq!((film.sliding_estimates, film.transports), (sliding, whole));
    let (session, _) = ended.open();
    let transports = TransportFilm::open(&session.transport_film_path()).unwrap();
    // A busy machine may lose cycles between those that it stores.
    let stored = (0..transports.cycles()).filter(|&cycle| transports.contains(cycle).unwrap()).count();
    assert_eq!(stored, whole, "those of whole cycles are stored, and no others");
}

#[test]
fn zarr_reads_a_film() {
    let python = std::env::var_os("RAYSWEEP_PYTHON").expect(
        "RAYSWEEP_PYTHON names a Python with tests/python/requirements.txt: `cargo xtask test` makes one",
    );
    let late = "[sim.camera]\nlate_frames_min = 2\nlate_frames_max = 2\ndropped = 0.02\n";
    let bench = Bench::new(&rig(4.0, late));
    let ended = bench.run(&plan(8));
    assert!(ended.open().1.cycles().count() < 8, "one of the cycles is missing");
    let script = data("").join("../python/read_session.py");
    let output = Command::new(python).arg(script).arg(&ended.session).output().unwrap();
    let said =
        format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}");
}

#[test]
fn frames_that_a_flying_spot_cuts_are_left_out_or_modelled() {
    // Exposures of 600 us: at 300 us they begin while the pixel's own row is drawn, at -300 us they end.
    const CUT_US: [f64; 5] = [-307.0, -303.0, 296.0, 300.0, 304.0];
    const UNCUT_US: [f64; 11] =
        [-1500.0, -1000.0, -640.0, -360.0, -270.0, 0.0, 270.0, 360.0, 640.0, 1000.0, 1500.0];
    let scene = "scene = \"v-groove\"\nscene_rows = 24\nscene_columns = 16\nseed = 5";
    let sim = "[sim.sensor]\nnoise = false\n[sim.projector]\nspot = \"bidirectional\"\n[sim.vsync]\njitter_us = 0.0\n";
    let ignored = rig_text(720, scene, sim);
    let known = ignored.replace("[sim]\n", "spot = \"flying\"\n[sim]\n");
    assert_ne!(ignored, known);
    let modelled = known
        .replace("spot = \"flying\"", "spot = \"flying\"\nscan = \"bidirectional\"\nbeam_sigma_rows = 0.0")
        .replace("[vsync]", "projector_columns = [0, 1]\n[vsync]");
    let delays_us = [&CUT_US[..], &UNCUT_US].concat();
    let error = |rig: &str, delays_us: &[f64]| {
        let bench = Bench::new(rig);
        let plan =
            format!("kind = \"film\"\n[film]\ncycles = 6\nexposure_us = 600\ndelay_us = {delays_us:?}\n");
        let warned = bench.runner.check(&plan).unwrap().warnings.iter().any(|it| it.contains("flying spot"));
        let ended = bench.run(&plan);
        let film = TransportFilm::open(&ended.session.join("transport_film.zarr")).unwrap();
        let u_min = film.attributes()["u_min"].as_i64().unwrap() as i32;
        let rig = Rig::load(&bench.folder.path().join("rig.toml")).unwrap();
        let scene = rig.simulated().unwrap().scene().transport.index_axis(Axis(3), 0).to_owned();
        // Before and after the film has learned from its first cycles.
        let errors = [1, 5].map(|cycle| {
            let found = film.read(cycle).unwrap().unwrap().t;
            let rows = u_min..=u_min + found.len_of(Axis(0)) as i32 - 1;
            median_profile_error(found.view(), relative_rows(scene.view(), &rows).view())
        });
        (errors, warned)
    };
    let (ignored, _) = error(&ignored, &delays_us);
    let (left_out, warned) = error(&known, &delays_us);
    assert!(warned, "check says which settings are left out");
    let (uncut, warned) = error(&known, &UNCUT_US);
    assert!(!warned);
    let (modelled, warned) = error(&modelled, &delays_us);
    assert!(!warned);
    println!("{ignored:?} {left_out:?} {uncut:?} {modelled:?}");
    assert_eq!(left_out, uncut, "the other frames decide, and only they");
    for cycle in [0, 1] {
        assert!(left_out[cycle] < ignored[cycle] / 2.0, "{left_out:?} {ignored:?}");
        assert!(modelled[cycle] < ignored[cycle] / 2.0, "{modelled:?} {ignored:?}");
    }
}
