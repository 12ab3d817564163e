use super::*;
use crate::stack::{ArrayName, Contents, StackShape};
use raysweep_core::{Counts, LossCause};
use std::fs;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

fn session() -> SessionEntry {
    SessionEntry {
        format: FORMAT,
        name: "Müller's \"cup\"\nsecond line".into(),
        kind: "sweep".into(),
        operator: None,
        sample: Some("wax".into()),
        note: None,
        tags: vec!["a".into(), "b".into()],
        created: "2026-03-04T05:06:07.25Z".parse().unwrap(),
        software: "raysweep 0.1.0".into(),
        shape: StackShape { contents: Contents::Sweep { points: 4, exposures: 2 }, rows: 3, columns: 5 },
        first_row: 0,
    }
}

fn counts() -> Counts {
    let mut counts = Counts { expected: 12, averaged: 8, settling: 1, ..Counts::default() };
    counts.lose(LossCause::CameraGap, 2);
    counts.lose(LossCause::EdgeMissing, 1);
    counts
}

fn point(index: usize, attempt: u32) -> Entry {
    Entry::Point(PointEntry {
        array: ArrayName::Sum,
        index,
        attempt,
        frames: 8,
        exposure_us: 600.02,
        delay_us: -1500.0 / 7.0,
        // Sums of decimal fractions need all 17 digits and an exact parser.
        delays_us: vec![0.1 + 0.2, -1e-7 / 3.0, 1_234_567.891_234_567_9, f64::MIN_POSITIVE],
        counts: counts(),
        crc32: 0xdead_beef,
        clipped_crc32: None,
        exposed: None,
    })
}

fn failed(index: usize, attempt: u32) -> Entry {
    Entry::AttemptFailed { array: ArrayName::Sum, index, attempt, counts: counts() }
}

fn end(state: EndState) -> Entry {
    Entry::End(EndEntry::new(state, 1, 3, vec!["the room's light \"flickers\"".into()]))
}

fn all_kinds() -> Vec<Entry> {
    vec![
        Entry::Run { started: "2026-03-04T05:06:08Z".parse().unwrap(), resumed: false },
        point(0, 0),
        failed(1, 0),
        Entry::Outside { counts: Counts { expected: 3, cancelled: 3, ..Counts::default() } },
        end(EndState::Faulted),
        Entry::Note(Remark {
            at: "2026-03-05T00:00:00Z".parse().unwrap(),
            by: Some("Ada".into()),
            text: "a \"fingerprint\" on the lens\nsecond line".into(),
        }),
    ]
}

/// A ledger in its own folder with these entries after the first line.
fn ledger_with(entries: &[Entry]) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("ledger.jsonl");
    let mut ledger = Ledger::create(&path, session(), BTreeMap::new()).unwrap();
    for entry in entries {
        ledger.append(entry).unwrap();
    }
    (dir, path)
}

#[test]
fn every_kind_of_entry_reads_back_to_the_last_bit() {
    let (_dir, path) = ledger_with(&all_kinds());
    let entries = read(&path).unwrap();
    assert_eq!(entries[0], Entry::Session(session()));
    assert_eq!(entries[1..], all_kinds());
    assert_eq!(fs::read_to_string(&path).unwrap().lines().count(), 7);
}

#[test]
fn the_lines_are_the_documented_json() {
    let (_dir, path) = ledger_with(&all_kinds());
    let text = fs::read_to_string(&path).unwrap();
    let lines: Vec<serde_json::Value> =
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines[0]["event"], "session");
    assert_eq!(lines[0]["created"], "2026-03-04T05:06:07.25Z");
    assert_eq!(lines[2]["array"], "sum");
    assert_eq!(lines[2]["counts"]["lost"]["camera_gap"], 2);
    assert_eq!(lines[3]["event"], "attempt_failed");
    assert_eq!(lines[5]["state"], "faulted");
}

#[test]
fn a_ledger_torn_at_any_byte_of_its_last_line_loses_that_line_only() {
    let (_dir, path) = ledger_with(&[point(0, 0), point(1, 0)]);
    let whole = fs::read(&path).unwrap();
    let last_line_at = whole[..whole.len() - 1].iter().rposition(|&byte| byte == b'\n').unwrap() + 1;
    for cut in last_line_at..whole.len() {
        fs::write(&path, &whole[..cut]).unwrap();
        assert_eq!(read(&path).unwrap(), [Entry::Session(session()), point(0, 0)], "cut at {cut}");
        let mut ledger = Ledger::open(&path).unwrap();
        assert_eq!(ledger.state().missing(ArrayName::Sum).collect::<Vec<_>>(), [1, 2, 3]);
        assert_eq!(fs::metadata(&path).unwrap().len(), last_line_at as u64, "cut at {cut}");
        ledger.append(&point(1, 0)).unwrap();
        assert_eq!(fs::read(&path).unwrap(), whole, "cut at {cut}");
    }
}

#[test]
fn a_last_line_of_garbage_is_dropped() {
    let (_dir, path) = ledger_with(&[point(0, 0)]);
    let whole = fs::read(&path).unwrap();
    for garbage in [&b"\0\0\0\0\0\0"[..], b"{\"event\":\"poi\0\0\0\0}\n", b"\n", b"\xff\xfe\n"] {
        fs::write(&path, [&whole, garbage].concat()).unwrap();
        drop(Ledger::open(&path).unwrap());
        assert_eq!(fs::read(&path).unwrap(), whole, "{garbage:?}");
    }
}

#[test]
fn a_line_that_says_something_unknown_is_never_dropped() {
    let (_dir, path) = ledger_with(&[point(0, 0)]);
    let mut text = fs::read_to_string(&path).unwrap();
    text.push_str("{\"event\":\"teleport\"}\n");
    fs::write(&path, &text).unwrap();
    let error = Ledger::open(&path).unwrap_err();
    assert!(matches!(error, Error::Ledger { line: 3, .. }), "{error}");
    assert_eq!(fs::read_to_string(&path).unwrap(), text);
}

#[test]
fn a_corrupt_line_in_the_middle_is_named() {
    let (_dir, path) = ledger_with(&[point(0, 0), point(1, 0), point(2, 0)]);
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replacen("\"index\":1", "\"index\":x", 1)).unwrap();
    for error in [read(&path).unwrap_err(), Ledger::open(&path).unwrap_err()] {
        assert!(matches!(error, Error::Ledger { line: 3, .. }), "{error}");
    }
}

#[test]
fn resumed_runs_without_a_point_are_counted_until_one_is_stored() {
    let run = |resumed| Entry::Run { started: "2026-03-04T05:06:08Z".parse().unwrap(), resumed };
    let (_dir, path) = ledger_with(&[run(false), point(0, 0)]);
    let mut ledger = Ledger::open(&path).unwrap();
    let mut barren = Vec::new();
    for entry in [run(true), failed(1, 0), run(true), run(true), point(1, 1), run(true), run(false)] {
        ledger.append(&entry).unwrap();
        barren.push(ledger.state().barren_resumes);
    }
    assert_eq!(barren, [1, 1, 2, 3, 0, 1, 0]);
}

#[test]
fn ledgers_that_make_no_sense_are_errors() {
    let (_dir, path) = ledger_with(&[]);
    let first = fs::read_to_string(&path).unwrap();
    let outside = serde_json::to_string(&point(4, 0)).unwrap();
    for (text, line) in [
        ("{\"event\":\"run\",\"started\":\"2026-03-04T05:06:08Z\",\"resumed\":false}\n".to_owned(), 1),
        (format!("{first}{first}"), 2),
        (format!("{first}{outside}\n"), 2),
    ] {
        fs::write(&path, &text).unwrap();
        match read_state(&path).unwrap_err() {
            Error::Ledger { line: found, .. } => assert_eq!(found, line, "{text}"),
            error => panic!("{text}: {error}"),
        }
    }
}

#[test]
fn a_ledger_of_the_future_is_told_apart_from_a_corrupt_one() {
    let (_dir, path) = ledger_with(&[]);
    let first = fs::read_to_string(&path).unwrap();
    let newer = first.replace("\"format\":2", "\"format\":3");
    for text in [newer.clone(), newer.replace("\"kind\"", "\"sort\"")] {
        fs::write(&path, text).unwrap();
        assert!(matches!(read(&path), Err(Error::NewerFormat { found: 3, known: FORMAT, .. })));
    }
}

#[test]
fn an_entry_that_would_not_read_back_is_refused_and_leaves_no_trace() {
    let (_dir, path) = ledger_with(&[point(0, 0)]);
    let before = fs::read(&path).unwrap();
    let mut ledger = Ledger::open(&path).unwrap();
    let Entry::Point(mut bad) = point(1, 0) else { unreachable!() };
    bad.delays_us[2] = f64::NAN;
    for entry in [Entry::Point(bad), point(4, 0), Entry::Session(session())] {
        assert!(matches!(ledger.append(&entry), Err(Error::Entry { .. })), "{entry:?}");
        assert_eq!(fs::read(&path).unwrap(), before);
        assert!(ledger.state().point(ArrayName::Sum, 1).is_none());
    }
    ledger.append(&point(1, 0)).unwrap();
    assert_eq!(read(&path).unwrap().len(), 3);
}

#[test]
fn an_existing_ledger_is_not_created_again() {
    let (_dir, path) = ledger_with(&[point(0, 0)]);
    assert!(matches!(Ledger::create(&path, session(), BTreeMap::new()), Err(Error::Io { .. })));
    assert_eq!(read(&path).unwrap().len(), 2);
}

#[test]
fn one_writer_at_a_time_and_readers_always() {
    let (_dir, path) = ledger_with(&[]);
    let mut ledger = Ledger::open(&path).unwrap();
    assert!(matches!(Ledger::open(&path), Err(Error::InUse { .. })));
    ledger.append(&point(0, 0)).unwrap();
    assert_eq!(read_state(&path).unwrap(), *ledger.state());
    drop(ledger);
    Ledger::open(&path).unwrap();
}

#[test]
fn the_latest_line_of_a_point_counts_and_all_frames_do() {
    let entries = [point(2, 0), failed(0, 0), failed(0, 1), point(0, 2), point(2, 1)];
    let (_dir, path) = ledger_with(&entries);
    let state = read_state(&path).unwrap();
    let stored: Vec<_> = state.stored(ArrayName::Sum).map(|point| (point.index, point.attempt)).collect();
    assert_eq!(stored, [(0, 2), (2, 1)]);
    assert_eq!(state.missing(ArrayName::Sum).collect::<Vec<_>>(), [1, 3]);
    assert_eq!(state.missing(ArrayName::Dark).collect::<Vec<_>>(), [0, 1]);
    assert_eq!(state.missing(ArrayName::Regular).collect::<Vec<_>>(), [0]);
    let attempts: Vec<_> = (0..4).map(|index| state.next_attempt(ArrayName::Sum, index)).collect();
    assert_eq!(attempts, [3, 0, 2, 0]);
    assert_eq!(state.counts.expected, 60);
    assert!(state.counts.balanced());
}

#[test]
fn a_new_run_reopens_an_ended_session() {
    let started = "2026-03-04T05:06:08Z".parse().unwrap();
    let (_dir, path) = ledger_with(&[end(EndState::Cancelled)]);
    let mut ledger = Ledger::open(&path).unwrap();
    assert_eq!(ledger.state().end.as_ref().unwrap().state, EndState::Cancelled);
    ledger.append(&Entry::Run { started, resumed: true }).unwrap();
    assert_eq!((ledger.state().runs, ledger.state().end.as_ref()), (1, None));
}

#[test]
fn what_has_come_to_its_end_or_is_past_is_not_resumed() {
    let sweep = session().shape.contents;
    let film = Contents::Film { cycles: 4, settings: 3, exposures: 2 };
    let board = Contents::Board { images: 2, capped: 1 };
    let ended = |state| end(state);
    let refused =
        Entry::End(EndEntry { is_final: true, ..EndEntry::new(EndState::Faulted, 1, 3, Vec::new()) });
    let all: Vec<Entry> = (0..4).map(|index| point(index, 0)).collect();
    for (contents, entries, expected) in [
        (sweep, vec![], true),
        (sweep, vec![point(0, 0), ended(EndState::Cancelled)], true),
        // All is measured, but not made into products.
        (sweep, [all.clone(), vec![ended(EndState::Faulted)]].concat(), true),
        (sweep, [all, vec![ended(EndState::Complete)]].concat(), false),
        (board, vec![ended(EndState::Faulted)], true),
        (board, vec![refused], false),
        (film, vec![], false),
        (film, vec![ended(EndState::Cancelled)], false),
        (Contents::Nothing, vec![], false),
    ] {
        let shape = StackShape { contents, ..session().shape };
        let first = Entry::Session(SessionEntry { shape, ..session() });
        let state = State::replay(std::iter::once(&first).chain(&entries)).unwrap();
        assert_eq!(state.can_resume(), expected, "{contents:?}");
    }
}

#[test]
fn warnings_are_kept_up_to_a_number_and_a_length_and_older_ends_have_none() {
    let kept = |warnings| EndEntry::new(EndState::Complete, 4, 0, warnings).warnings;
    let many = kept((0..130).map(|number| format!("warning {number}")).collect());
    assert_eq!(many.len(), 101);
    assert_eq!(many[99..], ["warning 99", "30 more warnings of this run are not kept"]);
    assert_eq!(kept(vec!["é".repeat(5000)]), ["é".repeat(1000) + "…"]);
    let older = r#"{"event":"end","state":"complete","stored":4,"missing":0}"#;
    let read: Entry = serde_json::from_str(older).unwrap();
    assert_eq!(read, Entry::End(EndEntry::new(EndState::Complete, 4, 0, Vec::new())));
    assert_eq!(serde_json::to_string(&read).unwrap(), older);
}

#[test]
fn the_mean_delay_is_that_of_the_frames() {
    let Entry::Point(mut entry) = point(0, 0) else { unreachable!() };
    entry.delays_us = vec![-3.0, 1.0, 5.0];
    assert_eq!(entry.mean_delay_us(), Some(1.0));
    entry.delays_us.clear();
    assert_eq!(entry.mean_delay_us(), None);
}

#[test]
fn records_of_a_mirrors_axes_are_points_of_their_own() {
    let axis = |axis| Entry::Axis(AxisEntry { axis, frames: 8, lost: 3, empty: 0, counts: counts() });
    let (_dir, path) = ledger_with(&[]);
    assert!(
        matches!(Ledger::open(&path).unwrap().append(&axis(0)), Err(Error::Entry { .. })),
        "a sweep has none"
    );
    let dir = tempfile::tempdir().unwrap();
    let shape = StackShape { contents: Contents::Axes { axes: 2 }, rows: 3, columns: 5 };
    let session = SessionEntry { kind: "response".into(), shape, ..session() };
    let (session, mut ledger) = crate::Session::create(dir.path(), session, "plan", "rig").unwrap();
    assert!(!session.stack_path().exists() && !session.dots_path().exists(), "records are products");
    for entry in [axis(1), axis(0)] {
        ledger.append(&entry).unwrap();
    }
    assert!(matches!(ledger.append(&axis(2)), Err(Error::Entry { .. })));
    let state = session.state().unwrap();
    assert_eq!(state.axes().map(|axis| axis.axis).collect::<Vec<_>>(), [0, 1]);
    assert_eq!((state.stored_points(), state.counts.expected), (2, 24));
}

#[test]
fn a_chained_line_that_is_changed_moved_or_left_out_is_named() {
    let (_dir, path) = ledger_with(&[point(0, 0), point(1, 0), point(2, 0)]);
    let text = fs::read_to_string(&path).unwrap();
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let changed = text.replacen("\"frames\":8", "\"frames\":9", 1);
    let without_chain = text.replacen(&lines[1][lines[1].find(",\"chain").unwrap()..], "}\n", 1);
    let left_out = [lines[0], lines[1], lines[3]].concat();
    let turned = [lines[0], lines[2], lines[1], lines[3]].concat();
    for (damaged, expected) in [(changed, 2), (without_chain, 2), (left_out, 3), (turned, 2)] {
        fs::write(&path, &damaged).unwrap();
        for error in [read(&path).unwrap_err(), Ledger::open(&path).unwrap_err()] {
            assert!(matches!(error, Error::Ledger { line, .. } if line == expected), "{error}");
        }
        // What is sound can still be read, and nothing is appended after damage.
        let (mut ledger, text) = Ledger::open_damaged(&path).unwrap();
        assert!(text.damaged.iter().any(|(line, _)| *line == expected), "{text:?}");
        assert!(ledger.state().point(ArrayName::Sum, 2).is_some() || expected == 3 || text.damaged.len() > 1);
        assert!(matches!(ledger.append(&point(3, 0)), Err(Error::Entry { .. })));
        assert_eq!(fs::read_to_string(&path).unwrap(), damaged);
    }
}

#[test]
fn a_ledger_without_a_chain_is_read_and_continued_with_one() {
    let (_dir, path) = ledger_with(&[point(0, 0), point(1, 0)]);
    let text = fs::read_to_string(&path).unwrap().replace("\"format\":2", "\"format\":1");
    let old: String =
        text.lines().map(|line| line[..line.find(",\"chain").unwrap()].to_owned() + "}\n").collect();
    fs::write(&path, &old).unwrap();
    Ledger::open(&path).unwrap().append(&point(2, 0)).unwrap();
    Ledger::open(&path).unwrap().append(&point(3, 0)).unwrap();
    assert_eq!(read_state(&path).unwrap().missing(ArrayName::Sum).count(), 0);
    // The first chained line covers all before it.
    let continued = fs::read_to_string(&path).unwrap();
    fs::write(&path, continued.replacen("\"frames\":8", "\"frames\":9", 1)).unwrap();
    assert!(matches!(read(&path), Err(Error::Ledger { line: 4, .. })));
}

#[test]
fn a_last_line_that_was_whole_once_is_damaged_not_torn() {
    let (_dir, path) = ledger_with(&[point(0, 0), point(1, 0)]);
    let text = fs::read_to_string(&path).unwrap();
    let last = text.rfind("\"index\"").unwrap();
    let mut bytes = text.into_bytes();
    bytes[last] ^= 1;
    fs::write(&path, &bytes).unwrap();
    assert!(matches!(Ledger::open(&path), Err(Error::Ledger { line: 3, .. })));
    assert_eq!(fs::read(&path).unwrap(), bytes, "nothing is cut off");
}

#[test]
fn a_ledger_appears_with_its_first_lines_and_a_torn_first_one_says_what_it_was() {
    let (dir, path) = ledger_with(&[]);
    let whole = fs::read(&path).unwrap();
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1, "no draft is left");
    for cut in 0..whole.len() {
        fs::write(&path, &whole[..cut]).unwrap();
        let error = read(&path).unwrap_err();
        assert!(matches!(error, Error::Torn { .. }) && error.to_string().contains("trash"), "{error}");
    }
}

#[test]
fn a_ledger_is_free_as_soon_as_it_is_dropped_although_processes_are_being_started() {
    let (_dir, path) = ledger_with(&[point(0, 0)]);
    let done = AtomicBool::new(false);
    thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while !done.load(Ordering::Relaxed) {
                    Command::new("true").status().unwrap();
                }
            });
        }
        let opened = (0..2_000).try_for_each(|_| Ledger::open(&path).map(drop));
        done.store(true, Ordering::Relaxed);
        opened.unwrap();
    });
}
