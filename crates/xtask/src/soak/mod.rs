//! `cargo xtask soak`: the daemon on simulated rigs with faults, for as long as one likes. Rounds of all procedures run
//! one after the other, beside clients that ask, misbehave and go away; each round also kills a daemon in the middle of a
//! sweep and resumes it. Judged is what may not grow or differ: memory, descriptors and threads at rest between rounds,
//! the accounting of each session, and the bits of resumed runs.

mod clients;
mod ledger;
mod process;
mod report;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use self::clients::Clients;
use self::process::AtRest;
use self::report::SoakReport;
use crate::daemon::Daemon;
use crate::run::{Done, cargo, root, run, target};

/// A plane rig whose line, trigger and camera fail now and then.
const PLANE: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
    rows = 720\n[sim]\nscene = \"v-groove\"\nscene_rows = 96\nscene_columns = 48\nseed = 1\n\
    [sim.vsync]\nmissing = 0.003\nfalse_edges = 0.003\nunseen = 0.003\n\
    [sim.camera]\ndropped = 0.003\nlate_frames_max = 2\n";
const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n[sim.dots]\nscene = \"v-groove\"\nseed = 1\n\
    [sim.dots.camera]\ndropped = 0.0001\n";

const SWEEP: &str = "kind = \"sweep\"\nname = \"sweep\"\n[sweep]\naverage = 8\n\
    delay_us = { start = -700, stop = 700, count = 15 }\nexposure_us = [400, 600, 900]\n";
const FILM: &str = "kind = \"film\"\nname = \"film\"\n[film]\ncycles = 40\n";
const DARKS: &str =
    "kind = \"darks\"\nname = \"darks\"\n[darks]\nexposure_us = [100, 1000, 10000]\nframes = 16\n";
const BATCHES: &str = "kind = \"batches\"\nname = \"batches\"\n[batches]\ncount = 6\ndots = 900\nexposure_us = 70\n\
    trailing_region = [240, 256, 112, 144]\n[batches.path]\nshape = \"raster\"\namplitude_deg = [2.2, 1.2]\nlines = 30\n\
    flyback = 0.1\n";

/// Rounds until memory, descriptors and threads have settled.
const WARM_UP_ROUNDS: usize = 2;

/// Longer than any run takes on a busy machine.
const RUN_LIMIT: Duration = Duration::from_secs(600);

/// What is wrong with a soak.
type Findings = Vec<String>;

/// Soaks for `minutes`, and fails if anything was found.
pub fn soak(minutes: f64) -> Done {
    run(cargo().args([
        "build",
        "--package",
        "raysweep",
        "--bins",
        "--profile",
        "demo",
        "--no-default-features",
    ]))?;
    let folder = target().join("soak");
    let _ = std::fs::remove_dir_all(&folder);
    let soak = Soak::new(target().join("demo"), folder)?;
    let response = read(&root().join("deploy/plans/mirror-response.toml"))?;
    let plane = Rig::start(&soak, "plane", PLANE)?;
    let dots = Rig::start(&soak, "dots", DOTS)?;
    let procedures = [
        (&plane, SWEEP),
        (&plane, FILM),
        (&plane, DARKS),
        (&plane, "kind = \"calibration\"\nname = \"calibration\"\n"),
        (&dots, BATCHES),
    ];
    let undisturbed = soak.undisturbed()?;
    let mut report = SoakReport::default();
    let end = Instant::now() + Duration::from_secs_f64(minutes * 60.0);
    let mut random = u64::from(std::process::id());
    println!("seed of the kills: {random}");
    while report.rounds() <= WARM_UP_ROUNDS + 2 || Instant::now() < end {
        let clients = [Clients::start(&plane.daemon.socket()), Clients::start(&dots.daemon.socket())];
        for (rig, plan) in procedures {
            report.ran(rig.ran(&soak, plan)?);
        }
        // Takes as long as four rounds of the others.
        if report.rounds() % 4 == 0 {
            report.ran(dots.ran(&soak, &response)?);
        }
        report.killed(soak.killed(&undisturbed, &mut random)?);
        for clients in clients {
            report.asked(clients.stop());
        }
        report.rested([AtRest::of(plane.daemon.id())?, AtRest::of(dots.daemon.id())?]);
        println!("{}", report.last_round());
    }
    let findings = report.findings(WARM_UP_ROUNDS);
    let path = report.write(&soak.folder, &findings)?;
    println!("{}\nreport: {}", report.table(&findings), path.display());
    plane.daemon.stop()?;
    dots.daemon.stop()?;
    if findings.is_empty() { Ok(()) } else { Err(findings.join("\n")) }
}

/// Programs and the folder of a soak.
struct Soak {
    programs: PathBuf,
    folder: PathBuf,
}

/// How a run ended.
pub struct Ran {
    /// The kind of its plan.
    pub kind: String,
    pub seconds: f64,
    pub findings: Findings,
}

/// How a killed and resumed run ended.
pub struct Killed {
    pub kills: usize,
    pub findings: Findings,
}

impl Soak {
    fn new(programs: PathBuf, folder: PathBuf) -> Done<Self> {
        std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        Ok(Self { programs, folder })
    }

    fn client(&self, daemon: &Daemon, arguments: &[&str]) -> Command {
        let mut client = Command::new(self.programs.join("raysweep"));
        client.args(arguments).arg("--socket").arg(daemon.socket()).stdin(Stdio::null());
        client
    }

    /// Checksums and accounting of a session; its folder is removed.
    fn verify(&self, session: &Path) -> Done<Findings> {
        let mut findings = ledger::audit(session);
        let verified = Command::new(self.programs.join("raysweep")).arg("verify").arg(session).output();
        let verified = verified.map_err(|error| format!("cannot start raysweep: {error}"))?;
        let _ = std::fs::remove_dir_all(session);
        let said = String::from_utf8_lossy(&verified.stdout);
        if !verified.status.success() {
            findings.push(format!("{}: {said}", session.display()));
        }
        Ok(findings)
    }

    /// The transport of the sweep when nothing disturbs the daemon.
    fn undisturbed(&self) -> Done<Vec<u8>> {
        let rig = Rig::start(self, "undisturbed", PLANE)?;
        let (session, _) = rig.session(self, SWEEP)?;
        let bits = std::fs::read(session.join("products/transport.npy"));
        rig.daemon.stop()?;
        bits.map_err(|error| format!("{}: {error}", session.display()))
    }

    /// Kills a daemon on the plane rig in the middle of a sweep, again and again, and completes the sweep.
    fn killed(&self, undisturbed: &[u8], random: &mut u64) -> Done<Killed> {
        let plan = self.write("sweep.toml", SWEEP)?;
        let mut session: Option<PathBuf> = None;
        let mut kills = 0;
        loop {
            let rig = Rig::start(self, "killed", PLANE)?;
            let mut client = match &session {
                None => self.client(&rig.daemon, &["run", "--json"]).arg(&plan).quiet()?,
                Some(session) => self.client(&rig.daemon, &["resume", "--json"]).arg(session).quiet()?,
            };
            let after = Duration::from_millis(50 + next(random) % 1500);
            let began = Instant::now();
            let ended = loop {
                let ended = client.try_wait().map_err(|error| format!("raysweep: {error}"))?;
                if ended.is_some() || kills < 3 && began.elapsed() > after {
                    break ended;
                }
                if began.elapsed() > RUN_LIMIT {
                    return Err(format!("a killed run did not end within {RUN_LIMIT:?}"));
                }
                std::thread::sleep(Duration::from_millis(5));
            };
            if session.is_none() {
                session = newest(&rig.data)?;
            }
            let Some(ended) = ended else {
                // Dropping kills.
                drop(rig);
                // Before the session was begun, nothing can be lost.
                kills += usize::from(session.is_some());
                let _ = client.wait();
                continue;
            };
            let Some(session) = session else {
                return Err(format!("raysweep run ended with {ended} and no session"));
            };
            rig.daemon.stop()?;
            let mut findings = Findings::new();
            if !ended.success() {
                findings.push(format!("{}: a killed run was not completed: {ended}", session.display()));
            } else if std::fs::read(session.join("products/transport.npy")).ok().as_deref()
                != Some(undisturbed)
            {
                findings.push(format!("{}: a killed run has other bits", session.display()));
            }
            findings.extend(self.verify(&session)?);
            return Ok(Killed { kills, findings });
        }
    }

    fn write(&self, name: &str, text: &str) -> Done<PathBuf> {
        let path = self.folder.join(name);
        std::fs::write(&path, text).map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(path)
    }
}

/// A daemon on a rig.
struct Rig {
    daemon: Daemon,
    data: PathBuf,
}

impl Rig {
    fn start(soak: &Soak, name: &str, rig: &str) -> Done<Self> {
        let data = soak.folder.join(name);
        let daemon = Daemon::start(&soak.programs, &soak.write(&format!("{name}.toml"), rig)?, &data)?;
        Ok(Self { daemon, data })
    }

    /// Runs a plan to its end; returns the session and the last event.
    fn session(&self, soak: &Soak, plan: &str) -> Done<(PathBuf, String)> {
        let plan = soak.write("plan.toml", plan)?;
        let output = soak.folder.join("output");
        let file =
            std::fs::File::create(&output).map_err(|error| format!("{}: {error}", output.display()))?;
        let mut client = soak.client(&self.daemon, &["run", "--json"]);
        let client = client.arg(&plan).stdout(file).spawn();
        let mut client = client.map_err(|error| format!("cannot start raysweep: {error}"))?;
        let began = Instant::now();
        while let Ok(None) = client.try_wait() {
            if began.elapsed() > RUN_LIMIT {
                return Err(format!("a run did not end within {RUN_LIMIT:?}"));
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let said = read(&output)?;
        let last = said.lines().find(|line| line.contains("\"event\":\"finished\"")).unwrap_or_default();
        let session = newest(&self.data)?.ok_or_else(|| format!("no session: {said}"))?;
        Ok((session, last.to_owned()))
    }

    fn ran(&self, soak: &Soak, plan: &str) -> Done<Ran> {
        let began = Instant::now();
        let (session, last) = self.session(soak, plan)?;
        let seconds = began.elapsed().as_secs_f64();
        let kind =
            plan.lines().find_map(|line| line.strip_prefix("kind = ")).unwrap_or_default().replace('"', "");
        let mut findings = Findings::new();
        // A film does not take lost cycles again.
        let has_all = kind == "film" || last.contains("\"missing\":0");
        if !last.contains("\"state\":\"complete\"") || !has_all {
            findings.push(format!("{kind}: {last}"));
        }
        findings.extend(soak.verify(&session)?);
        Ok(Ran { kind, seconds, findings })
    }
}

trait Quiet {
    fn quiet(&mut self) -> Done<Child>;
}

impl Quiet for Command {
    /// Starts a program whose output nobody wants.
    fn quiet(&mut self) -> Done<Child> {
        self.stdout(Stdio::null()).spawn().map_err(|error| format!("cannot start raysweep: {error}"))
    }
}

/// The newest session; session names begin with the time.
fn newest(data: &Path) -> Done<Option<PathBuf>> {
    let folders = std::fs::read_dir(data).map_err(|error| format!("{}: {error}", data.display()))?;
    Ok(folders.flatten().map(|folder| folder.path()).filter(|path| path.join("ledger.jsonl").exists()).max())
}

fn read(path: &Path) -> Done<String> {
    std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))
}

/// A random number (xorshift64).
fn next(state: &mut u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state
}
