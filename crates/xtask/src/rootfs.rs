//! A root file system of its own for a script: made for it, and gone with all mounts and processes on every way out.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};

/// Ends what still runs and removes the folder `$1`, once told that the script has ended or left alone by us: a pipe ends with
/// whoever holds its other end, however that came about. `$2...` runs a program as the folder's owner.
const GUARD: &str = r#"
folder=$1; shift
read -r process
read -r ended || kill -KILL "$process"
for attempt in 1 2 3 4 5; do
    "$@" rm --recursive --force --one-file-system "$folder" && exit
    sleep 1
done
"#;

/// What precedes each script, and a function for it: `mount_system ROOT`.
const PRELUDE: &str = include_str!("rootfs.sh");

/// Why this machine can make none, if so.
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

/// A script that runs as root, in mounts and processes of its own.
pub struct Running {
    process: Child,
    guard: Guard,
}

impl Running {
    /// Starts a shell script, whose `$1` is the folder, and what follows the arguments. It prints to a pipe.
    pub fn start(script: &str, folder: &Path, arguments: &[&str]) -> Result<Self, String> {
        let mut guard = Guard::start(folder)?;
        let script = format!("{PRELUDE}\n{script}");
        // A group of its own: whoever interrupts us leaves the rest to the guard.
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

    /// Takes what the script prints line by line to its end; whether it ended well.
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

/// What to `unshare`; only root needs no namespace of users.
fn namespaces() -> Vec<&'static str> {
    let mut all = user_namespace();
    all.extend(["--mount", "--pid", "--fork", "--kill-child"]);
    all
}

fn user_namespace() -> Vec<&'static str> {
    if is_root() { Vec::new() } else { vec!["--user", "--map-root-user", "--map-auto"] }
}

/// Whether we may do everything.
pub fn is_root() -> bool {
    let uid = Command::new("id").arg("-u").output();
    uid.is_ok_and(|output| output.stdout.trim_ascii() == b"0")
}

/// The process that cleans up. Dropping it waits until it has.
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
