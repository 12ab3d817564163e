//! Makes products and reports from stored sessions. Runs call the same functions, so offline results are
//! bit-identical to those of the run.
//!
//! Needs no rig, socket or device.

pub mod batches;
pub mod calibration;
pub mod darks;
mod export;
pub mod film;
pub mod materials;
pub mod memory;
pub mod mirror_response;
pub mod patterns;
pub mod plane;
mod relit;
mod report;
pub mod response;
mod saturation;
mod software;
mod stored;
pub mod sweep;
mod video;
pub mod viewfinder;

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use raysweep_config::Procedure;
use raysweep_session::integrity::{Audit, Damage, DamagedPart};
use raysweep_session::ledger::State;
use raysweep_session::manifest::FileRecord;
use raysweep_session::{Session, manifest};

pub use export::{ExportFormat, ExportScope, copy_acquired, export, export_as};
pub use relit::{RelitImage, RelitPicture, relit};
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
    let before = results_before(&session, &results)?;
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

/// A damaged result before processing.
struct DamagedResult {
    file: String,
    /// What the manifest says of it.
    recorded: FileRecord,
    written: Written,
}

/// Which writing of a file this is: every result is a new file when it is made again, even if its bytes are those that
/// an earlier processing wrote and was killed before its manifest.
#[derive(PartialEq)]
struct Written {
    inode: u64,
    /// Seconds, and nanoseconds of the last one.
    modified: (i64, i64),
}

impl Written {
    /// Of a file, if it is there.
    fn of(path: &Path) -> Option<Self> {
        let metadata = path.metadata().ok()?;
        let modified = (metadata.mtime(), metadata.mtime_nsec());
        Some(Self { inode: metadata.ino(), modified })
    }
}

/// The damaged results that are there.
fn results_before(session: &Session, damage: &[Damage]) -> Result<Vec<DamagedResult>, ProcessError> {
    // Without a manifest, nothing says how a result should be.
    if damage.is_empty() || !session.manifest_path().exists() {
        return Ok(Vec::new());
    }
    let recorded = manifest::read(session)?.files;
    let before = damage.iter().filter_map(|damage| {
        let DamagedPart::Result { file } = &damage.part else { return None };
        let written = Written::of(&session.dir().join(file))?;
        Some(DamagedResult { file: file.clone(), recorded: recorded.get(file)?.clone(), written })
    });
    Ok(before.collect())
}

/// Keeps the manifest from certifying damaged results that were not made again.
fn keep_damaged(session: &Session, before: Vec<DamagedResult>) -> Result<(), ProcessError> {
    let is_kept = |before: &DamagedResult| {
        Written::of(&session.dir().join(&before.file)).as_ref() == Some(&before.written)
    };
    let kept: BTreeMap<_, _> =
        before.into_iter().filter(is_kept).map(|before| (before.file, before.recorded)).collect();
    if kept.is_empty() { Ok(()) } else { Ok(manifest::keep_records(session, &kept)?) }
}

/// Processes what is not damaged.
fn process_sound(session: &Session, state: &State, asked: &Asked) -> Result<Processed, ProcessError> {
    Stored::with(session, state, |stored| match stored.plan.procedure.clone() {
        Procedure::Sweep(own) => sweep::process(stored, own, asked),
        Procedure::Film(own) => film::process(stored, own, asked),
        Procedure::Batches(own) => batches::process(stored, own, asked),
        Procedure::Response(own) => response::process(stored, own, asked),
        Procedure::Darks(own) => darks::process(stored, own, asked),
        Procedure::Calibration(own) => calibration::process(stored, own, asked),
        Procedure::Patterns(own) => patterns::process(stored, own, asked),
        Procedure::Viewfinder(own) => viewfinder::process(stored, own, asked),
    })
}
