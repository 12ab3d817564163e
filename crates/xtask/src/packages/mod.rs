//! System packages that the tests need: a list in the project, installed when we may.

mod apt;
mod libclang;
mod list;
mod probe;

use crate::rootfs::is_root;
use crate::run::{Done, say};
use list::{Entry, PATH};

/// What to do on systems that the list is not made for.
const ELSEWHERE: &str = "tests/packages.txt is made for Debian 12 and 13. On another system, install what serves the same purposes\n\
                         by its own means: `cargo xtask packages` tells what is found";

/// Prints what the list asks for, and whether it is there.
pub fn print() -> Done {
    for entry in list::entries()? {
        let state = if entry.is_there() { "present" } else { "missing" };
        say(&format!("{state} {}: {}", entry.names.join("|"), entry.why))?;
    }
    Ok(())
}

/// Installs what is missing, or says how to.
pub fn install() -> Done {
    let missing = missing(list::entries()?);
    if missing.is_empty() {
        return Ok(());
    }
    if !apt::is_there() {
        return Err(format!(
            "these packages are missing, and this system has no apt-get to install them with:\n{}\n{ELSEWHERE}",
            lines(&missing)
        ));
    }
    eprintln!("missing:\n{}", lines(&missing));
    if is_root() {
        apt::update()?;
    }
    let names = chosen(&missing, apt::has_candidate)?;
    if !is_root() {
        return Err(format!("only root may install packages; run\n  sudo sh -c '{}'", apt::by_hand(&names)));
    }
    apt::install(&names)?;
    still_missing(&self::missing(missing))
}

fn missing(entries: Vec<Entry>) -> Vec<Entry> {
    entries.into_iter().filter(|entry| !entry.is_there()).collect()
}

/// The first name of each entry that can be installed, or which entries have none.
fn chosen(missing: &[Entry], can_be_installed: impl Fn(&str) -> bool) -> Done<Vec<String>> {
    let choose = |entry: &Entry| entry.names.iter().find(|name| can_be_installed(name)).cloned();
    let choices: Vec<Option<String>> = missing.iter().map(choose).collect();
    if choices.iter().all(Option::is_some) {
        return Ok(choices.into_iter().flatten().collect());
    }
    let unknown = missing.iter().zip(choices).filter(|(_, choice)| choice.is_none()).map(|(entry, _)| entry);
    Err(format!(
        "apt has no package to install for these:\n{}\nare apt's lists up to date (`apt-get update`)?\n{ELSEWHERE}",
        lines(unknown)
    ))
}

/// A package may be installed and yet not be what programs find.
fn still_missing(entries: &[Entry]) -> Done {
    if entries.is_empty() {
        return Ok(());
    }
    Err(format!(
        "these packages are installed, yet what {PATH} has them for is not found:\n{}\nanother program of the same name may \
         come first on the path, or an environment variable may name another folder",
        lines(entries)
    ))
}

fn lines<'a>(entries: impl IntoIterator<Item = &'a Entry>) -> String {
    let line = |entry: &Entry| format!("  {}: {}", entry.name(), entry.why);
    entries.into_iter().map(line).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(names: &[&str], why: &str) -> Entry {
        let names = names.iter().map(|&name| name.to_owned()).collect();
        Entry { names, probes: Vec::new(), why: why.to_owned() }
    }

    #[test]
    fn the_first_name_that_a_release_knows_is_taken() {
        let missing = [entry(&["a-14", "a-19"], "reads"), entry(&["b"], "writes")];
        let chosen_of =
            |known: &[&str]| chosen(&missing, |name| known.contains(&name)).map(|names| names.join(" "));
        assert_eq!(chosen_of(&["a-14", "a-19", "b"]).unwrap(), "a-14 b");
        assert_eq!(chosen_of(&["a-19", "b"]).unwrap(), "a-19 b");
        let error = chosen_of(&["b"]).unwrap_err();
        assert!(error.contains("a-14 or a-19: reads") && error.contains(PATH), "{error}");
        assert!(!error.contains("writes"), "{error}");
    }
}
