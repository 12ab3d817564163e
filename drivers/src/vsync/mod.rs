//! Watchers of the projector's VSYNC line.

pub mod fx2lafw;
mod ioctl;
pub mod modemline;
pub mod pps;
pub mod reopen;
pub mod triggerbox;

use std::path::Path;

use nix::errno::Errno;
pub use raysweep_config::rig::vsync::Polarity;
use raysweep_core::{DeviceError, DeviceErrorKind};

const DEVICE: &str = "vsync";

/// What the system said of a device file, and what to do about it.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {call}: {errno}: {advice}")]
struct SystemError {
    path: String,
    call: &'static str,
    errno: Errno,
    advice: &'static str,
}

fn system_error(path: &Path, call: &'static str, errno: Errno) -> DeviceError {
    let (kind, advice) = match errno {
        Errno::EBUSY => (DeviceErrorKind::Busy, "end the program that holds it (fuser names it)"),
        Errno::EACCES | Errno::EPERM => {
            (DeviceErrorKind::NotReady, "not permitted: let the daemon's user into the device's group")
        }
        Errno::ENOTTY | Errno::EINVAL | Errno::ENOSYS => {
            (DeviceErrorKind::Unsupported, "this is no device of that kind: name another one")
        }
        _ => (DeviceErrorKind::Disconnected, "the device is gone: plug it in and begin again"),
    };
    let path = path.display().to_string();
    DeviceError::new(DEVICE, kind, SystemError { path, call, errno, advice })
}
