//! Room on a disk, looked for before a long work rather than missed in its middle.

use std::path::Path;
use std::process::Command;

use crate::run::Done;

/// Bytes of a gibibyte.
pub const GIB: u64 = 1 << 30;

/// Fails where the disk of a folder, which need not be there yet, has less than `needed_gib` left: `why` says for what it
/// is needed, and `remedy` what to do.
pub fn require(folder: &Path, needed_gib: u64, why: &str, remedy: &str) -> Done {
    let Some(free_bytes) = free_bytes(folder).filter(|&free_bytes| free_bytes < needed_gib * GIB) else {
        return Ok(());
    };
    Err(format!(
        "{}: {} MiB are free on its disk, and {why} {needed_gib} GiB: {remedy}",
        folder.display(),
        free_bytes >> 20
    ))
}

/// What the disk of a folder has left; unknown where there is no `df` like GNU's.
fn free_bytes(folder: &Path) -> Option<u64> {
    let folder = std::path::absolute(folder).ok()?;
    let present = folder.ancestors().find(|folder| folder.exists())?;
    number(Command::new("df").args(["--block-size=1", "--output=avail"]).arg(present))
}

/// What a folder takes of its disk; 0 if it is not there.
pub fn taken_bytes(folder: &Path) -> u64 {
    let mut du = Command::new("du");
    number(du.args(["--summarize", "--dereference-args", "--block-size=1"]).arg(folder)).unwrap_or(0)
}

/// The number that a program prints: in its last line, first. Files that vanish meanwhile are no reason to ask for it
/// again.
fn number(command: &mut Command) -> Option<u64> {
    let said = command.output().ok()?.stdout;
    String::from_utf8(said).ok()?.lines().last()?.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_without_room_is_told_with_what_it_has_and_for_what_more_is_needed() {
        let folder = std::env::temp_dir();
        assert_eq!(require(&folder, 0, "the tests write", "make room"), Ok(()));
        for folder in [folder.as_path(), Path::new("/does/not/exist")] {
            let error = require(folder, 1 << 20, "the tests write", "make room").unwrap_err();
            assert!(error.starts_with(&folder.display().to_string()), "{error}");
            assert!(error.ends_with("and the tests write 1048576 GiB: make room"), "{error}");
        }
    }

    #[test]
    fn what_a_folder_takes_is_what_its_files_have() {
        let folder = std::env::temp_dir().join(format!("raysweep-space-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(folder.join("kept")).unwrap();
        std::fs::write(folder.join("kept/file"), vec![1; 1 << 20]).unwrap();
        std::os::unix::fs::symlink(folder.join("kept"), folder.join("link")).unwrap();
        for name in ["kept", "link"] {
            let taken_bytes = taken_bytes(&folder.join(name));
            assert!((1 << 20..2 << 20).contains(&taken_bytes), "{name}: {taken_bytes}");
        }
        assert_eq!(taken_bytes(&folder.join("nothing")), 0);
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
