//! The folder of a session.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::slice;

use jiff::tz::TimeZone;
use raysweep_core::io_text;

use crate::dots::Dots;
use crate::film::Film;
use crate::ledger::{self, Entry, Ledger, LedgerText, Remark, SessionEntry, State};
use crate::manifest::{self, FileRecord};
use crate::products::Products;
use crate::stack::{Contents, Stack};
use crate::{Error, Result, durable, input};

/// Longest text of a session that is read at once: the socket takes plans of at most 1 MiB.
pub(crate) const MOST_TEXT_BYTES: u64 = 1 << 24;
/// Maximum bytes of a session's name that are used in its folder's name.
const NAME_MAX_BYTES: usize = 64;

/// A session's folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Session {
    dir: PathBuf,
}

impl Session {
    /// Creates the folder of a new session in `root` (which is created if it is missing): `plan.toml` and
    /// `rig.toml` as given, an empty stack (not for a dot rig) and the ledger with its first line. The ledger
    /// is written last: without it there is no session.
    ///
    /// The folder is named `YYYYMMDD-HHMMSS_name` after `session.created` in UTC. In the name, letters and
    /// digits of any script, `-`, `_` and `.` are kept; every run of other characters becomes one `-`; `-`
    /// and `.` at the ends are removed; and the result is cut to 64 bytes. An empty result becomes `session`.
    /// If the folder exists, `-2`, `-3`, ... is appended: creating the folder is the lock, and nothing is
    /// ever overwritten.
    ///
    /// # Errors
    /// [`Error::Io`] if the file system refuses, [`Error::Shape`] for an empty stack.
    pub fn create(root: &Path, session: SessionEntry, plan: &str, rig: &str) -> Result<(Session, Ledger)> {
        Session::create_with(root, session, [plan, rig], |_| Ok(()))
    }

    /// As [`Session::create`], from the texts of plan and rig file and with further files that `keep` writes. The ledger
    /// binds all of them by their SHA-256. After an error nothing is left.
    ///
    /// # Errors
    /// As [`Session::create`], and the error of `keep`.
    pub fn create_with<E: From<Error>>(
        root: &Path,
        session: SessionEntry,
        texts: [&str; 2],
        keep: impl FnOnce(&Session) -> std::result::Result<(), E>,
    ) -> std::result::Result<(Session, Ledger), E> {
        session.shape.check()?;
        durable::create_dir_all(root)?;
        let stamp = session.created.to_zoned(TimeZone::UTC).strftime("%Y%m%d-%H%M%S").to_string();
        let session_dir = create_unused(root, &format!("{stamp}_{}", folder_name(&session.name)))?;
        let created = Session { dir: session_dir };
        let filled = created.fill(&session, texts).map_err(E::from).and_then(|()| keep(&created));
        let begun = filled.and_then(|()| {
            let files = manifest::files_of(&created)?.into_iter();
            let files = files.map(|(file, record)| (file, record.sha256)).collect();
            Ok(Ledger::create(&created.ledger_path(), session, files)?)
        });
        match begun {
            Ok(ledger) => Ok((created, ledger)),
            Err(error) => {
                // Without a ledger there is no session; what cannot be removed is not listed as one.
                let _ = fs::remove_dir_all(&created.dir);
                Err(error)
            }
        }
    }

    /// Writes what a new session has before its ledger.
    fn fill(&self, session: &SessionEntry, [plan, rig]: [&str; 2]) -> Result<()> {
        durable::write(&self.plan_path(), plan.as_bytes())?;
        durable::write(&self.rig_path(), rig.as_bytes())?;
        durable::create_dir(&self.products_path())?;
        if !session.shape.arrays().is_empty() {
            Stack::create(&self.stack_path(), &session.shape, &session.kind)?;
        }
        match session.shape.contents {
            Contents::Batches { .. } => drop(Dots::create(&self.dots_path(), &session.shape)?),
            Contents::Film { .. } => drop(Film::create(&self.film_path(), &session.shape)?),
            Contents::Sweep { .. }
            | Contents::Axes { .. }
            | Contents::Darks { .. }
            | Contents::Board { .. }
            | Contents::Patterns { .. }
            | Contents::Nothing => {}
        }
        Ok(())
    }

    /// Opens a session below one of these folders, given by its full path or by its name in one of them. Symbolic links
    /// and other ways out of the folders are refused.
    ///
    /// # Errors
    /// [`Error::NotASession`].
    pub fn open_below(folders: &[PathBuf], given: &Path) -> Result<Session> {
        let refused = |error: io::Error| Error::NotASession { path: given.to_owned(), why: io_text(&error) };
        Session::open(&input::folder_below(folders, given).map_err(refused)?)
    }

    /// Opens an existing session, to read it or to continue it ([`Session::resume`]).
    ///
    /// # Errors
    /// [`Error::NotASession`] if there is no ledger.
    pub fn open(dir: &Path) -> Result<Session> {
        let session = Session { dir: dir.to_owned() };
        match fs::symlink_metadata(session.ledger_path()) {
            Ok(ledger) if ledger.is_file() => Ok(session),
            Ok(_) => {
                Err(Error::NotASession { path: dir.to_owned(), why: "its ledger.jsonl is not a file".into() })
            }
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
                Err(Error::NotASession { path: dir.to_owned(), why: "it has no ledger.jsonl".into() })
            }
            Err(error) => Err(Error::io("examine", &session.ledger_path())(error)),
        }
    }

    /// Opens the session for writing (to acquire what is missing, or to compute its products again). While
    /// the ledger is open, no other process can do so. Removes what a crash left behind and truncates a torn
    /// last line of the ledger.
    ///
    /// # Errors
    /// As [`Ledger::open`], [`Error::Io`] if a leftover cannot be removed.
    pub fn resume(&self) -> Result<Ledger> {
        let ledger = Ledger::open(&self.ledger_path())?;
        durable::remove_leftovers(&self.dir)?;
        Ok(ledger)
    }

    /// As [`Session::resume`], of a session whose ledger may be damaged, with what the ledger says.
    ///
    /// # Errors
    /// As [`Ledger::open_damaged`], [`Error::Io`] if a leftover cannot be removed.
    pub fn open_damaged(&self) -> Result<(Ledger, LedgerText)> {
        let opened = Ledger::open_damaged(&self.ledger_path())?;
        durable::remove_leftovers(&self.dir)?;
        Ok(opened)
    }

    /// An entry that binds files of the session, which are chosen by their paths with `/` separators.
    ///
    /// # Errors
    /// [`Error::Io`] if one cannot be read.
    pub fn bind(&self, is_bound: impl Fn(&str) -> bool) -> Result<Entry> {
        let bound = manifest::paths_of(self)?.into_iter().filter(|(file, _)| is_bound(file));
        let sum = |(file, path): (String, PathBuf)| Ok((file, FileRecord::read(&path)?.sha256));
        Ok(Entry::Files { sha256: bound.map(sum).collect::<Result<_>>()? })
    }

    /// Opens one of its files, given by its path in the session or with the session's folder, without following symbolic
    /// links.
    ///
    /// # Errors
    /// [`Error::Io`] if it is missing, longer than `most_bytes`, no regular file, or elsewhere.
    pub fn open_file(&self, file: &Path, most_bytes: u64) -> Result<File> {
        let inner = file.strip_prefix(&self.dir).unwrap_or(file);
        let opened = input::open_below(slice::from_ref(&self.dir), inner, most_bytes);
        opened.map_err(Error::io("read", &self.dir.join(inner)))
    }

    /// Reads one of its files, as [`Session::open_file`] opens it.
    ///
    /// # Errors
    /// As [`Session::open_file`].
    pub fn read(&self, file: &Path, most_bytes: u64) -> Result<Vec<u8>> {
        let opened = self.open_file(file, most_bytes)?;
        input::read_open(&opened, most_bytes).map_err(Error::io("read", file))
    }

    /// As [`Session::read`], of `plan.toml`, `rig.toml` and other short texts.
    ///
    /// # Errors
    /// As [`Session::open_file`], and [`Error::Codec`] if it is not UTF-8 text.
    pub fn read_text(&self, file: &Path) -> Result<String> {
        let bytes = self.read(file, MOST_TEXT_BYTES)?;
        String::from_utf8(bytes)
            .map_err(|_not_utf8| Error::codec("read", file.display())("it is not UTF-8 text"))
    }

    /// The size of all its files together.
    ///
    /// # Errors
    /// [`Error::Io`] if a file cannot be examined.
    pub fn stored_bytes(&self) -> Result<u64> {
        let paths = manifest::paths_of(self)?;
        let bytes = |path: &PathBuf| Ok(fs::metadata(path).map_err(Error::io("examine", path))?.len());
        paths.values().map(bytes).sum()
    }

    /// The state according to the ledger, read without locking it.
    ///
    /// # Errors
    /// As [`ledger::read_state`].
    pub fn state(&self) -> Result<State> {
        ledger::read_state(&self.ledger_path())
    }

    /// Appends a remark to the ledger, in which nothing is ever changed.
    ///
    /// # Errors
    /// [`Error::InUse`] during a run, [`Error::Io`] if the ledger cannot be written.
    pub fn note(&self, remark: Remark) -> Result<()> {
        Ledger::open(&self.ledger_path())?.append(&Entry::Note(remark))
    }

    /// Opens the stack for reading and writing.
    ///
    /// # Errors
    /// As [`Stack::open`]: its shape must match the ledger.
    pub fn stack(&self) -> Result<Stack> {
        Stack::open(&self.stack_path(), &self.state()?.session.shape)
    }

    /// Opens the frames of a film for reading and writing.
    ///
    /// # Errors
    /// As [`Film::open`]: its shape must match the ledger.
    pub fn film(&self) -> Result<Film> {
        Film::open(&self.film_path(), &self.state()?.session.shape)
    }

    /// Opens the batches of a flying dot for reading and writing.
    ///
    /// # Errors
    /// If the ledger cannot be read.
    pub fn dots(&self) -> Result<Dots> {
        Ok(Dots::open(&self.dots_path(), &self.state()?.session.shape))
    }

    /// The folder of the products.
    pub fn products(&self) -> Products {
        Products::new(self.products_path())
    }

    /// The session's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// `plan.toml`, the plan as used.
    pub fn plan_path(&self) -> PathBuf {
        self.dir.join("plan.toml")
    }

    /// `rig.toml`, the rig as used.
    pub fn rig_path(&self) -> PathBuf {
        self.dir.join("rig.toml")
    }

    /// `ledger.jsonl`, see [`crate::ledger`].
    pub fn ledger_path(&self) -> PathBuf {
        self.dir.join("ledger.jsonl")
    }

    /// `stack.zarr`, see [`crate::stack`].
    pub fn stack_path(&self) -> PathBuf {
        self.dir.join("stack.zarr")
    }

    /// `transport.zarr`, see [`crate::transport`].
    pub fn transport_path(&self) -> PathBuf {
        self.dir.join("transport.zarr")
    }

    /// `film.zarr`, see [`crate::film`].
    pub fn film_path(&self) -> PathBuf {
        self.dir.join("film.zarr")
    }

    /// `transport_film.zarr`, see [`crate::film`].
    pub fn transport_film_path(&self) -> PathBuf {
        self.dir.join("transport_film.zarr")
    }

    /// `dots.zarr`, see [`crate::dots`].
    pub fn dots_path(&self) -> PathBuf {
        self.dir.join("dots.zarr")
    }

    /// `raw.npy`, the raw frames of a flying dot, if they are kept; see [`crate::dots::RawFrames`].
    pub fn raw_path(&self) -> PathBuf {
        self.dir.join("raw.npy")
    }

    /// Path of a product's lighting pattern.
    pub fn pattern_path(&self, product: &str) -> PathBuf {
        self.dir.join("patterns").join(format!("{product}.npy"))
    }

    /// `mirror-response.json`: the measured response of a mirror, or the one that its path was predistorted
    /// with.
    pub fn mirror_response_path(&self) -> PathBuf {
        self.dir.join("mirror-response.json")
    }

    /// `products`, see [`crate::products`].
    pub fn products_path(&self) -> PathBuf {
        self.dir.join("products")
    }

    /// `report.html`, see [`crate::report`].
    pub fn report_path(&self) -> PathBuf {
        self.dir.join("report.html")
    }

    /// `manifest.json`, see [`crate::manifest`].
    pub fn manifest_path(&self) -> PathBuf {
        self.dir.join("manifest.json")
    }
}

fn create_unused(root: &Path, name: &str) -> Result<PathBuf> {
    let mut number = 1;
    loop {
        let dir = match number {
            1 => root.join(name),
            _ => root.join(format!("{name}-{number}")),
        };
        match durable::create_dir(&dir) {
            Ok(()) => return Ok(dir),
            Err(Error::Io { source, .. }) if source.kind() == io::ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(error),
        }
    }
}

fn folder_name(name: &str) -> String {
    let mut clean = String::new();
    for character in name.chars() {
        let kept = character.is_alphanumeric() || matches!(character, '-' | '_' | '.');
        let character = if kept { character } else { '-' };
        if character == '-' && clean.ends_with('-') {
            continue;
        }
        if clean.len() + character.len_utf8() > NAME_MAX_BYTES {
            break;
        }
        clean.push(character);
    }
    match clean.trim_matches(['-', '.']) {
        "" => "session".into(),
        trimmed => trimmed.into(),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::stack::{Contents, StackShape};

    /// A session to begin with.
    pub(crate) fn session(name: &str) -> SessionEntry {
        SessionEntry {
            format: ledger::FORMAT,
            name: name.into(),
            kind: "sweep".into(),
            operator: Some("Ada".into()),
            sample: None,
            note: None,
            tags: vec!["test".into()],
            created: "2026-03-04T05:06:07Z".parse().unwrap(),
            software: "raysweep 0.1.0".into(),
            shape: StackShape { contents: Contents::Sweep { points: 4, exposures: 2 }, rows: 3, columns: 5 },
            first_row: 0,
        }
    }

    #[test]
    fn names_are_made_fit_for_a_folder() {
        for (given, made) in [
            ("v-groove", "v-groove"),
            ("../../etc/passwd", "etc-passwd"),
            ("Müller's 2nd  cup", "Müller-s-2nd-cup"),
            ("a\0b\nc/d", "a-b-c-d"),
            ("...", "session"),
            ("", "session"),
            (".hidden", "hidden"),
        ] {
            assert_eq!(folder_name(given), made, "{given:?}");
        }
        let long = folder_name(&"ä".repeat(100));
        assert_eq!(long, "ä".repeat(32));
    }

    #[test]
    fn a_session_is_never_overwritten() {
        let root = tempfile::tempdir().unwrap();
        let root = root.path().join("data");
        let mut names = Vec::new();
        for plan in ["one", "two", "three"] {
            let (session, _) = Session::create(&root, session("cup"), plan, "rig").unwrap();
            assert_eq!(fs::read_to_string(session.plan_path()).unwrap(), plan);
            names.push(session.dir().file_name().unwrap().to_str().unwrap().to_owned());
        }
        assert_eq!(names, ["20260304-050607_cup", "20260304-050607_cup-2", "20260304-050607_cup-3"]);
        assert_eq!(fs::read_to_string(root.join(&names[0]).join("plan.toml")).unwrap(), "one");
    }

    #[test]
    fn concurrent_sessions_get_folders_of_their_own() {
        let root = tempfile::tempdir().unwrap();
        let dirs: Vec<_> = std::thread::scope(|scope| {
            let make = || Session::create(root.path(), session("cup"), "", "").unwrap().0.dir().to_owned();
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(make)).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        let distinct: std::collections::BTreeSet<_> = dirs.iter().collect();
        assert_eq!(distinct.len(), 8);
    }

    #[test]
    fn an_empty_stack_is_refused_before_anything_is_made() {
        let root = tempfile::tempdir().unwrap();
        let mut empty = session("cup");
        empty.shape.rows = 0;
        assert!(matches!(Session::create(root.path(), empty, "", ""), Err(Error::Shape { .. })));
        assert_eq!(fs::read_dir(root.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_session_that_is_refused_while_it_is_made_leaves_nothing() {
        let root = tempfile::tempdir().unwrap();
        let refuse = |session: &Session| {
            fs::write(session.pattern_path("x").with_file_name("kept"), "").unwrap_err();
            Err(Error::NotASession { path: session.dir().to_owned(), why: "no pattern".into() })
        };
        assert!(Session::create_with(root.path(), session("cup"), ["plan", "rig"], refuse).is_err());
        assert_eq!(fs::read_dir(root.path()).unwrap().count(), 0);
    }

    #[test]
    fn the_ledger_binds_what_a_session_begins_with() {
        let root = tempfile::tempdir().unwrap();
        let keep = |session: &Session| durable::write(&session.dir().join("calibration.toml"), b"kept");
        let (session, ledger) =
            Session::create_with(root.path(), session("cup"), ["plan", "rig"], keep).unwrap();
        let files = ledger.state().files();
        // SHA-256 of the three letters "rig", computed by another program.
        assert_eq!(files["rig.toml"], "c00ae0a63348054ecc8343f23278fe13bfa5c44255e208ff6102ffc2d7910a53");
        assert!(files.contains_key("calibration.toml") && files.contains_key("stack.zarr/sum/zarr.json"));
        fs::write(session.dir().join("calibration.toml"), "kepd").unwrap();
        fs::remove_file(session.rig_path()).unwrap();
        let (_, audit) = crate::integrity::Audit::of(&session).unwrap();
        let damaged: Vec<String> = audit.damage.iter().map(ToString::to_string).collect();
        assert_eq!(
            damaged,
            [
                "calibration.toml is damaged (its SHA-256 is not the one in the ledger)",
                "rig.toml is damaged (it is missing)"
            ]
        );
    }

    #[test]
    fn a_folder_without_a_ledger_is_not_a_session() {
        let root = tempfile::tempdir().unwrap();
        for dir in [root.path().join("missing"), root.path().to_owned()] {
            let error = Session::open(&dir).unwrap_err();
            assert!(matches!(error, Error::NotASession { .. }), "{error}");
            assert!(error.to_string().contains(dir.to_str().unwrap()), "{error}");
        }
        fs::create_dir(root.path().join("ledger.jsonl")).unwrap();
        assert!(matches!(Session::open(root.path()), Err(Error::NotASession { .. })));
    }

    #[test]
    fn a_session_is_resumed_by_one_writer_and_without_leftovers() {
        let root = tempfile::tempdir().unwrap();
        let (session, ledger) = Session::create(root.path(), session("a"), "", "").unwrap();
        let leftover = session.stack_path().join("sum/c.1.0.0.raysweep-tmp");
        fs::write(&leftover, "torn").unwrap();
        assert!(matches!(session.resume(), Err(Error::InUse { .. })));
        assert!(leftover.exists(), "only the one writer may tidy up");
        drop(ledger);
        let _ledger = session.resume().unwrap();
        assert!(!leftover.exists());
    }

    #[test]
    fn a_session_is_opened_below_its_folder_or_not_at_all() {
        let top = tempfile::tempdir().unwrap();
        let data = top.path().join("data");
        let (inside, _) = Session::create(&data, session("in"), "", "").unwrap();
        let (outside, _) = Session::create(&top.path().join("other"), session("out"), "", "").unwrap();
        std::os::unix::fs::symlink(outside.dir(), data.join("link")).unwrap();
        let name = inside.dir().file_name().unwrap();
        let open = |given: &Path| Session::open_below(std::slice::from_ref(&data), given);
        assert_eq!(open(Path::new(name)).unwrap(), inside);
        assert_eq!(open(inside.dir()).unwrap(), inside);
        let other = Path::new("../other").join(outside.dir().file_name().unwrap());
        for given in [Path::new("link"), outside.dir(), &other, Path::new("."), Path::new("missing")] {
            let error = open(given).unwrap_err();
            assert!(matches!(error, Error::NotASession { .. }), "{}: {error}", given.display());
        }
        // A ledger that lies elsewhere would be continued there.
        fs::rename(inside.ledger_path(), top.path().join("ledger")).unwrap();
        std::os::unix::fs::symlink(top.path().join("ledger"), inside.ledger_path()).unwrap();
        assert!(open(inside.dir()).is_err());
        assert!(Ledger::open(&inside.ledger_path()).is_err());
    }

    #[test]
    fn a_ledger_too_long_for_memory_is_not_read() {
        let root = tempfile::tempdir().unwrap();
        let (session, _) = Session::create(root.path(), session("a"), "", "").unwrap();
        fs::File::options().write(true).open(session.ledger_path()).unwrap().set_len(20 << 30).unwrap();
        for error in [session.state().map(drop).unwrap_err(), session.resume().map(drop).unwrap_err()] {
            assert!(error.to_string().contains("limit"), "{error}");
        }
    }
}
