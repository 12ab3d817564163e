//! Temporary root file systems for scripts; removed with all mounts and processes, however the script ends.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};

/// Kills remaining processes and removes the folder `$1`, once told that the script has ended, or when we have died:
/// the pipe closes in either case. `$2...` runs a program as the folder's owner.
const GUARD: &str = r#"
folder=$1; shift
read -r process
read -r ended || kill -KILL "$process"
for attempt in 1 2 3 4 5; do
    "$@" rm --recursive --force --one-file-system "$folder" && exit
    sleep 1
done
"#;

/// Prepended to each script; defines the function `mount_system ROOT`.
const PRELUDE: &str = include_str!("rootfs.sh");

/// Why this machine does not allow it, or `None`.
pub fn forbidden() -> Option<String> {
    let tried = Command::new("unshare").args(namespaces()).args(["chroot", "/", "true"]).output();
    match tried {
        Ok(output) if output.status.success() => None,
        Ok(output) => Some(format!(
            "a root file system of one's own takes chroot and namespaces: be root on a machine that permits them, or a user with \
             user namespaces, newuidmap and lines in /etc/subuid and /etc/subgid; {}",
            String::from_utf8_lossy(&output.stderr).trim()
        )),
        Err(error) => Some(format!("cannot start unshare: {error}")),
    }
}

/// A script running as root in its own mount and process namespaces.
pub struct Running {
    process: Child,
    guard: Guard,
}

impl Running {
    /// Starts a shell script with the folder as `$1`, followed by the arguments. Its output goes to a pipe.
    pub fn start(script: &str, folder: &Path, arguments: &[&str]) -> Result<Self, String> {
        let mut guard = Guard::start(folder)?;
        let script = format!("{PRELUDE}\n{script}");
        // A separate process group: if we are interrupted, the guard cleans up.
        let process = Command::new("unshare")
            .args(namespaces())
            .args(["sh", "-euc", &script, "sh"])
            .arg(folder)
            .args(arguments)
            .process_group(0)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| format!("cannot start unshare: {error}"))?;
        guard.say(&process.id().to_string())?;
        Ok(Self { process, guard })
    }

    /// Passes the script's output to `take` line by line until the end; returns whether the script succeeded.
    pub fn follow(mut self, mut take: impl FnMut(&str)) -> Result<bool, String> {
        let output = self.process.stdout.take().ok_or("unshare without output")?;
        for line in BufReader::new(output).split(b'\n') {
            let line = line.map_err(|error| format!("cannot read what the script prints: {error}"))?;
            take(&String::from_utf8_lossy(&line));
        }
        let status = self.process.wait().map_err(|error| format!("unshare: {error}"))?;
        self.guard.say("ended")?;
        Ok(status.success())
    }
}

/// Arguments of `unshare`; root does not need a user namespace.
fn namespaces() -> Vec<&'static str> {
    let mut all = user_namespace();
    all.extend(["--mount", "--pid", "--fork", "--kill-child"]);
    all
}

fn user_namespace() -> Vec<&'static str> {
    if is_root() { Vec::new() } else { vec!["--user", "--map-root-user", "--map-auto"] }
}

/// Whether we are root.
pub fn is_root() -> bool {
    let uid = Command::new("id").arg("-u").output();
    uid.is_ok_and(|output| output.stdout.trim_ascii() == b"0")
}

/// The process that cleans up. Dropping it waits until it has finished.
struct Guard {
    process: Child,
    pipe: Option<ChildStdin>,
}

impl Guard {
    fn start(folder: &Path) -> Result<Self, String> {
        let mut process = Command::new("sh")
            .args(["-c", GUARD, "sh"])
            .arg(folder)
            .arg("unshare")
            .args(user_namespace())
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .map_err(|error| format!("cannot start sh: {error}"))?;
        let pipe = process.stdin.take();
        Ok(Self { process, pipe })
    }

    fn say(&mut self, line: &str) -> Result<(), String> {
        let pipe = self.pipe.as_mut().ok_or("the guard's pipe is closed")?;
        writeln!(pipe, "{line}").map_err(|error| format!("the guard has ended: {error}"))
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        self.pipe = None;
        let _ = self.process.wait();
    }
}
