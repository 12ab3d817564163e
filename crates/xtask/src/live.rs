//! `cargo xtask bench live`: the daemon on the simulated rig in real time.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::daemon::Daemon;
use crate::run::{Done, cargo, root, run, target};

const SIDES_PX: [u32; 2] = [128, 512];

/// Threads that a simulated device runs in, and the pool's workers, which draw its noise; the pool has the daemon's name.
const SIMULATOR: [&str; 3] = ["camera", "vsync", "raysweepd"];

/// Clock ticks of `/proc/PID/task/TID/stat` in a second: Linux has had 100 on all machines for decades.
const TICKS_PER_S: f64 = 100.0;

/// How often threads are looked at, whose times go with them when they end.
const LOOK: Duration = Duration::from_millis(50);

/// How figures are printed.
pub enum Print {
    /// For people.
    Text,
    /// For programs.
    JsonLines,
}

/// What was measured of a run.
struct Ran {
    run_s: f64,
    /// From the last frame to the transport on disk.
    final_s: Option<f64>,
    /// Processor time of the simulator's threads and the pool's, and of all threads.
    simulator_s: f64,
    all_s: f64,
}

/// Builds the daemon, and runs the sweep at each size.
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
        let plan = plan.replace("average = 8", "average = 1");
        let (sweep, _) = plan.split_once("[[stage]]").ok_or("paper.toml has no stage")?;
        // What the simulator takes shows where nothing is computed beside it.
        let idle = ran(&rig, &written("sweep.toml", sweep.to_owned())?, &folder)?;
        let full = ran(&rig, &written("plan.toml", plan.clone())?, &folder)?;
        let final_s = full.final_s.ok_or("the run has made no transport; its message stands above")?;
        let case = format!("{side_px}x{side_px} at 30 frames/s");
        let simulator_share = idle.simulator_s / idle.run_s / cores as f64;
        let Ran { run_s, all_s, .. } = full;
        match print {
            Print::Text => println!(
                "{case}: transport on disk {final_s:.2} s after the last frame, run {run_s:.1} s, {all_s:.1} s of {cores} cores; \
                 the simulator alone takes {:.1} % of the cores while it sends frames",
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

/// A camera whose readout takes more than a period answers every other edge, 30 a second.
fn rig(side_px: u32) -> String {
    format!(
        "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
         [sim]\nscene = \"mix\"\nscene_rows = {side_px}\nscene_columns = {side_px}\nseed = 1\nrealtime = true\n\
         [sim.camera]\nreadout_us = 20000\n"
    )
}

/// Runs a plan in a daemon of its own.
fn ran(rig: &Path, plan: &Path, folder: &Path) -> Done<Ran> {
    let programs = target().join("release");
    let daemon = Daemon::start(&programs, rig, &folder.join("sessions"))?;
    let before = cpu_s(daemon.id());
    let ended = AtomicBool::new(false);
    let began = Instant::now();
    let (output, cpu_s) = std::thread::scope(|scope| {
        let watcher = scope.spawn(|| {
            let mut latest = before.clone();
            while !ended.load(Ordering::Relaxed) {
                latest.extend(cpu_s(daemon.id()));
                std::thread::sleep(LOOK);
            }
            latest
        });
        let output = Command::new(programs.join("raysweep"))
            .arg("--socket")
            .arg(daemon.socket())
            .args(["run", "--json"])
            .arg(plan)
            .stderr(Stdio::inherit())
            .output();
        ended.store(true, Ordering::Relaxed);
        (output, watcher.join())
    });
    let run_s = began.elapsed().as_secs_f64();
    let output = output.map_err(|error| format!("cannot start raysweep: {error}"))?;
    let said = String::from_utf8_lossy(&output.stdout);
    if !output.status.success() {
        return Err(format!("raysweep run ended with {}: {said}", output.status));
    }
    let cpu_s = cpu_s.map_err(|_panic| "the thread that looks at /proc panicked")?;
    daemon.stop()?;
    let spent = |wanted: &dyn Fn(&str) -> bool| -> f64 {
        let threads = cpu_s.iter().filter(|(_, (name, _))| wanted(name));
        threads.map(|(thread, (_, s))| s - before.get(thread).map_or(0.0, |(_, s)| *s)).sum()
    };
    Ok(Ran {
        run_s,
        final_s: said.lines().find_map(|line| number_after(line, "\"final_s\":")),
        simulator_s: spent(&|name| SIMULATOR.contains(&name)),
        all_s: spent(&|_| true),
    })
}

/// Processor time of each thread of a process so far, with its name; nothing of those that ended.
fn cpu_s(process: u32) -> BTreeMap<String, (String, f64)> {
    let threads = std::fs::read_dir(format!("/proc/{process}/task")).into_iter().flatten().flatten();
    let times = threads.filter_map(|thread| {
        let stat = std::fs::read_to_string(thread.path().join("stat")).ok()?;
        Some((thread.file_name().to_string_lossy().into_owned(), name_and_cpu_s(&stat)?))
    });
    times.collect()
}

/// From a line of `stat`: names may hold blanks and parentheses, so that fields count from the last parenthesis on.
fn name_and_cpu_s(stat: &str) -> Option<(String, f64)> {
    let name = stat.get(stat.find('(')? + 1..stat.rfind(')')?)?;
    let mut fields = stat.get(stat.rfind(')')? + 1..)?.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((name.to_owned(), (ticks()? + ticks()?) / TICKS_PER_S))
}

fn number_after(line: &str, key: &str) -> Option<f64> {
    let rest = line.split_once(key)?.1.trim_start();
    rest.split([',', '}']).next()?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_s_time_is_read_whatever_its_name() {
        let stat = "77 (a (b) c) S 1 2 3 4 5 6 7 8 9 10 150 50 0 0 20 0 1 0 99";
        assert_eq!(name_and_cpu_s(stat), Some(("a (b) c".into(), 2.0)));
        assert_eq!(name_and_cpu_s("77 (short) S 1"), None);
    }

    #[test]
    fn the_seconds_are_read_from_the_last_event() {
        let line = r#"{"event":"finished","final_s": 3.25, "stored":75}"#;
        assert_eq!(number_after(line, "\"final_s\":"), Some(3.25));
        assert_eq!(number_after(r#"{"final_s":null}"#, "\"final_s\":"), None);
    }
}
