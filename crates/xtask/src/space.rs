//! Room on a disk, looked for before half an hour's work rather than missed in the middle of it.

use std::path::Path;
use std::process::Command;

use crate::run::Done;

const GIB: u64 = 1 << 30;

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
    let present = folder.ancestors().find(|folder| folder.exists())?;
    number(Command::new("df").args(["--block-size=1", "--output=avail"]).arg(present))
}

/// What a folder takes of its disk, in whole gibibytes.
pub fn taken_gib(folder: &Path) -> u64 {
    let mut du = Command::new("du");
    number(du.args(["--summarize", "--dereference-args", "--block-size=1"]).arg(folder))
        .map_or(0, |it| it / GIB)
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
        std::fs::create_dir_all(&folder).unwrap();
        assert_eq!((taken_gib(&folder), taken_gib(Path::new("/does/not/exist"))), (0, 0));
        let said = number(Command::new("du").args(["--summarize", "--block-size=1"]).arg(&folder));
        assert!(said.is_some_and(|bytes| bytes < GIB), "{said:?}");
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
