use super::*;
use crate::ledger::{Entry, PointEntry, SessionEntry};
use crate::stack::{ArrayName, Contents, StackShape};
use serde_json::json;

fn session() -> (tempfile::TempDir, Session) {
    let root = tempfile::tempdir().unwrap();
    let header = SessionEntry {
        format: FORMAT,
        name: "cup".into(),
        kind: "sweep".into(),
        operator: None,
        sample: None,
        note: None,
        tags: Vec::new(),
        created: "2026-03-04T05:06:07Z".parse().unwrap(),
        software: "raysweep 0.1.0".into(),
        shape: StackShape { contents: Contents::Sweep { points: 3, exposures: 1 }, rows: 2, columns: 2 },
        first_row: 0,
    };
    let (session, mut ledger) = Session::create(root.path(), header, "plan", "rig").unwrap();
    let data = ndarray::array![[1, 2], [3, 4]];
    let crc32 = session.stack().unwrap().write(ArrayName::Sum, 1, data.view()).unwrap();
    ledger
        .append(&Entry::Point(PointEntry {
            array: ArrayName::Sum,
            index: 1,
            attempt: 0,
            frames: 1,
            exposure_us: 600.0,
            delay_us: 0.0,
            delays_us: vec![0.0],
            counts: Counts { expected: 1, averaged: 1, ..Counts::default() },
            crc32,
            clipped_crc32: None,
            exposed: None,
        }))
        .unwrap();
    write(&session, ledger.state(), BTreeMap::new(), json!({ "a": 1 }).as_object().cloned().unwrap())
        .unwrap();
    (root, session)
}

#[test]
fn it_names_every_file_and_adds_up() {
    let (_root, session) = session();
    let manifest = read(&session).unwrap();
    let names: Vec<_> = manifest.files.keys().map(String::as_str).collect();
    assert_eq!(
        names,
        [
            "ledger.jsonl",
            "plan.toml",
            "rig.toml",
            "stack.zarr/clipped/zarr.json",
            "stack.zarr/dark/zarr.json",
            "stack.zarr/regular/zarr.json",
            "stack.zarr/sum/c.1.0.0",
            "stack.zarr/sum/zarr.json",
            "stack.zarr/zarr.json",
        ]
    );
    // SHA-256 of the three letters "rig", computed by another program.
    let rig = &manifest.files["rig.toml"];
    assert_eq!(rig.bytes, 3);
    assert_eq!(rig.sha256, "c00ae0a63348054ecc8343f23278fe13bfa5c44255e208ff6102ffc2d7910a53");
    assert_eq!(manifest.points, PointCounts { planned: 3, stored: 1, missing: 2 });
    assert!(manifest.counts.balanced() && manifest.counts.expected == 1);
    assert!(verify(&session).unwrap().is_empty());
}

#[test]
fn a_flipped_bit_anywhere_is_found() {
    let (_root, session) = session();
    for name in read(&session).unwrap().files.keys() {
        let path = session.dir().join(name);
        let whole = fs::read(&path).unwrap();
        for at in [0, whole.len() / 2, whole.len() - 1] {
            let mut damaged = whole.clone();
            damaged[at] ^= 1;
            fs::write(&path, damaged).unwrap();
            assert_eq!(verify(&session).unwrap().changed, [name.as_str()]);
        }
        fs::write(&path, whole).unwrap();
    }
    assert!(verify(&session).unwrap().is_empty());
}

#[test]
fn files_that_came_or_went_are_named() {
    let (_root, session) = session();
    fs::remove_file(session.plan_path()).unwrap();
    fs::write(session.products_path().join("x.npy"), "").unwrap();
    fs::write(session.dir().join("y.raysweep-tmp"), "not the session's").unwrap();
    let differences = verify(&session).unwrap();
    assert_eq!(differences.missing, ["plan.toml"]);
    assert_eq!(differences.added, ["products/x.npy"]);
    assert!(differences.changed.is_empty());
}

#[test]
fn a_missing_damaged_or_newer_manifest_is_an_error() {
    let (_root, session) = session();
    let text = fs::read_to_string(session.manifest_path()).unwrap();
    fs::write(session.manifest_path(), text.replacen("\"format\": 2", "\"format\": 3", 1)).unwrap();
    assert!(matches!(verify(&session), Err(Error::NewerFormat { found: 3, .. })));
    fs::write(session.manifest_path(), "{}").unwrap();
    assert!(matches!(verify(&session), Err(Error::Codec { .. })));
    fs::remove_file(session.manifest_path()).unwrap();
    assert!(matches!(verify(&session), Err(Error::Io { .. })));
}

#[test]
fn a_flipped_bit_in_the_manifest_itself_is_found() {
    let (_root, session) = session();
    let whole = fs::read(session.manifest_path()).unwrap();
    for at in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[at] ^= 1 << (at % 7);
        fs::write(session.manifest_path(), damaged).unwrap();
        assert!(read(&session).is_err(), "byte {at}");
    }
}
