//! Manual pages and shell completions of all programs, made from their arguments.

use std::fs;
use std::io;
use std::path::Path;

use clap::CommandFactory;
use clap_complete::Shell;
use clap_mangen::Man;

use super::arguments::Arguments;
use crate::arguments::{DaemonArguments, SimCameraArguments};

/// Writes `man/*.1`, `man/raysweepd.8` and `completions/SHELL/*` below a folder.
pub(super) fn write(folder: &Path) -> io::Result<()> {
    let (man, completions) = (folder.join("man"), folder.join("completions"));
    fs::create_dir_all(&man)?;
    for shell in ["bash", "zsh", "fish"] {
        fs::create_dir_all(completions.join(shell))?;
    }
    // A page for each subcommand too.
    clap_mangen::generate_to(Arguments::command(), &man)?;
    clap_mangen::generate_to(SimCameraArguments::command(), &man)?;
    let mut page = Vec::new();
    Man::new(DaemonArguments::command()).section("8").render(&mut page)?;
    fs::write(man.join("raysweepd.8"), page)?;
    for (name, mut command) in [
        ("raysweep", Arguments::command()),
        ("raysweepd", DaemonArguments::command()),
        ("raysweep-sim-camera", SimCameraArguments::command()),
    ] {
        // Each shell looks for files of another name.
        for (shell, file) in [
            (Shell::Bash, format!("bash/{name}")),
            (Shell::Zsh, format!("zsh/_{name}")),
            (Shell::Fish, format!("fish/{name}.fish")),
        ] {
            let mut text = Vec::new();
            clap_complete::generate(shell, &mut command, name, &mut text);
            fs::write(completions.join(file), text)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_visible_command_has_a_page_and_every_program_a_completion() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path()).unwrap();
        let arguments = Arguments::command();
        let (hidden, visible): (Vec<_>, Vec<_>) =
            arguments.get_subcommands().partition(|command| command.is_hide_set());
        let page = |name: &str| folder.path().join(format!("man/raysweep-{name}.1"));
        for command in visible {
            let text = fs::read_to_string(page(command.get_name())).unwrap();
            assert!(text.contains("DESCRIPTION"), "{}", command.get_name());
        }
        assert!(hidden.iter().all(|command| !page(command.get_name()).exists()));
        for (file, word) in [
            ("man/raysweep.1", "Exit codes"),
            ("man/raysweepd.8", "operators"),
            ("man/raysweep-sim-camera.1", "test\\-pictures"),
            ("completions/bash/raysweep", "calibrate"),
            ("completions/zsh/_raysweepd", "--operators"),
            ("completions/fish/raysweep-sim-camera.fish", "test-pictures"),
        ] {
            let text = fs::read_to_string(folder.path().join(file)).unwrap();
            assert!(text.contains(word), "{file} lacks {word}");
        }
    }
}
