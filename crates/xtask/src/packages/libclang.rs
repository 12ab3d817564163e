//! Whether bindgen finds libclang: searches where its crate clang-sys does, for the same names.

use std::ffi::OsString;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::elf;
use crate::run::Done;

/// Search path; each `*` matches the rest of one folder name.
const FOLDERS: [&str; 7] = [
    "usr/local/llvm*/lib*",
    "usr/local/lib*/*/*",
    "usr/local/lib*/*",
    "usr/local/lib*",
    "usr/lib*/*/*",
    "usr/lib*/*",
    "usr/lib*",
];

/// Fails if bindgen does not find libclang on this system.
pub fn check() -> Done {
    if let Some(place) = std::env::var_os("LIBCLANG_PATH").map(PathBuf::from) {
        return only_in(&place).map_err(|error| format!("LIBCLANG_PATH={}: {error}", place.display()));
    }
    let llvm_folders = llvm_folders()?;
    let listed = ["LD_LIBRARY_PATH", "LIBRARY_PATH"].map(|name| listed(std::env::var_os(name))).concat();
    if is_in(Path::new("/"), &[llvm_folders, listed].concat()) {
        return Ok(());
    }
    Err("no libclang.so of this architecture in the folders of libraries below /usr and /usr/local, nor where \
         llvm-config, LD_LIBRARY_PATH and LIBRARY_PATH point"
        .to_owned())
}

/// Searches only this place: the file, or its folder.
fn only_in(place: &Path) -> Done {
    if !place.is_absolute() {
        return Err(
            "must be an absolute path: build scripts, which search there, run in other folders".to_owned()
        );
    }
    if is_libclang(place) || has_libclang(place) {
        return Ok(());
    }
    Err("no libclang.so of this architecture there, the only place searched while the variable is set"
        .to_owned())
}

/// Whether libclang is in one of these folders, or below `root` in one of the system's library folders.
fn is_in(root: &Path, folders: &[PathBuf]) -> bool {
    folders.iter().any(|folder| has_libclang(folder))
        || FOLDERS.iter().any(|pattern| matching(root, pattern).iter().any(|folder| has_libclang(folder)))
}

fn listed(variable: Option<OsString>) -> Vec<PathBuf> {
    variable.map(|list| std::env::split_paths(&list).collect()).unwrap_or_default()
}

/// Library folders of the LLVM that `llvm-config` belongs to.
fn llvm_folders() -> Done<Vec<PathBuf>> {
    let program = std::env::var_os("LLVM_CONFIG_PATH").unwrap_or_else(|| "llvm-config".into());
    match Command::new(&program).arg("--prefix").output() {
        Ok(output) if output.status.success() => folders_below(&String::from_utf8_lossy(&output.stdout))
            .ok_or_else(|| {
                format!("`{} --prefix` prints nothing; clang-sys fails on that", program.display())
            }),
        _ => Ok(Vec::new()),
    }
}

/// Folders below the prefix printed by `llvm-config --prefix`; clang-sys assumes that the output is not empty.
fn folders_below(said: &str) -> Option<Vec<PathBuf>> {
    let prefix = Path::new(said.lines().next()?);
    Some(["bin", "lib", "lib64"].iter().map(|name| prefix.join(name)).collect())
}

/// Folders below `root` that match a pattern.
fn matching(root: &Path, pattern: &str) -> Vec<PathBuf> {
    pattern.split('/').fold(vec![root.to_owned()], |folders, pattern| {
        let below = folders.iter().flat_map(|folder| names(folder).map(|name| folder.join(name)));
        let fits =
            |path: &PathBuf| path.file_name().is_some_and(|name| fits(&name.to_string_lossy(), pattern));
        below.filter(|path| fits(path) && path.is_dir()).collect()
    })
}

/// Whether a name equals the pattern or, for a pattern that ends in `*`, starts with the part before it.
fn fits(name: &str, pattern: &str) -> bool {
    pattern.strip_suffix('*').map_or(name == pattern, |beginning| name.starts_with(beginning))
}

fn names(folder: &Path) -> impl Iterator<Item = OsString> + use<> {
    std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name())
}

fn has_libclang(folder: &Path) -> bool {
    names(folder).any(|name| is_libclang(&folder.join(name)))
}

/// Whether a file is named like the library and built for this machine.
fn is_libclang(file: &Path) -> bool {
    file.file_name().is_some_and(|name| is_named_libclang(&name.to_string_lossy())) && is_for_us(file)
}

/// `libclang.so`, `libclang-*.so`, `libclang.so.*`, `libclang-*.so.*`; libclang-cpp is a different library.
fn is_named_libclang(name: &str) -> bool {
    let Some(rest) = name.strip_prefix("libclang") else { return false };
    let is_library = rest.ends_with(".so") || rest.contains(".so.");
    is_library && (rest.starts_with(".so") || rest.starts_with('-')) && !rest.contains("-cpp.")
}

fn is_for_us(file: &Path) -> bool {
    let mut header = [0; elf::HEADER];
    let read = std::fs::File::open(file).and_then(|mut file| file.read_exact(&mut header));
    read.is_ok() && elf::is_for_this_machine(&header)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A temporary root with the given files.
    struct Root(PathBuf);

    impl Root {
        fn new(name: &str) -> Self {
            let root = std::env::temp_dir().join(format!("raysweep-libclang-{name}-{}", std::process::id()));
            std::fs::create_dir_all(&root).unwrap();
            Self(root)
        }

        fn put(&self, file: &str, bytes: &[u8]) {
            let file = self.0.join(file);
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, bytes).unwrap();
        }

        fn has_libclang(&self) -> bool {
            is_in(&self.0, &[])
        }
    }

    impl Drop for Root {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn what_only_looks_like_it_is_passed_over() {
        let root = Root::new("decoys");
        assert!(!root.has_libclang());
        root.put("usr/lib/x86_64-linux-gnu/libclang-cpp.so.14", &elf::own_header());
        root.put("usr/lib/llvm-14/lib/libclang-cpp.so", &elf::own_header());
        root.put("usr/lib/llvm-14/lib/libclangBasic.a", b"!<arch>\n");
        root.put("usr/lib/llvm-14/lib/libclang-14.so.1", b"INPUT(nothing)\n");
        let mut other_machine = elf::own_header();
        other_machine[18] = 243;
        root.put("usr/lib/libclang-14.so.1", &other_machine);
        root.put("opt/lib/libclang-14.so.1", &elf::own_header());
        assert!(!root.has_libclang());
    }

    #[test]
    fn it_is_found_wherever_releases_put_it() {
        for file in [
            "usr/lib/x86_64-linux-gnu/libclang-14.so.1",
            "usr/lib/llvm-19/lib/libclang.so.1",
            "usr/lib64/libclang.so.20.1",
            "usr/local/lib/libclang.so",
            "usr/local/llvm-18/lib/libclang-18.so",
        ] {
            let root = Root::new("places");
            root.put(file, &elf::own_header());
            assert!(root.has_libclang(), "{file}");
        }
    }

    #[test]
    fn an_llvm_config_without_an_answer_is_a_failure() {
        assert_eq!(folders_below(""), None);
        let folders = ["bin", "lib", "lib64"].map(|name| Path::new("/opt/llvm").join(name));
        assert_eq!(folders_below("/opt/llvm\n"), Some(folders.to_vec()));
    }

    #[test]
    fn folders_that_variables_name_count_too() {
        let root = Root::new("variables");
        root.put("opt/lib/libclang.so", &elf::own_header());
        let folders =
            listed(Some(std::env::join_paths([Path::new("/nowhere"), &root.0.join("opt/lib")]).unwrap()));
        assert!(is_in(&root.0.join("opt"), &folders));
        assert!(is_libclang(&root.0.join("opt/lib/libclang.so")));
    }

    #[test]
    fn a_place_that_is_searched_alone_is_a_file_or_its_folder() {
        let root = Root::new("alone");
        root.put("lib/libclang.so", &elf::own_header());
        assert_eq!(only_in(&root.0.join("lib")), Ok(()));
        assert_eq!(only_in(&root.0.join("lib/libclang.so")), Ok(()));
        assert!(only_in(&root.0).unwrap_err().contains("the only place searched"));
        assert!(only_in(Path::new("lib")).unwrap_err().contains("absolute"));
    }
}
