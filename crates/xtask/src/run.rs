//! Running other programs.

use std::ffi::{OsStr, OsString};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Result with an error message for the terminal.
pub type Done<T = ()> = Result<T, String>;

/// The project's root folder: of the checkout in which `cargo xtask` was called, which need not be the one that was
/// compiled, where several share a target folder.
pub fn root() -> PathBuf {
    let manifest =
        std::env::var_os("CARGO_MANIFEST_DIR").unwrap_or_else(|| env!("CARGO_MANIFEST_DIR").into());
    // The manifest is in crates/xtask, two folders below the root.
    Path::new(&manifest).ancestors().nth(2).unwrap_or(Path::new(".")).to_owned()
}

/// Cargo's target folder.
pub fn target() -> PathBuf {
    named_target().unwrap_or_else(|| root().join("target"))
}

/// Target folder from the environment, relative to our working directory.
fn named_target() -> Option<PathBuf> {
    std::path::absolute(std::env::var_os("CARGO_TARGET_DIR")?).ok()
}

/// The cargo that started us, run in the project's root.
pub fn cargo() -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.current_dir(root());
    // What it builds is looked for there, whatever other variables and configuration files say.
    command.env("CARGO_TARGET_DIR", target()).env_remove("CARGO_BUILD_TARGET");
    command
}

/// Where Debian has chroot and mke2fs; not on the path of its ordinary users.
const SYSTEM_FOLDERS: [&str; 3] = ["/usr/local/sbin", "/usr/sbin", "/sbin"];

/// Starts this program anew with the folders of the system's programs on the path, unless they are there; returns why
/// that failed.
pub fn find_system_programs() -> Option<String> {
    let path = with_system_folders(&std::env::var_os("PATH")?)?;
    let mut again = Command::new(std::env::current_exe().ok()?);
    let error = again.args(std::env::args_os().skip(1)).env("PATH", path).exec();
    Some(format!("cannot start xtask again: {error}"))
}

/// A path with the folders that it lacks at its end; `None` if it lacks none.
fn with_system_folders(path: &OsStr) -> Option<OsString> {
    let named: Vec<PathBuf> = std::env::split_paths(path).collect();
    let lacking = SYSTEM_FOLDERS.map(PathBuf::from).into_iter().filter(|folder| !named.contains(folder));
    let lacking: Vec<PathBuf> = lacking.collect();
    match lacking.is_empty() {
        true => None,
        false => std::env::join_paths(named.into_iter().chain(lacking)).ok(),
    }
}

/// The program that a shell would start for a name.
pub fn program(name: &str) -> Option<PathBuf> {
    program_on(&std::env::var_os("PATH").unwrap_or_default(), name)
}

fn program_on(path: &OsStr, name: &str) -> Option<PathBuf> {
    std::env::split_paths(path).map(|folder| folder.join(name)).find(|file| {
        file.metadata().is_ok_and(|about| about.is_file() && about.permissions().mode() & 0o111 != 0)
    })
}

/// Fails with the messages of all parts that failed.
pub fn all(parts: impl IntoIterator<Item = Done>) -> Done {
    let errors: Vec<String> = parts.into_iter().filter_map(Done::err).collect();
    if errors.is_empty() { Ok(()) } else { Err(errors.join("\n")) }
}

/// Prints a line. A reader that has closed the pipe is not an error.
pub fn say(line: &str) -> Done {
    match writeln!(std::io::stdout(), "{line}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(format!("cannot print: {error}")),
        _ => Ok(()),
    }
}

/// Runs a program to completion; an error names the program.
pub fn run(command: &mut Command) -> Done {
    let shown = shown(command);
    eprintln!("$ {shown}");
    let status = command.status().map_err(|error| format!("cannot start `{shown}`: {error}"))?;
    if status.success() { Ok(()) } else { Err(format!("`{shown}` ended with {status}")) }
}

fn shown(command: &Command) -> String {
    let name = Path::new(command.get_program()).file_name().unwrap_or(command.get_program());
    let arguments = command.get_args().map(|argument| argument.to_string_lossy().into_owned());
    [name.to_string_lossy().into_owned()].into_iter().chain(arguments).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_of_system_programs_are_added_once() {
        let path = with_system_folders(OsStr::new("/usr/bin:/sbin")).unwrap();
        assert_eq!(path, "/usr/bin:/sbin:/usr/local/sbin:/usr/sbin");
        assert_eq!(with_system_folders(&path), None);
    }

    #[test]
    fn a_program_is_a_file_that_may_be_executed() {
        let folder = std::env::temp_dir().join(format!("raysweep-path-{}", std::process::id()));
        let (first, second) = (folder.join("first"), folder.join("second"));
        std::fs::create_dir_all(first.join("folder")).unwrap();
        std::fs::create_dir_all(&second).unwrap();
        for (file, mode) in [(first.join("tool"), 0o644), (second.join("tool"), 0o755)] {
            std::fs::write(&file, "").unwrap();
            std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).unwrap();
        }
        let path = std::env::join_paths([&first, &second]).unwrap();
        assert_eq!(program_on(&path, "tool"), Some(second.join("tool")));
        assert_eq!(program_on(&path, "folder"), None);
        assert_eq!(program_on(&path, "nothing"), None);
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
