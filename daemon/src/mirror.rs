//! Location of the mirror's state in the daemon's data folder, and its status for clients.

use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use raysweep_drivers::mirror::{Guardian, LightGuard, LightState, MirrorReport};
use raysweep_proto::{ErrorCode, MirrorStatus, RpcError};

/// Path of the mirror's state in the packaged daemon's data folder.
pub const DEFAULT_STATE: &str = "/var/lib/raysweep/mirror.json";

/// Path of the mirror's state in a data folder.
pub fn state_file(data: &Path) -> PathBuf {
    data.join("mirror.json")
}

/// The guard that permits light: the rig's interlock or, without one, the operator.
pub fn light_guard(data: &Path, interlock: Option<PathBuf>) -> LightGuard {
    LightGuard { armed_file: data.join("light-armed"), interlock }
}

/// Starts the process that parks the mirror of a data folder if this one is killed.
///
/// # Errors
/// When the client `raysweep` is not beside the daemon or cannot be started.
pub fn guardian(data: &Path) -> io::Result<Guardian> {
    let mut command = Command::new(std::env::current_exe()?.with_file_name("raysweep"));
    command.args(["park", "--when-closed", "--state"]).arg(state_file(data)).stdout(Stdio::null());
    Guardian::start(command)
}

/// Records the operator's permission.
pub(crate) fn arm_light(data: &Path) -> Result<(), RpcError> {
    let file = light_guard(data, None).armed_file;
    raysweep_drivers::mirror::arm_light(&file).map_err(|error| {
        let what =
            format!("cannot write {}: {error}: give the daemon a --data that it can write", file.display());
        RpcError::new(ErrorCode::Storage, what)
    })
}

/// The mirror's status according to its files; `None` if it was never moved.
pub(crate) fn status(data: &Path, guard: &LightGuard) -> Option<MirrorStatus> {
    let state = state_file(data);
    if !state.exists() {
        return None;
    }
    let MirrorReport { parked, laser, light, .. } = MirrorReport::read(&state, guard);
    let light = match light {
        LightState::InterlockClosed => "interlock_closed",
        LightState::InterlockOpen => "interlock_open",
        LightState::Armed => "armed",
        LightState::NotArmed => "not_armed",
    };
    Some(MirrorStatus { parked, laser, light: light.into() })
}
