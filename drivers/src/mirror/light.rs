//! Permission for light: an interlock, or the permission of an operator since this boot.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// File with the id of this boot.
const BOOT_ID: &str = "/proc/sys/kernel/random/boot_id";

/// Why light is not permitted.
#[derive(Debug, thiserror::Error)]
pub enum NoLight {
    /// The interlock is open.
    #[error("the interlock {} is open: close the enclosure", path.display())]
    Open {
        /// Path of the interlock.
        path: PathBuf,
    },
    /// The interlock cannot be read.
    #[error("the interlock {} cannot be read: {source}: check its wiring and the rig file", path.display())]
    Unreadable {
        /// Path of the interlock.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// No operator has permitted light.
    #[error(
        "nobody has permitted light since this boot: make sure that it is safe, then `raysweep arm-light`"
    )]
    NotArmed,
}

/// Permission for light as reported by `status`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LightState {
    /// The interlock is closed.
    InterlockClosed,
    /// The interlock is open, or cannot be read.
    InterlockOpen,
    /// No interlock; an operator has armed the light since this boot.
    Armed,
    /// No interlock, and no operator has armed the light.
    NotArmed,
}

/// Decides whether light is permitted, each time it is asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LightGuard {
    /// File in which [`arm_light`] records the operator's permission.
    pub armed_file: PathBuf,
    /// A file that begins with `1` while the interlock is closed, such as a GPIO's value. If given, it alone decides.
    pub interlock: Option<PathBuf>,
}

impl LightGuard {
    /// Whether light is permitted now.
    ///
    /// # Errors
    /// Why it is not, and what to do about it.
    pub fn permits(&self) -> Result<(), NoLight> {
        let Some(path) = &self.interlock else {
            return if is_armed(&self.armed_file) { Ok(()) } else { Err(NoLight::NotArmed) };
        };
        match fs::read(path) {
            Ok(value) if value.first() == Some(&b'1') => Ok(()),
            Ok(_) => Err(NoLight::Open { path: path.clone() }),
            Err(source) => Err(NoLight::Unreadable { path: path.clone(), source }),
        }
    }

    /// The same for `status`.
    pub fn state(&self) -> LightState {
        match (self.interlock.is_some(), self.permits().is_ok()) {
            (true, true) => LightState::InterlockClosed,
            (true, false) => LightState::InterlockOpen,
            (false, true) => LightState::Armed,
            (false, false) => LightState::NotArmed,
        }
    }
}

/// Records the operator's permission for this boot.
///
/// # Errors
/// If the file cannot be written.
pub fn arm_light(armed_file: &Path) -> io::Result<()> {
    fs::write(armed_file, boot_id()?)
}

/// The id of this boot.
pub(super) fn boot_id() -> io::Result<String> {
    Ok(fs::read_to_string(BOOT_ID)?.trim().to_owned())
}

fn is_armed(armed_file: &Path) -> bool {
    match (fs::read_to_string(armed_file), boot_id()) {
        (Ok(armed), Ok(boot)) => armed.trim() == boot,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_word_counts_for_this_boot_alone() {
        let folder = tempfile::tempdir().unwrap();
        let guard = LightGuard { armed_file: folder.path().join("armed"), interlock: None };
        assert!(matches!(guard.permits(), Err(NoLight::NotArmed)));
        fs::write(&guard.armed_file, "00000000-0000-0000-0000-000000000000\n").unwrap();
        assert_eq!(guard.state(), LightState::NotArmed, "the word of another boot");
        arm_light(&guard.armed_file).unwrap();
        assert_eq!(guard.state(), LightState::Armed);
    }

    #[test]
    fn an_interlock_decides_alone() {
        let folder = tempfile::tempdir().unwrap();
        let interlock = folder.path().join("value");
        let guard =
            LightGuard { armed_file: folder.path().join("armed"), interlock: Some(interlock.clone()) };
        arm_light(&guard.armed_file).unwrap();
        assert!(matches!(guard.permits(), Err(NoLight::Unreadable { .. })));
        fs::write(&interlock, "0\n").unwrap();
        assert!(matches!(guard.permits(), Err(NoLight::Open { .. })));
        fs::write(&interlock, "1\n").unwrap();
        assert!(guard.permits().is_ok());
    }
}
