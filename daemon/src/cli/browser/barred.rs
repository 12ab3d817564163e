//! Files that the user who started the view may not read: who may, and what to do.

use std::fs::{self, File};
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use nix::unistd::{Gid, Group};

/// Why this user may not read a path; `None` if permissions do not keep them from it.
pub(super) fn barred(path: &Path) -> Option<String> {
    // Metadata of what lies below a folder that may not be entered cannot be read.
    let (barrier, metadata) = path.ancestors().find_map(|part| Some((part, fs::metadata(part).ok()?)))?;
    let refused = File::open(barrier).err()?;
    if refused.kind() != ErrorKind::PermissionDenied {
        return None;
    }
    let group = Group::from_gid(Gid::from_raw(metadata.gid())).ok().flatten();
    let shown = barrier.display();
    Some(match group.filter(|_| metadata.mode() & 0o040 != 0) {
        // Who joins that group gets far more than sessions.
        Some(_) if metadata.gid() == 0 => format!(
            "only root may read {shown}: have root run raysweepd by its service, whose sessions members of the group \
             `raysweep` may read, or ask root for a copy"
        ),
        Some(Group { name, .. }) => format!(
            "only members of the group `{name}` may read {shown}: have root add you (`usermod -aG {name} USER`), \
             log in again and restart `raysweep view`, or ask one of them"
        ),
        None => format!("only its owner may read {shown}: ask them"),
    })
}
