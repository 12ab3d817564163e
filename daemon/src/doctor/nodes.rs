//! The files that a rig file names: device nodes, ports and the interlock.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, AtFlags};
use nix::unistd::{AccessFlags, Gid, Group, faccessat};
use raysweep_config::rig::dots::DotCameraDriver;
use raysweep_config::rig::plane::{CameraDriver, ProjectorDriver};
use raysweep_config::rig::vsync::VsyncDriver;
use raysweep_drivers::search::analysers;

use super::checkup::Checkup;
use super::host::user;
use crate::rig::SharedRig;

/// A file that the rig file names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct NamedNode {
    /// Its key in the rig file.
    pub key: &'static str,
    pub path: PathBuf,
    /// Whether it is only read.
    pub is_input: bool,
}

/// The files that a rig's drivers open.
pub(super) fn of(rig: &SharedRig) -> Vec<NamedNode> {
    let node = |key: &'static str, path: Option<PathBuf>| path.map(|path| (key, path));
    let named = match rig {
        SharedRig::Plane(rig) => {
            let (camera, vsync, projector) = (&rig.file.camera, &rig.file.vsync, &rig.file.projector);
            let device = camera.v4l2.as_ref().filter(|_| camera.driver == CameraDriver::V4l2);
            let line = match vsync.driver {
                VsyncDriver::ModemLine => {
                    node("vsync.modemline.port", vsync.modemline.as_ref().map(|config| config.port.clone()))
                }
                VsyncDriver::Pps => {
                    node("vsync.pps.source", vsync.pps.as_ref().map(|config| config.source.clone()))
                }
                VsyncDriver::TriggerBox => {
                    node("vsync.triggerbox.port", vsync.triggerbox.as_ref().map(|config| config.port.clone()))
                }
                // The rig file names none: its driver takes the only one on the USB.
                VsyncDriver::Fx2Lafw => {
                    node("vsync.fx2lafw", analysers().into_iter().next().map(|analyser| analyser.path))
                }
                VsyncDriver::Sim => None,
            };
            let card = (projector.driver == ProjectorDriver::Drm).then(|| projector.drm.card.clone());
            vec![
                node("camera.v4l2.device", device.map(|config| config.device.clone())),
                line,
                node("projector.drm.card", card),
            ]
        }
        SharedRig::Dots(rig) => {
            let camera = &rig.file.camera;
            let device = camera.v4l2.as_ref().filter(|_| camera.driver == DotCameraDriver::V4l2);
            let mirror = rig.file.mirror.as_ref().filter(|_| rig.has_real_mirror());
            vec![
                node("camera.v4l2.device", device.map(|config| config.device.clone())),
                node("mirror.port", mirror.and_then(|mirror| mirror.port.clone())),
                node("mirror.laser_port", mirror.and_then(|mirror| mirror.laser_port.clone())),
                node(INTERLOCK, mirror.and_then(|mirror| mirror.interlock.clone())),
            ]
        }
    };
    let found = named.into_iter().flatten();
    found.map(|(key, path)| NamedNode { key, path, is_input: key == INTERLOCK }).collect()
}

const INTERLOCK: &str = "mirror.interlock";

pub(super) fn examine(checkup: &mut Checkup, nodes: &[NamedNode]) {
    for node in nodes {
        examine_node(checkup, node);
    }
}

fn examine_node(checkup: &mut Checkup, NamedNode { key, path, is_input }: &NamedNode) {
    let shown = path.display();
    let metadata = match path.metadata() {
        Ok(metadata) => metadata,
        Err(error) => {
            let found = format!("{shown}: {}", raysweep_core::io_text(&error));
            return checkup.failure(key, found, list_of(path));
        }
    };
    let wanted = if *is_input { AccessFlags::R_OK } else { AccessFlags::R_OK | AccessFlags::W_OK };
    match faccessat(AT_FDCWD, path.as_path(), wanted, AtFlags::AT_EACCESS) {
        Ok(()) => checkup.ok(key, format!("{shown} is there, and {} may use it", user())),
        Err(Errno::EACCES) => {
            let found = format!("{shown}: {} may not use it", user());
            checkup.failure(key, found, grant(path, metadata.gid(), metadata.mode(), *is_input));
        }
        Err(errno) => checkup.failure(key, format!("{shown}: {errno}"), list_of(path)),
    }
}

/// What lists the paths that are there instead.
fn list_of(path: &Path) -> String {
    let listed = match path.to_string_lossy() {
        name if name.starts_with("/dev/video") => "`v4l2-ctl --list-devices` lists what is there",
        name if name.starts_with("/dev/tty") || name.starts_with("/dev/serial") => {
            "`ls -l /dev/serial/by-id` lists what is there"
        }
        name if name.starts_with("/dev/pps") => "`ls -l /dev/pps*` lists what is there",
        name if name.starts_with("/dev/dri") => "`ls -l /dev/dri/by-path` lists what is there",
        _ => "correct the path in the rig file",
    };
    format!("plug it in and switch it on; {listed}, `raysweep setup` names what answers")
}

/// How a user gets the permission of a node's group, if that has one.
fn grant(path: &Path, gid: u32, mode: u32, is_input: bool) -> String {
    let (group_may, rights) = if is_input { (0o040, "r") } else { (0o060, "rw") };
    let group = Group::from_gid(Gid::from_raw(gid)).ok().flatten().map(|group| group.name);
    match group.filter(|name| name != "root" && mode & group_may == group_may) {
        Some(group) => format!(
            "`usermod -aG {group} {0}` as root, then log in again, or `systemctl restart raysweepd` for the service",
            user()
        ),
        None => format!(
            "install the package's udev rules and plug it in again, or `chgrp raysweep {0} && chmod g+{rights} {0}` as root until it is unplugged",
            path.display()
        ),
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::fs::PermissionsExt;

    use nix::unistd::{Uid, setfsuid};
    use raysweep_proto::{DoctorCheck, Grade};

    use super::*;

    fn examined(path: &Path) -> DoctorCheck {
        let mut checkup = Checkup::default();
        let node = NamedNode { key: "vsync.modemline.port", path: path.to_owned(), is_input: false };
        // Of this thread alone; without it, root may use everything.
        let checks = std::thread::spawn(move || {
            setfsuid(Uid::from_raw(65_534));
            examine_node(&mut checkup, &node);
            checkup.checks().to_vec()
        });
        checks.join().unwrap().remove(0)
    }

    #[test]
    fn what_is_missing_or_forbidden_is_named_with_the_remedy() {
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(folder.path(), Permissions::from_mode(0o755)).unwrap();
        let path = folder.path().join("ttyS0");
        let missing = examined(&path);
        assert_eq!(missing.grade, Grade::Failure);
        assert!(missing.found.contains("No such file"), "{missing:?}");
        fs::write(&path, "").unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o600)).unwrap();
        if Uid::effective().is_root() {
            let forbidden = examined(&path);
            assert_eq!(forbidden.grade, Grade::Failure);
            assert!(forbidden.found.contains("may not use it"), "{forbidden:?}");
            assert!(forbidden.remedy.unwrap().contains("udev"), "its group is root's");
        }
        fs::set_permissions(&path, Permissions::from_mode(0o666)).unwrap();
        assert_eq!(examined(&path).grade, Grade::Ok);
    }

    #[test]
    fn the_group_of_a_node_is_told_to_who_is_not_in_it() {
        // The group that every Unix has after root's.
        let group = (1..1000).find_map(|gid| Group::from_gid(Gid::from_raw(gid)).unwrap()).unwrap();
        let told = |mode, is_input| grant(Path::new("/dev/ttyUSB0"), group.gid.as_raw(), mode, is_input);
        let remedy = told(0o660, false);
        assert!(remedy.contains(&format!("usermod -aG {}", group.name)), "{remedy}");
        assert!(told(0o600, false).contains("udev") && told(0o600, false).contains("g+rw"));
        assert!(told(0o640, true).contains("usermod") && !told(0o640, false).contains("usermod"));
        assert!(told(0o600, true).contains("chmod g+r /dev"), "{}", told(0o600, true));
    }
}
