//! What a data folder holds, as the socket tells it.

use std::ffi::OsStr;
use std::path::Path;

use raysweep_processing::calibration::{CalibrationHeader, current_in};
use raysweep_proto::{CalibrationInfo, SessionInfo};
use raysweep_session::integrity::{Audit, Damage, DamagedPart};
use raysweep_session::ledger::{EndState, LedgerText};
use raysweep_session::{Session, SessionSummary};

/// The procedure whose sessions hold calibrations.
const CALIBRATION: &str = "calibration";

/// The sessions of a data folder; those that cannot be read say why in their names.
pub fn sessions_in(data: &Path) -> raysweep_session::Result<Vec<SessionInfo>> {
    let listing = raysweep_session::list(data)?;
    let readable = listing.sessions.into_iter().map(|session| SessionInfo {
        session: session.dir,
        name: session.name,
        created: session.created.to_string(),
        stored: session.stored,
        points: session.points,
        can_resume: session.can_resume,
        state: session.end.map_or("unfinished", EndState::name).into(),
        kind: session.kind,
        operator: session.operator,
        sample: session.sample,
        tags: session.tags,
        warnings: session.warnings,
    });
    let unreadable = listing.unreadable.into_iter().map(|(dir, error)| SessionInfo {
        session: dir,
        name: error.to_string(),
        created: String::new(),
        stored: 0,
        points: 0,
        can_resume: false,
        state: "unreadable".into(),
        kind: String::new(),
        operator: None,
        sample: None,
        tags: Vec::new(),
        warnings: Vec::new(),
    });
    Ok(readable.chain(unreadable).collect())
}

/// The calibrations among the sessions of a data folder.
pub fn calibrations_in(data: &Path) -> raysweep_session::Result<Vec<CalibrationInfo>> {
    let listing = raysweep_session::list(data)?;
    let in_use = CalibrationHeader::read(&current_in(data)).ok().flatten();
    let measured = listing.sessions.into_iter().filter(|session| session.kind == CALIBRATION);
    let info = |session: SessionSummary| {
        let in_use = in_use.as_ref().is_some_and(|in_use| in_use.is_of(&session.dir));
        let (header, problem) = match CalibrationHeader::read(&session.dir) {
            Ok(header @ Some(_)) => (header, None),
            Ok(None) => {
                let why = match session.end {
                    None => "its run has not ended",
                    Some(_) => "its run did not succeed: `raysweep show` of the session says why",
                };
                (None, Some(why.into()))
            }
            Err(problem) => (None, Some(problem)),
        };
        CalibrationInfo {
            session: session.dir,
            made: header.as_ref().map_or_else(String::new, |header| header.made.to_string()),
            camera: header.map_or_else(String::new, |header| header.valid_for.camera),
            in_use,
            problem,
        }
    };
    let mut found: Vec<CalibrationInfo> = measured.map(info).collect();
    // Runs use it even if the session that measured it is gone or cannot be read.
    if let Some(header) = in_use.as_ref().filter(|_| !found.iter().any(|info| info.in_use)) {
        let name = Some(OsStr::new(&header.session));
        let at = found.partition_point(|info| info.session.file_name() < name);
        found.insert(
            at,
            CalibrationInfo {
                session: current_in(data),
                made: header.made.to_string(),
                camera: header.valid_for.camera.clone(),
                in_use: true,
                problem: None,
            },
        );
    }
    Ok(found)
}

/// What of a session's calibration is damaged, if anything.
pub fn damaged_calibration(session: &Session) -> raysweep_session::Result<Option<Damage>> {
    let text = LedgerText::read(&session.ledger_path())?;
    let state = text.replay(&session.ledger_path())?;
    let is_of_calibration = |damage: &Damage| match &damage.part {
        DamagedPart::Input { file } => file.starts_with("calibration."),
        part => matches!(part, DamagedPart::Manifest),
    };
    Ok(Audit::without_data(session, &text, &state)?.damage.into_iter().find(is_of_calibration))
}
