//! Settings written ahead: sweeps, and films with cameras without a sequencer.

use super::*;

#[test]
fn a_sweep_and_a_film_cost_no_frame_that_they_do_not_need() {
    for script in all_late() {
        let Script { late, promise, chunk, .. } = script;
        let what = format!("{late:?} frames late, {promise:?} promised, exposure carried: {chunk}");
        let sweep = play(script, 4, None);
        sweep.assert_true(&plan());
        assert_eq!((sweep.counted.len(), sweep.short.len()), (48, 0), "{what}");
        let late_frames = late[0] as u32;
        let found = SettingsLatency { min_frames: late_frames, max_frames: late_frames };
        assert_eq!(sweep.latency, Some(found), "{what}");
        // If frames do not carry their exposure and the camera does not report the first frame, the one change of
        // exposure costs the frames until it is certain, and the first of those.
        let unknown = if promise.is_some() && !chunk { 3 + 1 } else { 0 };
        assert!((48..=48 + unknown).contains(&sweep.frames()), "{what}: {} frames", sweep.frames());
        let film = play(script, 1, Some(3));
        film.assert_true(&plan());
        assert_eq!((film.counted.len(), film.short.len()), (36, 0), "{what}");
        assert!((36..=36 + 5 * unknown).contains(&film.frames()), "{what}: {} frames", film.frames());
    }
}

#[test]
fn settings_that_are_late_now_and_then_mislabel_nothing() {
    let late = &[2, 0, 3, 1, 1, 3, 0, 2, 3, 0, 0, 1, 2];
    for chunk in [true, false] {
        let script = Script { late, chunk, promise: Some(3), ..EXACT };
        let sweep = play(script, 4, None);
        sweep.assert_true(&plan());
        assert_eq!(sweep.latency, Some(SettingsLatency { min_frames: 0, max_frames: 3 }));
        assert_eq!((sweep.counted.len(), sweep.short.len()), (48, 0));
        // With timestamps, frames count as early as possible: on average, points are 1.4 frames late.
        let most = if chunk { 48 + 12 * 2 } else { 48 + 12 * 4 };
        assert!(sweep.frames() <= most, "exposure carried: {chunk}: {} frames", sweep.frames());
        let film = play(script, 1, Some(3));
        film.assert_true(&plan());
        assert_eq!((film.counted.len(), film.short.len()), (36, 0));
    }
}

#[test]
fn a_host_that_wakes_late_costs_a_film_nothing_while_it_is_late_by_less_than_half_a_period() {
    for script in all_late().into_iter().filter(|script| script.chunk) {
        let script = Script { oversleep_ms: &[0, 7, 3, 0, 6, 1, 7, 7], ..script };
        let film = play(script, 1, Some(5));
        film.assert_true(&plan());
        assert_eq!((film.counted.len(), film.frames()), (60, 60), "{:?} frames late", script.late);
    }
}

#[test]
fn a_host_that_wakes_later_still_costs_frames_and_no_settings() {
    for script in all_late() {
        let script = Script { oversleep_ms: &[0, 40, 3, 0, 0, 18, 1, 0, 25, 16, 2], ..script };
        let film = play(script, 1, Some(5));
        film.assert_true(&plan());
        assert_eq!((film.counted.len(), film.short.len()), (60, 0), "{:?} frames late", script.late);
        let order: Vec<u32> = film.counted.iter().map(|(point, _)| *point).collect();
        assert_eq!(order, (0..5).flat_map(|_| 0..12).collect::<Vec<_>>());
    }
}

#[test]
fn a_lost_frame_costs_its_own_point_at_the_most() {
    for script in all_late() {
        // Probe and lead-in are over by frame 70; the points end no earlier than frame 95.
        let script = Script { lost: &[75, 76, 82, 86, 88, 90], ..script };
        let sweep = play(script, 4, None);
        sweep.assert_true(&plan());
        assert!(sweep.short.len() <= 6 && sweep.counted.len() >= 48 - 6, "{:?}", sweep.short);
        let film = play(script, 1, Some(5));
        film.assert_true(&plan());
        assert_eq!(film.short.len() + film.counted.len(), 60);
        assert!((1..=6).contains(&film.short.len()), "{:?}", film.short);
    }
}

#[test]
fn frames_that_are_held_up_on_their_way_keep_their_settings() {
    for script in all_late() {
        let Script { late, promise, chunk, .. } = script;
        let unknown = if promise.is_some() && !chunk { 3 + 1 } else { 0 };
        for held_ms in [20, 45, 90, 140, 200] {
            let held = [(72, held_ms), (77, held_ms), (90, held_ms)];
            let script = Script { held_up: Vec::leak(held.to_vec()), ..script };
            let what =
                format!("{held_ms} ms, {late:?} late, {promise:?} promised, exposure carried: {chunk}");
            let sweep = play(script, 4, None);
            sweep.assert_true(&plan());
            assert_eq!((sweep.counted.len(), sweep.short.len()), (48, 0), "{what}");
            // The clock bridges delays of two or three frames.
            assert!(held_ms > 45 || sweep.frames() <= 48 + unknown, "{what}: {} frames", sweep.frames());
            let film = play(script, 1, Some(5));
            film.assert_true(&plan());
            assert_eq!((film.counted.len(), film.short.len()), (60, 0), "{what}");
        }
    }
}

#[test]
fn settings_that_stamps_tell_apart() {
    let line = |plan: &[CameraSettings]| TriggerLine::new(16_666.667, 50.0, plan);
    let tells = |plan: &[CameraSettings]| line(plan).distinct;
    assert!(tells(&plan()));
    assert!(!tells(&[settings(100.0, 600.0), settings(149.0, 600.0)]));
    assert!(tells(&[settings(100.0, 600.0), settings(149.0, 900.0)]));
    // One period apart, two delays have the same distance from an edge.
    assert!(!tells(&[settings(100.0, 600.0), settings(16_740.0, 600.0)]));
}

#[test]
fn a_frame_whose_stamps_leave_a_doubt_is_nobodys() {
    // Frame 1 has the first settings; frames 2 to 4 may have the second already.
    let owner = |second: CameraSettings, shown: CameraSettings, chunk: bool| {
        let mut ahead = Ahead::new(capabilities(), TriggerLine::new(PERIOD_NS as f64 * 1e-3, 50.0, &plan()));
        let see = |seq: u64, settings: CameraSettings, ahead: &mut Ahead| {
            let start_us = LATENCY_US + settings.trigger_delay_us;
            let start_ns = seq as i64 * PERIOD_NS + ns_from_us(start_us);
            let exposure_us = chunk.then_some(settings.exposure_us);
            let (device_ns, exposure_start_ns, host_ns) = (start_ns, start_ns, start_ns + 1_000_000);
            ahead.see(&FrameStamp { seq, device_ns, exposure_start_ns, host_ns, exposure_us }).owner
        };
        let first = settings(3_000.0, 600.0);
        ahead.push(Applied { actual: first, first_frame: FirstFrame::Exactly(1) }, (0, 0), None);
        assert_eq!(see(1, first, &mut ahead), Some(0));
        let first_frame = FirstFrame::Within { earliest: 2, certain: 5 };
        ahead.push(Applied { actual: second, first_frame }, (PERIOD_NS, PERIOD_NS), None);
        see(2, shown, &mut ahead)
    };
    let first = settings(3_000.0, 600.0);
    let second = settings(3_200.0, 600.0);
    assert_eq!((owner(second, first, true), owner(second, second, true)), (Some(0), Some(1)));
    assert_eq!((owner(second, first, false), owner(second, second, false)), (Some(0), Some(1)));
    assert_eq!(owner(second, settings(3_100.0, 600.0), true), None, "a delay that nobody asked for");
    assert_eq!(owner(second, settings(3_200.0, 900.0), true), None, "an exposure that nobody asked for");
    assert_eq!(owner(settings(3_010.0, 600.0), settings(3_005.0, 600.0), true), None, "either might be");
    let longer = settings(3_200.0, 900.0);
    assert_eq!(
        (owner(longer, longer, true), owner(longer, longer, false)),
        (Some(1), None),
        "who knows how long"
    );
}
