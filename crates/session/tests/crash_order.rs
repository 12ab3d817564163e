//! Crashes a session at every step of storing a point; only the ledger decides what is stored.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;

use ndarray::{Array2, array};
use raysweep_core::Counts;
use raysweep_session::ledger::{Entry, FORMAT, PointEntry, SessionEntry};
use raysweep_session::stack::{ArrayName, Contents, StackShape, crc32};
use raysweep_session::{Session, list};

fn header() -> SessionEntry {
    SessionEntry {
        format: FORMAT,
        name: "crash".into(),
        kind: "sweep".into(),
        operator: None,
        sample: None,
        note: None,
        tags: Vec::new(),
        created: "2026-03-04T05:06:07Z".parse().unwrap(),
        software: "raysweep 0.1.0".into(),
        shape: StackShape { contents: Contents::Sweep { points: 3, exposures: 1 }, rows: 2, columns: 2 },
        first_row: 0,
    }
}

fn image(index: usize) -> Array2<u32> {
    array![[1, 2], [3, 4]].mapv(|value| value + 10 * index as u32)
}

fn point(index: usize) -> Entry {
    Entry::Point(PointEntry {
        array: ArrayName::Sum,
        index,
        attempt: 0,
        frames: 1,
        exposure_us: 600.0,
        delay_us: 0.0,
        delays_us: vec![0.25],
        counts: Counts { expected: 1, averaged: 1, ..Counts::default() },
        crc32: crc32(image(index).view()),
        clipped_crc32: None,
        exposed: None,
    })
}

/// A session with point 0 stored.
fn session() -> (tempfile::TempDir, Session) {
    let root = tempfile::tempdir().unwrap();
    let (session, mut ledger) = Session::create(root.path(), header(), "", "").unwrap();
    session.stack().unwrap().write(ArrayName::Sum, 0, image(0).view()).unwrap();
    ledger.append(&point(0)).unwrap();
    (root, session)
}

fn missing(session: &Session) -> Vec<usize> {
    session.resume().unwrap().state().missing(ArrayName::Sum).collect()
}

#[test]
fn data_without_a_line_are_not_stored() {
    let (_root, session) = session();
    session.stack().unwrap().write(ArrayName::Sum, 1, image(1).view()).unwrap();
    assert_eq!(missing(&session), [1, 2]);
}

#[test]
fn data_in_a_temporary_file_are_not_stored_and_not_in_the_way() {
    let (_root, session) = session();
    let temporary = session.stack_path().join("sum/c.1.0.0.raysweep-tmp");
    fs::write(&temporary, "half a shard").unwrap();
    assert_eq!(missing(&session), [1, 2]);
    assert!(!temporary.exists());
    session.stack().unwrap().write(ArrayName::Sum, 1, image(1).view()).unwrap();
    assert_eq!(session.stack().unwrap().read_point(ArrayName::Sum, 1).unwrap(), image(1));
}

#[test]
fn data_with_a_torn_line_are_not_stored_and_the_session_can_be_finished() {
    let (root, session) = session();
    let whole = fs::read(session.ledger_path()).unwrap();
    let mut ledger = session.resume().unwrap();
    for index in [1, 2] {
        session.stack().unwrap().write(ArrayName::Sum, index, image(index).view()).unwrap();
        ledger.append(&point(index)).unwrap();
    }
    drop(ledger);
    let finished = fs::read(session.ledger_path()).unwrap();
    for cut in whole.len()..finished.len() {
        fs::write(session.ledger_path(), &finished[..cut]).unwrap();
        let mut ledger = session.resume().unwrap();
        let missing: Vec<_> = ledger.state().missing(ArrayName::Sum).collect();
        let whole_lines = finished[whole.len()..cut].iter().filter(|&&byte| byte == b'\n').count();
        assert_eq!(missing.len(), 2 - whole_lines, "cut at {cut}");
        for index in missing {
            ledger.append(&point(index)).unwrap();
        }
        assert!(fs::read(session.ledger_path()).unwrap() == finished, "cut at {cut}");
    }
    assert_eq!(list(root.path()).unwrap().sessions[0].stored, 3);
}

#[test]
fn a_crash_while_the_session_was_made_leaves_no_session() {
    let (root, session) = session();
    fs::remove_file(session.ledger_path()).unwrap();
    assert!(Session::open(session.dir()).is_err());
    let listing = list(root.path()).unwrap();
    assert!(listing.sessions.is_empty() && listing.unreadable.is_empty());
    let (next, _) = Session::create(root.path(), header(), "", "").unwrap();
    assert_ne!(next.dir(), session.dir());
}

#[test]
fn the_stack_must_be_the_one_of_the_ledger() {
    let (root, session) = session();
    let mut wider = header();
    wider.shape.columns = 3;
    let (other, _) = Session::create(root.path(), wider, "", "").unwrap();
    fs::copy(other.ledger_path(), session.ledger_path()).unwrap();
    assert!(session.stack().is_err());
}
