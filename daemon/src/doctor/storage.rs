//! The data folder: permission, room and speed.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::Instant;

use nix::unistd::{Uid, User};
use raysweep_core::{Size, io_text};
use raysweep_processing::calibration::{CalibrationHeader, current_in};
use raysweep_session::durable;

use super::PlanNeeds;
use super::checkup::Checkup;

/// Written to measure the disk: more than the caches of a slow disk's controller.
const TEST_BYTES: usize = 32 << 20;
const BLOCK_BYTES: usize = 1 << 20;
/// Less room than this is little for any run.
const LITTLE_ROOM_BYTES: u64 = 1 << 30;
/// A disk that is this much faster than a plan needs keeps up while other programs write.
const RESERVE: f64 = 2.0;

const CALIBRATION: &str = "calibration";
const OLD_SESSIONS: &str = "`raysweep sessions` lists sessions: move old ones to another disk, or delete them by `raysweep trash --for-good`";

pub(super) fn examine(checkup: &mut Checkup, data: &Path, needs: Option<PlanNeeds>) {
    const FOLDER: &str = "data folder";
    // A folder that is missing is made by the daemon, not by who looks: its disk is that of the folder it will be in.
    let present = data.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("."));
    let shown = match data.try_exists() {
        Ok(false) => format!("{} does not exist yet: the daemon makes it", data.display()),
        // It may also be out of sight of who looks.
        Ok(true) | Err(_) => data.display().to_string(),
    };
    if data.is_symlink() && !data.exists() {
        let found = format!("{} is a symbolic link to what is not there", data.display());
        return checkup.failure(FOLDER, found, "make the folder that it points to, or remove the link");
    }
    let speed = match speed(present) {
        Ok(bytes_per_s) => bytes_per_s,
        Err(error) => {
            let found =
                format!("{}: {} cannot be written: {}", data.display(), present.display(), io_text(&error));
            let remedy = match error.kind() {
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => OLD_SESSIONS.into(),
                _ => writable(present),
            };
            return checkup.failure(FOLDER, found, remedy);
        }
    };
    let free_bytes = durable::available_bytes(present).unwrap_or(0);
    let needed_bytes = needs.map_or(LITTLE_ROOM_BYTES, |needs| needs.disk_bytes);
    let found = format!("{shown}, {} free", Size(free_bytes));
    if free_bytes < needed_bytes {
        let of = if needs.is_some() { "the plan needs" } else { "a run may need" };
        let found = format!("{found}; {of} {}", Size(needed_bytes));
        checkup.warning(FOLDER, found, OLD_SESSIONS);
    } else {
        checkup.ok(FOLDER, found);
    }
    examine_speed(checkup, speed, needs);
}

/// How this user gets a data folder instead of one that they may not write, which may be anybody's.
fn writable(folder: &Path) -> String {
    let own = format!("give by --data a folder that `{}` may write", super::host::user());
    let owner = folder.metadata().ok().filter(fs::Metadata::is_dir);
    let owner = owner.and_then(|metadata| User::from_uid(Uid::from_raw(metadata.uid())).ok().flatten());
    // The daemon's folder is never root's.
    match owner.filter(|owner| owner.uid != Uid::effective() && !owner.uid.is_root()) {
        Some(User { name, .. }) => {
            format!("{own}, or ask as its owner: `runuser -u {name} -- raysweep doctor` as root")
        }
        None => own,
    }
}

/// Whether the calibration can be read that a plane rig's runs use.
pub(super) fn examine_calibration(checkup: &mut Checkup, data: &Path) {
    let folder = current_in(data);
    match CalibrationHeader::read(&folder) {
        Ok(Some(header)) => {
            checkup.ok(CALIBRATION, format!("of {}", header.made.strftime("%Y-%m-%d %H:%M UTC")))
        }
        Ok(None) => {}
        Err(why) => {
            let (user, folder) = (super::host::user(), folder.display());
            let remedy = format!("let `{user}` read {folder}, or `raysweep calibrate` again");
            checkup.failure(CALIBRATION, format!("cannot be used: {why}"), remedy);
        }
    }
}

fn examine_speed(checkup: &mut Checkup, bytes_per_s: f64, needs: Option<PlanNeeds>) {
    const DISK: &str = "disk";
    let mb = |bytes_per_s: f64| format!("{:.0} MB/s", bytes_per_s / 1e6);
    let Some(needs) = needs else {
        return checkup
            .ok(DISK, format!("writes {}; give a plan to compare with its needs", mb(bytes_per_s)));
    };
    let needed = needs.disk_bytes as f64 / needs.light_s.max(1e-3);
    let found = format!("writes {}; the plan needs {}", mb(bytes_per_s), mb(needed));
    if bytes_per_s < RESERVE * needed {
        checkup.warning(DISK, found, "give the daemon a --data on a faster disk, such as an NVMe drive");
    } else {
        checkup.ok(DISK, found);
    }
}

/// Speed at which the folder's disk takes data for good, in bytes per second.
fn speed(folder: &Path) -> io::Result<f64> {
    let path = folder.join(format!(".raysweep-doctor-{}", std::process::id()));
    let file = File::create_new(&path)?;
    // A file without a name leaves nothing behind, however this ends.
    fs::remove_file(&path)?;
    write_for_good(file)
}

fn write_for_good(mut file: File) -> io::Result<f64> {
    // Disks that compress would be too fast with zeros.
    let mut block = vec![0_u8; BLOCK_BYTES];
    let mut state = 1_u32;
    block.iter_mut().for_each(|byte| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        *byte = state.to_le_bytes()[3];
    });
    let began = Instant::now();
    for _ in 0..TEST_BYTES / BLOCK_BYTES {
        file.write_all(&block)?;
    }
    file.sync_data()?;
    Ok(TEST_BYTES as f64 / began.elapsed().as_secs_f64())
}

#[cfg(test)]
mod tests {
    use raysweep_proto::Grade;

    use super::*;

    #[test]
    fn a_disk_is_held_against_the_plan_and_nothing_is_left_in_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let data = folder.path().join("data");
        let mut checkup = Checkup::default();
        examine(&mut checkup, &data, Some(PlanNeeds { disk_bytes: 1, light_s: 10.0 }));
        examine(&mut checkup, &data, Some(PlanNeeds { disk_bytes: u64::MAX, light_s: 10.0 }));
        let grades: Vec<Grade> = checkup.checks().iter().map(|check| check.grade).collect();
        assert_eq!(grades, [Grade::Ok, Grade::Ok, Grade::Warning, Grade::Warning]);
        assert!(checkup.checks()[0].found.contains("does not exist yet"), "{:?}", checkup.checks());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_link_to_nothing_and_a_calibration_that_cannot_be_read_are_failures() {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("nowhere", &link).unwrap();
        let damaged = folder.path().join("data");
        fs::create_dir_all(current_in(&damaged)).unwrap();
        fs::write(current_in(&damaged).join("calibration.toml"), "made = ").unwrap();
        let mut checkup = Checkup::default();
        examine(&mut checkup, &link, None);
        examine_calibration(&mut checkup, &damaged);
        examine_calibration(&mut checkup, folder.path());
        let [of_link, of_calibration] = checkup.checks() else { panic!("one check each, none without one") };
        assert_eq!([of_link.grade, of_calibration.grade], [Grade::Failure; 2]);
        assert!(of_link.found.contains("symbolic link"), "{of_link:?}");
        assert!(of_calibration.found.contains("cannot be used"), "{of_calibration:?}");
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_named_with_the_remedy() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        for data in [&file, &file.join("data")] {
            let mut checkup = Checkup::default();
            examine(&mut checkup, data, None);
            let [check] = checkup.checks() else { panic!("one check") };
            assert_eq!((check.name.as_str(), check.grade), ("data folder", Grade::Failure));
            let remedy = check.remedy.as_ref().unwrap();
            assert!(remedy.contains("--data") && !remedy.contains("chown"), "{check:?}");
        }
    }
}
