//! What of a session is damaged: its checksums, compared with what is on disk.
//!
//! | part | its checksum |
//! | --- | --- |
//! | a line of the ledger | the line's own `chain` |
//! | data of points, cycles and batches | the CRC-32 in their line of the ledger |
//! | plan, rig, calibration and other inputs | the ledger's `files`; in sessions of format 1, the manifest |
//! | results, and the ledger as it was when they were made | the manifest, which has a checksum of its own |

use std::io::{ErrorKind, Read};
use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;

pub use crate::damage::{Damage, DamagedPart};
use crate::folder::{MOST_TEXT_BYTES, Session};
use crate::ledger::{EndState, LedgerText, PointEntry, State};
use crate::manifest::{self, FileRecord, Manifest};
use crate::stack::{ArrayName, Contents, crc32};
use crate::{Error, Result, film, input};

/// The result of checking all checksums of a session.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Audit {
    /// What is damaged.
    pub damage: Vec<Damage>,
    /// Files that the manifest does not name, if there is one.
    pub added: Vec<String>,
    /// Bytes of a last line of the ledger that a crash tore: it was never acknowledged.
    pub torn_bytes: usize,
    /// Whether there is a manifest. Without one nothing has a checksum that is a result.
    pub has_manifest: bool,
}

impl Audit {
    /// Checks a session without locking it; also returns what its ledger says of it.
    ///
    /// # Errors
    /// As [`LedgerText::read`], [`LedgerText::replay`] and [`Audit::new`].
    pub fn of(session: &Session) -> Result<(State, Self)> {
        let text = LedgerText::read(&session.ledger_path())?;
        let state = text.replay(&session.ledger_path())?;
        let audit = Self::new(session, &text, &state)?;
        Ok((state, audit))
    }

    /// Checks a session, given what its ledger says and the state that results from it.
    ///
    /// # Errors
    /// [`crate::Error::Io`] if the session's folder cannot be listed or read.
    pub fn new(session: &Session, text: &LedgerText, state: &State) -> Result<Self> {
        let mut audit = Self::without_data(session, text, state)?;
        audit.damage.extend(damaged_data(session, state, &|| true));
        audit.damage.sort_by(|a, b| a.part.cmp(&b.part));
        Ok(audit)
    }

    /// As [`Audit::new`], but for the data of points, cycles and batches: enough to tell whether results are sound.
    ///
    /// # Errors
    /// As [`Audit::new`].
    pub fn without_data(session: &Session, text: &LedgerText, state: &State) -> Result<Self> {
        let line = |(line, why): &(usize, String)| Damage {
            part: DamagedPart::Line { line: *line },
            why: why.clone(),
        };
        let mut audit = Self { torn_bytes: text.torn_bytes, ..Self::default() };
        audit.damage.extend(text.damaged.iter().map(line));
        audit.damage.extend(changed_inputs(session, state)?);
        audit.add_manifest(session, state, text.damaged.is_empty())?;
        audit.damage.sort_by(|a, b| a.part.cmp(&b.part));
        Ok(audit)
    }

    /// Compares the session with its manifest, as far as the ledger does not say what must be there.
    fn add_manifest(&mut self, session: &Session, state: &State, lines_are_sound: bool) -> Result<()> {
        self.has_manifest = session.manifest_path().exists();
        if !self.has_manifest {
            self.damage.extend(missing_manifest(state));
            return Ok(());
        }
        let recorded = match manifest::read(session) {
            Ok(Manifest { files, .. }) => files,
            Err(error) => {
                self.damage.push(Damage { part: DamagedPart::Manifest, why: error.to_string() });
                return Ok(());
            }
        };
        let found = manifest::paths_of(session)?;
        let added = found.iter().filter(|(file, _)| !recorded.contains_key(*file));
        for (file, path) in added {
            self.added.push(file.clone());
            // Whatever it leads to is no part of the session.
            if let Err(why) = input::open_itself(path, u64::MAX) {
                let part = DamagedPart::Result { file: file.clone() };
                self.damage.push(Damage { part, why: why.to_string() });
            }
        }
        let compare = |(file, record): (&String, &FileRecord)| {
            let why = match found.get(file) {
                // Lines are appended after the manifest was written, and those with damage have been named.
                Some(path) if file == LEDGER => {
                    (lines_are_sound && !begins_with(path, record)?).then(|| SHORTENED.into())
                }
                _ if state.files().contains_key(file) || is_data(file) => None,
                Some(path) => why_unlike_manifest(path, record)?,
                None => Some(MISSING.into()),
            };
            let file = file.clone();
            let part = match is_result(&file, &state.session.kind) {
                true => DamagedPart::Result { file },
                false => DamagedPart::Input { file },
            };
            Ok(why.map(|why| Damage { part, why }))
        };
        let compared: Vec<Option<Damage>> = recorded.par_iter().map(compare).collect::<Result<_>>()?;
        self.damage.extend(compared.into_iter().flatten());
        Ok(())
    }
}

const LEDGER: &str = "ledger.jsonl";
const MANIFEST: &str = "manifest.json";
const MISSING: &str = "it is missing";
const NO_MANIFEST: &str = "it is missing, unless the run is being finished at this moment";
const NOT_OF_LEDGER: &str = "its SHA-256 is not the one in the ledger";
const NOT_OF_MANIFEST: &str = "its SHA-256 is not the one in the manifest";
const SHORTENED: &str = "it does not begin with the lines that it had when the manifest was written";
const OTHER_SIZE: &str = "its size is not the one in the manifest";
const OTHER_CRC: &str = "its checksum differs from the ledger's";

/// A session that is complete and has results also has a manifest.
fn missing_manifest(state: &State) -> Option<Damage> {
    let is_complete = state.end.as_ref().is_some_and(|end| end.state == EndState::Complete);
    let part = DamagedPart::Result { file: MANIFEST.into() };
    (is_complete && state.session.shape.contents != Contents::Nothing)
        .then(|| Damage { part, why: NO_MANIFEST.into() })
}

/// Whether the CRC-32 of a file's content is in the ledger.
fn is_data(file: &str) -> bool {
    let is_chunk = !file.ends_with("zarr.json");
    is_chunk && ["stack.zarr/", "film.zarr/", "dots.zarr/b"].iter().any(|data| file.starts_with(data))
}

/// Whether a file can be made again from the others of a session of this kind.
fn is_result(file: &str, kind: &str) -> bool {
    let results = ["products/", "report.html", "transport.zarr/", "transport_film.zarr/"];
    // The records of a mirror's axes are among the products, and its response is made from them.
    let is_of_mirror = kind == "response" && file == "mirror-response.json";
    let is_record = file.starts_with("products/chirp_");
    is_of_mirror || (results.iter().any(|result| file.starts_with(result)) && !is_record)
}

/// Whether a file begins with the bytes of a record.
fn begins_with(path: &Path, record: &FileRecord) -> Result<bool> {
    let read = |path: &Path| {
        let mut begin = Vec::new();
        input::open_itself(path, u64::MAX)?.take(record.bytes).read_to_end(&mut begin).map(|_| begin)
    };
    let begin = read(path).map_err(crate::Error::io("read", path))?;
    Ok(FileRecord::of(&begin) == *record)
}

/// The files that results depend on and that are not as the ledger has them; none in sessions of format 1.
///
/// # Errors
/// [`crate::Error::Io`] if a file cannot be read.
pub fn changed_inputs(session: &Session, state: &State) -> Result<Vec<Damage>> {
    let mut changed = Vec::new();
    for (file, sha256) in state.files() {
        let why = why_unlike_ledger(&session.dir().join(file), sha256)?;
        let part = DamagedPart::Input { file: file.clone() };
        changed.extend(why.map(|why| Damage { part, why }));
    }
    Ok(changed)
}

/// Which of these files, given by their paths in the session, are not as the ledger or the manifest has them. Files that
/// neither names are left out: a session that is not complete has no manifest.
///
/// # Errors
/// [`crate::Error::Io`] if a file cannot be read.
pub fn damaged_files(session: &Session, state: &State, files: &[String]) -> Result<Vec<Damage>> {
    let mut damage = Vec::new();
    let recorded = match manifest::read(session) {
        Ok(Manifest { files, .. }) => files,
        Err(Error::Io { source, .. }) if source.kind() == ErrorKind::NotFound => {
            damage.extend(missing_manifest(state));
            Default::default()
        }
        Err(error) => {
            damage.push(Damage { part: DamagedPart::Manifest, why: error.to_string() });
            Default::default()
        }
    };
    for file in files {
        let path = session.dir().join(file);
        let why = match (state.files().get(file), recorded.get(file)) {
            (Some(sha256), _) => why_unlike_ledger(&path, sha256)?,
            (None, Some(record)) => why_unlike_manifest(&path, record)?,
            (None, None) => None,
        };
        let file = file.clone();
        let part = match is_result(&file, &state.session.kind) {
            true => DamagedPart::Result { file },
            false => DamagedPart::Input { file },
        };
        damage.extend(why.map(|why| Damage { part, why }));
    }
    Ok(damage)
}

/// Why a file is not the one that the ledger has, if it is another.
fn why_unlike_ledger(path: &Path, sha256: &str) -> Result<Option<String>> {
    // What no plan or rig file can be need not be read to its end.
    let is_text = path.extension().is_some_and(|ending| ending == "toml");
    match std::fs::symlink_metadata(path) {
        Ok(found) if is_text && found.len() > MOST_TEXT_BYTES => Ok(Some(NOT_OF_LEDGER.into())),
        _ => why_unlike(path, sha256, NOT_OF_LEDGER),
    }
}

/// Why a file is not the one that the manifest has, if it is another.
fn why_unlike_manifest(path: &Path, record: &FileRecord) -> Result<Option<String>> {
    match std::fs::symlink_metadata(path) {
        Ok(found) if found.is_file() && found.len() != record.bytes => Ok(Some(OTHER_SIZE.into())),
        _ => why_unlike(path, &record.sha256, NOT_OF_MANIFEST),
    }
}

/// Why a file is not the one that has this SHA-256, if it is another, is missing, or is no file at all.
fn why_unlike(path: &Path, sha256: &str, unlike: &str) -> Result<Option<String>> {
    match FileRecord::read(path) {
        Ok(found) => Ok((found.sha256 != *sha256).then(|| unlike.into())),
        Err(Error::Io { source, .. }) if source.kind() == ErrorKind::NotFound => Ok(Some(MISSING.into())),
        // A symbolic link, a pipe, a device.
        Err(Error::Io { source, .. }) if source.kind() == ErrorKind::InvalidInput => {
            Ok(Some(source.to_string()))
        }
        Err(error) => Err(error),
    }
}

/// The stored data that are damaged: they cannot be read, or have another checksum than their line of the ledger.
/// Returns early, soon after `go_on` returns false.
pub fn damaged_data(session: &Session, state: &State, go_on: &(dyn Fn() -> bool + Sync)) -> Vec<Damage> {
    let mut damage = Vec::new();
    let points: Vec<&PointEntry> = [ArrayName::Sum, ArrayName::Dark, ArrayName::Regular]
        .iter()
        .flat_map(|&array| state.stored(array))
        .collect();
    let stack = session.stack().map_err(|error| error.to_string());
    let of_point = |point: &&PointEntry| {
        let PointEntry { array, index, crc32: sum, clipped_crc32, .. } = **point;
        let images = [(array, Some(sum)), (ArrayName::Clipped, clipped_crc32)];
        let why =
            images.into_iter().filter_map(|(array, crc)| Some((array, crc?))).find_map(|(array, crc)| {
                match &stack {
                    Err(why) => Some(why.clone()),
                    Ok(stack) => match stack.read_point(array, index) {
                        Ok(image) => (crc32(image.view()) != crc).then(|| OTHER_CRC.into()),
                        Err(error) => Some(error.to_string()),
                    },
                }
            });
        why.map(|why| Damage { part: DamagedPart::Point { array, index }, why })
    };
    damage.par_extend(points.par_iter().filter(|_| go_on()).filter_map(of_point));
    if state.cycles().next().is_some() {
        let film = session.film().map_err(|error| error.to_string());
        damage.extend(state.cycles().take_while(|_| go_on()).filter_map(|entry| {
            let read = film.as_ref().map_err(String::clone).and_then(|film| {
                film.read(entry.cycle).map_err(|error| error.to_string())?.ok_or_else(|| MISSING.into())
            });
            let checked = read.map(|frames| film::crc32(frames.view()));
            let part = DamagedPart::Cycle { cycle: entry.cycle };
            why_not(checked, entry.crc32).map(|why| Damage { part, why })
        }));
    }
    if state.batches().next().is_some() {
        let dots = session.dots().map_err(|error| error.to_string());
        damage.extend(state.batches().take_while(|_| go_on()).filter_map(|entry| {
            let read = dots.as_ref().map_err(String::clone);
            let read = read.and_then(|dots| dots.read(entry.batch).map_err(|error| error.to_string()));
            let part = DamagedPart::Batch { batch: entry.batch };
            why_not(read.map(|columns| columns.crc32()), entry.crc32).map(|why| Damage { part, why })
        }));
    }
    damage
}

/// Why data are damaged, given their checksum, or why they cannot be read.
fn why_not(found: std::result::Result<u32, String>, expected: u32) -> Option<String> {
    match found {
        Ok(found) if found == expected => None,
        Ok(_) => Some(OTHER_CRC.into()),
        Err(why) => Some(why),
    }
}
