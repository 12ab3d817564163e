//! What users read when the daemon or `raysweep process` refuses something. The tests assert kind and field of each
//! refusal; the snapshots hold the messages.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fmt::Write;

use raysweep::control::Control;
use raysweep::rig::{AnyRig, RigError};
use raysweep::{Probes, Runner};
use raysweep_processing::{Asked, process, process_asked};
use raysweep_proto::{ErrorCode, ResumeParams, RpcError, RunParams, describe};
use raysweep_tests::{Bench, dots, rig_text};

/// A sweep that takes a few milliseconds.
const PLAN: &str =
    "kind = \"sweep\"\n[sweep]\naverage = 1\ndelay_us = [-60, 0, 60]\nexposure_us = [50, 100, 150]\n";

fn plane() -> Bench {
    Bench::new(&rig_text(8, "scene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8", ""))
}

/// Adds a refusal to a snapshot.
fn show(shown: &mut String, name: &str, error: &RpcError) {
    let code = error.name().unwrap();
    let field = error.data.as_ref().and_then(|data| data.field.as_deref()).unwrap_or("-");
    writeln!(shown, "# {name}\n{code:?} {field}\n{error}\n").unwrap();
}

/// Checks plans that a rig refuses. The snapshot also holds the field of each mistake.
fn refused(bench: &Bench, cases: &[(&str, String)]) -> String {
    let mut shown = String::new();
    for (name, plan) in cases {
        let error = bench.runner.check(plan).unwrap_err();
        let data = error.data.as_ref().unwrap();
        assert!(data.name == ErrorCode::InvalidPlan && data.field.is_some(), "{name}: {error}");
        assert!(data.span.is_some(), "{name} has no place");
        show(&mut shown, name, &error);
    }
    shown
}

#[test]
fn plans_that_a_plane_rig_refuses() {
    let stage = |lines: &str| format!("{PLAN}[[stage]]\n{lines}\n");
    let product = |lines: &str| format!("{PLAN}[[product]]\n{lines}\n");
    let cases = [
        ("a plan of a dot rig", "kind = \"batches\"".into()),
        ("unknown stage", stage("name = \"denoise\"")),
        ("unknown option of a stage", stage("name = \"hot-pixels\"\nthreshold = 3")),
        ("a text for an option", stage("name = \"hot-pixels\"\nthreshold_dn = \"3\"")),
        ("a negative threshold", stage("name = \"hot-pixels\"\nthreshold_dn = -1")),
        ("too far a neighbour", stage("name = \"hot-pixels\"\nstep_px = 3")),
        ("neighbours of a mosaic", stage("name = \"hot-pixels\"\nstep_px = 2")),
        ("unknown prior", stage("name = \"demux\"\nprior = \"plain\"")),
        ("a stage after demux", stage("name = \"demux\"\n[[stage]]\nname = \"hot-pixels\"")),
        ("no light at any delay", PLAN.replace("[-60, 0, 60]", "[-9000]")),
        ("a rig file", "kind = \"plane\"".into()),
        ("two folds of a name", stage("name = \"demux\"\n[[stage]]\nname = \"demux\"")),
        ("products without a transport", product("kind = \"regular\"\n[[stage]]\nname = \"hot-pixels\"")),
        ("unknown product", product("kind = \"floodlit\"")),
        ("unknown option of a product", product("kind = \"epipolar\"\nwidth = 3")),
        ("an even width", product("kind = \"epipolar\"\nwidth_rows = 4")),
        ("a band from high to low", product("kind = \"band\"\nfrom_rows = 3\nto_rows = 2")),
        ("a name with a slash", product("kind = \"regular\"\nname = \"a/b\"")),
        ("the name of the transport", product("kind = \"regular\"\nname = \"transport\"")),
        ("a name twice", product("kind = \"regular\"\n[[product]]\nkind = \"regular\"")),
        ("no light", product("kind = \"relight\"")),
        ("no rows of light", product("kind = \"relight\"\nrows = []")),
        ("rows that the projector lacks", product("kind = \"relight\"\nrows = [{ first = 0, last = 8 }]")),
        (
            "stripes wider than their period",
            product("kind = \"relight\"\nstripes = { period_rows = 2, lit_rows = 3 }"),
        ),
        ("a profile of nothing", product("kind = \"delay-profile\"")),
        ("a pixel that the camera lacks", product("kind = \"delay-profile\"\npixel = [8, 0]")),
        ("an empty region", product("kind = \"delay-profile\"\nregion = [3, 3, 0, 1]")),
        (
            "an exposure that the plan lacks",
            product("kind = \"delay-profile\"\npixel = [3, 4]\nexposure_us = 900"),
        ),
        ("a product of a film", "kind = \"film\"\n[[product]]\nkind = \"regular\"".into()),
    ];
    insta::assert_snapshot!(refused(&plane(), &cases));
}

#[test]
fn plans_that_a_dot_rig_refuses() {
    let plan = |lines: &str| dots::plan("", 2) + lines;
    let changed = |from: &str, to: &str| dots::plan("", 2).replace(from, to);
    let stage = |lines: &str| plan(&format!("[[stage]]\n{lines}\n"));
    let product = |lines: &str| plan(&format!("[[product]]\n{lines}\n"));
    let cases = [
        ("a plan of a plane rig", "kind = \"sweep\"".into()),
        ("a region beyond the frame", changed("[112, 128, 48, 80]", "[112, 129, 48, 80]")),
        ("a tilt beyond the mirror's limit", changed("[2.3, 1.3]", "[9.3, 1.3]")),
        ("a path too fast for the mirror", changed("cycles = [7, 1]", "cycles = [700, 1]")),
        ("unknown stage", stage("name = \"demux\"")),
        ("unknown option of a stage", stage("name = \"denoise\"\nradius = 3")),
        ("a negative radius", stage("name = \"denoise\"\nradius_px = -1")),
        ("a patch beyond the frame", stage("name = \"denoise\"\nstop = \"printed\"\npatch = [0, 999, 0, 8]")),
        ("no hot pixels", stage("name = \"correct\"\nhot_sigmas = 0")),
        ("a flat field of no session", stage("name = \"correct\"\nflat_field = \"nowhere\"")),
        ("unknown product", product("kind = \"epipolar\"")),
        ("unknown option of a product", product("kind = \"floodlit\"\nwidth = 3")),
        ("a negative distance", product("kind = \"direct-global\"\nmethod = \"epipolar\"\ndistance_px = -1")),
        ("no pixels", product("kind = \"dual\"\nsize_px = [0, 3]")),
        ("a name twice", product("kind = \"floodlit\"\n[[product]]\nkind = \"floodlit\"")),
        ("too large a chirp", "kind = \"response\"\n[response]\namplitude_deg = 3".into()),
    ];
    let bench = Bench::dots(&dots::rig(""));
    insta::assert_snapshot!(without_paths(&bench, &refused(&bench, &cases)));
}

#[test]
fn calls_that_are_refused() {
    let mut shown = String::new();
    for info in describe("1").errors {
        writeln!(shown, "{} {:?}: {}", info.code, info.name, info.meaning).unwrap();
    }
    shown.push('\n');
    let mut bench = plane();
    let run = |bench: &Bench, plan: &str| {
        bench.runner.run(RunParams { plan: plan.into(), ..RunParams::default() }).unwrap_err()
    };
    let resume = |bench: &Bench, session| bench.runner.resume(ResumeParams { session }).unwrap_err();
    let ended = bench.run(PLAN);
    let film = bench.run("kind = \"film\"\n[film]\ndelay_us = [-60, 0, 60]\nexposure_us = 50\ncycles = 1\n");
    let mut refusals = vec![
        ("pause without a run", ErrorCode::NotRunning, bench.runner.pause().unwrap_err()),
        ("continue without a run", ErrorCode::NotRunning, bench.runner.go_on().unwrap_err()),
        ("cancel without a run", ErrorCode::NotRunning, bench.runner.cancel().unwrap_err()),
        ("light without a mirror", ErrorCode::MethodNotFound, bench.runner.arm_light().unwrap_err()),
        ("a faulty plan", ErrorCode::InvalidPlan, run(&bench, "kind = \"sweep\"\n[sweep]\naverage = 0")),
        ("resume no session", ErrorCode::NoSession, resume(&bench, "none".into())),
        ("resume a film", ErrorCode::NoSession, resume(&bench, film.session)),
    ];
    let plan = ended.session.join("plan.toml");
    std::fs::write(&plan, PLAN.replace("[-60, 0, 60]", "[0, 60]")).unwrap();
    refusals.push(("resume with another plan", ErrorCode::NoSession, resume(&bench, ended.session.clone())));
    std::fs::write(ended.session.join("rig.toml"), "").unwrap();
    refusals.push(("resume on another rig", ErrorCode::NoSession, resume(&bench, ended.session)));
    bench.limit_memory(1, Probes::default());
    refusals.push(("too little memory", ErrorCode::Storage, run(&bench, PLAN)));
    bench.runner.shut_down();
    refusals.push(("run while the daemon ends", ErrorCode::Busy, run(&bench, PLAN)));
    for (name, code, error) in refusals {
        assert_eq!(error.name(), Some(code), "{name}: {error}");
        show(&mut shown, name, &error);
    }
    insta::assert_snapshot!(without_paths(&bench, &shown));
}

#[test]
fn sessions_that_cannot_be_processed() {
    let bench = plane();
    let ended = bench.run(PLAN);
    let film = bench.run("kind = \"film\"\n[film]\ndelay_us = [-60, 0, 60]\nexposure_us = 50\ncycles = 1\n");
    let darks = bench.run("kind = \"darks\"\n[darks]\nexposure_us = [50]\nframes = 1\n");
    let ask = |session, product: &str, memory_limit_bytes| {
        process_asked(
            session,
            &Asked { products: vec![product.into()], memory_limit_bytes, ..Asked::default() },
        )
    };
    let mut shown = String::new();
    let mut tell = |name: &str, error: raysweep_processing::ProcessError| {
        let debug = format!("{error:?}");
        let variant = debug.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
        writeln!(shown, "# {name}\n{variant}: {error}\n").unwrap();
    };
    tell("no session", process(&bench.folder.path().join("none")).unwrap_err());
    tell("a product that is none", ask(&ended.session, "kind = 3", None).unwrap_err());
    tell("unknown product", ask(&ended.session, "kind = \"floodlit\"", None).unwrap_err());
    tell("a product of a film", ask(&film.session, "kind = \"regular\"", None).unwrap_err());
    tell("a product of dark images", ask(&darks.session, "kind = \"regular\"", None).unwrap_err());
    tell(
        "too little memory",
        ask(&ended.session, "kind = \"regular\", name = \"again\"", Some(1)).unwrap_err(),
    );
    let plan = ended.session.join("plan.toml");
    std::fs::write(&plan, PLAN.replace("[-60, 0, 60]", "[0, 60]")).unwrap();
    tell("another plan", process(&ended.session).unwrap_err());
    std::fs::write(&plan, "kind = \"sweep\"\naverage = 3\n").unwrap();
    tell("a faulty plan", process(&ended.session).unwrap_err());
    std::fs::remove_file(&plan).unwrap();
    tell("no plan", process(&ended.session).unwrap_err());
    insta::assert_snapshot!(without_paths(&bench, &shown));
}

#[test]
fn rigs_that_cannot_be_used() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.toml");
    let open = |text: &String| {
        std::fs::write(&path, text).unwrap();
        let rig = AnyRig::load(&path)?;
        Runner::new(rig, folder.path().join("sessions")).map(drop)
    };
    let mut shown = String::new();
    for (name, text) in [
        ("a faulty rig file", "kind = \"plane\"\n[camera]\ndriver = \"sin\"\n".to_owned()),
        ("unknown scene of a plane rig", rig_text(8, "scene = \"teapot\"", "")),
        ("unknown scene of a dot rig", dots::rig("").replace("v-groove", "teapot")),
        (
            "a scene with more rows than the projector",
            rig_text(8, "scene = \"v-groove\"\nscene_rows = 16", ""),
        ),
        ("a simulated camera beside a bench", rig_text(128, "scene = \"v-groove\"\nbench = \"bench\"", "")),
    ] {
        let error = open(&text).unwrap_err();
        assert!(matches!(error, RigError::Config(_)), "{name}: {error}");
        writeln!(shown, "# {name}\n{error}\n").unwrap();
    }
    let unread = AnyRig::load(&folder.path().join("none.toml")).err().unwrap();
    writeln!(shown, "# no rig file\n{unread}\n").unwrap();
    insta::assert_snapshot!(shown.replace(folder.path().to_str().unwrap(), "/bench"));
}

/// The messages with fixed names for the bench's folder and its sessions.
fn without_paths(bench: &Bench, shown: &str) -> String {
    let sessions = bench.folder.path().join("sessions");
    let mut shown = shown.to_owned();
    for entry in std::fs::read_dir(&sessions).into_iter().flatten() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        if let Some((_, kind)) = name.split_once('_') {
            shown = shown.replace(&name, &format!("20260101-000000_{kind}"));
        }
    }
    shown.replace(bench.folder.path().to_str().unwrap(), "/bench")
}
