//! `raysweep view` with the real daemon: who is let in, that browsers change no bit, and the page in a real browser.

#![cfg(feature = "view")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod process;

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use nix::unistd::Uid;
use raysweep_proto::Client;
use raysweep_session::Session;
use raysweep_session::ledger::{EndEntry, EndState, Entry};
use raysweep_session::stack::ArrayName;
use serde_json::{Value, json};

use self::process::{HUNG, Process, wait_for};

const RIG: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
                   [sim]\nscene = \"v-groove\"\nscene_rows = 48\nscene_columns = 32\nseed = 1\n";
const SWEEP: &str = "kind = \"sweep\"\nname = \"groove\"\n[sweep]\naverage = 4\n\
                     delay_us = { start = -900, stop = 900, count = 13 }\nexposure_us = [400, 800]\n";
const FILM: &str = "kind = \"film\"\nname = \"film\"\n[film]\ncycles = 12\n";
const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
                    [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n";
const BATCHES: &str = "kind = \"batches\"\nname = \"dots\"\nproduct = [{ kind = \"floodlit\" }]\n\
                       [batches]\ncount = 2\ndots = 300\nexposure_us = 100\ndark_frames = 64\n\
                       trailing_region = [112, 128, 48, 80]\nbackground_indices = [0]\ncalibration = []\n\
                       [batches.path]\nshape = \"lissajous\"\ncycles = [7, 1]\namplitude_deg = [2.3, 1.3]\n\
                       samples = 1500\nrate_hz = 30000\n";
/// Nobody: a user who is no operator.
const OBSERVER: u32 = 65534;

struct Lab {
    folder: tempfile::TempDir,
    _daemon: Process,
}

impl Lab {
    fn start() -> Self {
        Self::with(RIG)
    }

    fn with(rig: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        let daemon = Process::start(
            Command::new(env!("CARGO_BIN_EXE_raysweepd"))
                .current_dir(folder.path())
                .args(["--rig", "rig.toml", "--data", "data", "--socket", "socket"])
                .stderr(Stdio::null()),
        );
        let lab = Self { folder, _daemon: daemon };
        wait_for("the daemon does not listen", || Client::connect(lab.socket()).ok());
        lab
    }

    fn socket(&self) -> PathBuf {
        self.folder.path().join("socket")
    }

    fn view(&self, uid: Option<u32>) -> Page {
        let built = Path::new(env!("CARGO_BIN_EXE_raysweep"));
        let program = self.folder.path().join("raysweep");
        if uid.is_some() && !program.exists() {
            // Others may not enter the folder in which it was built, such as root's home.
            fs::copy(built, &program).unwrap();
        }
        let mut command = Command::new(if uid.is_some() { &program } else { built });
        let said = fs::File::create(self.folder.path().join("said")).unwrap();
        command.arg("view").arg("--json").arg("--socket").arg(self.socket());
        command.stdout(Stdio::piped()).stderr(said);
        if let Some(uid) = uid {
            command.uid(uid).gid(uid);
        }
        let (process, output) = Process::with_output(&mut command);
        let mut line = String::new();
        BufReader::new(output).read_line(&mut line).unwrap();
        let told: Value = serde_json::from_str(&line).unwrap();
        let address = told["address"].as_str().unwrap().to_owned();
        let (host, path) = address.strip_prefix("http://").unwrap().split_once('/').unwrap();
        Page { _view: process, host: host.into(), path: format!("/{path}"), address: address.clone() }
    }

    /// What the view last started said on the terminal.
    fn said(&self) -> String {
        fs::read_to_string(self.folder.path().join("said")).unwrap()
    }

    /// Runs a plan to its end, at which nothing is missing; returns its session.
    fn run(&self, plan: &str) -> PathBuf {
        let output = Command::new(env!("CARGO_BIN_EXE_raysweep"))
            .args(["run", "--json", "--socket"])
            .arg(self.socket())
            .arg(self.write_plan(plan))
            .stderr(Stdio::null())
            .output()
            .unwrap();
        assert!(output.status.success(), "{output:?}");
        let text = String::from_utf8(output.stdout).unwrap();
        let end: Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
        assert_eq!((&end["state"], &end["missing"]), (&json!("complete"), &json!(0)), "{end}");
        end["session"].as_str().unwrap().into()
    }

    fn write_plan(&self, plan: &str) -> PathBuf {
        let path = self.folder.path().join("plan.toml");
        fs::write(&path, plan).unwrap();
        path
    }
}

/// A running view.
struct Page {
    _view: Process,
    host: String,
    path: String,
    address: String,
}

impl Page {
    /// Sends a request; returns status, head and body.
    fn request(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: &str,
    ) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.host).unwrap();
        // A stream of events that is let in has no end.
        stream.set_read_timeout(Some(HUNG)).unwrap();
        let has_host = headers.iter().any(|(name, _)| *name == "Host");
        let mut head =
            format!("{method} {path} HTTP/1.1\r\nConnection: close\r\nContent-Length: {}\r\n", body.len());
        if !has_host {
            head.push_str(&format!("Host: {}\r\n", self.host));
        }
        headers.iter().for_each(|(name, value)| head.push_str(&format!("{name}: {value}\r\n")));
        stream.write_all(format!("{head}\r\n{body}").as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|four| four == b"\r\n\r\n").unwrap();
        let head = String::from_utf8(answer[..end].to_vec()).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head.to_lowercase(), answer[end + 4..].to_vec())
    }

    fn get(&self, rest: &str) -> (u16, String, Vec<u8>) {
        self.request("GET", &format!("{}{rest}", self.path), &[], "")
    }

    fn call(&self, method: &str, params: Value) -> Value {
        let body = json!({ "method": method, "params": params }).to_string();
        let (status, _, answer) = self.request("POST", &format!("{}call", self.path), &[], &body);
        assert_eq!(status, 200, "{}", String::from_utf8_lossy(&answer));
        serde_json::from_slice(&answer).unwrap()
    }
}

#[test]
fn only_the_page_itself_is_let_in_and_only_with_its_users_rights() {
    let lab = Lab::start();
    let page = lab.view(None);
    let (status, head, body) = page.get("");
    assert_eq!(status, 200);
    assert!(head.contains("content-security-policy: default-src 'none'; script-src 'self'"), "{head}");
    assert!(String::from_utf8(body).unwrap().contains("<title>raysweep</title>"));

    let call = json!({ "method": "status" }).to_string();
    let to_call = format!("{}call", page.path);
    let wrong_token = page.path.replace(|digit: char| digit.is_ascii_hexdigit(), "0");
    let session = lab.run(SWEEP);
    let session = format!("session/{}", session.file_name().unwrap().to_str().unwrap());
    let of_session = ["", "/report", "/thumbnail", "/picture/epipolar", "/pixel/1/1", "/delays/1/1"];
    let of_session = of_session.map(|rest| format!("{session}{rest}"));
    let routes = ["events", "live", "live/epipolar"].into_iter().chain(of_session.iter().map(String::as_str));
    for route in routes {
        if route != "events" {
            assert_eq!(page.get(route).0, 200, "{route}");
        }
        for (path, headers) in [
            (&wrong_token, &[][..]),
            (&page.path, &[("Host", "rig.example.org")]),
            (&page.path, &[("Origin", "http://example.org")]),
        ] {
            let (status, _, body) = page.request("GET", &format!("{path}{route}"), headers, "");
            assert_eq!(status, 403, "{route} {headers:?}: {}", String::from_utf8_lossy(&body));
        }
    }
    for (path, headers) in [
        ("/", &[][..]),
        ("/call", &[]),
        (&wrong_token, &[]),
        (&to_call, &[("Host", "rig.example.org")]),
        (&to_call, &[("Origin", "http://example.org")]),
        (&to_call, &[("Origin", "null")]),
    ] {
        let (status, _, body) = page.request("POST", path, headers, &call);
        let text = String::from_utf8_lossy(&body).into_owned();
        assert_eq!(status, 403, "{path} {headers:?}: {text}");
        assert!(!text.contains("version"), "{text}");
    }
    // Not what the page has a button for, and not a call.
    for body in ["{\"method\": \"arm_light\"}", "{\"method\": \"subscribe\"}"] {
        assert_eq!(page.request("POST", &to_call, &[], body).0, 403, "{body}");
    }
    for body in ["", "[]", "{\"method\": 1}", "{\"method\": \"status\", \"more\": 1}"] {
        assert_eq!(page.request("POST", &to_call, &[], body).0, 400, "{body}");
    }
    // Only sessions that the daemon lists, and of them only pictures.
    let beyond = page.get(&format!("{session}/picture/epipolar?k=1"));
    let said = String::from_utf8_lossy(&beyond.2).into_owned();
    assert!(
        beyond.0 == 404 && said.contains("picture 1 of product `epipolar`, counted from 0 of 1"),
        "{said}"
    );
    for path in ["session/..", "session/%2Fetc", "session/x/report", "session/..%2F..%2Fetc/picture/passwd"] {
        assert_eq!(page.get(path).0, 404, "{path}");
    }
    assert_eq!(page.call("status", json!({}))["result"]["role"], "operator");
    let refused = page.call("run", json!({ "plan": "kind = \"sweep\"\n[sweep]\ndelay_us = []" }));
    assert_eq!(refused["error"]["data"]["name"], "invalid_plan", "{refused}");

    // Only root can start a process of another user.
    if Uid::effective().is_root() {
        // As in the service.
        let data = lab.folder.path().join("data");
        fs::set_permissions(&data, fs::Permissions::from_mode(0o750)).unwrap();
        let page = lab.view(Some(OBSERVER));
        let status = page.call("status", json!({}));
        assert_eq!(
            (&status["result"]["role"], &status["result"]["operators"]),
            (&json!("observer"), &json!("raysweep"))
        );
        for (method, params) in [
            ("run", json!({ "plan": SWEEP })),
            ("resume", json!({ "session": "groove" })),
            ("pause", json!({})),
            ("continue", json!({})),
            ("cancel", json!({})),
            ("viewfinder", json!({ "picture": "black" })),
        ] {
            assert_eq!(page.call(method, params)["error"]["data"]["name"], "forbidden", "{method}");
        }
        let (status, _, names) = page.get("live");
        let names: Value = serde_json::from_slice(&names).unwrap();
        assert_eq!((status, names["epipolar"].is_u64()), (200, true), "{names}");
        assert_eq!(page.get("live/epipolar").0, 200, "observers see live what a run does");
        let why = format!("only root may read {}", data.display());
        for route in &of_session {
            let (status, _, body) = page.get(route);
            let text = String::from_utf8_lossy(&body).into_owned();
            assert!(status == 403 && text.starts_with(&why), "{route}: {status} {text}");
        }
        let listed = page.call("sessions", json!({}));
        assert_eq!(listed["result"].as_array().unwrap().len(), 1, "{listed}");
        assert!(listed["barred"].as_str().unwrap().starts_with(&why), "{listed}");
        assert!(lab.said().contains("you are an observer") && lab.said().contains(&why), "{}", lab.said());
    }
}

/// All files below a folder of a session.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    files.insert(path.strip_prefix(folder).unwrap().to_owned(), fs::read(&path).unwrap());
                }
            }
        }
    }
    files
}

/// Number of a live picture.
fn sequence(picture: &[u8]) -> u64 {
    let length = u32::from_le_bytes(picture[..4].try_into().unwrap()) as usize;
    let head: Value = serde_json::from_slice(&picture[4..4 + length]).unwrap();
    head["sequence"].as_u64().unwrap()
}

/// A film and a sweep. The sweep comes last because it leaves all pictures that browsers look at.
const WATCHED: [&str; 2] = [FILM, SWEEP];

/// Runs [`WATCHED`] while ten browsers look at all that they can, and have looked at what the runs before have left.
fn run_watched(lab: &Lab) -> [PathBuf; 2] {
    const BROWSERS: usize = 10;
    let page = Arc::new(lab.view(None));
    let (stop, pictures) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
    // The stream of events stays open, as a browser's does.
    let streams: Vec<TcpStream> = (0..BROWSERS)
        .map(|_| {
            let mut stream = TcpStream::connect(&page.host).unwrap();
            let head = format!("GET {}events HTTP/1.1\r\nHost: {}\r\n\r\n", page.path, page.host);
            stream.write_all(head.as_bytes()).unwrap();
            stream.set_read_timeout(Some(HUNG)).unwrap();
            stream
        })
        .collect();
    let browsers: Vec<_> = (0..BROWSERS)
        .map(|browser| {
            let (page, stop, pictures) = (page.clone(), stop.clone(), pictures.clone());
            std::thread::spawn(move || {
                let (name, mut newest) = (["epipolar", "indirect", "total"][browser % 3], 0);
                // As fast as the page: each picture once, as soon as it comes.
                while !stop.load(Ordering::Relaxed) {
                    page.call("status", json!({}));
                    let (status, _, body) = page.get(&format!("live/{name}?after={newest}"));
                    if status == 200 {
                        newest = sequence(&body);
                        pictures.fetch_add(1, Ordering::Relaxed);
                    } else {
                        std::thread::sleep(Duration::from_millis(50));
                    }
                }
            })
        })
        .collect();
    let seen = |number| {
        wait_for("too few pictures", || (pictures.load(Ordering::Relaxed) >= number).then_some(()));
    };
    // Each looks on when the runs begin: it has seen the only picture that there is for it.
    seen(BROWSERS);
    let watched = WATCHED.map(|plan| lab.run(plan));
    seen(2 * BROWSERS);
    stop.store(true, Ordering::Relaxed);
    browsers.into_iter().for_each(|browser| browser.join().unwrap());
    for (stream, mut text) in streams.into_iter().map(|stream| (stream, String::new())) {
        let mut lines = BufReader::new(stream);
        // Each stream tells of both ends.
        for _ in 0..2 {
            while !text.contains("\"event\":\"finished\"") {
                text.clear();
                assert!(lines.read_line(&mut text).unwrap() > 0, "the stream of events has ended");
            }
            text.clear();
        }
    }
    watched
}

/// In virtual time, in which a busy machine is no other.
#[test]
fn ten_browsers_change_no_bit_of_a_sweep_and_a_film() {
    let lab = Lab::start();
    let alone = WATCHED.map(|plan| lab.run(plan));
    let watched = run_watched(&lab);
    for ((alone, watched), array) in alone.iter().zip(&watched).zip(["film.zarr", "stack.zarr"]) {
        let (alone, watched) = (files(&alone.join(array)), files(&watched.join(array)));
        assert!(alone.len() > 2 && alone == watched, "{array} differs");
    }
}

/// The frames come when the camera of a rig would send them. What browsers take of a core is measured by
/// `cargo xtask bench view`.
#[test]
fn ten_browsers_cost_no_frame_in_real_time() {
    let lab = Lab::with(&format!("{RIG}realtime = true\n"));
    lab.run(SWEEP);
    for session in run_watched(&lab) {
        let counts = Session::open(&session).unwrap().state().unwrap().counts;
        assert!(counts.balanced() && counts.averaged > 100 && counts.lost.is_empty(), "{counts:?}");
    }
}

#[test]
fn connections_that_ask_nothing_do_not_shut_the_page_out() {
    let lab = Lab::start();
    let page = lab.view(None);
    // More than the process may have files open.
    let idle: Vec<TcpStream> = (0..1100)
        .map_while(|nth| {
            let mut stream = TcpStream::connect(&page.host).ok()?;
            // Half of them begin with a request.
            if nth % 2 == 0 {
                stream.write_all(b"GET / HTTP/1.1\r\nHost: ").ok()?;
            }
            Some(stream)
        })
        .collect();
    assert!(idle.len() > 200, "{}", idle.len());
    assert_eq!(page.get("").0, 200);
}

#[test]
fn the_light_of_a_pixel_over_the_delays_is_that_of_the_stack() {
    let lab = Lab::start();
    let session = lab.run(SWEEP);
    let page = lab.view(None);
    let name = session.file_name().unwrap().to_str().unwrap();
    let (status, _, body) = page.get(&format!("session/{name}/delays/5/7"));
    assert_eq!(status, 200, "{}", String::from_utf8_lossy(&body));
    let told: Value = serde_json::from_slice(&body).unwrap();
    let opened = Session::open(&session).unwrap();
    let (state, stack) = (opened.state().unwrap(), opened.stack().unwrap());
    let of = |array, index: usize, frames: u32| {
        f64::from(stack.read(array).unwrap()[[index, 5, 7]]) / f64::from(frames)
    };
    let mut points = 0;
    for point in state.stored(ArrayName::Sum) {
        let dark = state.stored(ArrayName::Dark).find(|dark| dark.exposure_us == point.exposure_us).unwrap();
        let light =
            of(ArrayName::Sum, point.index, point.frames) - of(ArrayName::Dark, dark.index, dark.frames);
        let delays = told["delay_us"].as_array().unwrap();
        let delay = delays.iter().position(|delay| delay.as_f64() == Some(point.delay_us)).unwrap();
        let exposures = told["exposures"].as_array().unwrap();
        let of_exposure = exposures.iter().find(|it| it["exposure_us"].as_f64() == Some(point.exposure_us));
        let shown = of_exposure.unwrap()["light_dn"][delay].as_f64().unwrap();
        assert!((shown - light).abs() < 1e-9, "{shown} {light}");
        points += 1;
    }
    assert!(points > 20, "{points}");
    for outside in ["delays/5000/7", "pixel/5000/7", "pixel/18446744073709551615/0"] {
        let (status, _, why) = page.get(&format!("session/{name}/{outside}"));
        let why = String::from_utf8(why).unwrap();
        assert!(status == 404 && why.contains("rows and"), "{outside}: {status} {why}");
    }
}

#[test]
fn a_session_in_the_trash_is_said_to_be_there_and_is_not_resumed() {
    let lab = Lab::start();
    let session = lab.run(SWEEP);
    let name = session.file_name().unwrap().to_str().unwrap();
    let page = lab.view(None);
    assert_eq!(page.get(&format!("session/{name}")).0, 200);
    let trashed = Session::open(&session).unwrap().trash().unwrap();
    let way_back = format!("is in the trash: `raysweep restore {}`", trashed.display());
    for command in ["show", "resume"] {
        let output = Command::new(env!("CARGO_BIN_EXE_raysweep"))
            .args([command, name, "--socket"])
            .arg(lab.socket())
            .output()
            .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(1) && said.contains(&way_back), "{command}: {said}");
    }
    let (_, _, said) = page.get(&format!("session/{name}"));
    let said = String::from_utf8(said).unwrap();
    assert!(said.contains(&way_back), "{said}");
    let refused = &page.call("resume", json!({ "session": trashed }))["error"];
    assert_eq!(refused["data"]["name"], "no_session", "{refused}");
    assert!(refused["message"].as_str().unwrap().contains(&way_back), "{refused}");
}

/// A run is checked, started, watched, paused, cancelled, resumed, finished; its report is opened; a viewfinder is worked;
/// two sessions are compared; a run's questions are answered; a session's warnings are read; colours, limits and zoom of
/// a picture are changed; a dot rig's batches are watched.
#[test]
fn the_page_works_in_a_real_browser() {
    let python = std::env::var("RAYSWEEP_PYTHON").expect(
        "RAYSWEEP_PYTHON names a Python with tests/python/requirements.txt: `cargo xtask test` makes one",
    );
    let lab = Lab::start();
    let warned = lab.run(&SWEEP.replace("groove", "warned"));
    let mut ledger = Session::open(&warned).unwrap().resume().unwrap();
    let end = EndEntry::new(EndState::Complete, 26, 0, vec!["the rig has moved".into()]);
    ledger.append(&Entry::End(end)).unwrap();
    drop(ledger);
    let page = lab.view(None);
    let dots = Lab::with(DOTS);
    let of_dots = dots.view(None);
    let rig = RIG.replace("[projector]\ndriver = \"sim\"", "[projector]\ndriver = \"external\"");
    assert_ne!(rig, RIG);
    let asking = Lab::with(&format!("{rig}realtime = true\n"));
    let asked = asking.view(None);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/python/view_page.py");
    let mut command = Command::new(python);
    command.arg(script).arg(&page.address).arg(lab.write_plan(SWEEP)).arg(&asked.address);
    command.arg(&of_dots.address).arg(dots.write_plan(BATCHES));
    // To look at them: RAYSWEEP_SCREENSHOTS=FOLDER.
    if let Some(folder) = std::env::var_os("RAYSWEEP_SCREENSHOTS") {
        command.arg(folder);
    }
    let output = command.output().unwrap();
    let told = [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    assert!(output.status.success(), "{}", told.concat());
}
