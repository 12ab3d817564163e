//! Room on a disk, looked for before half an hour's work rather than missed in the middle of it.

use std::path::Path;
use std::process::Command;

use crate::run::Done;

const GIB: u64 = 1 << 30;

/// Fails where the disk of `folder` has less than `needed_gib` left; `why` says for what it is needed.
pub fn require(folder: &Path, needed_gib: u64, why: &str) -> Done {
    let mut df = Command::new("df");
    // Where there is no df as GNU's, the disk itself will tell.
    let Some(free_bytes) = number(df.args(["--block-size=1", "--output=avail"]).arg(folder)) else {
        return Ok(());
    };
    if free_bytes >= needed_gib * GIB {
        return Ok(());
    }
    Err(format!(
        "{}: {:.1} GiB are free on this disk, and {why} {needed_gib} GiB: make room",
        folder.display(),
        free_bytes as f64 / GIB as f64
    ))
}

/// What a folder takes of its disk, in whole gibibytes.
pub fn taken_gib(folder: &Path) -> u64 {
    number(Command::new("du").args(["--summarize", "--block-size=1"]).arg(folder)).map_or(0, |it| it / GIB)
}

/// The number that a program prints: in its last line, first.
fn number(command: &mut Command) -> Option<u64> {
    let said = command.output().ok().filter(|output| output.status.success())?.stdout;
    String::from_utf8(said).ok()?.lines().last()?.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_without_room_is_told_with_what_it_has_and_for_what_more_is_needed() {
        let folder = std::env::temp_dir();
        assert_eq!(require(&folder, 0, "the tests write"), Ok(()));
        let error = require(&folder, 1 << 20, "the tests write").unwrap_err();
        assert!(error.starts_with(&folder.display().to_string()), "{error}");
        assert!(error.ends_with("and the tests write 1048576 GiB: make room"), "{error}");
    }

    #[test]
    fn a_folder_that_is_not_there_takes_nothing_and_stops_nobody() {
        let folder = Path::new("/does/not/exist");
        assert_eq!((taken_gib(folder), require(folder, 1, "the tests write")), (0, Ok(())));
    }
}
