//! `cargo xtask demo`: the paper's sweep on the simulated rig, through the real daemon and its client.

use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use crate::run::{Done, cargo, root, run, target};

/// Starting takes longer only where something is wrong.
const START_TIMEOUT: Duration = Duration::from_secs(30);

/// Builds, starts the daemon, runs the plan, stops the daemon.
pub fn demo() -> Done {
    let began = Instant::now();
    run(cargo().args(["build", "--package", "raysweep", "--bins", "--profile", "demo"]))?;
    let built_s = began.elapsed().as_secs_f64();

    let programs = target().join("demo");
    let data = target().join("demo-sessions");
    // Socket paths are short by law (108 bytes), checkouts are not.
    let runtime = std::env::temp_dir().join(format!("raysweep-demo-{}", std::process::id()));
    std::fs::create_dir_all(&runtime).map_err(|error| format!("{}: {error}", runtime.display()))?;
    let socket = runtime.join("raysweepd.sock");
    let rig = root().join("deploy/rigs/plane-sim.toml");
    let daemon = Command::new(programs.join("raysweepd"))
        .arg("--rig")
        .arg(&rig)
        .arg("--socket")
        .arg(&socket)
        .arg("--data")
        .arg(&data)
        .spawn()
        .map_err(|error| format!("cannot start raysweepd: {error}"))?;
    let mut daemon = Daemon { process: daemon, runtime };
    daemon.wait_for(&socket)?;

    let run_began = Instant::now();
    run(Command::new(programs.join("raysweep"))
        .arg("--socket")
        .arg(&socket)
        .args(["run", "--operator", "demo", "--sample", "rendered V-groove"])
        .arg(root().join("deploy/plans/paper.toml")))?;
    let run_s = run_began.elapsed().as_secs_f64();
    daemon.stop()?;

    println!("built in {built_s:.0} s, ran in {run_s:.1} s");
    println!("report: {}", newest(&data)?.join("report.html").display());
    Ok(())
}

/// The daemon, ended in order when all is well and in any case when not.
struct Daemon {
    process: Child,
    runtime: PathBuf,
}

impl Daemon {
    fn wait_for(&mut self, socket: &Path) -> Done {
        let began = Instant::now();
        while !socket.exists() {
            if let Ok(Some(status)) = self.process.try_wait() {
                return Err(format!("raysweepd ended with {status}; its message stands above"));
            }
            if began.elapsed() > START_TIMEOUT {
                return Err(format!("raysweepd does not listen on {}", socket.display()));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(())
    }

    /// Asks the daemon to end, as systemd does, and waits until it has.
    fn stop(&mut self) -> Done {
        run(Command::new("kill").args(["-TERM", &self.process.id().to_string()]))?;
        let status = self.process.wait().map_err(|error| format!("raysweepd: {error}"))?;
        if status.success() { Ok(()) } else { Err(format!("raysweepd ended with {status}")) }
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // Both fail where the daemon has ended in order, which is how it should be.
        let _ = self.process.kill();
        let _ = self.process.wait();
        let _ = std::fs::remove_dir_all(&self.runtime);
    }
}

/// The newest session: names begin with the time.
fn newest(data: &Path) -> Done<PathBuf> {
    let folders = std::fs::read_dir(data).map_err(|error| format!("{}: {error}", data.display()))?;
    let newest = folders.flatten().map(|folder| folder.path()).max();
    newest.ok_or_else(|| format!("{}: no session", data.display()))
}
