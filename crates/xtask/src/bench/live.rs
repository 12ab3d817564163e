//! `cargo xtask bench live`: the daemon on the simulated rig in real time.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use super::Print;
use super::times::{cpu_s, spent_s};
use crate::daemon::Daemon;
use crate::run::{Done, cargo, root, run, target};

const SIDES_PX: [u32; 2] = [128, 512];

/// Threads of the simulated devices, and the workers of the thread pool, which compute sensor noise until the last
/// frame and have no other work before that; pool threads carry the daemon's name.
const SIMULATOR: [&str; 3] = ["camera", "vsync", "raysweepd"];

/// The event that follows the last frame.
const DRAINING: &str = "\"draining\"";

/// Measurements of a run.
struct Ran {
    run_s: f64,
    /// Time from the last frame to the transport on disk.
    final_s: f64,
    /// Total processor time of all threads.
    all_s: f64,
    /// Average number of cores used by the simulator's threads between the start of the run and its last frame.
    simulator_cores: f64,
}

/// Builds the daemon and runs the sweep at each size.
pub fn live(print: Print) -> Done {
    run(cargo().args(["build", "--package", "raysweep", "--bins", "--release"]))?;
    let cores = std::thread::available_parallelism().map_err(|error| error.to_string())?.get();
    for side_px in SIDES_PX {
        let folder = target().join("bench-live").join(side_px.to_string());
        let written = |name: &str, text: String| {
            let path = folder.join(name);
            std::fs::create_dir_all(&folder)
                .and_then(|()| std::fs::write(&path, text))
                .map(|()| path.clone())
                .map_err(|error| format!("{}: {error}", path.display()))
        };
        let rig = written("rig.toml", rig(side_px))?;
        let plan = root().join("deploy/plans/paper.toml");
        let plan = std::fs::read_to_string(&plan).map_err(|error| format!("{}: {error}", plan.display()))?;
        let plan = written("plan.toml", plan.replace("average = 8", "average = 1"))?;
        let Ran { run_s, final_s, all_s, simulator_cores } = ran(&rig, &plan, &folder)?;
        let case = format!("{side_px}x{side_px} at 30 frames/s");
        let simulator_share = simulator_cores / cores as f64;
        match print {
            Print::Text => println!(
                "{case}: transport on disk {final_s:.2} s after the last frame, run {run_s:.1} s, {all_s:.1} s of {cores} cores; \
                 the simulator takes {:.1} % of the cores while it sends frames",
                100.0 * simulator_share
            ),
            Print::JsonLines => println!(
                "{{\"bench\":\"live\",\"case\":\"{case}\",\"seconds\":{final_s:.3},\"run_seconds\":{run_s:.3},\
                 \"cpu_seconds\":{all_s:.2},\"cores\":{cores},\"simulator_share\":{simulator_share:.4}}}"
            ),
        }
    }
    Ok(())
}

/// A camera whose readout takes longer than a period responds to every other edge, 30 per second.
fn rig(side_px: u32) -> String {
    format!(
        "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
         [sim]\nscene = \"mix\"\nscene_rows = {side_px}\nscene_columns = {side_px}\nseed = 1\nrealtime = true\n\
         [sim.camera]\nreadout_us = 20000\n"
    )
}

/// Runs a plan in a separate daemon.
fn ran(rig: &Path, plan: &Path, folder: &Path) -> Done<Ran> {
    let programs = target().join("release");
    let daemon = Daemon::start(&programs, rig, &folder.join("sessions"))?;
    let before = cpu_s(daemon.id());
    let began = Instant::now();
    let mut client = Command::new(programs.join("raysweep"))
        .arg("--socket")
        .arg(daemon.socket())
        .args(["run", "--json"])
        .arg(plan)
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|error| format!("cannot start raysweep: {error}"))?;
    let events = client.stdout.take().map(BufReader::new).ok_or("raysweep run has no output")?;
    let mut latest = before.clone();
    let (mut simulator_cores, mut final_s) = (None, None);
    // Events arrive at every point, often enough to see each thread before it ends.
    for event in events.lines() {
        let event = event.map_err(|error| format!("raysweep run: {error}"))?;
        latest.extend(cpu_s(daemon.id()));
        if event.contains(DRAINING) {
            let simulator = spent_s(&before, &latest, |name| SIMULATOR.contains(&name));
            simulator_cores = Some(simulator / began.elapsed().as_secs_f64());
        }
        final_s = number_after(&event, "\"final_s\":").or(final_s);
    }
    let run_s = began.elapsed().as_secs_f64();
    let status = client.wait().map_err(|error| format!("raysweep run: {error}"))?;
    daemon.stop()?;
    match (simulator_cores, final_s) {
        (Some(simulator_cores), Some(final_s)) if status.success() => {
            let all_s = spent_s(&before, &latest, |_| true);
            Ok(Ran { run_s, final_s, all_s, simulator_cores })
        }
        _ => Err(format!("raysweep run ended with {status} and no transport; its message stands above")),
    }
}

fn number_after(line: &str, key: &str) -> Option<f64> {
    let rest = line.split_once(key)?.1.trim_start();
    rest.split([',', '}']).next()?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_seconds_are_read_from_the_last_event() {
        let line = r#"{"event":"finished","final_s": 3.25, "stored":75}"#;
        assert_eq!(number_after(line, "\"final_s\":"), Some(3.25));
        assert_eq!(number_after(r#"{"final_s":null}"#, "\"final_s\":"), None);
    }
}
