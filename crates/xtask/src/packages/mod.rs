//! System packages that the tests need: a list in the project, installed if permitted.

mod apt;
mod elf;
mod libclang;
mod list;
mod probe;

use crate::rootfs::is_root;
use crate::run::{Done, say};
use list::{Entry, PATH};

/// Advice for systems other than those of the list.
const ELSEWHERE: &str = "tests/packages.txt is made for Debian 12 and 13. On another system, install what serves the same purposes\n\
                         by its own means: `cargo xtask packages` tells what is found";

/// Why a package may be installed without being found by programs.
const SHADOWED: &str = "another program of the same name may come first on the path, or an environment variable may name another folder";

/// Prints the list's entries, and whether they are present.
pub fn print() -> Done {
    for entry in list::entries()? {
        let state = if entry.is_there() { "present" } else { "missing" };
        say(&format!("{state} {}: {}", entry.names.join("|"), entry.why))?;
    }
    Ok(())
}

/// Installs what is missing, or prints how to.
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
    if !is_root() {
        return Err(for_root(&missing, apt::has_candidate));
    }
    // If one of several sources is unreachable, another may still have what is missing.
    if let Err(error) = apt::update() {
        eprintln!("{error}; going on with the lists that there are");
    }
    apt::install(&chosen(&missing, apt::has_candidate)?)?;
    still_missing(&self::missing(missing))
}

fn missing(entries: Vec<Entry>) -> Vec<Entry> {
    entries.into_iter().filter(|entry| !entry.is_there()).collect()
}

/// The first installable name of each entry, or an error that lists the entries without one.
fn chosen(missing: &[Entry], can_be_installed: impl Fn(&str) -> bool) -> Done<Vec<String>> {
    let (names, unknown) = choices(missing, can_be_installed);
    if unknown.is_empty() {
        return Ok(names);
    }
    Err(format!(
        "apt has no package to install for these:\n{}\nare apt's lists up to date (`apt-get update`)?\n{ELSEWHERE}",
        lines(unknown)
    ))
}

/// Message for users who may not install: the command to run. Apt's lists may never have been fetched, which only root
/// can do, so packages missing from them are not an error yet.
fn for_root(missing: &[Entry], can_be_installed: impl Fn(&str) -> bool) -> String {
    let (names, unknown) = choices(missing, can_be_installed);
    let mut said = format!("only root may install packages; run\n  sudo sh -c '{}'", apt::by_hand(&names));
    if !unknown.is_empty() {
        said += &format!(
            "\napt's lists do not have these yet, by any name:\n{}\nif they still lack one after the update, run this again for \
             the name that they have\n{ELSEWHERE}",
            lines(unknown)
        );
    }
    said + "\nif they are installed already: " + SHADOWED
}

/// The first installable name of each entry, or else its first name; and the entries without an installable name.
fn choices(missing: &[Entry], can_be_installed: impl Fn(&str) -> bool) -> (Vec<String>, Vec<&Entry>) {
    let known = |entry: &Entry| entry.names.iter().find(|name| can_be_installed(name)).cloned();
    let choices: Vec<_> = missing.iter().map(|entry| (entry, known(entry))).collect();
    let unknown = choices.iter().filter(|(_, known)| known.is_none()).map(|&(entry, _)| entry).collect();
    let name = |(entry, known): (&Entry, Option<String>)| known.or_else(|| entry.names.first().cloned());
    (choices.into_iter().filter_map(name).collect(), unknown)
}

/// Fails if programs still do not find what the installed packages provide.
fn still_missing(entries: &[Entry]) -> Done {
    if entries.is_empty() {
        return Ok(());
    }
    Err(format!(
        "these packages are installed, yet what {PATH} has them for is not found:\n{}\n{SHADOWED}",
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

    #[test]
    fn who_is_not_root_is_told_a_command_whatever_apt_knows() {
        let missing = [entry(&["a-14", "a-19"], "reads"), entry(&["b"], "writes")];
        let told = |known: &[&str]| for_root(&missing, |name| known.contains(&name));
        let command = |names: &str| {
            format!("sudo sh -c 'apt-get update; apt-get install --yes --no-install-recommends {names}'\n")
        };
        let all = told(&["a-19", "b"]);
        assert!(all.contains(&command("a-19 b")) && all.ends_with(SHADOWED), "{all}");
        assert!(!all.contains("lists"), "{all}");
        let none = told(&[]);
        assert!(none.contains(&command("a-14 b")) && none.ends_with(SHADOWED), "{none}");
        assert!(none.contains("a-14 or a-19: reads") && none.contains(ELSEWHERE), "{none}");
    }
}
