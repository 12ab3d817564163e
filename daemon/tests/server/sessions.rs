//! `raysweep show`, `diff`, `rerun`, `note`, `trash` and `restore`, on stored sessions.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use nix::sys::stat::Mode;
use nix::unistd::mkfifo;
use raysweep_session::Session;
use raysweep_session::integrity::Audit;
use raysweep_session::ledger::{EndEntry, EndState, Entry};
use serde_json::{Value, json};

use crate::fake::Daemon;

/// Exit code, standard output, standard error.
fn run(arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_raysweep"))
        .args(["--socket", "/nonexistent/socket"])
        .args(arguments)
        .output()
        .unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

fn done(arguments: &[&str]) -> String {
    let (exit, out, err) = run(arguments);
    assert_eq!(exit, 0, "{arguments:?}: {out}{err}");
    out
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let target = to.join(entry.file_name());
        match entry.path().is_dir() {
            true => copy(&entry.path(), &target),
            false => drop(fs::copy(entry.path(), target).unwrap()),
        }
    }
}

/// A copy of the stored sweep in a data folder.
fn stored(data: &Path, name: &str) -> PathBuf {
    let to = data.join(name);
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/sessions/sweep"), &to);
    to
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn a_session_is_shown_on_one_screen_with_its_remarks() {
    let data = tempfile::tempdir().unwrap();
    let session = stored(data.path(), "20260101-000000_sweep");
    done(&["process", text(&session)]);
    done(&["note", text(&session), "a fingerprint on the lens", "--by", "Ada"]);
    done(&["note", text(&session), "wiped it"]);
    let shown = done(&["show", text(&session)]);
    for part in [
        "frames",
        "settings",
        "sweep.average = ",
        "a fingerprint on the lens",
        ", Ada: ",
        "prior: ",
        "report.html",
        "epipolar.npy",
    ] {
        assert!(shown.contains(part), "{part} in {shown}");
    }
    assert!(shown.find("fingerprint") < shown.find("wiped it"), "oldest first: {shown}");
    let shown: Value = serde_json::from_str(&done(&["show", text(&session), "--json"])).unwrap();
    assert_eq!(shown["remarks"][1]["text"], "wiped it");
    let thumbnails = data.path().join("thumbnails");
    let shown = done(&["show", text(&session), "--thumbnails", text(&thumbnails), "--json"]);
    let shown: Value = serde_json::from_str(&shown).unwrap();
    let listed: Vec<&str> =
        shown["thumbnails"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    assert!(listed.contains(&text(&thumbnails.join("epipolar.png"))), "{listed:?}");
    assert!(listed.iter().all(|path| fs::read(path).unwrap().starts_with(b"\x89PNG")));
    // A remark is under the ledger's checksums, and changes nothing else.
    let (_, audit) = Audit::of(&Session::open(&session).unwrap()).unwrap();
    assert!(audit.damage.is_empty(), "{:?}", audit.damage);
    let ledger = session.join("ledger.jsonl");
    let edited = fs::read_to_string(&ledger).unwrap().replace("fingerprint", "Fingerprint");
    fs::write(&ledger, edited).unwrap();
    assert_eq!(run(&["verify", text(&session)]).0, 1, "an edited remark is noticed");
    assert_eq!(run(&["note", text(&session), " "]).0, 2, "an empty remark");
}

#[test]
fn sessions_are_moved_away_and_back_and_deleted_only_for_good() {
    let data = tempfile::tempdir().unwrap();
    let session = stored(data.path(), "20260101-000000_sweep");
    let before = fs::read(session.join("ledger.jsonl")).unwrap();
    done(&["trash", text(&session)]);
    let trashed = data.path().join(".trash/20260101-000000_sweep");
    assert!(!session.exists() && trashed.exists());
    let (exit, _, err) = run(&["show", text(&session)]);
    let way_back = format!("`raysweep restore {}`", trashed.display());
    assert!(exit == 1 && err.contains(&way_back), "{exit} {err}");
    let listed = raysweep_session::list(data.path()).unwrap();
    assert!(listed.sessions.is_empty() && listed.unreadable.is_empty());
    // Another of the same name is not overwritten, neither there nor here.
    stored(data.path(), "20260101-000000_sweep");
    for arguments in [["trash", text(&session)], ["restore", text(&trashed)]] {
        let (exit, _, err) = run(&arguments);
        assert!(exit == 1 && err.contains("20260101-000000_sweep"), "{err}");
    }
    assert_eq!(run(&["restore", text(&session)]).0, 1, "it is not in the trash");
    done(&["trash", text(&session), "--for-good"]);
    assert!(!session.exists() && trashed.exists(), "the one in the trash is another");
    done(&["restore", text(&trashed)]);
    assert_eq!(fs::read(session.join("ledger.jsonl")).unwrap(), before);
    // While somebody works on it, it stays where it is.
    let locked = Session::open(&session).unwrap().resume().unwrap();
    for arguments in [
        &["trash", text(&session)][..],
        &["trash", text(&session), "--for-good"],
        &["note", text(&session), "x"],
    ] {
        let (exit, _, err) = run(arguments);
        assert!(exit == 1 && session.exists(), "{arguments:?}: {err}");
    }
    drop(locked);
}

#[test]
fn a_session_in_the_trash_is_restored_by_its_name() {
    let daemon = Daemon::start();
    let session = stored(daemon.folder.path(), "20260101-000000_sweep");
    done(&["trash", text(&session)]);
    // A name of neither here nor there, and one for which no daemon answers.
    let by_name = |socket: &Path, name: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
        command.arg("--socket").arg(socket).args(["restore", name]).output().unwrap()
    };
    for (socket, name) in
        [(&*daemon.path, "20260102-000000_sweep"), (Path::new("/none"), "20260101-000000_sweep")]
    {
        let refused = by_name(socket, name);
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(refused.status.code() == Some(1) && said.contains(name) && !session.exists(), "{said}");
        assert!(!said.contains("`raysweep sessions`"), "which does not list the trash: {said}");
    }
    let refused = by_name(&daemon.path, "20260102-000000_sweep");
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(said.contains("in the trash; it holds: 20260101-000000_sweep"), "{said}");
    let restored = by_name(&daemon.path, "20260101-000000_sweep");
    let said = String::from_utf8_lossy(&restored.stdout).into_owned();
    assert!(restored.status.success() && said.contains(text(&session)) && session.exists(), "{said}");
}

#[test]
fn a_new_folder_that_processing_refuses_is_removed() {
    let data = tempfile::tempdir().unwrap();
    let (session, to) = (stored(data.path(), "20260101-000000_sweep"), data.path().join("again"));
    let process = ["process", text(&session), "--to", text(&to)];
    for refused in ["nonsense", "kind = \"nonsense\"", "kind = \"epipolar\", width_rows = 0"] {
        let (exit, _, err) = run(&[&process[..], &["--product", refused]].concat());
        assert!(exit != 0 && !err.contains("already exists") && !to.exists(), "{refused}: {err}");
    }
    let stack = fs::read_dir(session.join("stack.zarr")).unwrap().count();
    let plan = fs::read_to_string(session.join("plan.toml")).unwrap();
    fs::write(session.join("plan.toml"), "kind = 1").unwrap();
    let (exit, _, err) = run(&process);
    assert!(exit != 0 && err.contains("plan") && !to.exists(), "{err}");
    fs::write(session.join("plan.toml"), plan).unwrap();
    done(&process);
    assert!(to.join("report.html").exists());
    assert_eq!(
        fs::read_dir(session.join("stack.zarr")).unwrap().count(),
        stack,
        "links, not the session's files"
    );
    let (exit, _, err) = run(&process);
    assert!(exit == 1 && err.contains("already exists") && to.join("report.html").exists(), "{err}");
}

#[test]
fn two_sessions_are_compared_by_settings_and_by_their_images() {
    let data = tempfile::tempdir().unwrap();
    let (a, b) = (stored(data.path(), "a"), stored(data.path(), "b"));
    let plan = fs::read_to_string(b.join("plan.toml")).unwrap();
    fs::write(b.join("plan.toml"), format!("{plan}\n[[stage]]\nname = \"demux\"\nprior = \"paper\"\n"))
        .unwrap();
    done(&["process", text(&a)]);
    done(&["process", text(&b), "--accept-edits"]);
    let same: Value = serde_json::from_str(&done(&["diff", text(&a), text(&a), "--json"])).unwrap();
    assert_eq!(same["settings"], Value::Array(Vec::new()));
    assert_eq!(same["products"]["epipolar"]["rms_difference"], 0.0);
    let picture = data.path().join("seen.png");
    let arguments = ["diff", text(&a), text(&b), "--picture", text(&picture)];
    let out = done(&arguments);
    assert!(
        out.contains("red is B > A, full at +") && out.contains("A and B: black is 0, white is"),
        "{out}"
    );
    assert!(out.contains("stage.0.prior = \"paper\", was not given"), "{out}");
    let compared: Value = serde_json::from_str(&done(&["diff", text(&a), text(&b), "--json"])).unwrap();
    // By other means: from the files themselves.
    let image = |dir: &Path| Session::open(dir).unwrap().products().read_image("epipolar").unwrap();
    let (one, other) = (image(&a), image(&b));
    let squares: f64 = one.iter().zip(&other).map(|(a, b)| (f64::from(*b) - f64::from(*a)).powi(2)).sum();
    let expected = (squares / one.len() as f64).sqrt();
    let found = compared["products"]["epipolar"]["rms_difference"].as_f64().unwrap();
    assert!(expected > 0.0 && (found / expected - 1.0).abs() < 1e-9, "{found}, {expected}");
    let width = u32::from_be_bytes(fs::read(&picture).unwrap()[16..20].try_into().unwrap()) as usize;
    assert_eq!(width, 3 * one.ncols() + 2 * 4);
    let (exit, _, err) = run(&[&arguments[..], &["--product", "nothing"]].concat());
    assert!(exit == 2 && err.contains("no image nothing"), "{err}");
}

/// Notes a further end of a session's run, with these warnings.
fn warn(session: &Path, warnings: &[&str]) {
    let mut ledger = Session::open(session).unwrap().resume().unwrap();
    let (stored, missing) = (ledger.state().stored_points(), ledger.state().missing_points());
    let warnings = warnings.iter().map(|&warning| warning.to_owned()).collect();
    let end = EndEntry::new(EndState::Complete, stored, missing, warnings);
    ledger.append(&Entry::End(end)).unwrap();
}

#[test]
fn the_warnings_of_a_run_are_shown_and_reported_and_those_of_one_session_alone_differ() {
    let data = tempfile::tempdir().unwrap();
    let (a, b) = (stored(data.path(), "a"), stored(data.path(), "b"));
    assert!(!done(&["show", text(&a)]).contains("warning"));
    warn(&a, &["the rig has moved", "few frames"]);
    warn(&b, &["few frames", "too bright"]);
    let shown = done(&["show", text(&a)]);
    assert!(shown.contains("\nwarning    the rig has moved\nwarning    few frames\n"), "{shown}");
    let shown: Value = serde_json::from_str(&done(&["show", text(&a), "--json"])).unwrap();
    assert_eq!(shown["warnings"], json!(["the rig has moved", "few frames"]));
    let said = done(&["diff", text(&a), text(&b)]);
    let differ = "\nwarning    only in A: the rig has moved\nwarning    only in B: too bright";
    assert!(said.contains(differ) && !said.contains("few frames"), "{said}");
    let compared: Value = serde_json::from_str(&done(&["diff", text(&a), text(&b), "--json"])).unwrap();
    assert_eq!(compared["warnings"], json!([["the rig has moved"], ["too bright"]]));
    done(&["process", text(&a)]);
    let page = fs::read_to_string(a.join("report.html")).unwrap();
    assert!(page.contains("the rig has moved") && page.contains("few frames"));
}

#[test]
fn a_session_is_run_again_with_its_plan_and_what_was_known_of_it() {
    let daemon = Daemon::start();
    let session = stored(daemon.folder.path(), "20260101-000000_sweep");
    let output = Command::new(env!("CARGO_BIN_EXE_raysweep"))
        .env("RAYSWEEP_SOCKET", &daemon.path)
        .args(["rerun", text(&session), "--detach"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let runs = daemon.fake.runs.lock().unwrap();
    assert_eq!(runs[0].plan, fs::read_to_string(session.join("plan.toml")).unwrap());
    let entry = Session::open(&session).unwrap().state().unwrap().session;
    assert_eq!(
        (&runs[0].operator, &runs[0].sample, &runs[0].tags),
        (&entry.operator, &entry.sample, &entry.tags)
    );
    // The fake has no session that it could be compared with.
    assert!(String::from_utf8(output.stderr).unwrap().contains("what has changed since is not known"));
    drop(runs);
    done(&["process", text(&session)]);
    let plan = fs::read_to_string(session.join("plan.toml")).unwrap();
    fs::write(session.join("plan.toml"), plan + "# changed\n").unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_raysweep"))
        .env("RAYSWEEP_SOCKET", &daemon.path)
        .args(["rerun", text(&session), "--detach"])
        .output()
        .unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && said.contains("plan.toml is damaged"), "{said}");
    assert_eq!(daemon.fake.runs.lock().unwrap().len(), 1, "nothing is run");
}

/// A processed session of its own.
fn processed(data: &Path) -> PathBuf {
    let session = stored(data, "20260101-000000_sweep");
    done(&["process", text(&session)]);
    session
}

fn is_gone(path: &Path) -> bool {
    fs::symlink_metadata(path).is_err()
}

#[test]
fn pipes_and_links_in_a_session_are_neither_waited_for_nor_followed() {
    let data = tempfile::tempdir().unwrap();
    let session = processed(data.path());
    let secret = data.path().join("secret");
    fs::write(&secret, "of somebody else").unwrap();
    let in_place = |file: &str, put: &dyn Fn(&Path)| {
        let (path, kept) = (session.join(file), data.path().join("kept"));
        fs::rename(&path, &kept).unwrap();
        put(&path);
        let (exit, out, err) = run(&["verify", text(&session)]);
        assert!(exit == 1 && out.contains(&format!("{file} is damaged")), "{file}: {out}{err}");
        for (command, to) in [("show", None), ("diff", Some(text(&session)))] {
            let words: Vec<&str> = [command, text(&session)].into_iter().chain(to).collect();
            let (_, out, err) = run(&words);
            assert!(!out.contains("somebody else"), "{out}");
            // Products that are no files are not listed.
            assert!(file.ends_with("npy") || format!("{out}{err}").contains(file), "{out}{err}");
        }
        let copy = data.path().join("copy");
        run(&["export", text(&session), "--accept-damage", "--to", text(&copy)]);
        let copied = copy.join(Path::new(file).file_name().unwrap());
        assert!(is_gone(&copied), "{file} was copied");
        let _ = fs::remove_dir_all(&copy);
        fs::remove_file(&path).unwrap();
        fs::rename(&kept, &path).unwrap();
    };
    for file in ["plan.toml", "rig.toml", "products/transport.json", "products/epipolar.npy"] {
        in_place(file, &|path| mkfifo(path, Mode::S_IRWXU).unwrap());
        in_place(file, &|path| symlink(&secret, path).unwrap());
        in_place(file, &|path| symlink("/dev/zero", path).unwrap());
    }
    let pipe = data.path().join("pipe");
    mkfifo(&pipe, Mode::S_IRWXU).unwrap();
    // A plan may come through a pipe, which has an end.
    for words in [["check", "/dev/zero"].as_slice(), &["park", "--state", text(&pipe)]] {
        let (exit, _, err) = run(words);
        assert!(exit != 0 && err.contains("not a regular file"), "{words:?}: {err}");
    }
    // A whole folder, too.
    let products = session.join("products");
    fs::rename(&products, data.path().join("elsewhere")).unwrap();
    symlink(data.path().join("elsewhere"), &products).unwrap();
    let shown = run(&["show", text(&session)]).1;
    assert!(!shown.contains("epipolar.npy"), "{shown}");
    assert_eq!(run(&["verify", text(&session)]).0, 1);
}

#[test]
fn what_is_shown_of_damaged_files_is_said_to_be_damaged() {
    let data = tempfile::tempdir().unwrap();
    let session = processed(data.path());
    assert!(!done(&["show", text(&session)]).contains("DAMAGED"));
    let image = session.join("products/epipolar.npy");
    let mut bytes = fs::read(&image).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&image, bytes).unwrap();
    let out = done(&["diff", text(&session), text(&session)]);
    assert!(out.contains("DAMAGED    in A, products/epipolar.npy is damaged"), "{out}");
    let plan = session.join("plan.toml");
    fs::write(&plan, fs::read_to_string(&plan).unwrap() + "\n").unwrap();
    let out = done(&["show", text(&session)]);
    assert!(out.contains("DAMAGED    plan.toml is damaged"), "{out}");
    // In a copy, the session is what is damaged.
    let chunk = fs::read_dir(session.join("stack.zarr/sum")).unwrap().map(|entry| entry.unwrap().path());
    let chunk = chunk.filter(|path| path.extension().is_none_or(|ending| ending != "json")).min().unwrap();
    fs::write(&chunk, "torn").unwrap();
    let (_, _, err) = run(&["process", text(&session), "--to", text(&data.path().join("copy"))]);
    assert!(err.contains(&format!("{} is damaged", session.display())), "{err}");
}

#[test]
fn what_others_wrote_into_a_session_does_not_control_the_terminal() {
    let data = tempfile::tempdir().unwrap();
    let session = processed(data.path());
    done(&["note", text(&session), "\u{1b}[2Jgone \u{202e}live\nstate      complete", "--by", "\u{9b}1mEve"]);
    let shown = done(&["show", text(&session)]);
    assert!(shown.contains("\\u{9b}1mEve: \\u{1b}[2Jgone \\u{202e}live\n           state "), "{shown}");
    assert!(!shown.contains(['\u{1b}', '\u{9b}', '\u{202e}']), "{shown}");
}

#[test]
fn nothing_is_copied_into_the_session_itself_and_half_a_copy_is_none() {
    let data = tempfile::tempdir().unwrap();
    let session = processed(data.path());
    let link = data.path().join("link");
    symlink(&session, &link).unwrap();
    let before = fs::read_dir(&session).unwrap().count();
    for to in [session.join("copy"), session.join("products/../copy"), link.join("copy")] {
        for command in
            [&["process"][..], &["export"], &["export", "--format", "zip"], &["export", "--format", "png"]]
        {
            let words = [command, &[text(&session), "--to", text(&to)]].concat();
            let (exit, _, err) = run(&words);
            assert!(exit != 0 && err.contains("is in the session itself"), "{words:?}: {err}");
        }
    }
    assert_eq!(fs::read_dir(&session).unwrap().count(), before);
    // A description that cannot be read is found after others were copied.
    fs::write(session.join("products/regular.json"), "{").unwrap();
    let to = data.path().join("copy");
    let words = ["export", text(&session), "--accept-damage", "--format", "npy", "--to", text(&to)];
    assert_ne!(run(&words).0, 0);
    assert!(is_gone(&to));
    let left: Vec<_> = fs::read_dir(data.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left.len(), 2, "{left:?}");
}

#[test]
fn a_trash_that_leads_elsewhere_is_refused() {
    let data = tempfile::tempdir().unwrap();
    let session = stored(data.path(), "20260101-000000_sweep");
    let elsewhere = data.path().join("elsewhere/.trash");
    fs::create_dir_all(&elsewhere).unwrap();
    symlink(&elsewhere, data.path().join(".trash")).unwrap();
    let (exit, _, err) = run(&["trash", text(&session)]);
    assert!(exit == 1 && err.contains("not a folder itself"), "{err}");
    assert!(session.exists());
    let other = stored(&elsewhere, "20260102-000000_sweep");
    let given = data.path().join(".trash/20260102-000000_sweep");
    let (exit, _, err) = run(&["restore", text(&given)]);
    assert!(exit == 1 && err.contains("not a folder itself") && other.exists(), "{err}");
}
