//! Checks whether a package is present, by using it as the build or the tests do.

use std::ffi::OsString;
use std::fmt::Display;
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::process::{Command, Stdio};

use super::elf;
use crate::run::{Done, program, target};

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
    /// The program pkg-config, and what it must find: a C library with development files, `NAME` or `NAME >= VERSION`.
    PkgConfig(Option<String>),
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
        let named = |name: &str| match is_name(name) {
            true => Ok(name.to_owned()),
            false => Err(format!("`{word}`: expected a name of letters, digits and any of +-._")),
        };
        match word.split_once(':') {
            None if word == "libclang" => Ok(Self::Libclang),
            None if word == "pkg-config" => Ok(Self::PkgConfig(None)),
            None => Ok(Self::Program(named(word)?)),
            Some(("static", name)) => Ok(Self::Static(named(name)?)),
            Some(("compiles", "c")) => Ok(Self::Compiles(Language::C)),
            Some(("compiles", "c++")) => Ok(Self::Compiles(Language::Cpp)),
            Some(("python", version)) => python(version),
            Some(("pkg-config", library)) => {
                let Some((name, version)) = library.split_once(">=") else {
                    return Ok(Self::PkgConfig(Some(named(library)?)));
                };
                if !is_name(version) || !version.starts_with(|first: char| first.is_ascii_digit()) {
                    return Err(format!("`{word}`: expected a version like 0.8.25"));
                }
                Ok(Self::PkgConfig(Some(format!("{} >= {version}", named(name)?))))
            }
            _ => Err(format!(
                "`{word}`: expected a program, static:NAME, compiles:c, compiles:c++, python:VERSION, \
                 pkg-config, pkg-config:LIBRARY[>=VERSION] or libclang"
            )),
        }
    }

    /// Fails, and tells why, if the requirement is not fulfilled.
    pub fn check(&self) -> Done {
        let found = |name: &str| program(name).ok_or_else(|| format!("no program `{name}` on the path"));
        match self {
            Self::Program(name) => found(name).map(|_| ()),
            Self::Static(name) => {
                let path = found(name)?;
                let error = || format!("{} is not a static program: it needs libraries", path.display());
                is_static(&path).then_some(()).ok_or_else(error)
            }
            Self::Compiles(language) => compiles(*language),
            Self::Python { major, minor } => Tool::new("python3", None).run(
                &[
                    "-c",
                    &format!(
                        "import sys\n\
                         if sys.version_info < ({major}, {minor}):\n    \
                             sys.exit(f'{{sys.executable}} is {{sys.version.split()[0]}}, older than {major}.{minor}')\n\
                         import venv, ensurepip, ssl, zlib"
                    ),
                ],
                "",
            ),
            Self::PkgConfig(library) => pkg_config(library.as_deref()),
            Self::Libclang => libclang(),
        }
    }
}

/// Whether a word can name a program, a library or a version.
fn is_name(word: &str) -> bool {
    word.starts_with(|first: char| first.is_ascii_alphanumeric())
        && word.chars().all(|letter| letter.is_ascii_alphanumeric() || "+-._".contains(letter))
}

fn python(version: &str) -> Done<Probe> {
    let number = |text: &str| text.parse().ok();
    version
        .split_once('.')
        .filter(|_| is_name(version))
        .and_then(|(major, minor)| Some(Probe::Python { major: number(major)?, minor: number(minor)? }))
        .ok_or_else(|| format!("`python:{version}`: expected a version like 3.11"))
}

/// A program of the build, by the name that crates start it by.
struct Tool {
    /// The program and its first arguments.
    words: Vec<OsString>,
    /// The environment variable and its value, or else the program.
    shown: String,
}

impl Tool {
    fn new(name: &str, variable: Option<(String, OsString)>) -> Self {
        match variable {
            Some((variable, value)) => {
                Self { shown: format!("{variable}={}", value.display()), words: vec![value] }
            }
            None => Self { words: vec![name.into()], shown: name.to_owned() },
        }
    }

    /// A compiler; its variable may also hold arguments, or the compiler after a wrapper.
    fn compiler(name: &str, variable: &str) -> Self {
        let mut tool =
            Self::new(name, set(variable).filter(|(_, value)| !value.to_string_lossy().trim().is_empty()));
        if let [value] = tool.words.as_slice()
            && !Path::new(value).exists()
        {
            tool.words = value.to_string_lossy().split_whitespace().map(OsString::from).collect();
        }
        tool
    }

    /// Runs it with this input. What it prints is the error if it fails.
    fn run(&self, arguments: &[&str], input: &str) -> Done {
        let failed = |why: &dyn Display| format!("{}: {why}", self.shown);
        let [program, first @ ..] = self.words.as_slice() else { return Err(failed(&"no program")) };
        let started = Command::new(program)
            .args(first)
            .args(arguments)
            // What it prints is read below, so it must not be translated.
            .env("LC_ALL", "C")
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn();
        let mut process = started.map_err(|error| match error.kind() {
            ErrorKind::NotFound => failed(&"no such program"),
            _ => failed(&error),
        })?;
        if let Some(mut stdin) = process.stdin.take() {
            // A program that does not read its input also fails with an exit status.
            let _ = stdin.write_all(input.as_bytes());
        }
        let output = process.wait_with_output().map_err(|error| failed(&error))?;
        if output.status.success() {
            return Ok(());
        }
        Err(failed(&essence(&String::from_utf8_lossy(&output.stderr)).unwrap_or(&output.status.to_string())))
    }
}

/// The line that tells most of what a failed program has printed.
fn essence(said: &str) -> Option<&str> {
    let tells = |line: &&str| line.contains("fatal error") || line.contains("cannot find");
    let last = || said.lines().rfind(|line| !line.trim().is_empty());
    said.lines().find(tells).or_else(last).map(str::trim)
}

/// The variable by which the crates `cc` and `pkg-config` are told of a tool for the machine that builds, and its value.
fn set(variable: &str) -> Option<(String, OsString)> {
    let libc = if cfg!(target_env = "musl") { "musl" } else { "gnu" };
    let target = format!("{}-unknown-linux-{libc}", std::env::consts::ARCH);
    let names = [
        format!("{variable}_{target}"),
        format!("{variable}_{}", target.replace('-', "_")),
        format!("HOST_{variable}"),
        variable.to_owned(),
    ];
    names.into_iter().find_map(|name| std::env::var_os(&name).map(|value| (name, value)))
}

/// Asks for a library, or only starts the program.
fn pkg_config(library: Option<&str>) -> Done {
    let variable = set("PKG_CONFIG");
    // Unlike `--exists`, querying the flags also requires the libraries that it depends on.
    let arguments = library.map_or(vec!["--version"], |library| {
        vec!["--cflags", "--libs", "--print-errors", "--short-errors", library]
    });
    let name = if program("pkg-config").is_none() && program("pkgconf").is_some() {
        "pkgconf"
    } else {
        "pkg-config"
    };
    Tool::new(name, variable).run(&arguments, "")
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

/// Loads libclang through the crate by which bindgen does, so that both find the same file.
fn libclang() -> Done {
    if let Some(place) = std::env::var_os("LIBCLANG_PATH")
        && !Path::new(&place).is_absolute()
    {
        let why = "must be an absolute path: build scripts, which search there, run in other folders";
        return Err(format!("LIBCLANG_PATH={}: {why}", place.display()));
    }
    let found = std::panic::catch_unwind(clang_sys::load_manually).unwrap_or_else(|_| {
        Err("clang-sys panicked while it searched; does `llvm-config --prefix` print nothing?".to_owned())
    });
    found.map(|_| ())
}

/// Compiles and links an empty program.
fn compiles(language: Language) -> Done {
    let (compiler, kind, source) = match language {
        Language::C => (
            Tool::compiler("cc", "CC"),
            "c",
            "#include <stdio.h>\n#include <linux/types.h>\nint main(void) { return 0; }\n",
        ),
        Language::Cpp => {
            (Tool::compiler("c++", "CXX"), "c++", "#include <vector>\nint main() { return 0; }\n")
        }
    };
    // Not /dev/null, which tcc replaces by a file.
    let folder = target().join("tmp");
    std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let made = folder.join(format!("probe-{}", std::process::id()));
    let done = compiler.run(&["-x", kind, "-o", &made.display().to_string(), "-"], source);
    let _ = std::fs::remove_file(made);
    done
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
        assert_eq!(parse("pkg-config"), Probe::PkgConfig(None));
        assert_eq!(parse("pkg-config:a"), Probe::PkgConfig(Some("a".to_owned())));
        assert_eq!(parse("pkg-config:a-0.8>=0.8.25"), Probe::PkgConfig(Some("a-0.8 >= 0.8.25".to_owned())));
    }

    #[test]
    fn what_is_no_probe_is_told_what_is_expected() {
        for (word, expected) in [
            ("", "a name"),
            ("/usr/bin/xz", "a name"),
            ("static:", "a name"),
            ("static:bin/xz", "a name"),
            ("pkg-config:", "a name"),
            ("pkg-config:--all", "a name"),
            ("pkg-config:>=1", "a name"),
            ("pkg-config:a>=", "a version"),
            ("pkg-config:a>=new", "a version"),
            ("python:3", "a version"),
            ("python:3.x", "a version"),
            ("python:+3.11", "a version"),
            ("compiles:d", "a program, static:NAME, compiles:c, compiles:c++"),
            ("file:/a", "a program, static:NAME"),
        ] {
            let error = Probe::parse(word).unwrap_err();
            assert!(error.starts_with(&format!("`{word}`: expected {expected}")), "{error}");
        }
    }

    #[test]
    fn a_tool_that_fails_says_by_which_variable_and_why() {
        let tool = |words: &str| Tool {
            words: words.split(' ').map(OsString::from).collect(),
            shown: format!("CC={words}"),
        };
        assert_eq!(tool("/nonexistent").run(&[], ""), Err("CC=/nonexistent: no such program".to_owned()));
        assert_eq!(tool("env sh").run(&["-c", "read line; test $line = word"], "word\n"), Ok(()));
        let error = tool("sh -c").run(&["echo first; echo last >&2; exit 1"], "").unwrap_err();
        assert_eq!(error, "CC=sh -c: last");
        let error = tool("sh").run(&["-c", "exit 3"], "").unwrap_err();
        assert_eq!(error, "CC=sh: exit status: 3");
        let said =
            "In file included\n<stdin>:1:10: fatal error: stdio.h: No such file\ncompilation terminated.\n";
        assert_eq!(essence(said), Some("<stdin>:1:10: fatal error: stdio.h: No such file"));
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
