//! The session that `resume --auto` resumes.

use std::path::{Path, PathBuf};

use raysweep_config::AnyRigFile;
use raysweep_proto::SessionInfo;
use raysweep_session::{Session, input};

use super::CommandFailure;
use super::plan_file::MOST_BYTES;

/// A run that ends the daemon again and again would otherwise be resumed, with its light, for ever.
const MOST_BARREN_RESUMES: u32 = 3;

/// The newest session if it was cut off and may be resumed with nobody present; otherwise, why there is none.
///
/// # Errors
/// If its rig file cannot be read.
pub(super) fn cut_off(sessions: &[SessionInfo]) -> Result<Result<PathBuf, String>, CommandFailure> {
    let Some(newest) = sessions.iter().rfind(|session| session.state != "unreadable") else {
        return Ok(Err("no session to resume".into()));
    };
    let shown = newest.session.display();
    if newest.state != "unfinished" {
        return Ok(Err(format!("nothing to resume: the newest session, {shown}, is {}", newest.state)));
    }
    // What a link leads to may be the file of another rig.
    let read = |file| {
        let path = newest.session.join(file);
        input::read_itself(&path, MOST_BYTES)
            .map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
            .map_err(|source| CommandFailure::File { path, source })
    };
    // Calibrations and darks ask an operator to put something before the camera; a film's scene has moved on.
    let plan = toml::from_str::<toml::Table>(&read("plan.toml")?).unwrap_or_default();
    if plan.get("kind").and_then(toml::Value::as_str) != Some("sweep") {
        return Ok(Err(format!("{shown} was cut off; only sweeps are resumed with nobody present")));
    }
    let rig = AnyRigFile::parse(&read("rig.toml")?);
    if !matches!(rig, Ok(AnyRigFile::Plane(rig)) if rig.auto_resume) {
        return Ok(Err(format!(
            "{shown} was cut off; its rig file does not say `auto_resume = true`: `raysweep resume {}`",
            name(&newest.session)
        )));
    }
    let state = Session::open(&newest.session).and_then(|session| session.state());
    if let Ok(state) = state
        && state.barren_resumes >= MOST_BARREN_RESUMES
    {
        return Ok(Err(format!(
            "{shown} was resumed {} times without storing a point: see why in the journal, then `raysweep resume {}`",
            state.barren_resumes,
            name(&newest.session)
        )));
    }
    Ok(Ok(newest.session.clone()))
}

fn name(session: &Path) -> String {
    session.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use raysweep_session::ledger::{Entry, FORMAT, SessionEntry};
    use raysweep_session::stack::{Contents, StackShape};

    use super::*;

    const PERMITTED: &str = "kind = \"plane\"\nauto_resume = true\ncamera.driver = \"sim\"\nvsync.driver = \"sim\"\nprojector.driver = \"sim\"\n";

    fn session(folder: &Path, state: &str, rig: &str, plan: &str) -> SessionInfo {
        fs::write(folder.join("rig.toml"), rig).unwrap();
        fs::write(folder.join("plan.toml"), plan).unwrap();
        SessionInfo {
            session: folder.to_owned(),
            name: "a".into(),
            created: String::new(),
            stored: 1,
            points: 2,
            can_resume: false,
            state: state.into(),
            kind: "sweep".into(),
            operator: None,
            sample: None,
            tags: Vec::new(),
            warnings: Vec::new(),
        }
    }

    #[test]
    fn only_a_cut_off_sweep_of_a_rig_that_permits_it_is_resumed() {
        let folder = tempfile::tempdir().unwrap();
        let sweep = "kind = \"sweep\"";
        let forbidden = PERMITTED.replace("true", "false");
        let why = |state, rig: &str, plan| {
            cut_off(&[session(folder.path(), state, rig, plan)]).unwrap().err().unwrap_or_default()
        };
        assert_eq!(why("unfinished", PERMITTED, sweep), "");
        assert!(why("cancelled", PERMITTED, sweep).contains("is cancelled"));
        assert!(why("unfinished", &forbidden, sweep).contains("auto_resume"));
        assert!(why("unfinished", PERMITTED, "kind = \"darks\"").contains("only sweeps"));
        assert!(cut_off(&[]).unwrap().is_err());
        let linked = [session(folder.path(), "unfinished", PERMITTED, sweep)];
        fs::rename(folder.path().join("rig.toml"), folder.path().join("other.toml")).unwrap();
        std::os::unix::fs::symlink("other.toml", folder.path().join("rig.toml")).unwrap();
        assert!(cut_off(&linked).unwrap_err().to_string().contains("link"));
    }

    #[test]
    fn a_run_that_gets_nowhere_is_left_alone_after_three_attempts() {
        let data = tempfile::tempdir().unwrap();
        let shape = StackShape { contents: Contents::Sweep { points: 2, exposures: 1 }, rows: 2, columns: 2 };
        let entry = SessionEntry {
            format: FORMAT,
            name: "a".into(),
            kind: "sweep".into(),
            operator: None,
            sample: None,
            note: None,
            tags: Vec::new(),
            created: "2026-03-04T05:06:07Z".parse().unwrap(),
            software: "raysweep".into(),
            shape,
            first_row: 0,
        };
        let (created, mut ledger) =
            Session::create(data.path(), entry, "kind = \"sweep\"", PERMITTED).unwrap();
        let listed = [session(created.dir(), "unfinished", PERMITTED, "kind = \"sweep\"")];
        let run = |resumed| Entry::Run { started: "2026-03-04T05:06:08Z".parse().unwrap(), resumed };
        for resumed in [false, true, true] {
            ledger.append(&run(resumed)).unwrap();
            assert!(cut_off(&listed).unwrap().is_ok());
        }
        ledger.append(&run(true)).unwrap();
        assert!(cut_off(&listed).unwrap().unwrap_err().contains("3 times"));
    }

    #[test]
    fn an_older_session_is_left_alone() {
        let (old, new) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let sessions = [
            session(old.path(), "unfinished", PERMITTED, "kind = \"sweep\""),
            session(new.path(), "complete", PERMITTED, "kind = \"sweep\""),
        ];
        assert!(cut_off(&sessions).unwrap().is_err());
        assert_eq!(cut_off(&sessions[..1]).unwrap().unwrap(), old.path());
    }
}
