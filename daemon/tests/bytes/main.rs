//! Bytes from outside: real examples and the nasty ones in `fuzz/seeds`, and mutations of them, are read without a
//! panic, in bounded memory, and with an error that says something.
//! `RAYSWEEP_MUTATIONS=100000 cargo test -p raysweep --all-features --test bytes` tries more mutations than CI does.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod bodies;
mod mutation;

use std::fs;
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};
use std::time::Instant;

use bodies::{BODIES, Body};
use ndarray::ArrayD;
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep::Runner;
use raysweep::control::Control;
use raysweep::live::LiveFile;
use raysweep::rig::Rig;
use raysweep_proto::{Event, RunParams};

/// Mutations for each target in each run of the tests.
const MUTATIONS: usize = 600;

/// Memory that no input may take, beyond what the largest examples do.
const MOST_MIB: u64 = 400;

const BOARD: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                     [projector]\ndriver = \"sim\"\nrows = 720\nrow_time_us = 22.22\n\
                     [sim]\nscene_rows = 96\nscene_columns = 48\n";
const CALIBRATION: &str =
    "kind = \"calibration\"\n[calibration]\nframes = 8\npicture_frames = 2\ndelays = 40\n";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn files(folder: &str) -> Vec<Vec<u8>> {
    let Ok(entries) = fs::read_dir(root().join(folder)) else { return Vec::new() };
    let mut paths: Vec<_> =
        entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_file()).collect();
    paths.sort();
    paths.into_iter().map(|path| fs::read(path).unwrap()).collect()
}

fn file(path: &str) -> Vec<Vec<u8>> {
    vec![fs::read(root().join(path)).unwrap()]
}

/// Real examples, which are sound.
fn examples(target: &str, made: &Path) -> Vec<Vec<u8>> {
    match target {
        "plan" => files("deploy/plans"),
        "rig" => files("deploy/rigs"),
        "ledger" => file("tests/data/sessions/sweep/ledger.jsonl"),
        "zarr_metadata" => file("tests/data/sessions/sweep/stack.zarr/sum/zarr.json"),
        "scene" => vec![fs::read(made.join("scene.npz")).unwrap()],
        "manifest" => vec![fs::read(made.join("calibration/manifest.json")).unwrap()],
        "calibration_header" => vec![fs::read(made.join("calibration/calibration.toml")).unwrap()],
        "calibration_arrays" => vec![fs::read(made.join("calibration/calibration.npz")).unwrap()],
        "live_file" => vec![fs::read(made.join("live-example")).unwrap()],
        _ => Vec::new(),
    }
}

/// Makes the examples that are too large to be kept.
fn make(folder: &Path) {
    let rig = folder.join("rig.toml");
    fs::write(&rig, BOARD).unwrap();
    let runner = Runner::new(Rig::load(&rig).unwrap(), folder.join("sessions")).unwrap();
    let mut events = runner.events();
    let session = runner.run(RunParams { plan: CALIBRATION.into(), ..RunParams::default() }).unwrap().session;
    while !matches!(events.blocking_recv(), Ok(Event::Finished { .. })) {}
    fs::rename(session, folder.join("calibration")).unwrap();
    let size = raysweep_sim::scene::SceneSize { rows: 8, columns: 8 };
    raysweep_sim::scene::Scene::builtin("slab", size, 1).unwrap().save(&folder.join("scene.npz")).unwrap();
    let live = LiveFile::create(&folder.join("live")).unwrap();
    for name in ["a", "b"] {
        live.publish(name, ArrayD::<f32>::ones(vec![2, 3]).view(), &serde_json::Map::new()).unwrap();
    }
    // It is removed when its daemon ends.
    fs::copy(folder.join("live"), folder.join("live-example")).unwrap();
}

/// The most memory that this process has taken so far.
fn peak_mib() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() >> 10
}

/// Reads the nasty examples and mutations of all. Returns how many inputs were refused, and the first defect.
fn try_bytes(target: &str, body: Body, sound: &[Vec<u8>], count: usize) -> Result<usize, String> {
    let nasty = files(&format!("fuzz/seeds/{target}"));
    let all = [sound, &nasty].concat();
    assert!(!all.is_empty(), "{target} has no examples");
    // A live file has several megabytes, which take longer to write than to read.
    let is_large = all.iter().any(|example| example.len() > 1 << 20);
    let count = if is_large { count / 10 } else { count };
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    let mutations = (0..count).map(|number| mutation::mutated(&mut random, &all[number % all.len()], &all));
    let inputs = nasty.iter().cloned().chain(mutations);
    let mut refused = 0;
    for (number, input) in inputs.enumerate() {
        let before = peak_mib();
        let read = catch_unwind(|| body(&input));
        // The kernel adds the counts of its processors up only now and then, so the sum can also become smaller.
        let grown = peak_mib().saturating_sub(before);
        let is_wrong = read.is_err() || grown > MOST_MIB;
        if is_wrong {
            let path = std::env::temp_dir().join(format!("{target}-{number}"));
            fs::write(&path, &input).unwrap();
            let read = read.map_err(|panic| raysweep_pipeline::message_of(&*panic).to_owned());
            return Err(format!(
                "{target}: input {number}, kept as {}: {grown} MiB, {read:?}",
                path.display()
            ));
        }
        refused += usize::from(read.is_ok_and(|read| read.is_err()));
    }
    Ok(refused)
}

#[test]
fn no_bytes_from_outside_make_a_reader_panic_or_take_much_memory() {
    let made = tempfile::tempdir_in("/dev/shm").unwrap();
    make(made.path());
    let count = std::env::var("RAYSWEEP_MUTATIONS").map_or(MUTATIONS, |count| count.parse().unwrap());
    let mut defects = Vec::new();
    for (target, body) in BODIES {
        let began = Instant::now();
        let tried = try_bytes(target, body, &examples(target, made.path()), count);
        println!("{target}: of {count} mutations, refused: {tried:?}, in {:.1?}", began.elapsed());
        assert_ne!(tried, Ok(0), "{target}: nothing was refused");
        defects.extend(tried.err());
    }
    assert!(defects.is_empty(), "{defects:#?}");
}

#[test]
fn the_examples_are_sound() {
    let made = tempfile::tempdir_in("/dev/shm").unwrap();
    make(made.path());
    for (target, body) in BODIES {
        // The manifest is of another session than the one in which it is read.
        // A calibration's header is read with its arrays.
        if !["manifest", "calibration_header"].contains(&target) {
            for example in examples(target, made.path()) {
                assert_eq!(body(&example).map_err(|error| format!("{target}: {error}")), Ok(()));
            }
        }
    }
}
