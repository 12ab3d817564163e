//! `cargo xtask bench view`: what live pictures take of the daemon, alone and watched in a browser.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::Print;
use super::times::process_s;
use crate::daemon::Daemon;
use crate::run::{Done, cargo, run, target};

/// Pictures flow by then.
const BEGINS_AFTER: Duration = Duration::from_secs(3);
const MEASURED: Duration = Duration::from_secs(10);

/// A run whose pictures are watched.
struct Case {
    name: &'static str,
    /// Name of the live picture.
    picture: &'static str,
    camera: &'static [&'static str],
    projector: &'static str,
    rig: &'static str,
    plan: &'static str,
}

/// The camera is a process of its own, so all that the daemon takes is the daemon's.
const CASES: [Case; 2] = [
    Case {
        name: "viewfinder, 1280x720 at 15 pictures/s",
        picture: "viewfinder",
        camera: &["--test-pictures", "1280x720"],
        projector: "rows = 720\nrow_time_us = 22.22\nfirst_row_us = 555.5\n",
        rig: "scene = \"v-groove\"\nscene_rows = 720\nscene_columns = 16\n",
        plan: "kind = \"viewfinder\"\n[viewfinder]\ntrigger = \"none\"\nexposure_us = 2000\npictures_per_s = 15\nseconds = 60\n",
    },
    Case {
        name: "film, 128x128 at 4 cycles/s",
        picture: "epipolar",
        camera: &[],
        projector: "rows = 128\nrow_time_us = 22.22\nfirst_row_us = 2200\n",
        rig: "scene = \"v-groove\"\nscene_rows = 128\nscene_columns = 128\n",
        plan: "kind = \"film\"\nname = \"film\"\n[film]\ncycles = 120\n",
    },
];

/// What processes take of one core, and what a browser sees.
struct Taken {
    daemon: f64,
    view: f64,
    pictures_per_s: f64,
}

/// Builds the programs and measures each case alone, then watched.
pub fn view(print: Print) -> Done {
    let build = ["build", "--package", "raysweep", "--bins", "--all-features", "--release"];
    run(cargo().args(build))?;
    for case in &CASES {
        let folder = target().join("bench-view").join(case.picture);
        std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        let alone = measure(case, &folder, false)?;
        let watched = measure(case, &folder, true)?;
        let Case { name, .. } = case;
        match print {
            Print::Text => println!(
                "{name}: daemon {:.3} of a core alone, {:.3} watched; view {:.3} for {:.1} pictures/s",
                alone.daemon, watched.daemon, watched.view, watched.pictures_per_s
            ),
            Print::JsonLines => println!(
                "{{\"bench\":\"view\",\"case\":\"{name}\",\"daemon_cores_alone\":{:.4},\"daemon_cores_watched\":{:.4},\
                 \"view_cores\":{:.4},\"pictures_per_s\":{:.2}}}",
                alone.daemon, watched.daemon, watched.view, watched.pictures_per_s
            ),
        }
    }
    Ok(())
}

fn measure(case: &Case, folder: &Path, is_watched: bool) -> Done<Taken> {
    let programs = target().join("release");
    let written = |name: &str, text: &str| -> Done<PathBuf> {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(path)
    };
    let rig = written("rig.toml", &rig(case))?;
    let plan = written("plan.toml", case.plan)?;
    let mut camera = Command::new(programs.join("raysweep-sim-camera"));
    let (_camera, _) = Helper::start(camera.arg("--rig").arg(&rig).args(case.camera))?;
    let daemon = Daemon::start(&programs, &rig, &folder.join("sessions"))?;
    let client = |words: &[&str]| {
        let mut command = Command::new(programs.join("raysweep"));
        command.arg("--socket").arg(daemon.socket()).args(words);
        command
    };
    let watched = match is_watched {
        true => {
            let (view, line) = Helper::start(&mut client(&["view", "--json"]))?;
            Some((Browser::start(&line, case.picture)?, view))
        }
        false => None,
    };
    // The client stays for the run: a viewfinder ends with it.
    let mut run = client(&["run", "--json"]);
    let (_run, _) = Helper::start(run.arg(&plan))?;
    std::thread::sleep(BEGINS_AFTER);
    let view_id = watched.as_ref().map(|(_, view)| view.0.id());
    let seen = || watched.as_ref().map_or(0, |(browser, _)| browser.seen.load(Ordering::Relaxed));
    let view_s = || view_id.map_or(Ok(0.0), process_s);
    let before = (process_s(daemon.id())?, view_s()?, seen());
    let began = Instant::now();
    std::thread::sleep(MEASURED);
    let after = (process_s(daemon.id())?, view_s()?, seen());
    let s = began.elapsed().as_secs_f64();
    let taken = Taken {
        daemon: (after.0 - before.0) / s,
        view: (after.1 - before.1) / s,
        pictures_per_s: (after.2 - before.2) as f64 / s,
    };
    if is_watched && taken.pictures_per_s == 0.0 {
        return Err(format!("{}: no picture was seen", case.name));
    }
    // A daemon ends a run in order.
    daemon.stop()?;
    Ok(taken)
}

fn rig(case: &Case) -> String {
    format!(
        "kind = \"plane\"\n[camera]\ndriver = \"aravis\"\naravis.address = \"127.0.0.1\"\n[vsync]\ndriver = \"sim\"\n\
         [projector]\ndriver = \"sim\"\n{}[sim]\nbench = \"bench.sock\"\nseed = 1\n{}",
        case.projector, case.rig
    )
}

/// A program beside the daemon, killed in the end.
struct Helper(Child);

impl Helper {
    /// Starts it, and returns the first line that it prints.
    fn start(command: &mut Command) -> Done<(Self, String)> {
        let name = command.get_program().to_string_lossy().into_owned();
        let mut helper = Self(
            command
                .stdout(Stdio::piped())
                .spawn()
                .map_err(|error| format!("cannot start {name}: {error}"))?,
        );
        let mut output =
            BufReader::new(helper.0.stdout.take().ok_or_else(|| format!("{name} has no output"))?);
        let mut line = String::new();
        output.read_line(&mut line).map_err(|error| format!("{name}: {error}"))?;
        if line.is_empty() {
            return Err(format!("{name} ended before it was ready; its message stands above"));
        }
        // A full pipe would hold it up.
        std::thread::spawn(move || std::io::copy(&mut output, &mut std::io::sink()));
        Ok((helper, line))
    }
}

impl Drop for Helper {
    fn drop(&mut self) {
        // Both fail if it has ended.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Asks for each new picture, as the page does.
struct Browser {
    seen: Arc<AtomicU64>,
    over: Arc<AtomicBool>,
    asking: Option<JoinHandle<()>>,
}

impl Browser {
    /// Of the view whose first line this is.
    fn start(line: &str, picture: &str) -> Done<Self> {
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('"').next());
        let (host, path) =
            address.and_then(|it| it.split_once('/')).ok_or_else(|| format!("no address in {line}"))?;
        let (host, path) = (host.to_owned(), format!("/{path}live/{picture}"));
        let (seen, over) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let (counts, is_over) = (Arc::clone(&seen), Arc::clone(&over));
        let asking = std::thread::spawn(move || {
            let mut newest = 0;
            while !is_over.load(Ordering::Relaxed) {
                match sequence(&host, &format!("{path}?after={newest}")) {
                    Some(sequence) => {
                        newest = sequence;
                        counts.fetch_add(1, Ordering::Relaxed);
                    }
                    // Before the first picture.
                    None => std::thread::sleep(Duration::from_millis(20)),
                }
            }
        });
        Ok(Self { seen, over, asking: Some(asking) })
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        self.asking.take().map(JoinHandle::join);
    }
}

/// Gets a picture; its number.
fn sequence(host: &str, path: &str) -> Option<u64> {
    let mut stream = TcpStream::connect(host).ok()?;
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").ok()?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).ok()?;
    let text = String::from_utf8_lossy(&answer[..answer.len().min(4096)]).into_owned();
    text.split("\"sequence\":").nth(1)?.split([',', '}']).next()?.trim().parse().ok()
}
