//! Which files of a crate import which: `use` declarations and paths, traced through re-exports to the file that
//! defines what is imported. Test modules do not count, nor do paths that begin with a child module.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use syn::visit::{self, Visit};
use syn::{Attribute, Item, ItemMod, ItemUse, UseTree, Visibility};

/// The files of a crate by their module paths; the crate's root has the empty path.
pub struct Graph {
    files: BTreeMap<Vec<String>, File>,
}

struct File {
    /// From the source folder on.
    name: PathBuf,
    /// Paths that the file uses, from the crate's root on.
    uses: BTreeSet<Vec<String>>,
    /// What it re-exports: the name, and the path that it stands for.
    exports: BTreeMap<String, Vec<String>>,
}

impl Graph {
    /// The graph of the sources in a folder `src`.
    pub fn read(folder: &Path) -> Self {
        let mut sources = BTreeMap::new();
        let mut folders = vec![folder.to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let is_program = path.file_name().is_some_and(|name| name == "bin" || name == "main.rs");
                if path.is_dir() && !is_program {
                    folders.push(path);
                } else if path.extension().is_some_and(|extension| extension == "rs") && !is_program {
                    let text = std::fs::read_to_string(&path).unwrap();
                    sources.insert(path, text);
                }
            }
        }
        let named = sources.iter().map(|(path, text)| (path.strip_prefix(folder).unwrap(), text.as_str()));
        Self::of(named)
    }

    /// The graph of these sources.
    pub fn of<'a>(sources: impl Iterator<Item = (&'a Path, &'a str)>) -> Self {
        let sources: Vec<_> = sources.map(|(name, text)| (module(name), name, text)).collect();
        let modules: BTreeSet<Vec<String>> = sources.iter().map(|(module, ..)| module.clone()).collect();
        let file = |(module, name, text): (Vec<String>, &Path, &str)| {
            let syntax = syn::parse_file(text).unwrap_or_else(|error| panic!("{}: {error}", name.display()));
            let file = File { name: name.to_owned(), uses: BTreeSet::new(), exports: BTreeMap::new() };
            let mut reader = Reader { module: &module, modules: &modules, file };
            reader.visit_file(&syntax);
            let Reader { file, .. } = reader;
            (module, file)
        };
        Self { files: sources.into_iter().map(file).collect() }
    }

    /// The files that each file imports.
    pub fn edges(&self) -> BTreeMap<&Path, BTreeSet<&Path>> {
        let edges = self.files.iter().map(|(module, file)| {
            let imported = file.uses.iter().map(|path| self.defined_in(path, 0));
            let others = imported.filter(|other| other != module).map(|other| &*self.files[&other].name);
            (&*file.name, others.collect())
        });
        edges.collect()
    }

    /// The module whose file defines a path.
    fn defined_in(&self, path: &[String], depth: usize) -> Vec<String> {
        let known = (0..=path.len()).rev().find(|&n| self.files.contains_key(&path[..n])).unwrap_or(0);
        let (module, rest) = path.split_at(known);
        let target = rest.first().and_then(|name| self.files[module].exports.get(name));
        match target {
            // Re-exports do not go in circles.
            Some(target) if depth < 16 => {
                let full: Vec<String> = target.iter().chain(&rest[1..]).cloned().collect();
                self.defined_in(&full, depth + 1)
            }
            _ => module.to_vec(),
        }
    }

    /// Sets of files each of which imports all others of its set, directly or through them.
    pub fn cycles(&self) -> Vec<BTreeSet<&Path>> {
        let edges = self.edges();
        let reached = |from: &Path| {
            let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
            while let Some(file) = open.pop() {
                for other in edges.get_key_value(file).into_iter().flat_map(|(_, others)| others) {
                    if seen.insert(*other) {
                        open.push(other);
                    }
                }
            }
            seen
        };
        let reach: BTreeMap<&Path, BTreeSet<&Path>> =
            edges.keys().map(|file| (*file, reached(file))).collect();
        let cycle = |file: &&Path| -> BTreeSet<&Path> {
            reach[*file].iter().copied().filter(|other| reach[other].contains(*file)).collect()
        };
        let cycles: BTreeSet<BTreeSet<&Path>> = reach.keys().map(cycle).collect();
        cycles.into_iter().filter(|cycle| cycle.len() > 1).collect()
    }
}

/// The module path of a file.
fn module(name: &Path) -> Vec<String> {
    let mut parts: Vec<String> =
        name.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if parts.last().is_some_and(|last| last == "mod" || last == "lib") {
        parts.pop();
    }
    parts
}

/// The folder that a file belongs to: `x.rs` belongs to `x/` where there is one.
pub fn folder(file: &Path, all: &BTreeSet<&Path>) -> PathBuf {
    let own = file.with_extension("");
    if all.iter().any(|other| other.starts_with(&own)) { own } else { file.parent().unwrap().to_owned() }
}

struct Reader<'a> {
    module: &'a [String],
    modules: &'a BTreeSet<Vec<String>>,
    file: File,
}

impl Reader<'_> {
    /// A path from the crate's root on; `None` for other crates.
    fn absolute(&self, path: &[String]) -> Option<Vec<String>> {
        let first = path.first()?;
        let (base, rest) = match first.as_str() {
            "crate" => (Vec::new(), &path[1..]),
            "self" | "super" => {
                let ups = path.iter().take_while(|part| *part == "super").count();
                let rest = path.iter().skip_while(|part| *part == "super" || *part == "self").count();
                (self.module[..self.module.len().checked_sub(ups)?].to_vec(), &path[path.len() - rest..])
            }
            _ => {
                let child = [self.module, std::slice::from_ref(first)].concat();
                self.modules.contains(&child).then_some((self.module.to_vec(), path))?
            }
        };
        Some([&base, rest].concat())
    }

    fn note(&mut self, tree: &UseTree, path: &mut Vec<String>, is_exported: bool) {
        let one = |this: &mut Self, path: &[String], name: String| {
            let path =
                if path.last().is_some_and(|last| last == "self") { &path[..path.len() - 1] } else { path };
            if let Some(path) = this.absolute(path) {
                match is_exported {
                    true => drop(this.file.exports.insert(name, path)),
                    false => drop(this.file.uses.insert(path)),
                }
            }
        };
        match tree {
            UseTree::Path(inner) => {
                path.push(inner.ident.to_string());
                self.note(&inner.tree, path, is_exported);
                path.pop();
            }
            UseTree::Group(group) => group.items.iter().for_each(|tree| self.note(tree, path, is_exported)),
            UseTree::Name(name) => {
                path.push(name.ident.to_string());
                one(self, path, name.ident.to_string());
                path.pop();
            }
            UseTree::Rename(name) => {
                path.push(name.ident.to_string());
                one(self, path, name.rename.to_string());
                path.pop();
            }
            UseTree::Glob(_) => one(self, path, "*".into()),
        }
    }
}

fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Ident>().is_ok_and(|condition| condition == "test")
    })
}

impl<'ast> Visit<'ast> for Reader<'_> {
    fn visit_item(&mut self, item: &'ast Item) {
        let is_test = match item {
            Item::Mod(ItemMod { attrs, .. }) | Item::Use(ItemUse { attrs, .. }) => is_test(attrs),
            _ => false,
        };
        if !is_test {
            visit::visit_item(self, item);
        }
    }

    fn visit_item_use(&mut self, item: &'ast ItemUse) {
        let is_exported = !matches!(item.vis, Visibility::Inherited);
        self.note(&item.tree, &mut Vec::new(), is_exported);
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let parts: Vec<String> = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        let is_inner = parts.len() > 1 && ["crate", "self", "super"].contains(&parts[0].as_str());
        if let Some(path) = is_inner.then(|| self.absolute(&parts)).flatten() {
            self.file.uses.insert(path);
        }
        visit::visit_path(self, path);
    }
}
