//! Random SIGKILLs of runs, of resumed runs and of `raysweep process`, for every kind of session, as a table.
//! `RAYSWEEP_KILLS=2000 cargo test -p raysweep --all-features --test kills -- --nocapture` tries more than CI does.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

#[path = "../daemon/mod.rs"]
mod daemon;
mod judge;
mod kinds;
#[path = "../process/mod.rs"]
mod process;
mod reference;

use std::fmt;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use judge::Verdict;
use kinds::{Kind, kinds};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use reference::Reference;

/// Kills in each run of the tests.
const KILLS: usize = 50;

/// What is killed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Victim {
    Run,
    Resume,
    Process,
}

impl Victim {
    fn of(kind: &Kind) -> &'static [Self] {
        match kind.is_resumable {
            true => &[Self::Run, Self::Process, Self::Resume],
            false => &[Self::Run, Self::Process],
        }
    }
}

/// What came of the kills of one case.
#[derive(Debug, Default)]
struct Row {
    kills: usize,
    /// Kills before the end of what was killed.
    within: usize,
    unreadable: usize,
    lost: usize,
    double: usize,
    different: usize,
    problems: Vec<String>,
}

impl Row {
    fn add(&mut self, Verdict { within, unreadable, lost, double, different }: Verdict, what: &str) {
        self.kills += 1;
        self.within += usize::from(within);
        for (count, problems) in [
            (&mut self.unreadable, unreadable),
            (&mut self.lost, lost),
            (&mut self.double, double),
            (&mut self.different, different),
        ] {
            *count += problems.len();
            self.problems.extend(problems.into_iter().map(|problem| format!("{what}: {problem}")));
        }
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kills, within, unreadable, lost, double, different, .. } = self;
        write!(f, "{kills:>6} {within:>7} {unreadable:>11} {lost:>5} {double:>7} {different:>15}")
    }
}

/// Kills what belongs to a kind `kills` times, taking its victims in turn.
fn kill_all(number: usize, kind: &Kind, kills: usize) -> Vec<(String, Row)> {
    let began = Instant::now();
    let reference = Reference::new(kind);
    let begun = began.elapsed();
    let victims = Victim::of(kind);
    let mut rows: Vec<_> =
        victims.iter().map(|victim| (format!("{}, {victim:?}", kind.name), Row::default())).collect();
    let seed = std::env::var("RAYSWEEP_KILLS_SEED").map_or(0, |seed| seed.parse::<u64>().unwrap());
    let mut random = Xoshiro256PlusPlus::seed_from_u64((seed << 8) + number as u64);
    for kill in 0..kills {
        let turn = kill % victims.len();
        let (verdict, when) = match victims[turn] {
            Victim::Run => reference.kill_a_run(&mut random),
            Victim::Resume => reference.kill_a_resumed_run(&mut random),
            Victim::Process => reference.kill_processing(&mut random),
        };
        let (name, row) = &mut rows[turn];
        row.add(verdict, &format!("{name}, kill {kill}, {when}"));
    }
    println!("{}: reference in {begun:.1?}, {kills} kills in {:.1?}", kind.name, began.elapsed() - begun);
    rows
}

#[test]
fn random_kills_lose_nothing_and_change_no_bit() {
    let kills = std::env::var("RAYSWEEP_KILLS").map_or(KILLS, |kills| kills.parse().unwrap());
    let (kinds, next, rows) = (kinds(), AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while let number = next.fetch_add(1, Ordering::Relaxed)
                    && let Some(kind) = kinds.get(number)
                {
                    // The first ones take what is left over.
                    let share = kills / kinds.len() + usize::from(number < kills % kinds.len());
                    let made = kill_all(number, kind, share);
                    rows.lock().unwrap().extend(made.into_iter().map(|row| (number, row)));
                }
            });
        }
    });
    let mut rows = rows.into_inner().unwrap();
    rows.sort_by_key(|(number, _)| *number);
    println!(
        "{:<28} {:>6} {:>7} {:>11} {:>5} {:>7} {:>15}",
        "case", "kills", "within", "unreadable", "lost", "double", "different bits"
    );
    for (_, (name, row)) in &rows {
        println!("{name:<28} {row}");
    }
    let sum = |of: fn(&Row) -> usize| rows.iter().map(|(_, (_, row))| of(row)).sum::<usize>();
    println!("{} kills, {} of them before the end", sum(|row| row.kills), sum(|row| row.within));
    let problems: Vec<_> = rows.iter().flat_map(|(_, (_, row))| &row.problems).collect();
    assert!(problems.is_empty(), "{} problems: {problems:#?}", problems.len());
    assert_eq!(sum(|row| row.kills), kills);
    assert!(sum(|row| row.within) * 2 >= kills, "the moments do not lie within what is killed");
}
