//! `cargo xtask demo`: the paper's sweep on the simulated rig, through the real daemon and its client.

use std::process::Command;
use std::time::Instant;

use crate::daemon::Daemon;
use crate::run::{Done, cargo, root, run, target};

/// Builds, starts the daemon, runs the plan, stops the daemon.
pub fn demo() -> Done {
    let began = Instant::now();
    run(cargo().args([
        "build",
        "--package",
        "raysweep",
        "--bin=raysweepd",
        "--bin=raysweep",
        "--profile",
        "demo",
        "--no-default-features",
    ]))?;
    let built_s = began.elapsed().as_secs_f64();

    let programs = target().join("demo");
    let data = target().join("demo-sessions");
    let daemon = Daemon::start(&programs, &root().join("deploy/rigs/plane-sim.toml"), &data)?;

    let run_began = Instant::now();
    run(Command::new(programs.join("raysweep"))
        .arg("--socket")
        .arg(daemon.socket())
        .args(["run", "--operator", "demo", "--sample", "rendered V-groove"])
        .arg(root().join("deploy/plans/paper.toml")))?;
    let run_s = run_began.elapsed().as_secs_f64();
    daemon.stop()?;

    println!("built in {built_s:.0} s, ran in {run_s:.1} s");
    Ok(())
}
