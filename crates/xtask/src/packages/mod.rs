//! System packages that the tests need: a list in the project, installed if permitted.

pub mod apt;
mod elf;
mod list;
mod probe;

use crate::rootfs::is_root;
use crate::run::{Done, say};
use list::{PATH, PackageEntry};

/// By these, compilers, pkg-config and clang-sys search.
const SEARCHED_BY: [&str; 6] =
    ["LIBCLANG_PATH", "CC", "CXX", "PKG_CONFIG", "PKG_CONFIG_PATH", "PKG_CONFIG_LIBDIR"];
/// Advice for systems other than those of the list.
const ELSEWHERE: &str = "tests/packages.txt is made for Debian 12 and 13. On another system, install by its own means what serves the same\n\
                         purposes, until `cargo xtask packages` finds all; then run `cargo xtask test --no-guest`";

/// An entry that is not there.
struct Missing {
    entry: PackageEntry,
    /// What was looked for, and why it is not found.
    reason: String,
}

/// Prints the list's entries, missing ones last; fails if there are any, and tells how to install them.
pub fn print() -> Done {
    let entries = list::entries()?;
    let all = entries.len();
    let known = apt::candidates(entries.iter().flat_map(|entry| &entry.names));
    let name = |entry: &PackageEntry| first_of(entry, &known).cloned().unwrap_or(entry.names.join("|"));
    let width = entries.iter().map(|entry| name(entry).len()).max().unwrap_or(0);
    let line = |state, entry: &PackageEntry| format!("{state}  {:width$}  {}", name(entry), entry.why);
    let (present, missing) = sorted(entries);
    for entry in &present {
        say(&line("present", entry))?;
    }
    for Missing { entry, reason } in &missing {
        say(&line("missing", entry))?;
        say(&format!("         {:width$}  ({reason})", ""))?;
    }
    match missing.len() {
        0 => say(&format!("all {all} present")),
        few => Err(format!("{few} of {all} missing\n{}", advice(&missing, &known))),
    }
}

/// Installs what is missing, or tells how to.
pub fn install() -> Done {
    let missing = sorted(list::entries()?).1;
    if missing.is_empty() {
        return Ok(());
    }
    let listed = format!("missing:\n{}", lines(&missing));
    if !apt::is_there() || !is_root() {
        return Err(format!("{listed}\n{}", advice(&missing, &candidates(&missing))));
    }
    eprintln!("{listed}");
    // If one of several sources is unreachable, another may still have what is missing.
    let updated = apt::update();
    let known = candidates(&missing);
    if let Err(error) = updated {
        if known.is_empty() {
            return Err(format!("{error}, and apt knows none of what is missing: mend that first"));
        }
        eprintln!("{error}; going on with the lists that there are");
    }
    apt::install(&chosen(&missing, &known)?)?;
    still_missing(&sorted(missing.into_iter().map(|it| it.entry)).1)
}

/// The entries that are there and those that are not.
fn sorted(entries: impl IntoIterator<Item = PackageEntry>) -> (Vec<PackageEntry>, Vec<Missing>) {
    let (mut present, mut missing) = (Vec::new(), Vec::new());
    for entry in entries {
        match entry.check() {
            Ok(()) => present.push(entry),
            Err(reason) => missing.push(Missing { entry, reason }),
        }
    }
    (present, missing)
}

fn candidates(missing: &[Missing]) -> Vec<String> {
    apt::candidates(missing.iter().flat_map(|it| &it.entry.names))
}

/// The first name of an entry that apt knows.
fn first_of<'a>(entry: &'a PackageEntry, known: &[String]) -> Option<&'a String> {
    entry.names.iter().find(|name| known.contains(name))
}

/// The first installable name of each entry, or an error that lists the entries without one.
fn chosen(missing: &[Missing], known: &[String]) -> Done<Vec<String>> {
    let (names, unknown) = choices(missing, known);
    if unknown.is_empty() {
        return Ok(names);
    }
    Err(format!(
        "apt has no package to install for these:\n{}\nare apt's lists up to date (`apt-get update`)?\n{ELSEWHERE}",
        lines(unknown)
    ))
}

/// How this system's user installs what is missing.
fn advice(missing: &[Missing], known: &[String]) -> String {
    let installed = if apt::is_there() { by_hand(missing, known, is_root()) } else { ELSEWHERE.to_owned() };
    format!("{}{installed}", misled())
}

/// Variables by which programs and libraries are searched, if any is set: a wrong one hides what is installed.
fn misled() -> String {
    let set = SEARCHED_BY
        .into_iter()
        .filter_map(|name| std::env::var_os(name).map(|value| format!("  {name}={}\n", value.display())));
    let set: String = set.collect();
    match set.is_empty() {
        true => set,
        false => format!("these variables say where to look; correct or unset a wrong one first:\n{set}"),
    }
}

/// The command to run. Apt's lists may never have been fetched, which only root can do, so packages missing from them
/// are not an error yet.
fn by_hand(missing: &[Missing], known: &[String], is_root: bool) -> String {
    let (mut names, unknown) = choices(missing, known);
    if unknown.len() < missing.len() {
        // Apt would refuse all for one that it does not know.
        names.retain(|name| known.contains(name));
    }
    let mut said = format!("install with\n  {}", apt::by_hand(&names, is_root));
    if !unknown.is_empty() {
        said += &format!(
            "\napt does not know these packages yet, by any name:\n{}\nafter the update, run this command \
             again\n{ELSEWHERE}",
            lines(unknown)
        );
    }
    said
}

/// The first installable name of each entry, or else its first name; and the entries without an installable name.
fn choices<'a>(missing: &'a [Missing], known: &[String]) -> (Vec<String>, Vec<&'a Missing>) {
    let unknown = missing.iter().filter(|it| first_of(&it.entry, known).is_none()).collect();
    let name = |it: &Missing| first_of(&it.entry, known).or(it.entry.names.first()).cloned();
    (missing.iter().filter_map(name).collect(), unknown)
}

/// Fails if programs still do not find what the installed packages provide.
fn still_missing(missing: &[Missing]) -> Done {
    if missing.is_empty() {
        return Ok(());
    }
    Err(format!(
        "installed, but what they are needed for is still not found ({PATH} says how it is looked \
         for):\n{}\n{}{ELSEWHERE}",
        lines(missing),
        misled()
    ))
}

fn lines<'a>(missing: impl IntoIterator<Item = &'a Missing>) -> String {
    let line = |it: &Missing| format!("  {}: {} ({})", it.entry.names.join(" or "), it.entry.why, it.reason);
    missing.into_iter().map(line).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn missing(names: &[&str], why: &str) -> Missing {
        let entry = PackageEntry { names: strings(names), probes: Vec::new(), why: why.to_owned() };
        Missing { entry, reason: "no program".to_owned() }
    }

    fn strings(words: &[&str]) -> Vec<String> {
        words.iter().map(|&word| word.to_owned()).collect()
    }

    #[test]
    fn the_first_name_that_a_release_knows_is_taken() {
        let missing = [missing(&["a-14", "a-19"], "reads"), missing(&["b"], "writes")];
        let chosen_of = |known: &[&str]| chosen(&missing, &strings(known)).map(|names| names.join(" "));
        assert_eq!(chosen_of(&["a-14", "a-19", "b"]).unwrap(), "a-14 b");
        assert_eq!(chosen_of(&["a-19", "b"]).unwrap(), "a-19 b");
        let error = chosen_of(&["b"]).unwrap_err();
        assert!(error.contains("a-14 or a-19: reads (no program)") && error.contains(PATH), "{error}");
        assert!(!error.contains("writes"), "{error}");
    }

    #[test]
    fn a_command_is_told_whatever_apt_knows_and_to_others_than_root_with_sudo() {
        let missing = [missing(&["a-14", "a-19"], "reads"), missing(&["b"], "writes")];
        let told = |known: &[&str], is_root| by_hand(&missing, &strings(known), is_root);
        let command = "apt-get update; apt-get install --yes --no-install-recommends";
        let all = ["a-19", "b"];
        assert_eq!(told(&all, true), format!("install with\n  {command} a-19 b"));
        assert_eq!(told(&all, false), format!("install with\n  sudo sh -c '{command} a-19 b'"));
        let none = told(&[], false);
        assert!(none.contains(&format!("sudo sh -c '{command} a-14 b'\n")), "{none}");
        assert!(none.contains("a-14 or a-19: reads") && none.contains(ELSEWHERE), "{none}");
    }
}
