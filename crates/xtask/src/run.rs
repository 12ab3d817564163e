//! Running other programs.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Result with an error message for the terminal.
pub type Done<T = ()> = Result<T, String>;

/// The project's root folder.
pub fn root() -> &'static Path {
    // The manifest is in crates/xtask, two folders below the root.
    Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap_or(Path::new("."))
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
    // Cargo runs in a different folder, where a relative path would point elsewhere.
    if let Some(target) = named_target() {
        command.env("CARGO_TARGET_DIR", target);
    }
    command
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
