//! System packages that the tests need: a list in the project, installed when we may.

use std::process::{Command, Stdio};

use crate::run::{Done, root, run};

/// One line of `tests/packages.txt`: the package, what shows that it is there, and why it is needed.
struct Package {
    name: String,
    shows: String,
    why: String,
}

/// Installs what is missing, or says how to.
pub fn install() -> Done {
    let missing: Vec<Package> = list()?.into_iter().filter(|package| !is_there(&package.shows)).collect();
    if missing.is_empty() {
        return Ok(());
    }
    for Package { name, why, .. } in &missing {
        eprintln!("missing: {name} ({why})");
    }
    let names: Vec<&str> = missing.iter().map(|package| package.name.as_str()).collect();
    let by_hand =
        format!("apt-get update && apt-get install --yes --no-install-recommends {}", names.join(" "));
    if !is_root() {
        return Err(format!(
            "these packages are missing and only root may install them:\n  sudo sh -c '{by_hand}'"
        ));
    }
    eprintln!("installing them through apt");
    let apt = |arguments: &[&str]| {
        run(Command::new("apt-get")
            .args(arguments)
            .env("DEBIAN_FRONTEND", "noninteractive")
            .stdout(Stdio::null()))
    };
    apt(&["update"])
        .and_then(|()| apt(&[&["install", "--yes", "--no-install-recommends"], names.as_slice()].concat()))
        .map_err(|error| format!("{error}\ninstall them by hand:\n  {by_hand}"))
}

fn list() -> Done<Vec<Package>> {
    let path = root().join("tests/packages.txt");
    let text = std::fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))?;
    text.lines()
        .filter(|line| !line.trim().is_empty() && !line.starts_with('#'))
        .map(|line| {
            let mut fields = line.splitn(3, char::is_whitespace).map(str::trim);
            match (fields.next(), fields.next(), fields.next()) {
                (Some(name), Some(shows), Some(why)) => {
                    Ok(Package { name: name.into(), shows: shows.into(), why: why.into() })
                }
                _ => Err(format!("{}: `{line}` is not `package file why`", path.display())),
            }
        })
        .collect()
}

/// Whether a program is on the path or, written `python3:MODULE`, Python has a module or, written `pkg-config:NAME`, a C
/// library can be built with or, written `ldconfig:NAME`, the loader has a library.
fn is_there(shows: &str) -> bool {
    if let Some(library) = shows.strip_prefix("pkg-config:") {
        let exists = Command::new("pkg-config").args(["--exists", library]).status();
        return exists.is_ok_and(|status| status.success());
    }
    if let Some(library) = shows.strip_prefix("ldconfig:") {
        let libraries = Command::new("/sbin/ldconfig").arg("-p").output();
        return libraries.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains(library));
    }
    if let Some(module) = shows.strip_prefix("python3:") {
        let import = Command::new("python3").args(["-c", &format!("import {module}")]).output();
        return import.is_ok_and(|output| output.status.success());
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(shows).exists())
}

fn is_root() -> bool {
    let uid = Command::new("id").arg("-u").output();
    uid.is_ok_and(|output| output.stdout.trim_ascii() == b"0")
}
