//! Errors of a session's files.

use std::io;
use std::path::{Path, PathBuf};

use raysweep_core::io_text;
use zarrs::array::ArrayError;
use zarrs::storage::StorageError;

/// A result of this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Errors of a session's files. Each message names the path and what to do.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file system refused an operation.
    #[error("cannot {action} {}: {}", path.display(), io_text(source))]
    Io {
        /// The operation, as a verb.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The file system's error.
        source: io::Error,
    },
    /// The folder is not a session.
    #[error(
        "{} is not a session: {why}; give the folder of a session; `raysweep sessions` lists the names of those in the daemon's data folder",
        path.display()
    )]
    NotASession {
        /// The folder.
        path: PathBuf,
        /// What is missing.
        why: String,
    },
    /// Another process is writing this session.
    #[error("{} is being written by another process; wait until its run has ended", path.display())]
    InUse {
        /// The ledger.
        path: PathBuf,
    },
    /// A line of the ledger cannot be read, or must not be written.
    #[error("{} line {line}: {why}; restore this line from a backup, because its content is stored nowhere else", path.display())]
    Ledger {
        /// The ledger.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What is wrong with it.
        why: String,
    },
    /// A crash tore the first line of a ledger: the session had not begun.
    #[error("{} has no whole line: a crash cut the session off before it had begun, and nothing was acquired; `raysweep trash` takes its folder", path.display())]
    Torn {
        /// The ledger.
        path: PathBuf,
    },
    /// An entry would not read back unchanged, so it was not written.
    #[error("{}: an entry was not written: {why}", path.display())]
    Entry {
        /// The ledger.
        path: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// The session was written by a newer raysweep.
    #[error("{} has format {found}, but this raysweep reads formats up to {known}: use a newer raysweep", path.display())]
    NewerFormat {
        /// The file with that format.
        path: PathBuf,
        /// Its format.
        found: u32,
        /// The newest supported format.
        known: u32,
    },
    /// Data of the wrong shape.
    #[error("{what} has shape {found:?}, expected {allowed}")]
    Shape {
        /// The data.
        what: String,
        /// Its shape.
        found: Vec<usize>,
        /// The allowed shape.
        allowed: String,
    },
    /// An index that the array does not have.
    #[error("index {index} is outside of array `{array}`, which has {len} points (0 to {})", len.saturating_sub(1))]
    Index {
        /// The array.
        array: &'static str,
        /// The requested index.
        index: usize,
        /// The array's length.
        len: usize,
    },
    /// The data of a point are not in the stack.
    #[error("{}: array `{array}` holds no data at index {index}; acquire the point again with `raysweep resume`", path.display())]
    NotStored {
        /// The stack.
        path: PathBuf,
        /// The array.
        array: &'static str,
        /// The point's index.
        index: usize,
    },
    /// A Zarr hierarchy could not be read or written.
    #[error("cannot {action} {}: {source}", path.display())]
    Zarr {
        /// The operation, as a verb.
        action: &'static str,
        /// The hierarchy or array.
        path: PathBuf,
        /// The library's error.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A file could not be encoded or decoded.
    #[error("cannot {action} {what}: {why}")]
    Codec {
        /// The operation, as a verb.
        action: &'static str,
        /// The file or part.
        what: String,
        /// The library's error.
        why: String,
    },
}

impl Error {
    /// Whether the disk takes nothing at present, because it is full or read-only. The same write succeeds once that is
    /// mended.
    pub fn is_mendable(&self) -> bool {
        let kind = match self {
            Error::Io { source, .. } => Some(source.kind()),
            Error::Zarr { source, .. } => match source.downcast_ref() {
                Some(ArrayError::StorageError(StorageError::IOError(error))) => Some(error.kind()),
                _ => None,
            },
            _ => None,
        };
        use io::ErrorKind::{QuotaExceeded, ReadOnlyFilesystem, StorageFull};
        matches!(kind, Some(StorageFull | QuotaExceeded | ReadOnlyFilesystem))
    }

    /// For `map_err`: the operation and its path.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Error {
        move |source| Error::Io { action, path: path.to_owned(), source }
    }

    /// For `map_err`: the operation and its hierarchy.
    pub(crate) fn zarr<E>(action: &'static str, path: &Path) -> impl FnOnce(E) -> Error
    where
        E: std::error::Error + Send + Sync + 'static,
    {
        move |source| Error::Zarr { action, path: path.to_owned(), source: Box::new(source) }
    }

    /// For `map_err`: the operation and its file.
    pub(crate) fn codec<E: ToString>(action: &'static str, what: impl ToString) -> impl FnOnce(E) -> Error {
        move |why| Error::Codec { action, what: what.to_string(), why: why.to_string() }
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;

    use super::Error;

    #[test]
    fn every_error_says_what_to_do() {
        let refused = || std::io::Error::from(std::io::ErrorKind::PermissionDenied);
        let errors = [
            Error::Io { action: "read", path: "s/ledger.jsonl".into(), source: refused() },
            Error::NotASession { path: "s".into(), why: "there is no ledger.jsonl".into() },
            Error::InUse { path: "s/ledger.jsonl".into() },
            Error::Ledger { path: "s/ledger.jsonl".into(), line: 3, why: "its checksum is wrong".into() },
            Error::Torn { path: "s/ledger.jsonl".into() },
            Error::Entry { path: "s/ledger.jsonl".into(), why: "delays_us[0] = NaN".into() },
            Error::NewerFormat { path: "s/ledger.jsonl".into(), found: 9, known: 2 },
            Error::Shape { what: "a sum".into(), found: vec![2, 3], allowed: "[4, 5]".into() },
            Error::Index { array: "sum", index: 75, len: 75 },
            Error::NotStored { path: "s/stack.zarr".into(), array: "sum", index: 3 },
            Error::Zarr { action: "open", path: "s/stack.zarr".into(), source: Box::new(refused()) },
            Error::Codec { action: "write", what: "s/products/epipolar.exr".into(), why: "no pixels".into() },
        ];
        let mut shown = String::new();
        for error in errors {
            let debug = format!("{error:?}");
            let variant = debug.split(' ').next().unwrap_or_default();
            writeln!(shown, "{variant}: {error}\n").unwrap();
        }
        insta::assert_snapshot!(shown);
    }
}
