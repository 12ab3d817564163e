//! Files that others may have put in place: opened without waiting for a writer, read within limits, and, where a
//! client names them, found below an allowed folder without following symbolic links.

use std::ffi::OsStr;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::fd::OwnedFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Component, Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{OFlag, openat, readlinkat};
use nix::sys::stat::Mode;
use raysweep_core::Size;

/// Opens a regular file of at most `most_bytes` for reading. Anything else is refused: a pipe without a writer would
/// block, a device has no end.
///
/// # Errors
/// Those of the file system, and `InvalidInput` for what is no regular file or too long.
pub fn open(path: &Path, most_bytes: u64) -> io::Result<File> {
    regular(OpenOptions::new().read(true).custom_flags(OFlag::O_NONBLOCK.bits()).open(path)?, most_bytes)
}

/// As [`open`], but the file itself, not what a symbolic link in its place leads to.
///
/// # Errors
/// As [`open`], and `InvalidInput` for a symbolic link.
pub fn open_itself(path: &Path, most_bytes: u64) -> io::Result<File> {
    let flags = OFlag::O_NONBLOCK | OFlag::O_NOFOLLOW;
    match OpenOptions::new().read(true).custom_flags(flags.bits()).open(path) {
        Err(error) if error.raw_os_error() == Some(Errno::ELOOP as i32) => Err(io::Error::new(
            ErrorKind::InvalidInput,
            "it is a symbolic link, and a session contains none: put the file itself in its place",
        )),
        opened => regular(opened?, most_bytes),
    }
}

/// Reads a regular file of at most `most_bytes`, even if it grows meanwhile.
///
/// # Errors
/// As [`open`].
pub fn read(path: &Path, most_bytes: u64) -> io::Result<Vec<u8>> {
    read_open(&open(path, most_bytes)?, most_bytes)
}

/// As [`read`], of the file itself, not of what a symbolic link in its place leads to.
///
/// # Errors
/// As [`open_itself`].
pub fn read_itself(path: &Path, most_bytes: u64) -> io::Result<Vec<u8>> {
    read_open(&open_itself(path, most_bytes)?, most_bytes)
}

/// As [`read`], of UTF-8 text.
///
/// # Errors
/// As [`open`], and `InvalidData` for other bytes.
pub fn read_text(path: &Path, most_bytes: u64) -> io::Result<String> {
    String::from_utf8(read(path, most_bytes)?)
        .map_err(|_not_utf8| io::Error::new(ErrorKind::InvalidData, "it is not UTF-8 text"))
}

/// As [`read`], of a file that is open.
///
/// # Errors
/// As [`open`].
pub fn read_open(file: &File, most_bytes: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    file.take(most_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most_bytes {
        return Err(too_long(most_bytes));
    }
    Ok(bytes)
}

/// As [`open`], of a file below one of these folders, given by its full path or relative to one of them. Symbolic links
/// below the folder, and ways out of it, are refused.
///
/// # Errors
/// As [`open`], and `PermissionDenied` for a file elsewhere.
pub fn open_below(folders: &[PathBuf], path: &Path, most_bytes: u64) -> io::Result<File> {
    regular(below(folders, path, OFlag::O_RDONLY | OFlag::O_NONBLOCK)?.1, most_bytes)
}

/// The path of a folder below one of these folders, found as in [`open_below`].
///
/// # Errors
/// As [`open_below`].
pub fn folder_below(folders: &[PathBuf], path: &Path) -> io::Result<PathBuf> {
    Ok(below(folders, path, OFlag::O_PATH | OFlag::O_DIRECTORY)?.0)
}

/// Opens what is at `path` below the first of the folders that has it.
fn below(folders: &[PathBuf], path: &Path, flags: OFlag) -> io::Result<(PathBuf, File)> {
    let elsewhere =
        || io::Error::new(ErrorKind::PermissionDenied, "it is outside of the folders that are allowed");
    let mut failed: Option<io::Error> = None;
    for folder in folders {
        let full = std::path::absolute(folder)?;
        let Some(inner) = inside(&full, path) else { continue };
        match open_inside(&full, &inner, flags) {
            Ok(file) => return Ok((full.join(inner), file)),
            // What is refused says more than what is missing in another folder.
            Err(error) => match &failed {
                Some(first) if first.kind() != ErrorKind::NotFound => {}
                _ => failed = Some(error),
            },
        }
    }
    Err(failed.unwrap_or_else(elsewhere))
}

/// The part of a path below a folder; `None` if it is elsewhere, or the folder itself.
fn inside(folder: &Path, path: &Path) -> Option<PathBuf> {
    let inner = if path.is_absolute() { path.strip_prefix(folder).ok()? } else { path };
    inner.components().any(|part| matches!(part, Component::Normal(_))).then(|| inner.to_owned())
}

/// Opens one part of the path after the other. `openat2` would do this at once, but fails in services with
/// `RestrictSUIDSGID=`, because systemd cannot see its arguments.
fn open_inside(folder: &Path, inner: &Path, flags: OFlag) -> io::Result<File> {
    let refused = |what: &str| io::Error::new(ErrorKind::PermissionDenied, what);
    let mut parts = Vec::new();
    for part in inner.components() {
        match part {
            Component::Normal(name) => parts.push(name),
            Component::CurDir => {}
            // As no link is followed, the folder above is that of the name before.
            _ if parts.pop().is_some() => {}
            _ => return Err(refused("its path leads out of the folder that is allowed")),
        }
    }
    let Some((name, above)) = parts.split_last() else {
        return Err(refused("it is the folder that is allowed, not a file in it"));
    };
    let mut place = OwnedFd::from(File::open(folder)?);
    let step = |place: &OwnedFd, name: &OsStr, flags: OFlag| {
        openat(place, name, flags | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC, Mode::empty()).map_err(|errno| {
            let is_link = || readlinkat(place, name).is_ok();
            match errno {
                Errno::ELOOP | Errno::ENOTDIR if is_link() => {
                    refused("there is a symbolic link in its path, which is not followed")
                }
                _ => errno.into(),
            }
        })
    };
    for name in above {
        place = step(&place, name, OFlag::O_PATH | OFlag::O_DIRECTORY)?;
    }
    Ok(step(&place, name, flags)?.into())
}

fn regular(file: File, most_bytes: u64) -> io::Result<File> {
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::new(ErrorKind::InvalidInput, "it is not a regular file"));
    }
    if metadata.len() > most_bytes {
        return Err(too_long(most_bytes));
    }
    Ok(file)
}

fn too_long(most_bytes: u64) -> io::Error {
    io::Error::new(
        ErrorKind::InvalidInput,
        format!("it is longer than {}, which is the limit", Size(most_bytes)),
    )
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use nix::unistd::mkfifo;

    use super::*;

    #[test]
    fn only_regular_files_within_the_limit_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::write(path("text"), "abc").unwrap();
        assert_eq!(read(&path("text"), 3).unwrap(), b"abc");
        assert_eq!(read(&path("text"), 2).unwrap_err().kind(), ErrorKind::InvalidInput);
        mkfifo(&path("pipe"), Mode::S_IRWXU).unwrap();
        for other in [path("pipe"), folder.path().to_owned(), "/dev/zero".into()] {
            let error = read(&other, u64::MAX).unwrap_err();
            assert!(error.to_string().contains("regular"), "{}: {error}", other.display());
        }
        fs::write(path("latin"), [0xe4]).unwrap();
        assert_eq!(read_text(&path("latin"), 9).unwrap_err().kind(), ErrorKind::InvalidData);
    }

    #[test]
    fn nothing_is_found_by_a_way_out_of_the_allowed_folders() {
        let top = tempfile::tempdir().unwrap();
        let (allowed, other) = (top.path().join("allowed"), top.path().join("other"));
        fs::create_dir_all(allowed.join("deep")).unwrap();
        fs::create_dir(&other).unwrap();
        fs::write(allowed.join("deep/file"), "1").unwrap();
        fs::write(other.join("file"), "2").unwrap();
        symlink(&other, allowed.join("link")).unwrap();
        symlink(other.join("file"), allowed.join("file")).unwrap();
        let folders = [top.path().join("missing"), allowed.clone()];
        let open = |path: &Path| open_below(&folders, path, 9).map(drop);
        open(Path::new("deep/file")).unwrap();
        open(&allowed.join("deep/file")).unwrap();
        open(Path::new("deep/../deep/file")).unwrap();
        for out in ["../other/file", "link/file", "file", "deep/../../other/file", "", ".", "/etc/passwd"] {
            open(Path::new(out)).unwrap_err();
        }
        for out in
            [other.join("file"), allowed.join("../other/file"), allowed.join("link/file"), allowed.clone()]
        {
            assert_eq!(open(&out).unwrap_err().kind(), ErrorKind::PermissionDenied, "{}", out.display());
        }
        assert_eq!(folder_below(&folders, Path::new("deep")).unwrap(), allowed.join("deep"));
        assert!(folder_below(&folders, Path::new("link")).is_err());
        assert!(folder_below(&folders, Path::new("deep/file")).is_err());
    }
}
