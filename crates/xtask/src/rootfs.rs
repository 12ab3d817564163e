//! Temporary root file systems for scripts; removed with all mounts and processes, however the script ends.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
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

/// Why this machine does not allow it, and what to do, or `None`.
pub fn forbidden() -> Option<String> {
    // Where a single user is mapped, files cannot be given to another group.
    let trial =
        "chroot / true && file=$(mktemp) && { chown 0:50 \"$file\"; code=$?; rm \"$file\"; exit $code; }";
    let tried = Command::new("unshare").args(namespaces()).args(["sh", "-c", trial]).output();
    let said = match tried {
        Ok(output) if output.status.success() => return None,
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(error) => return Some(format!("cannot start unshare: {error}")),
    };
    let (lacking, remedy) = if is_root() {
        (
            lacking_as_root(),
            "permit it, as containers do with `--cap-add`, or use a machine that is no container",
        )
    } else {
        (lacking_as_user(), "permit it, or be root")
    };
    let lacking: String = lacking.iter().map(|it| format!("\n  {it}")).collect();
    Some(format!("this machine forbids chroot or namespaces ({said}); {remedy}{lacking}"))
}

/// Capabilities that root needs and this one, probably in a container, has not got.
fn lacking_as_root() -> Vec<String> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    let Some(mask) = effective.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()) else {
        return Vec::new();
    };
    let all = [(18, "CAP_SYS_CHROOT"), (21, "CAP_SYS_ADMIN")];
    all.iter()
        .filter(|(bit, _)| mask >> bit & 1 == 0)
        .map(|(_, name)| format!("root has no {name} here"))
        .collect()
}

/// Conditions of user namespaces that do not hold, each with its remedy.
fn lacking_as_user() -> Vec<String> {
    let mut lacking = Vec::new();
    if Command::new("newuidmap").output().is_err() {
        lacking.push("no program `newuidmap`: apt-get install uidmap".to_owned());
    }
    let id = |option| Command::new("id").arg(option).output().map_or(Vec::new(), |output| output.stdout);
    let [name, uid] =
        ["-un", "-u"].map(|option| String::from_utf8_lossy(id(option).trim_ascii()).into_owned());
    let has_range = |file| {
        let lines = std::fs::read_to_string(file).unwrap_or_default();
        lines.lines().any(|line| line.split(':').next().is_some_and(|owner| owner == name || owner == uid))
    };
    if !has_range("/etc/subuid") || !has_range("/etc/subgid") {
        lacking.push(format!(
            "no line for {name} in /etc/subuid or /etc/subgid: sudo usermod --add-subuids 100000-165535 --add-subgids \
             100000-165535 {name}"
        ));
    }
    for (setting, forbids, permits) in [
        ("user.max_user_namespaces", "0", "10000"),
        ("kernel.unprivileged_userns_clone", "0", "1"),
        ("kernel.apparmor_restrict_unprivileged_userns", "1", "0"),
    ] {
        let file = format!("/proc/sys/{}", setting.replace('.', "/"));
        if std::fs::read_to_string(file).is_ok_and(|value| value.trim() == forbids) {
            lacking.push(format!("{setting}={forbids}: sudo sysctl {setting}={permits}"));
        }
    }
    lacking
}

/// The folder of this process: another's may still be being removed.
pub fn folder_of(name: &Path) -> PathBuf {
    name.with_extension(std::process::id().to_string())
}

/// A script running as root in its own mount and process namespaces.
pub struct Running {
    process: Child,
    guard: Guard,
}

impl Running {
    /// Starts a shell script with a folder of its own, [`folder_of`] `name`, as `$1`, followed by the arguments. Its
    /// output goes to a pipe.
    pub fn start(script: &str, name: &Path, arguments: &[&str]) -> Result<Self, String> {
        let folder = &folder_of(name);
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
