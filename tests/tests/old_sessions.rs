//! Sessions written before `shape.contents` and the crate of processing existed are resumed and processed as before.
//! `tests/data/sessions` has one sweep, ended after two of its three points, and one film, both of 8 x 8 pixels.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::path::{Path, PathBuf};

use ndarray::Array3;
use raysweep_session::Session;
use raysweep_session::film::TransportFilm;
use raysweep_tests::{Bench, data};

/// A copy of a stored session in a folder, where it can be written.
fn copy(name: &str, folder: &Path) -> PathBuf {
    fn copy_all(from: &Path, to: &Path) {
        fs::create_dir_all(to).unwrap();
        for entry in fs::read_dir(from).unwrap() {
            let (path, target) = (entry.as_ref().unwrap().path(), to.join(entry.unwrap().file_name()));
            match path.is_dir() {
                true => copy_all(&path, &target),
                false => drop(fs::copy(path, target).unwrap()),
            }
        }
    }
    let copied = folder.join(name);
    copy_all(&data("sessions").join(name), &copied);
    fs::create_dir_all(copied.join("products")).unwrap();
    copied
}

fn transport(session: &Path) -> Array3<f32> {
    ndarray_npy::read_npy(session.join("products/transport.npy")).unwrap()
}

#[test]
fn an_interrupted_sweep_is_resumed_to_the_bits_of_a_whole_one() {
    let read = |file: &str| fs::read_to_string(data("sessions/sweep").join(file)).unwrap();
    let bench = Bench::new(&read("rig.toml"));
    let session = copy("sweep", &bench.folder.path().join("sessions"));
    assert_eq!(Session::open(&session).unwrap().state().unwrap().stored_points(), 2);
    let resumed = bench.resume(&session);
    assert_eq!(
        (resumed.state.as_str(), resumed.open().1.stored_points()),
        ("complete", 3),
        "{:?}",
        resumed.error
    );
    let whole = bench.run(&read("plan.toml"));
    assert_eq!(transport(&session), transport(&whole.session));
}

#[test]
fn a_film_is_processed_to_the_transports_that_it_had() {
    let folder = tempfile::tempdir().unwrap();
    let session = copy("film", folder.path());
    let transports = |session: &Path| {
        let film = TransportFilm::open(&session.join("transport_film.zarr")).unwrap();
        [0, 1].map(|cycle| film.read(cycle).unwrap().unwrap().t)
    };
    let before = transports(&session);
    let processed = raysweep_processing::process(&session).unwrap();
    assert_eq!((processed.stored, processed.points, processed.problems.len()), (2, 2, 0));
    for (before, after) in before.iter().zip(transports(&session)) {
        // Other processors round differently.
        let off = (before - &after).iter().fold(0.0_f32, |most, off| most.max(off.abs()));
        assert!(off < 1e-5 && after.iter().any(|&light| light > 0.1), "off by {off}");
    }
}
