//! Checks the units in `deploy/` with systemd's own tools, in a staged root with the programs at their installed paths.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;
use std::process::Command;

#[test]
fn systemd_accepts_the_units_and_finds_what_they_start() {
    let deploy = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy");
    let root = tempfile::tempdir().unwrap();
    let put = |from: &Path, to: &str| {
        let to = root.path().join(to);
        std::fs::create_dir_all(to.parent().unwrap()).unwrap();
        std::fs::copy(from, to).unwrap();
    };
    put(Path::new(env!("CARGO_BIN_EXE_raysweepd")), "usr/bin/raysweepd");
    put(Path::new(env!("CARGO_BIN_EXE_raysweep")), "usr/bin/raysweep");
    for unit in ["raysweepd.service", "raysweepd.socket"] {
        put(&deploy.join("systemd").join(unit), &format!("usr/lib/systemd/system/{unit}"));
    }
    // Units that ours refer to and that every system has.
    for unit in ["sysinit.target", "basic.target", "sockets.target", "multi-user.target", "shutdown.target"] {
        let path = root.path().join("usr/lib/systemd/system").join(unit);
        std::fs::write(path, "[Unit]\nDescription=stands for the system's own\n").unwrap();
    }
    let output = Command::new("systemd-analyze")
        .arg(format!("--root={}", root.path().display()))
        .args(["verify", "--man=no", "--recursive-errors=no", "raysweepd.service", "raysweepd.socket"])
        .output()
        .expect("systemd-analyze: `cargo xtask test` installs it");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.trim().is_empty(), "{said}");
}
