//! Films by the camera's own sequencer.

use super::*;

/// Eight delays at one exposure: a film.
fn film_plan() -> Vec<CameraSettings> {
    [0.0, 60.0, 200.0, 400.0, 700.0, 500.0, 300.0, 120.0]
        .iter()
        .map(|us| settings(3_000.0 + us, 600.0))
        .collect()
}

/// Sequencers whose frames report their set, and others whose phase only timestamps can show.
fn sequencers() -> Vec<Script> {
    let says = [Says::Nothing, Says::Truth, Says::First];
    let scripts = all_late().into_iter().map(|script| Script { sets: 8, ..script });
    scripts.flat_map(|script| says.map(|says| Script { says, ..script })).collect()
}

#[test]
fn a_film_by_the_sequencer_is_told_nothing_while_it_runs() {
    for script in sequencers() {
        // Such delays of the host would cost frames if the film were written ahead.
        let script = Script { oversleep_ms: &[0, 40, 3, 0, 0, 18, 1, 0, 25, 16, 2], ..script };
        let film = play_plan(&film_plan(), script, 1, Some(5), None);
        film.assert_true(&film_plan());
        assert_eq!((film.counted.len(), film.short.len(), film.frames()), (40, 0, 40), "{:?}", script.late);
        let ids: Vec<u64> = film.counted.iter().map(|(_, seq)| *seq).collect();
        assert!(!film.told.iter().any(|told| (ids[0]..=ids[39]).contains(told)), "{:?}", film.told);
        // With timestamps, it takes at most two cycles until the phase is known and the film's cycle begins; with
        // reported sets, at most one.
        let begun = film.told.iter().filter(|told| **told < ids[0]).max().unwrap();
        let cycles = if script.says == Says::Truth { 1 } else { 2 };
        assert!(ids[0] - begun <= cycles * 8 + 6, "{begun} {ids:?}");
        assert!(film.told.last().unwrap() > &ids[39], "it is stopped");
    }
}

#[test]
fn a_lost_frame_of_a_sequence_takes_its_set_with_it() {
    for script in sequencers() {
        let script = Script { lost: &[75, 76, 82, 86, 88, 98], ..script };
        let film = play_plan(&film_plan(), script, 1, Some(6), None);
        film.assert_true(&film_plan());
        assert_eq!(film.short.len() + film.counted.len(), 48);
        let (first, last) = (film.counted[0].1, film.counted.last().unwrap().1);
        let lost = script.lost.iter().filter(|lost| (first..=last).contains(*lost)).count();
        assert!(lost >= 2, "{first} to {last}");
        assert_eq!(film.short.len(), lost);
    }
}

#[test]
fn a_sequence_that_stutters_is_found_again() {
    let script = Script { sets: 8, stutters: &[120], ..EXACT };
    let film = play_plan(&film_plan(), script, 1, Some(20), None);
    // The assembler sees wrong frames by their delay: for less than two cycles.
    let wrong = film.wrong(&film_plan());
    assert!((1..=16).contains(&wrong.len()) && wrong[0] == 120, "{wrong:?}");
    assert_eq!(film.counted.len(), 160);
    let film = play_plan(&film_plan(), Script { says: Says::Truth, ..script }, 1, Some(20), None);
    film.assert_true(&film_plan());
    let last = film.counted.last().unwrap().1;
    assert_eq!((film.counted.len(), film.frames(), last > 120), (160, 161, true));
}

#[test]
fn a_sequencer_that_says_wrong_sets_is_found_out_by_its_stamps() {
    let script = Script { sets: 8, says: Says::Next, ..EXACT };
    let film = play_plan(&film_plan(), script, 1, Some(20), None);
    let (wrong, first) = (film.wrong(&film_plan()), film.counted[0].1);
    assert!((1..=16).contains(&wrong.len()) && wrong.iter().all(|seq| seq - first < 16), "{wrong:?}");
    assert_eq!(film.counted.len(), 160);
}

#[test]
fn a_pause_stops_the_sequence_and_a_cycle_is_whole_before_it() {
    let script = Script { sets: 8, ..EXACT };
    // The pause order arrives through the events, of which 64 may be queued.
    let film = play_plan(&film_plan(), script, 1, Some(12), Some(11));
    film.assert_true(&film_plan());
    assert_eq!((film.counted.len(), film.short.len()), (96, 0));
    let gaps: Vec<usize> =
        (1..96).filter(|&place| film.counted[place].1 != film.counted[place - 1].1 + 1).collect();
    assert!(gaps.len() == 1 && gaps[0].is_multiple_of(8), "{gaps:?}");
    let (before, after) = (film.counted[gaps[0] - 1].1, film.counted[gaps[0]].1);
    assert_eq!(
        film.told.iter().filter(|told| (before..after).contains(*told)).count(),
        2,
        "stopped and begun"
    );
}

#[test]
fn a_film_that_the_sequencer_cannot_take_is_written_ahead() {
    let one_set_short = Script { sets: 7, ..EXACT };
    let film = play_plan(&film_plan(), one_set_short, 1, Some(3), None);
    film.assert_true(&film_plan());
    assert_eq!((film.counted.len(), film.frames()), (24, 24));
    for says in [Says::Nothing, Says::Truth] {
        let film = play_plan(&film_plan(), Script { sets: 8, stuck: true, says, ..EXACT }, 1, Some(3), None);
        film.assert_true(&film_plan());
        assert_eq!((film.counted.len(), film.frames()), (24, 24));
    }
    // Delays in equal steps around a period: any set might be the first, unless frames report their set.
    let round: Vec<_> = (0..6).map(|k| settings(f64::from(k) * PERIOD_NS as f64 / 6e3, 600.0)).collect();
    let film = play_plan(&round, Script { sets: 8, says: Says::Truth, ..EXACT }, 1, Some(3), None);
    film.assert_true(&round);
    let told = film.told.iter().filter(|told| **told > film.counted[0].1).count();
    assert_eq!((film.counted.len(), film.frames(), told), (18, 18, 1));
    let film = play_plan(&round, Script { sets: 8, ..EXACT }, 1, Some(3), None);
    film.assert_true(&round);
    assert_eq!(film.counted.len(), 18);
    assert!(film.told.len() > 18, "{:?}", film.told);
}
