//! The states in which a power loss can leave a disk, given what was done to it.
//!
//! A file system with a journal writes changes of names and of contents when it likes, unless a sync makes it. Two kinds
//! are modelled. With an *ordered* journal (ext4, `data=ordered`), changes of names become durable in their order, all
//! of them with any sync; contents that were not synced may be missing from any sector on, whatever their name. With a
//! *weak* one, each folder is independent of the others, a change of its names is durable once the folder was synced,
//! and of contents that were not synced any sectors may be missing.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::Rng;

use crate::record::{Call, Recorded};

/// What a disk writes whole or not at all.
const SECTOR_BYTES: usize = 512;

/// A file or folder, whatever its name is by now.
type Inode = usize;
const ROOT: Inode = 0;

/// The content of a folder: files with their bytes, and folders as `None`, by their paths.
pub type Tree = BTreeMap<PathBuf, Option<Vec<u8>>>;

/// Changes of names in a folder that happen at once; `None`: the name is removed.
type Names = Vec<(String, Option<Inode>)>;

enum Content {
    Write { at: usize, bytes: Vec<u8> },
    Truncate(usize),
}

/// What is lost of the changes that no sync has made durable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Loss {
    /// None of them: the process was killed, and the disk had power.
    Nothing,
    /// All of them.
    Everything,
    /// Some, as with an ordered journal.
    Ordered,
    /// Some, as with a weak journal.
    Weak,
}

impl Loss {
    pub const ALL: [Loss; 4] = [Loss::Nothing, Loss::Everything, Loss::Ordered, Loss::Weak];
}

/// A call that makes what was changed before it durable when it returns.
struct Sync {
    inode: Inode,
    begun: usize,
    returned: usize,
}

/// All that was done to a folder. Times are numbers of calls that had returned.
pub struct History {
    folders: BTreeMap<Inode, Vec<(usize, Names)>>,
    files: BTreeMap<Inode, Vec<(usize, Content)>>,
    syncs: Vec<Sync>,
    /// The first call that a thread made after it had appended to the ledger, and the ledger's length. A sync is not
    /// such a call: whatever a thread does next, it relies on the line.
    acknowledged: Vec<(usize, usize)>,
    /// How many calls there were.
    pub len: usize,
}

impl History {
    /// What calls did to the folder `root`, which was empty.
    pub fn of(calls: &[Recorded], root: &Path) -> Self {
        let mut replay = Replay {
            root,
            names: BTreeMap::from([(ROOT, BTreeMap::new())]),
            places: BTreeMap::new(),
            appended: BTreeMap::new(),
            history: History {
                folders: BTreeMap::from([(ROOT, Vec::new())]),
                files: BTreeMap::new(),
                syncs: Vec::new(),
                acknowledged: Vec::new(),
                len: calls.len(),
            },
        };
        for (time, recorded) in calls.iter().enumerate() {
            replay.apply(time, recorded);
        }
        replay.history
    }

    /// The first call from which on a change of an inode may be lost, if the power is lost after `time` calls.
    fn durable(&self, inode: Inode, time: usize) -> usize {
        let synced = self.syncs.iter().filter(|sync| sync.inode == inode && sync.returned < time);
        synced.map(|sync| sync.begun).max().unwrap_or(0)
    }

    /// The disk after a power loss, when `time` calls had returned.
    pub fn after_power_loss(&self, time: usize, loss: Loss, random: &mut Xoshiro256PlusPlus) -> Tree {
        let journal = self.syncs.iter().filter(|sync| sync.returned < time).map(|sync| sync.begun).max();
        let journal = between(journal.unwrap_or(0)..time, random);
        let mut tree = Tree::new();
        let mut folders = vec![(PathBuf::new(), ROOT)];
        while let Some((path, folder)) = folders.pop() {
            let durable = self.durable(folder, time);
            let until = match loss {
                Loss::Nothing => time,
                Loss::Everything => durable,
                Loss::Ordered => journal,
                Loss::Weak => between(durable..time, random),
            };
            for (name, inode) in self.names(folder, until) {
                let path = path.join(name);
                let bytes = self.files.contains_key(&inode).then(|| self.content(inode, time, loss, random));
                if bytes.is_none() {
                    folders.push((path.clone(), inode));
                }
                tree.insert(path, bytes);
            }
        }
        tree
    }

    /// Names in a folder after the changes of the calls before `until`.
    fn names(&self, folder: Inode, until: usize) -> BTreeMap<String, Inode> {
        let mut names = BTreeMap::new();
        let changes = self.folders[&folder].iter().take_while(|(time, _)| *time < until);
        for (name, inode) in changes.flat_map(|(_, changes)| changes) {
            match inode {
                Some(inode) => names.insert(name.clone(), *inode),
                None => names.remove(name),
            };
        }
        names
    }

    fn content(&self, file: Inode, time: usize, loss: Loss, random: &mut Xoshiro256PlusPlus) -> Vec<u8> {
        let durable = self.durable(file, time);
        let mut bytes = Vec::new();
        for (at, change) in self.files[&file].iter().take_while(|(at, _)| *at < time) {
            let is_lost = *at >= durable;
            match (change, loss) {
                _ if !is_lost || loss == Loss::Nothing => change.apply(&mut bytes),
                (_, Loss::Nothing | Loss::Everything) => break,
                (_, Loss::Ordered) => {
                    // The contents end here, in one case of two within this change.
                    if random.next_u64().is_multiple_of(2) {
                        change.torn(random).apply(&mut bytes);
                        break;
                    }
                    change.apply(&mut bytes);
                }
                (_, Loss::Weak) => change.in_pieces(random).iter().for_each(|piece| piece.apply(&mut bytes)),
            }
        }
        bytes
    }

    /// Bytes of the ledger that were acknowledged when `time` calls had returned.
    pub fn acknowledged_bytes(&self, time: usize) -> usize {
        let acknowledged = self.acknowledged.iter().filter(|(after, _)| *after < time);
        acknowledged.map(|(_, bytes)| *bytes).max().unwrap_or(0)
    }
}

impl Content {
    fn apply(&self, file: &mut Vec<u8>) {
        match self {
            Content::Truncate(len) => file.resize(*len, 0),
            Content::Write { at, bytes } => {
                file.resize(file.len().max(at + bytes.len()), 0);
                file[*at..at + bytes.len()].copy_from_slice(bytes);
            }
        }
    }

    /// Only the first sectors of it.
    fn torn(&self, random: &mut Xoshiro256PlusPlus) -> Content {
        match self {
            // In one case of two it does not happen.
            Content::Truncate(len) if random.next_u64().is_multiple_of(2) => Content::Truncate(*len),
            Content::Truncate(_) => Content::Write { at: 0, bytes: Vec::new() },
            Content::Write { at, bytes } => {
                let sectors = (at + bytes.len()).div_ceil(SECTOR_BYTES) - at / SECTOR_BYTES;
                let kept = random.next_u64() as usize % (sectors + 1);
                let end = (at / SECTOR_BYTES + kept) * SECTOR_BYTES;
                let len = end.saturating_sub(*at).min(bytes.len());
                Content::Write { at: *at, bytes: bytes[..len].to_vec() }
            }
        }
    }

    /// Any sectors of it; in one case of two the file has its length nevertheless.
    fn in_pieces(&self, random: &mut Xoshiro256PlusPlus) -> Vec<Content> {
        let Content::Write { at, bytes } = self else { return vec![self.torn(random)] };
        let mut pieces = Vec::new();
        let mut begin = *at;
        while begin < at + bytes.len() {
            let end = ((begin / SECTOR_BYTES + 1) * SECTOR_BYTES).min(at + bytes.len());
            if random.next_u64().is_multiple_of(2) {
                pieces.push(Content::Write { at: begin, bytes: bytes[begin - at..end - at].to_vec() });
            }
            begin = end;
        }
        if random.next_u64().is_multiple_of(2) {
            // A hole of zeros, where nothing was written later.
            pieces.push(Content::Write { at: at + bytes.len(), bytes: Vec::new() });
        }
        pieces
    }
}

/// Any number of the range or its end.
fn between(range: Range<usize>, random: &mut Xoshiro256PlusPlus) -> usize {
    range.start + random.next_u64() as usize % (range.len() + 1)
}

/// Follows the calls with the names that the processes saw.
struct Replay<'a> {
    root: &'a Path,
    names: BTreeMap<Inode, BTreeMap<String, Inode>>,
    /// Where the next write of a descriptor goes; `None`: to the file's end.
    places: BTreeMap<(i32, Inode), Option<usize>>,
    /// The ledger's length after a thread's last call, if that appended to it.
    appended: BTreeMap<u32, usize>,
    history: History,
}

impl Replay<'_> {
    fn find(&self, path: &Path) -> Option<Inode> {
        let path = path.strip_prefix(self.root).unwrap();
        path.components()
            .try_fold(ROOT, |folder, name| self.names.get(&folder)?.get(name.as_os_str().to_str()?).copied())
    }

    fn folder_and_name(&self, path: &Path) -> (Inode, String) {
        let folder =
            self.find(path.parent().unwrap()).unwrap_or_else(|| panic!("no folder of {}", path.display()));
        (folder, path.file_name().unwrap().to_str().unwrap().to_owned())
    }

    fn change_names(&mut self, time: usize, folder: Inode, names: Names) {
        let now = self.names.get_mut(&folder).unwrap();
        for (name, inode) in &names {
            match inode {
                Some(inode) => now.insert(name.clone(), *inode),
                None => now.remove(name),
            };
        }
        self.history.folders.get_mut(&folder).unwrap().push((time, names));
    }

    fn add(&mut self, time: usize, path: &Path, is_file: bool) -> Inode {
        let inode = 1 + time;
        match is_file {
            true => drop(self.history.files.insert(inode, Vec::new())),
            false => {
                self.names.insert(inode, BTreeMap::new());
                self.history.folders.insert(inode, Vec::new());
            }
        }
        let (folder, name) = self.folder_and_name(path);
        self.change_names(time, folder, vec![(name, Some(inode))]);
        inode
    }

    fn change_content(&mut self, time: usize, file: Inode, change: Content) {
        self.history.files.get_mut(&file).unwrap().push((time, change));
    }

    fn len(&self, file: Inode) -> usize {
        self.history.files[&file].iter().fold(0, |len, (_, change)| match change {
            Content::Truncate(len) => *len,
            Content::Write { at, bytes } => len.max(at + bytes.len()),
        })
    }

    fn apply(&mut self, time: usize, Recorded { call, thread, begun }: &Recorded) {
        if !matches!(call, Call::Sync(_))
            && let Some(bytes) = self.appended.remove(thread)
        {
            self.history.acknowledged.push((time, bytes));
        }
        match call {
            // The data folder itself.
            Call::MakeDir(path) if path == self.root => {}
            Call::MakeDir(path) => drop(self.add(time, path, false)),
            Call::Open { path, fd, create, truncate, append } => {
                let found = self.find(path);
                let inode = match found {
                    Some(inode) => inode,
                    None if *create => self.add(time, path, true),
                    // It was removed meanwhile.
                    None => return,
                };
                if *truncate && found.is_some() {
                    self.change_content(time, inode, Content::Truncate(0));
                }
                self.places.insert((*fd, inode), (!append).then_some(0));
            }
            Call::Write { path, fd, bytes } => {
                // Nothing can be found any more of a file without a name.
                let Some(file) = self.find(path) else { return };
                let place = self.places[&(*fd, file)];
                let at = place.unwrap_or_else(|| self.len(file));
                self.places.insert((*fd, file), place.map(|at| at + bytes.len()));
                self.change_content(time, file, Content::Write { at, bytes: bytes.clone() });
                if path.file_name().is_some_and(|name| name == "ledger.jsonl") {
                    self.appended.insert(*thread, self.len(file));
                }
            }
            Call::WriteAt { path, bytes, at } => {
                let Some(file) = self.find(path) else { return };
                self.change_content(time, file, Content::Write { at: *at as usize, bytes: bytes.clone() });
            }
            Call::Seek { path, fd, to } => {
                let Some(file) = self.find(path) else { return };
                self.places.insert((*fd, file), Some(*to as usize));
            }
            Call::Truncate { path, len } => {
                let Some(file) = self.find(path) else { return };
                self.change_content(time, file, Content::Truncate(*len as usize));
            }
            Call::Rename { from, to } => {
                let ((folder, from), (other, to)) = (self.folder_and_name(from), self.folder_and_name(to));
                assert_eq!(folder, other, "renames within a folder are modelled");
                let inode = self.names[&folder][&from];
                self.change_names(time, folder, vec![(from, None), (to, Some(inode))]);
            }
            Call::Exchange(a, b) => {
                let ((folder, a), (other, b)) = (self.folder_and_name(a), self.folder_and_name(b));
                assert_eq!(folder, other, "exchanges within a folder are modelled");
                let (was_a, was_b) = (self.names[&folder][&a], self.names[&folder][&b]);
                self.change_names(time, folder, vec![(a, Some(was_b)), (b, Some(was_a))]);
            }
            Call::Remove(path) => {
                let (folder, name) = self.folder_and_name(path);
                self.change_names(time, folder, vec![(name, None)]);
            }
            Call::Other { name, strings } => panic!("{name} is not modelled: {strings}"),
            Call::Sync(path) => {
                let Some(inode) = self.find(path) else { return };
                self.history.syncs.push(Sync { inode, begun: *begun, returned: time });
            }
        }
    }
}
