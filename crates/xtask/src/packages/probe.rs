//! Checks whether a package is present, by using it as the build or the tests do.

use std::ffi::OsStr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use super::{elf, libclang};
use crate::run::Done;

/// A requirement that a package fulfils.
#[derive(Debug, PartialEq)]
pub enum Probe {
    /// A program on the search path.
    Program(String),
    /// A statically linked program, which also runs in a guest without libraries.
    Static(String),
    /// A compiler that can build a program in this language.
    Compiles(Language),
    /// Python of at least this version that can create environments with pip.
    Python { major: u32, minor: u32 },
    /// A C library with development files, and its minimum version.
    PkgConfig { library: String, version: Option<String> },
    /// The library that bindgen loads at run time.
    Libclang,
}

/// Language in which a compiler is tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Language {
    C,
    Cpp,
}

impl Probe {
    /// Parses a probe of the list.
    pub fn parse(word: &str) -> Done<Self> {
        match word.split_once(':') {
            None if word == "libclang" => Ok(Self::Libclang),
            None if !word.is_empty() => Ok(Self::Program(word.to_owned())),
            Some(("static", name)) => Ok(Self::Static(name.to_owned())),
            Some(("compiles", "c")) => Ok(Self::Compiles(Language::C)),
            Some(("compiles", "c++")) => Ok(Self::Compiles(Language::Cpp)),
            Some(("python", version)) => python(version),
            Some(("pkg-config", library)) => Ok(match library.split_once(">=") {
                Some((library, version)) => {
                    Self::PkgConfig { library: library.to_owned(), version: Some(version.to_owned()) }
                }
                None => Self::PkgConfig { library: library.to_owned(), version: None },
            }),
            _ => Err(format!(
                "`{word}` is not a program, static:NAME, compiles:c, compiles:c++, python:VERSION, \
                 pkg-config:LIBRARY[>=VERSION] or libclang"
            )),
        }
    }

    /// Whether the requirement is fulfilled.
    pub fn holds(&self) -> bool {
        match self {
            Self::Program(name) => program(name).is_some(),
            Self::Static(name) => program(name).is_some_and(|path| is_static(&path)),
            Self::Compiles(language) => compiles(*language),
            Self::Python { major, minor } => succeeds(Command::new("python3").args([
                "-c",
                &format!(
                    "import sys, venv, ensurepip, ssl, zlib; sys.exit(sys.version_info < ({major}, {minor}))"
                ),
            ])),
            Self::PkgConfig { library, version } => {
                let is_new_enough = version.as_ref().is_none_or(|version| {
                    succeeds(
                        Command::new("pkg-config").arg(format!("--atleast-version={version}")).arg(library),
                    )
                });
                // Unlike `--exists`, querying the flags also requires the libraries that it depends on.
                is_new_enough && succeeds(Command::new("pkg-config").args(["--cflags", "--libs", library]))
            }
            Self::Libclang => libclang::is_there(),
        }
    }
}

fn python(version: &str) -> Done<Probe> {
    let number = |text: &str| text.parse().ok();
    version
        .split_once('.')
        .and_then(|(major, minor)| Some(Probe::Python { major: number(major)?, minor: number(minor)? }))
        .ok_or_else(|| format!("`{version}` is not a version of Python like 3.11"))
}

/// The program that a shell would start for a name.
fn program(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    program_on(&path, name)
}

fn program_on(path: &OsStr, name: &str) -> Option<PathBuf> {
    std::env::split_paths(path).map(|folder| folder.join(name)).find(|file| {
        file.metadata().is_ok_and(|about| about.is_file() && about.permissions().mode() & 0o111 != 0)
    })
}

fn is_static(path: &Path) -> bool {
    std::fs::read(path).is_ok_and(|bytes| {
        let kinds = program_headers(&bytes).unwrap_or_default();
        // Loadable segments, but no interpreter, which would load libraries.
        kinds.contains(&PT_LOAD) && !kinds.contains(&PT_INTERP)
    })
}

const PT_LOAD: u32 = 1;
const PT_INTERP: u32 = 3;

/// Types of an ELF file's program headers; `None` if it is not an ELF file for this machine.
fn program_headers(bytes: &[u8]) -> Option<Vec<u32>> {
    let u16_at = |at: usize| Some(u16::from_le_bytes(bytes.get(at..at.checked_add(2)?)?.try_into().ok()?));
    let u32_at = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at.checked_add(4)?)?.try_into().ok()?));
    if !elf::is_for_this_machine(bytes) {
        return None;
    }
    // From the file header: offset, entry size and number of the program headers.
    let (start, size, count) = (u32_at(32)? as usize, u16_at(54)? as usize, u16_at(56)? as usize);
    (0..count).map(|index| u32_at(start + index * size)).collect()
}

/// Compiles and links an empty program with the default compiler of crates and cargo.
fn compiles(language: Language) -> bool {
    let (compiler, kind, source) = match language {
        Language::C => {
            ("cc", "c", "#include <stdio.h>\n#include <linux/types.h>\nint main(void) { return 0; }\n")
        }
        Language::Cpp => ("c++", "c++", "#include <vector>\nint main() { return 0; }\n"),
    };
    let compiler = Command::new(compiler)
        .args(["-x", kind, "-o", "/dev/null", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    let Ok(mut compiler) = compiler else { return false };
    if let Some(mut input) = compiler.stdin.take() {
        // A compiler that does not read its input also fails with an exit status.
        let _ = std::io::Write::write_all(&mut input, source.as_bytes());
    }
    compiler.wait().is_ok_and(|status| status.success())
}

fn succeeds(command: &mut Command) -> bool {
    command.stdin(Stdio::null()).output().is_ok_and(|output| output.status.success())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probes_are_read_as_the_list_writes_them() {
        let parse = |word| Probe::parse(word).unwrap();
        assert_eq!(parse("xz"), Probe::Program("xz".to_owned()));
        assert_eq!(parse("libclang"), Probe::Libclang);
        assert_eq!(parse("compiles:c++"), Probe::Compiles(Language::Cpp));
        assert_eq!(parse("python:3.11"), Probe::Python { major: 3, minor: 11 });
        assert_eq!(
            parse("pkg-config:a-0.8>=0.8.25"),
            Probe::PkgConfig { library: "a-0.8".to_owned(), version: Some("0.8.25".to_owned()) }
        );
        assert_eq!(parse("pkg-config:a"), Probe::PkgConfig { library: "a".to_owned(), version: None });
        for word in ["", "compiles:d", "python:3", "python:3.x", "file:/a"] {
            assert!(Probe::parse(word).is_err(), "{word}");
        }
    }

    #[test]
    fn a_program_is_a_file_that_may_be_executed() {
        let folder = std::env::temp_dir().join(format!("raysweep-probe-{}", std::process::id()));
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

    #[test]
    fn a_static_program_is_loaded_by_the_kernel_alone() {
        // One program header of each of these types, directly after the file header.
        let program = |kinds: &[u8]| {
            let mut bytes = vec![0; 64 + 56 * kinds.len()];
            bytes[..elf::HEADER].copy_from_slice(&elf::own_header());
            (bytes[32], bytes[54], bytes[56]) = (64, 56, kinds.len() as u8);
            kinds.iter().enumerate().for_each(|(index, &kind)| bytes[64 + 56 * index] = kind);
            bytes
        };
        let file = std::env::temp_dir().join(format!("raysweep-static-{}", std::process::id()));
        let is_static = |bytes: &[u8]| {
            std::fs::write(&file, bytes).unwrap();
            is_static(&file)
        };
        assert!(is_static(&program(&[1, 1])));
        assert!(!is_static(&program(&[3, 1])), "an interpreter");
        assert!(!is_static(&program(&[4])), "nothing to load");
        assert!(!is_static(&program(&[])), "a header alone");
        assert!(!is_static(&program(&[1, 1])[..100]), "cut off");
        assert!(!is_static(b"#!/bin/sh\n"), "a script");
        std::fs::remove_file(&file).unwrap();
    }
}
