//! `manifest.json`: the software that made the session, and the checksum of each file.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use raysweep_core::Counts;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};

use crate::folder::Session;
use crate::ledger::{FORMAT, State};
use crate::{Error, Result, durable};

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
    let manifest = Manifest {
        format: FORMAT,
        software,
        settings,
        points: PointCounts { planned, stored, missing: planned - stored },
        counts: state.counts.clone(),
        files: scan(session)?,
    };
    let path = session.manifest_path();
    let mut text = serde_json::to_vec_pretty(&manifest).map_err(Error::codec("encode", path.display()))?;
    text.push(b'\n');
    durable::write(&path, &text)?;
    Ok(manifest)
}

/// Reads the manifest of a session.
///
/// # Errors
/// [`Error::Io`] if it is missing, [`Error::Codec`] if it is damaged, [`Error::NewerFormat`].
pub fn read(session: &Session) -> Result<Manifest> {
    let path = session.manifest_path();
    let text = fs::read(&path).map_err(Error::io("read", &path))?;
    let manifest: Manifest = serde_json::from_slice(&text).map_err(Error::codec("read", path.display()))?;
    if manifest.format > FORMAT {
        return Err(Error::NewerFormat { path, found: manifest.format, known: FORMAT });
    }
    Ok(manifest)
}

/// Compares the files of a session with its manifest.
///
/// # Errors
/// As [`read`], and [`Error::Io`] if a file cannot be read.
pub fn verify(session: &Session) -> Result<Differences> {
    let expected = read(session)?.files;
    let found = scan(session)?;
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

fn scan(session: &Session) -> Result<BTreeMap<String, FileRecord>> {
    let mut paths = Vec::new();
    list_files(session.dir(), "", &mut paths)?;
    let record = |(name, path): (String, PathBuf)| {
        checksum(&path).map(|record| (name, record)).map_err(Error::io("read", &path))
    };
    let mut files = paths.into_par_iter().map(record).collect::<Result<BTreeMap<_, _>>>()?;
    files.remove("manifest.json");
    Ok(files)
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

fn checksum(path: &Path) -> io::Result<FileRecord> {
    let mut file = File::open(path)?;
    let mut digest = Sha256::new();
    let mut bytes = 0;
    let mut buffer = vec![0; 1 << 16];
    loop {
        let count = file.read(&mut buffer)?;
        if count == 0 {
            let sha256 = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
            return Ok(FileRecord { bytes, sha256 });
        }
        digest.update(&buffer[..count]);
        bytes += count as u64;
    }
}

#[cfg(test)]
mod tests;
