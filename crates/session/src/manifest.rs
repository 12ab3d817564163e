//! `manifest.json`: the software that made the session, and the checksum of each file.

use std::collections::BTreeMap;
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use raysweep_core::Counts;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};

use crate::folder::Session;
use crate::ledger::{FORMAT, State};
use crate::{Error, Result, durable, input};

/// The content of `manifest.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Format version of the session folder.
    pub format: u32,
    /// Name and version of each program and library involved.
    pub software: BTreeMap<String, String>,
    /// The settings as the devices applied them.
    pub settings: Map<String, Value>,
    /// Counts of sweep points.
    pub points: PointCounts,
    /// Counts of frames.
    pub counts: Counts,
    /// What was damaged and is left out of the results.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub left_out: Vec<String>,
    /// All files of the session except the manifest, by path with `/` separators.
    pub files: BTreeMap<String, FileRecord>,
}

/// Counts of sweep points or film cycles: planned = stored + missing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PointCounts {
    /// Number in the plan.
    pub planned: usize,
    /// Number stored, according to the ledger.
    pub stored: usize,
    /// Number not stored.
    pub missing: usize,
}

/// Size and checksum of a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileRecord {
    /// Size in bytes.
    pub bytes: u64,
    /// SHA-256, hexadecimal.
    pub sha256: String,
}

/// Differences between a session's files and its manifest; paths with `/` separators, sorted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Differences {
    /// Files whose content differs.
    pub changed: Vec<String>,
    /// Files that no longer exist.
    pub missing: Vec<String>,
    /// Files that are not in the manifest.
    pub added: Vec<String>,
}

impl Differences {
    /// Whether there are no differences.
    pub fn is_empty(&self) -> bool {
        self.changed.is_empty() && self.missing.is_empty() && self.added.is_empty()
    }
}

/// Writes the manifest of a session, durably. Write it last: any later change makes it stale.
///
/// # Errors
/// [`Error::Io`] if a file cannot be read or the manifest cannot be written.
pub fn write(
    session: &Session,
    state: &State,
    software: BTreeMap<String, String>,
    settings: Map<String, Value>,
) -> Result<Manifest> {
    let stored = state.stored_points();
    let planned = state.session.shape.points();
    let missing = state.missing_points();
    let manifest = Manifest {
        format: FORMAT,
        software,
        settings,
        points: PointCounts { planned, stored, missing },
        counts: state.counts.clone(),
        left_out: state.left_out(),
        files: files_of(session)?,
    };
    store(session, &manifest)?;
    Ok(manifest)
}

/// Puts files that differ from their records back under these, so that their damage is not taken for what they should
/// be.
///
/// # Errors
/// As [`read`] and [`write`].
pub fn keep_records(session: &Session, damaged: &BTreeMap<String, FileRecord>) -> Result<()> {
    let mut manifest = read(session)?;
    manifest.files.extend(damaged.clone());
    store(session, &manifest)
}

/// Longest manifest that is read: an estimate of twice that of the longest run.
const MOST_BYTES: u64 = 256 << 20;
/// Between the manifest and its checksum, its last key.
const KEY: &str = ",\n  \"sha256\": \"";
/// After the checksum.
const END: &str = "\"\n}\n";

fn store(session: &Session, manifest: &Manifest) -> Result<()> {
    let path = session.manifest_path();
    let text = serde_json::to_string_pretty(manifest).map_err(Error::codec("encode", path.display()))?;
    // The closing brace follows the checksum.
    let text = text.strip_suffix("\n}").unwrap_or(&text);
    let FileRecord { sha256, .. } = FileRecord::of(text.as_bytes());
    durable::write(&path, format!("{text}{KEY}{sha256}{END}").as_bytes())
}

/// Whether a manifest's text has its own checksum; those of format 1 have none.
fn is_sound(text: &[u8], format: u32) -> bool {
    let sealed = str::from_utf8(text).ok().and_then(|text| text.strip_suffix(END)?.rsplit_once(KEY));
    match sealed {
        Some((text, sha256)) => FileRecord::of(text.as_bytes()).sha256 == sha256,
        None => format < FORMAT,
    }
}

/// Reads the manifest of a session.
///
/// # Errors
/// [`Error::Io`] if it is missing, [`Error::Codec`] if it is damaged, [`Error::NewerFormat`].
pub fn read(session: &Session) -> Result<Manifest> {
    let path = session.manifest_path();
    let text = session.read(&path, MOST_BYTES)?;
    let manifest: Manifest = serde_json::from_slice(&text).map_err(Error::codec("read", path.display()))?;
    if manifest.format > FORMAT {
        return Err(Error::NewerFormat { path, found: manifest.format, known: FORMAT });
    }
    if !is_sound(&text, manifest.format) {
        return Err(Error::codec("read", path.display())("its own checksum is wrong, so it was damaged"));
    }
    Ok(manifest)
}

/// Compares the files of a session with its manifest.
///
/// # Errors
/// As [`read`], and [`Error::Io`] if a file cannot be read.
pub fn verify(session: &Session) -> Result<Differences> {
    let expected = read(session)?.files;
    let found = files_of(session)?;
    let mut differences = Differences::default();
    for (path, record) in &expected {
        match found.get(path) {
            None => differences.missing.push(path.clone()),
            Some(now) if now != record => differences.changed.push(path.clone()),
            Some(_) => {}
        }
    }
    differences.added = found.into_keys().filter(|path| !expected.contains_key(path)).collect();
    Ok(differences)
}

/// All files of a session but the manifest and those that a crash left behind.
pub(crate) fn files_of(session: &Session) -> Result<BTreeMap<String, FileRecord>> {
    let record = |(name, path): (String, PathBuf)| Ok((name, FileRecord::read(&path)?));
    paths_of(session)?.into_par_iter().map(record).collect()
}

/// The paths of these files, by their names in the manifest.
pub(crate) fn paths_of(session: &Session) -> Result<BTreeMap<String, PathBuf>> {
    let mut paths = Vec::new();
    list_files(session.dir(), "", &mut paths)?;
    Ok(paths.into_iter().filter(|(name, _)| name != "manifest.json").collect())
}

fn list_files(dir: &Path, prefix: &str, files: &mut Vec<(String, PathBuf)>) -> Result<()> {
    for entry in fs::read_dir(dir).map_err(Error::io("list", dir))? {
        let entry = entry.map_err(Error::io("list", dir))?;
        let path = entry.path();
        let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
        let kind = entry.file_type().map_err(Error::io("examine", &path))?;
        if durable::is_temporary(&path) {
            continue;
        } else if kind.is_dir() {
            list_files(&path, &format!("{name}/"), files)?;
        } else {
            files.push((name, path));
        }
    }
    Ok(())
}

impl FileRecord {
    /// Of a file of a session.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be read, or is a symbolic link or no regular file.
    pub fn read(path: &Path) -> Result<Self> {
        let mut file = input::open_itself(path, u64::MAX).map_err(Error::io("read", path))?;
        let mut digest = Sha256::new();
        let mut bytes = 0;
        let mut buffer = vec![0; 1 << 16];
        loop {
            let count = file.read(&mut buffer).map_err(Error::io("read", path))?;
            if count == 0 {
                return Ok(Self { bytes, sha256: hex(&digest.finalize()) });
            }
            digest.update(&buffer[..count]);
            bytes += count as u64;
        }
    }

    /// Of the content of a file.
    pub(crate) fn of(content: &[u8]) -> Self {
        Self { bytes: content.len() as u64, sha256: hex(&Sha256::digest(content)) }
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests;
