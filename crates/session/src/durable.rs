//! Writes that survive a power cut: afterwards either the old or the new content exists, never a part.
//!
//! The order is: temporary file in the same folder, data, fsync, rename, fsync of the folder (which makes the
//! rename durable).

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, RenameFlags, renameat2};
use nix::sys::statvfs::statvfs;

use crate::{Error, Result};

/// Suffix of the names of all temporary files and folders.
pub const TEMPORARY_SUFFIX: &str = ".raysweep-tmp";

/// Replaces the file at `path` with `bytes`, durably and atomically. Overwrites a stale temporary file.
///
/// # Errors
/// [`Error::Io`] if the file system refuses; the file at `path` is then unchanged.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    write_with(path, |file| write_in_pieces(file, bytes))
}

/// Bytes per write. A kernel without preemption (common in virtual machines) runs nothing else on the core
/// during one write, and needs 5 ms for 2 MiB of new pages: a camera's settings would arrive too late for
/// their trigger.
const PIECE_BYTES: usize = 128 << 10;

/// Writes all bytes in small pieces, so that real-time threads can run in between.
pub(crate) fn write_in_pieces(file: &mut File, bytes: &[u8]) -> io::Result<()> {
    bytes.chunks(PIECE_BYTES).try_for_each(|piece| file.write_all(piece))
}

/// As [`write`], with the content that `fill` writes into the temporary file.
///
/// # Errors
/// The error of `fill`, or [`Error::Io`]; the file at `path` is then unchanged.
pub fn write_with(path: &Path, fill: impl FnOnce(&mut File) -> io::Result<()>) -> Result<()> {
    let mut draft = DraftFile::create(path)?;
    let filled = fill(&mut draft.file);
    filled.map_err(draft.failed())?;
    draft.commit()
}

/// As [`write()`], of several files: none is replaced before the contents of all are on disk.
///
/// # Errors
/// [`Error::Io`]; the files are then unchanged, unless a rename itself failed.
pub fn write_all(files: &[(&Path, &[u8])]) -> Result<()> {
    let drafts = files.iter().map(|(path, bytes)| {
        let mut draft = DraftFile::create(path)?;
        let written = write_in_pieces(&mut draft.file, bytes).and_then(|()| draft.file.sync_all());
        written.map_err(draft.failed())?;
        Ok(draft)
    });
    drafts.collect::<Result<Vec<_>>>()?.into_iter().try_for_each(DraftFile::commit)
}

/// As [`write()`], with the content that another program writes to the path given to `fill`, which returns whether there
/// is any.
///
/// # Errors
/// [`Error::Io`]; the file at `path` is then unchanged.
pub fn write_by(path: &Path, fill: impl FnOnce(&Path) -> bool) -> Result<()> {
    let draft = DraftFile::create(path)?;
    if fill(&draft.path) { draft.commit() } else { Ok(()) }
}

/// Creates a new folder, durably. It can serve as a lock: this fails if the name exists.
///
/// # Errors
/// [`Error::Io`], of the kind `AlreadyExists` if the name exists.
pub fn create_dir(path: &Path) -> Result<()> {
    fs::create_dir(path).map_err(Error::io("create folder", path))?;
    sync_dir(parent(path))
}

/// Creates a folder and its missing parents, durably.
///
/// # Errors
/// [`Error::Io`] if the file system refuses.
pub fn create_dir_all(path: &Path) -> Result<()> {
    if path.as_os_str().is_empty() || path.is_dir() {
        return Ok(());
    }
    create_dir_all(parent(path))?;
    match create_dir(path) {
        Err(Error::Io { source, .. }) if source.kind() == io::ErrorKind::AlreadyExists && path.is_dir() => {
            Ok(())
        }
        done => done,
    }
}

/// Creates a folder within an existing one, durably, if it is missing. Unlike [`create_dir_all`], this never brings back
/// a session's folder that was removed.
///
/// # Errors
/// [`Error::Io`] if the file system refuses.
pub(crate) fn create_dir_within(path: &Path) -> Result<()> {
    if path.is_dir() { Ok(()) } else { create_dir(path) }
}

/// Replaces the folder at `path` with one that `fill` writes, durably. `fill` gets the temporary folder and
/// must write its files durably. Readers see either the old or the new folder: they are exchanged atomically
/// if the file system supports it (all local Linux ones do). Otherwise, a crash between the two renames
/// leaves neither in place.
///
/// # Errors
/// The error of `fill`, or [`Error::Io`]; the folder at `path` is then unchanged.
pub fn replace_dir<T, E: From<Error>>(
    path: &Path,
    fill: impl FnOnce(&Path) -> std::result::Result<T, E>,
) -> std::result::Result<T, E> {
    let draft = DraftDir::create(path)?;
    let filled = fill(draft.path())?;
    draft.commit()?;
    Ok(filled)
}

/// Removes a file or folder, if it is there.
///
/// # Errors
/// [`Error::Io`].
pub fn remove(path: &Path) -> Result<()> {
    let removed = match fs::symlink_metadata(path) {
        Ok(found) if found.is_dir() => fs::remove_dir_all(path),
        Ok(_) => fs::remove_file(path),
        Err(error) => Err(error),
    };
    match removed {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(Error::io("remove", path)(error)),
        _ => Ok(()),
    }
}

/// Calls `work` with an empty folder next to `path`, which is removed afterwards; one that a crash left behind is
/// replaced.
///
/// # Errors
/// The error of `work`, or [`Error::Io`].
pub fn with_scratch_dir<T, E: From<Error>>(
    path: &Path,
    work: impl FnOnce(&Path) -> std::result::Result<T, E>,
) -> std::result::Result<T, E> {
    let scratch = DraftDir::create(path)?;
    work(scratch.path())
}

/// A folder that is written gradually next to the one that it will replace, as in [`replace_dir`]. Removed if
/// dropped without [`DraftDir::commit`].
pub(crate) struct DraftDir {
    target: PathBuf,
    path: PathBuf,
}

impl DraftDir {
    /// Creates the temporary folder, replacing one that a crash left behind.
    pub(crate) fn create(target: &Path) -> Result<DraftDir> {
        let path = temporary_path(target);
        match fs::remove_dir_all(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(Error::io("remove", &path)(error));
            }
            _ => create_dir(&path)?,
        }
        Ok(DraftDir { target: target.to_owned(), path })
    }

    /// The temporary folder, whose files must be written durably.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Moves the folder to its final place.
    pub(crate) fn commit(self) -> Result<()> {
        let DraftDir { target, path } = &self;
        sync_dir(path)?;
        if target.exists() {
            exchange(path, target)?;
        } else {
            fs::rename(path, target).map_err(Error::io("replace", target))?;
        }
        sync_dir(parent(target))?;
        match fs::remove_dir_all(path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(Error::io("remove", path)(error)),
            _ => Ok(()),
        }
    }
}

impl Drop for DraftDir {
    fn drop(&mut self) {
        // Nothing is left after a commit. What cannot be removed here is removed by the next writer.
        let _ = fs::remove_dir_all(&self.path);
    }
}

/// A file that is written gradually next to the one that it will replace, as in [`write`]. Removed if dropped
/// without [`DraftFile::commit`].
pub(crate) struct DraftFile {
    target: PathBuf,
    path: PathBuf,
    file: File,
}

impl DraftFile {
    /// Creates the temporary file; replaces a stale one, or a link that somebody has put in its place.
    pub(crate) fn create(target: &Path) -> Result<DraftFile> {
        let path = temporary_path(target);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(Error::io("remove", &path)(error));
            }
            _ => {}
        }
        // Fails if anything has the name, even a dangling link.
        let file = File::create_new(&path).map_err(Error::io("write", &path))?;
        Ok(DraftFile { target: target.to_owned(), path, file })
    }

    /// Its path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The temporary file.
    pub(crate) fn file(&self) -> &File {
        &self.file
    }

    /// For `map_err` on writes to [`DraftFile::file`].
    pub(crate) fn failed(&self) -> impl FnOnce(io::Error) -> Error {
        Error::io("write", &self.path)
    }

    /// Moves the file to its final place.
    pub(crate) fn commit(self) -> Result<()> {
        self.file.sync_all().map_err(self.failed())?;
        fs::rename(&self.path, &self.target).map_err(Error::io("replace", &self.target))?;
        sync_dir(parent(&self.target))
    }
}

impl Drop for DraftFile {
    fn drop(&mut self) {
        // Nothing is left after a commit. What cannot be removed here is removed by the next writer.
        let _ = fs::remove_file(&self.path);
    }
}

/// Removes the temporary files and folders that crashes left anywhere below `dir`; returns how many. Only the
/// single process that writes there may call it, before it writes.
///
/// # Errors
/// [`Error::Io`] if the file system refuses, and for a symbolic link: what is written there would land elsewhere.
pub fn remove_leftovers(dir: &Path) -> Result<usize> {
    let mut removed = 0;
    for entry in fs::read_dir(dir).map_err(Error::io("list", dir))? {
        let entry = entry.map_err(Error::io("list", dir))?;
        let path = entry.path();
        let kind = entry.file_type().map_err(Error::io("examine", &path))?;
        let is_dir = kind.is_dir();
        if kind.is_symlink() && !is_temporary(&path) {
            let why = "it is a symbolic link, and a session contains none: put the file itself in its place";
            return Err(Error::io("write to", &path)(io::Error::other(why)));
        }
        if is_temporary(&path) {
            if is_dir { fs::remove_dir_all(&path) } else { fs::remove_file(&path) }
                .map_err(Error::io("remove", &path))?;
            removed += 1;
        } else if is_dir {
            removed += remove_leftovers(&path)?;
        }
    }
    Ok(removed)
}

/// Free bytes for an unprivileged process on the file system that contains `dir`.
///
/// # Errors
/// [`Error::Io`] if `dir` does not exist.
pub fn available_bytes(dir: &Path) -> Result<u64> {
    let stat = statvfs(dir).map_err(|errno| Error::io("examine", dir)(errno.into()))?;
    Ok(stat.blocks_available() * stat.fragment_size())
}

/// Whether a path is that of a temporary file or folder.
pub(crate) fn is_temporary(path: &Path) -> bool {
    path.as_os_str().as_encoded_bytes().ends_with(TEMPORARY_SUFFIX.as_bytes())
}

/// Makes the directory entries of a folder durable.
pub(crate) fn sync_dir(dir: &Path) -> Result<()> {
    File::open(dir).and_then(|folder| folder.sync_all()).map_err(Error::io("sync folder", dir))
}

fn exchange(fresh: &Path, path: &Path) -> Result<()> {
    match renameat2(AT_FDCWD, fresh, AT_FDCWD, path, RenameFlags::RENAME_EXCHANGE) {
        Ok(()) => Ok(()),
        Err(Errno::EINVAL | Errno::ENOSYS) => {
            let old = temporary_path(&fresh.with_extension("old"));
            fs::rename(path, &old)
                .and_then(|()| fs::rename(fresh, path))
                .and_then(|()| fs::remove_dir_all(&old))
                .map_err(Error::io("replace", path))
        }
        Err(errno) => Err(Error::io("replace", path)(errno.into())),
    }
}

fn temporary_path(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(TEMPORARY_SUFFIX);
    PathBuf::from(name)
}

fn parent(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stale_temporary_file_is_no_obstacle() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("plan.toml");
        fs::write(temporary_path(&path), "torn, and longer than the new content").unwrap();
        write(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_failed_write_keeps_the_old_content() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("manifest.json");
        write(&path, b"old").unwrap();
        fs::create_dir(temporary_path(&path)).unwrap();
        let error = write(&path, b"new").unwrap_err();
        assert!(matches!(&error, Error::Io { path: named, .. } if named.starts_with(dir.path())), "{error}");
        assert_eq!(fs::read(&path).unwrap(), b"old");
    }

    #[test]
    fn nothing_is_written_through_a_link() {
        use std::os::unix::fs::symlink;
        let dir = tempfile::tempdir().unwrap();
        let (precious, session) = (dir.path().join("precious"), dir.path().join("session"));
        fs::write(&precious, "mine").unwrap();
        create_dir_all(&session).unwrap();
        let (file, folder) = (session.join("manifest.json"), session.join("transport.zarr"));
        symlink(&precious, temporary_path(&file)).unwrap();
        symlink(dir.path(), temporary_path(&folder)).unwrap();
        write(&file, b"ours").unwrap();
        // The link itself is removed.
        replace_dir(&folder, |fresh| write(&fresh.join("x"), b"1")).unwrap();
        assert!(folder.join("x").is_file() && !folder.is_symlink());
        assert_eq!(fs::read(&precious).unwrap(), b"mine");
        assert!(!dir.path().join("x").exists());
        assert!(fs::symlink_metadata(&file).unwrap().is_file());
        symlink(dir.path(), session.join("products")).unwrap();
        fs::write(dir.path().join("kept.raysweep-tmp"), "mine").unwrap();
        assert!(remove_leftovers(&session).unwrap_err().to_string().contains("symbolic link"));
        assert!(dir.path().join("kept.raysweep-tmp").exists());
    }

    #[test]
    fn leftovers_are_removed_at_any_depth_and_nothing_else_is() {
        let dir = tempfile::tempdir().unwrap();
        let deep = dir.path().join("stack.zarr/sum");
        create_dir_all(&deep).unwrap();
        fs::write(deep.join("c.0.0.0"), "data").unwrap();
        fs::write(deep.join("c.1.0.0.raysweep-tmp"), "torn").unwrap();
        let torn = dir.path().join("transport.zarr.raysweep-tmp");
        create_dir_all(&torn.join("transport")).unwrap();
        fs::write(torn.join("transport/zarr.json"), "{").unwrap();
        assert_eq!(remove_leftovers(dir.path()).unwrap(), 2);
        assert_eq!(remove_leftovers(dir.path()).unwrap(), 0);
        assert!(deep.join("c.0.0.0").exists() && !torn.exists());
    }

    #[test]
    fn a_folder_is_replaced_whole_or_not_at_all() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("transport.zarr");
        replace_dir(&path, |fresh| write(&fresh.join("old"), b"1")).unwrap();
        let failed: Result<()> = replace_dir(&path, |fresh| {
            write(&fresh.join("half"), b"2")?;
            Err(Error::io("write", fresh)(io::Error::other("disk full")))
        });
        assert!(failed.is_err());
        assert!(path.join("old").exists() && !path.join("half").exists());
        replace_dir(&path, |fresh| write(&fresh.join("new"), b"3")).unwrap();
        assert!(path.join("new").exists() && !path.join("old").exists() && !path.join("half").exists());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn available_bytes_of_a_missing_folder_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        assert!(available_bytes(dir.path()).unwrap() > 0);
        assert!(available_bytes(&dir.path().join("missing")).is_err());
    }
}
