//! Makes products and reports from stored sessions. Runs call the same functions, so offline results are
//! bit-identical to those of the run.
//!
//! Needs no rig, socket or device.

pub mod batches;
pub mod calibration;
pub mod darks;
mod export;
pub mod film;
pub mod memory;
pub mod mirror_response;
pub mod plane;
mod report;
pub mod response;
mod saturation;
mod software;
mod stored;
pub mod sweep;
mod video;

use std::collections::BTreeMap;
use std::path::Path;

use raysweep_config::{Plan, Procedure};
use raysweep_session::integrity::{Audit, Damage, DamagedPart};
use raysweep_session::ledger::State;
use raysweep_session::manifest::FileRecord;
use raysweep_session::{Session, manifest};

use self::stored::read;

pub use export::{ExportScope, copy_acquired, export};
pub use software::SOFTWARE;
pub use stored::{Asked, ProcessError, Processed, Stored};

/// Makes the products of a session again, with its own plan and rig file: bit-identical to those of the run.
///
/// # Errors
/// When the session is being written by a run, or cannot be read.
pub fn process(dir: &Path) -> Result<Processed, ProcessError> {
    process_asked(dir, &Asked::default())
}

/// Like [`process`], with products that the plan does not name. Files of products that are not made now are kept.
///
/// # Errors
/// Those of [`process`]; when something is damaged, unless `asked` accepts it; and when a product cannot be made from
/// this session: all before anything is written.
pub fn process_asked(dir: &Path, asked: &Asked) -> Result<Processed, ProcessError> {
    let session = Session::open(dir)?;
    let (mut ledger, text) = session.open_damaged()?;
    let Audit { mut damage, torn_bytes, .. } = Audit::new(&session, &text, ledger.state())?;
    let edited: Vec<&str> = EDITABLE.into_iter().filter(|file| is_edited(&session, &damage, file)).collect();
    if asked.accept_edits {
        damage.retain(|damage| !edited.iter().any(|file| damage.part == input(file)));
    }
    let (results, damage): (Vec<_>, Vec<_>) = damage.into_iter().partition(Damage::is_of_results_only);
    if !damage.is_empty() && !asked.accept_damage {
        let damage = damage.iter().map(ToString::to_string).collect();
        let is_edited = !edited.is_empty() && !asked.accept_edits;
        return Err(ProcessError::Damaged { dir: dir.to_owned(), damage, is_edited });
    }
    ledger.leave_out(&damage);
    let before = records_of(&session, &results)?;
    let mut processed = process_sound(&session, ledger.state(), asked)?;
    if torn_bytes > 0 {
        let torn = "the last line of ledger.jsonl was torn by a crash: what it recorded is not stored";
        processed.problems.insert(0, torn.into());
    }
    keep_damaged(&session, before)?;
    if asked.accept_edits && !edited.is_empty() {
        ledger.append(&session.bind(|file| edited.contains(&file))?)?;
    }
    Ok(processed)
}

/// The files that users edit to process a session differently.
const EDITABLE: [&str; 2] = ["plan.toml", "rig.toml"];

fn input(file: &str) -> DamagedPart {
    DamagedPart::Input { file: file.to_owned() }
}

/// Whether a file is there, but not as it was.
fn is_edited(session: &Session, damage: &[Damage], file: &str) -> bool {
    session.dir().join(file).exists() && damage.iter().any(|damage| damage.part == input(file))
}

/// Of damaged results that are there: what the manifest says of them, and what they are.
fn records_of(session: &Session, damage: &[Damage]) -> Result<Vec<(String, [FileRecord; 2])>, ProcessError> {
    if damage.is_empty() {
        return Ok(Vec::new());
    }
    let recorded = manifest::read(session)?.files;
    let mut records = Vec::new();
    for damage in damage {
        let DamagedPart::Result { file } = &damage.part else { continue };
        let path = session.dir().join(file);
        if let Some(record) = recorded.get(file).filter(|_| path.exists()) {
            records.push((file.clone(), [record.clone(), FileRecord::read(&path)?]));
        }
    }
    Ok(records)
}

/// Keeps the manifest from certifying damaged results that were not made again.
fn keep_damaged(session: &Session, before: Vec<(String, [FileRecord; 2])>) -> Result<(), ProcessError> {
    let mut kept = BTreeMap::new();
    for (file, [recorded, damaged]) in before {
        let path = session.dir().join(&file);
        if path.exists() && FileRecord::read(&path)? == damaged {
            kept.insert(file, recorded);
        }
    }
    if kept.is_empty() { Ok(()) } else { Ok(manifest::keep_records(session, &kept)?) }
}

/// Processes what is not damaged.
fn process_sound(session: &Session, state: &State, asked: &Asked) -> Result<Processed, ProcessError> {
    let path = session.plan_path();
    let plan_text = read(&path)?;
    let plan = Plan::parse_stored(&plan_text)
        .map_err(|error| ProcessError::Config(error.render(&path.display().to_string(), &plan_text)))?;
    let stored = Stored { session, state, plan: &plan, plan_text: &plan_text };
    match plan.procedure.clone() {
        Procedure::Sweep(own) => sweep::process(&stored, own, asked),
        Procedure::Film(own) => film::process(&stored, own, asked),
        Procedure::Batches(own) => batches::process(&stored, own, asked),
        Procedure::Response(own) => response::process(&stored, own, asked),
        Procedure::Darks(own) => darks::process(&stored, own, asked),
        Procedure::Calibration(own) => calibration::process(&stored, own, asked),
    }
}
