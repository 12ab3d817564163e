//! A projector worked by an operator, on the simulated line: questions pause the run, and nothing is acquired before
//! the answer.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use raysweep::control::Control;
use raysweep_proto::{Event, RunParams, RunState};
use raysweep_session::stack::ArrayName;
use raysweep_tests::{Bench, Ended, end_of, next_event, rig_text};

const PLAN: &str = "kind = \"sweep\"\n[sweep]\ndelay_us = [-300, 0, 300]\nexposure_us = [500]\naverage = 2\n";

fn bench() -> Bench {
    let sim = "realtime = true\nscene = \"slab\"\nscene_rows = 16\nscene_columns = 8";
    let rig = rig_text(16, sim, "[sim.vsync]\njitter_us = 0\n");
    Bench::new(&rig.replace("[projector]\ndriver = \"sim\"", "[projector]\ndriver = \"external\""))
}

/// Runs the plan with an operator who does what is asked, calling `answer` first; returns the questions and the result.
fn run(bench: &Bench, answer: impl Fn(usize, &Bench)) -> (Vec<String>, Ended) {
    let mut events = bench.runner.events();
    let mut told = bench.runner.events();
    bench.runner.run(RunParams { plan: PLAN.into(), ..RunParams::default() }).unwrap();
    let mut asked = Vec::new();
    loop {
        match next_event(&mut events) {
            Event::Ask(question) => {
                if question.wants_answer {
                    let status = bench.runner.status();
                    assert_eq!((status.state, status.question.as_ref()), (RunState::Paused, Some(&question)));
                    answer(asked.len(), bench);
                }
                asked.push(question.to_string());
            }
            Event::Finished { .. } => {
                assert_eq!(bench.runner.status().question, None);
                return (asked, end_of(&mut told));
            }
            _ => {}
        }
    }
}

fn stored(bench: &Bench) -> usize {
    bench.runner.status().progress.map_or(0, |progress| progress.points_stored)
}

#[test]
fn points_wait_for_the_picture_that_they_need() {
    let bench = bench();
    let (asked, ended) = run(&bench, |questions_before, bench| {
        // Long enough for several frames, in case they were wrongly taken for points.
        std::thread::sleep(std::time::Duration::from_millis(300));
        // Before the light is off, nothing is stored; before it is on, only the dark images of the sweep and the
        // regular image.
        assert_eq!(stored(bench), [0, 2][questions_before]);
        bench.runner.go_on().unwrap();
    });
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    assert_eq!(asked.len(), 3, "{asked:?}");
    assert!(asked[0].contains("light off") && asked[1].contains("white"), "{asked:?}");
    assert!(asked[2].contains("light off") && asked[2].contains("over"), "{asked:?}");
    let (_, state) = ended.open();
    assert!(state.counts.balanced(), "{:?}", state.counts);
}

#[test]
fn a_run_that_waits_for_its_operator_can_be_cancelled_and_resumed() {
    let bench = bench();
    let (asked, ended) = run(&bench, |questions_before, bench| match questions_before {
        0 => bench.runner.go_on().unwrap(),
        _ => bench.runner.cancel().unwrap(),
    });
    assert_eq!((ended.state.as_str(), &ended.error), ("cancelled", &None), "{asked:?}");
    let (_, state) = ended.open();
    assert_eq!(state.stored(ArrayName::Sum).count(), 0, "nothing was taken in a light that nobody confirmed");
    assert!(state.point(ArrayName::Dark, 0).is_some());
}
