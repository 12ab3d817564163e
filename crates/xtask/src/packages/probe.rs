//! What shows that a package is there: the very thing that needs it finds it.

use std::ffi::OsStr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use super::libclang;
use crate::run::Done;

/// One thing that must be there.
#[derive(Debug, PartialEq)]
pub enum Probe {
    /// A program on the path.
    Program(String),
    /// A program that runs without any library, as a guest does that has none.
    Static(String),
    /// A compiler that makes a program of this language.
    Compiles(Language),
    /// A Python of this version or a later one that makes environments with pip.
    Python { major: u32, minor: u32 },
    /// A C library that can be built with, and its lowest version.
    PkgConfig { library: String, version: Option<String> },
    /// The library that bindgen loads.
    Libclang,
}

/// What a compiler is tried with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Language {
    C,
    Cpp,
}

impl Probe {
    /// Reads a probe as the list writes it.
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

    /// Whether it is there.
    pub fn holds(&self) -> bool {
        match self {
            Self::Program(name) => program(name).is_some(),
            Self::Static(name) => program(name).is_some_and(|path| is_static(&path)),
            Self::Compiles(language) => compiles(*language),
            Self::Python { major, minor } => succeeds(Command::new("python3").args([
                "-c",
                &format!("import sys, venv, ensurepip; sys.exit(sys.version_info < ({major}, {minor}))"),
            ])),
            Self::PkgConfig { library, version } => {
                let is_new_enough = version.as_ref().is_none_or(|version| {
                    succeeds(
                        Command::new("pkg-config").arg(format!("--atleast-version={version}")).arg(library),
                    )
                });
                // Flags, unlike existence, ask for the libraries that it is built with, too.
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

/// The program that a shell would start.
fn program(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    program_on(&path, name)
}

fn program_on(path: &OsStr, name: &str) -> Option<PathBuf> {
    std::env::split_paths(path).map(|folder| folder.join(name)).find(|file| {
        file.metadata().is_ok_and(|about| about.is_file() && about.permissions().mode() & 0o111 != 0)
    })
}

/// Whether a 64-bit ELF file names no interpreter, which would load its libraries.
fn is_static(path: &Path) -> bool {
    std::fs::read(path).ok().and_then(|bytes| has_interpreter(&bytes)) == Some(false)
}

/// None: no 64-bit little-endian ELF file.
fn has_interpreter(bytes: &[u8]) -> Option<bool> {
    const PT_INTERP: u32 = 3;
    let u16_at = |at: usize| Some(u16::from_le_bytes(bytes.get(at..at.checked_add(2)?)?.try_into().ok()?));
    let u32_at = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at.checked_add(4)?)?.try_into().ok()?));
    if !bytes.starts_with(b"\x7fELF\x02\x01") {
        return None;
    }
    // The program headers' place, the size of one, their number: of the file's header.
    let (start, size, count) = (u32_at(32)? as usize, u16_at(54)? as usize, u16_at(56)? as usize);
    (0..count).try_fold(false, |found, index| Some(found || u32_at(start + index * size)? == PT_INTERP))
}

/// Compiles and links a program that does nothing, by the compiler that crates and cargo use.
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
        // A compiler that does not read ends with a status that says so.
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
    fn an_interpreter_is_found_in_an_elf_file() {
        let own = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        assert_eq!(has_interpreter(&own), Some(true));
        assert_eq!(has_interpreter(&own[..60]), None, "cut off");
        assert_eq!(has_interpreter(b"#!/bin/sh\n"), None);
        // A header alone, without any program header, is enough.
        let mut header = [0; 64];
        header[..6].copy_from_slice(b"\x7fELF\x02\x01");
        assert_eq!(has_interpreter(&header), Some(false));
    }
}
