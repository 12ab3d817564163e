//! Which files of a crate name items of which others: in `use` declarations, and by any path in code, attributes and
//! macros. Each name is traced through imports and re-exports to the file that defines the item, as the compiler does.
//! Neither a declaration `mod child;` nor a re-export is an edge. Test code does not count.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use proc_macro2::{TokenStream, TokenTree};
use syn::visit::{self, Visit};
use syn::{Attribute, ImplItemFn, Item, ItemMod, ItemUse, Meta, UseTree, Visibility};

/// Names from the crate's root to a module; the root itself has the empty path.
type ModulePath = Vec<String>;

/// The modules of a crate that are compiled without tests, found from the root on.
pub struct Graph {
    modules: BTreeMap<ModulePath, Module>,
}

#[derive(Default)]
struct Module {
    /// From the source folder on.
    file: PathBuf,
    /// What it defines, by name, apart from modules.
    items: BTreeSet<String>,
    /// Structs, enums, traits and unions that other files can name.
    visible_types: Vec<String>,
    /// What it imports or re-exports: the name in this module, and the path that it stands for.
    imports: BTreeMap<String, Vec<String>>,
    /// Modules and enums of which it imports or re-exports everything.
    globs: Vec<Vec<String>>,
    /// Paths that name something: those of private `use` declarations, and those in code.
    paths: BTreeSet<Vec<String>>,
}

impl Graph {
    /// The graph of the sources in a folder `src`.
    pub fn read(folder: &Path) -> Self {
        Self::from_root(&|name| std::fs::read_to_string(folder.join(name)).ok())
    }

    /// The graph of these sources.
    pub fn of(sources: &[(&str, &str)]) -> Self {
        let sources: BTreeMap<_, _> =
            sources.iter().map(|(name, text)| (Path::new(*name), (*text).to_owned())).collect();
        Self::from_root(&|name| sources.get(name).cloned())
    }

    fn from_root(text: &dyn Fn(&Path) -> Option<String>) -> Self {
        let root = ["lib.rs", "main.rs"].map(PathBuf::from).into_iter().find(|root| text(root).is_some());
        let mut open = vec![(ModulePath::new(), root.expect("a crate has a lib.rs or a main.rs"))];
        let mut modules = BTreeMap::new();
        while let Some((path, file)) = open.pop() {
            let syntax = syn::parse_file(&text(&file).expect("only files that exist are opened"))
                .unwrap_or_else(|error| panic!("{}: {error}", file.display()));
            let mut reader =
                Reader { path, file: &file, modules: BTreeMap::new(), children: BTreeSet::new() };
            reader.read(|reader| reader.visit_file(&syntax));
            modules.extend(reader.modules);
            for child in reader.children {
                let name: PathBuf = child.iter().collect();
                let files = [name.with_extension("rs"), name.join("mod.rs")];
                let file = files.into_iter().find(|file| text(file).is_some());
                open.push((
                    child,
                    file.unwrap_or_else(|| panic!("no file has the module {}", name.display())),
                ));
            }
        }
        Self { modules }
    }

    /// The files whose items each file names.
    pub fn edges(&self) -> BTreeMap<&Path, BTreeSet<&Path>> {
        let mut edges: BTreeMap<&Path, BTreeSet<&Path>> = BTreeMap::new();
        for (path, module) in &self.modules {
            let named = module.paths.iter().filter_map(|named| self.defined_in(path, named, 0));
            let others = named.map(|other| &*other.file).filter(|other| *other != module.file);
            edges.entry(&module.file).or_default().extend(others);
        }
        edges
    }

    /// Names of structs, enums, traits and unions that are visible beyond their file, with the file.
    pub fn visible_types(&self) -> impl Iterator<Item = (&str, &Path)> {
        self.modules
            .values()
            .flat_map(|module| module.visible_types.iter().map(|name| (name.as_str(), module.file.as_path())))
    }

    /// The module that defines the item that a path names in this module. `None` if the path names a module, something
    /// local or something of another crate.
    fn defined_in(&self, at: &[String], path: &[String], depth: usize) -> Option<&Module> {
        let (first, rest) = path.split_first()?;
        match first.as_str() {
            "crate" => self.found_in(&[], rest, depth),
            "self" => self.found_in(at, rest, depth),
            "super" => self.found_in(at.split_last()?.1, rest, depth),
            _ => self.in_scope(at, path, depth),
        }
    }

    /// The same for a path that goes on from this module. What is not found there, a macro has defined.
    fn found_in(&self, at: &[String], path: &[String], depth: usize) -> Option<&Module> {
        let first = path.first()?;
        if first == "super" {
            return self.defined_in(at, path, depth);
        }
        let is_known = self.modules[at].imports.contains_key(first) || self.child(at, first).is_some();
        self.in_scope(at, path, depth).or_else(|| (!is_known).then(|| &self.modules[at]))
    }

    /// The same for a path whose first part is a name in the scope of this module.
    fn in_scope(&self, at: &[String], path: &[String], depth: usize) -> Option<&Module> {
        // Names of other crates may look as if they stood for themselves: `use rand::rand`.
        if depth > 16 {
            return None;
        }
        let (first, rest) = path.split_first()?;
        let module = &self.modules[at];
        // A module and an item may have the same name; only the module has a path that goes on.
        if let Some(child) = self.child(at, first).filter(|_| !rest.is_empty()) {
            return self.found_in(&child, rest, depth + 1);
        }
        if module.items.contains(first) {
            return Some(module);
        }
        if let Some(target) = module.imports.get(first) {
            return self.defined_in(at, &[target.as_slice(), rest].concat(), depth + 1);
        }
        module.globs.iter().find_map(|glob| self.in_scope(&self.module_at(at, glob)?, path, depth + 1))
    }

    fn child(&self, at: &[String], name: &str) -> Option<ModulePath> {
        let child = [at, &[name.to_owned()]].concat();
        self.modules.contains_key(&child).then_some(child)
    }

    /// The module that a path names.
    fn module_at(&self, at: &[String], path: &[String]) -> Option<ModulePath> {
        path.iter().try_fold(at.to_owned(), |at, part| match part.as_str() {
            "crate" => Some(ModulePath::new()),
            "self" => Some(at),
            "super" => Some(at.split_last()?.1.to_owned()),
            name => self.child(&at, name),
        })
    }

    /// Sets of files each of which names items of all others of its set, directly or through them.
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

/// The folder that a file belongs to: `x.rs` belongs to `x/` where there is one.
pub fn folder(file: &Path, all: &BTreeSet<&Path>) -> PathBuf {
    let own = file.with_extension("");
    if all.iter().any(|other| other.starts_with(&own)) { own } else { file.parent().unwrap().to_owned() }
}

/// Reads one file: its module, and those that are written out within it.
struct Reader<'a> {
    /// The module that is being read.
    path: ModulePath,
    file: &'a Path,
    modules: BTreeMap<ModulePath, Module>,
    /// Modules in files of their own.
    children: BTreeSet<ModulePath>,
}

impl Reader<'_> {
    fn read(&mut self, visit: impl FnOnce(&mut Self)) {
        let module = Module { file: self.file.to_owned(), ..Module::default() };
        self.modules.insert(self.path.clone(), module);
        visit(self);
    }

    fn module(&mut self) -> &mut Module {
        self.modules.get_mut(&self.path).expect("a module is added before it is read")
    }

    fn add_use(&mut self, tree: &UseTree, mut path: Vec<String>, is_exported: bool) {
        let (last, name) = match tree {
            UseTree::Path(inner) => {
                path.push(inner.ident.to_string());
                return self.add_use(&inner.tree, path, is_exported);
            }
            UseTree::Group(group) => {
                return group.items.iter().for_each(|tree| self.add_use(tree, path.clone(), is_exported));
            }
            UseTree::Glob(_) => return self.module().globs.push(path),
            UseTree::Name(name) => (&name.ident, &name.ident),
            UseTree::Rename(name) => (&name.ident, &name.rename),
        };
        let mut name = name.to_string();
        match (last == "self", path.last()) {
            (true, Some(module)) if name == "self" => name = module.clone(),
            (true, _) => {}
            (false, _) => path.push(last.to_string()),
        }
        if !is_exported {
            self.module().paths.insert(path.clone());
        }
        self.module().imports.insert(name, path);
    }

    /// All that looks like a path in the tokens of a macro or an attribute.
    fn add_tokens(&mut self, tokens: TokenStream) {
        let (mut path, mut colons) = (Vec::new(), 0);
        for token in tokens {
            match token {
                TokenTree::Ident(name) => {
                    if colons != 2 {
                        self.add_path(std::mem::take(&mut path));
                    }
                    path.push(name.to_string());
                    colons = 0;
                }
                TokenTree::Punct(mark) if mark.as_char() == ':' => colons += 1,
                other => {
                    self.add_path(std::mem::take(&mut path));
                    colons = 0;
                    if let TokenTree::Group(group) = other {
                        self.add_tokens(group.stream());
                    }
                }
            }
        }
        self.add_path(path);
    }

    fn add_path(&mut self, path: Vec<String>) {
        self.module().paths.insert(path);
    }
}

fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Ident>().is_ok_and(|condition| condition == "test")
    })
}

/// The name of an item, its attributes, and its visibility if it is a type.
fn parts(item: &Item) -> (Option<&syn::Ident>, &[Attribute], Option<&Visibility>) {
    match item {
        Item::Const(item) => (Some(&item.ident), &item.attrs, None),
        Item::Enum(item) => (Some(&item.ident), &item.attrs, Some(&item.vis)),
        Item::Fn(item) => (Some(&item.sig.ident), &item.attrs, None),
        Item::Impl(item) => (None, &item.attrs, None),
        Item::Macro(item) => (item.ident.as_ref(), &item.attrs, None),
        Item::Mod(item) => (None, &item.attrs, None),
        Item::Static(item) => (Some(&item.ident), &item.attrs, None),
        Item::Struct(item) => (Some(&item.ident), &item.attrs, Some(&item.vis)),
        Item::Trait(item) => (Some(&item.ident), &item.attrs, Some(&item.vis)),
        Item::Type(item) => (Some(&item.ident), &item.attrs, None),
        Item::Union(item) => (Some(&item.ident), &item.attrs, Some(&item.vis)),
        Item::Use(item) => (None, &item.attrs, None),
        _ => (None, &[], None),
    }
}

impl<'ast> Visit<'ast> for Reader<'_> {
    fn visit_item(&mut self, item: &'ast Item) {
        let (name, attributes, visibility) = parts(item);
        if is_test(attributes) {
            return;
        }
        self.module().items.extend(name.map(syn::Ident::to_string));
        if visibility.is_some_and(|visibility| !matches!(visibility, Visibility::Inherited)) {
            self.module().visible_types.extend(name.map(syn::Ident::to_string));
        }
        visit::visit_item(self, item);
    }

    fn visit_impl_item_fn(&mut self, function: &'ast ImplItemFn) {
        if !is_test(&function.attrs) {
            visit::visit_impl_item_fn(self, function);
        }
    }

    fn visit_item_mod(&mut self, item: &'ast ItemMod) {
        self.path.push(item.ident.to_string());
        match &item.content {
            Some(_) => self.read(|reader| visit::visit_item_mod(reader, item)),
            None => drop(self.children.insert(self.path.clone())),
        }
        self.path.pop();
    }

    fn visit_item_use(&mut self, item: &'ast ItemUse) {
        let is_exported = !matches!(item.vis, Visibility::Inherited);
        if item.leading_colon.is_none() {
            self.add_use(&item.tree, Vec::new(), is_exported);
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        if path.leading_colon.is_none() {
            self.add_path(path.segments.iter().map(|segment| segment.ident.to_string()).collect());
        }
        visit::visit_path(self, path);
    }

    fn visit_macro(&mut self, invocation: &'ast syn::Macro) {
        self.add_tokens(invocation.tokens.clone());
        visit::visit_macro(self, invocation);
    }

    fn visit_attribute(&mut self, attribute: &'ast Attribute) {
        if let Meta::List(list) = &attribute.meta {
            self.add_tokens(list.tokens.clone());
        }
        visit::visit_attribute(self, attribute);
    }
}
