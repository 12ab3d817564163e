//! What a daemon does to its data folder, recorded with `strace`: each write, sync, rename, truncation and removal.

use std::path::{Path, PathBuf};
use std::process::Command;

use nix::sys::signal::Signal;
use raysweep_proto::{Client, Event, RunParams};

use crate::process::{Process, wait_for};

/// A system call that changed a folder, or made a change durable. Paths are absolute.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Call {
    MakeDir(PathBuf),
    Open {
        path: PathBuf,
        fd: i32,
        create: bool,
        truncate: bool,
        append: bool,
    },
    Write {
        path: PathBuf,
        fd: i32,
        bytes: Vec<u8>,
    },
    WriteAt {
        path: PathBuf,
        bytes: Vec<u8>,
        at: u64,
    },
    Seek {
        path: PathBuf,
        fd: i32,
        to: u64,
    },
    Truncate {
        path: PathBuf,
        len: u64,
    },
    Rename {
        from: PathBuf,
        to: PathBuf,
    },
    Exchange(PathBuf, PathBuf),
    Remove(PathBuf),
    Sync(PathBuf),
    /// A call that the model does not know, and all strings of it.
    Other {
        name: String,
        strings: String,
    },
}

/// A call that succeeded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recorded {
    pub call: Call,
    pub thread: u32,
    /// The number of recorded calls that had returned when it was made.
    pub begun: usize,
}

/// The calls that change files or make changes durable. Those that the model does not know are recorded too, so that it
/// can refuse them.
const TRACED: &str = "trace=open,openat,openat2,creat,write,pwrite64,writev,pwritev,pwritev2,lseek,ftruncate,truncate,\
    fallocate,rename,renameat,renameat2,unlink,unlinkat,rmdir,mkdir,mkdirat,fsync,fdatasync,sync_file_range,syncfs,\
    link,linkat,symlink,symlinkat,copy_file_range,sendfile,splice,mmap";

/// Runs a plan to its end in a daemon of its own, whose data folder is `sessions` in `folder`; returns what was done to
/// it, and the session.
pub fn record(folder: &Path, plan: &str) -> (Vec<Recorded>, PathBuf) {
    let (trace, socket, data) = (folder.join("trace"), folder.join("socket"), folder.join("sessions"));
    // With -D the daemon is the child of this process, and strace its grandchild.
    let mut command = Command::new("strace");
    command
        // Without ffmpeg: video files are no arrays.
        .args(["-E", "PATH=/nonexistent"])
        .args(["-D", "-f", "--seccomp-bpf", "-y", "-xx", "-s", "1000000000", "-e", TRACED, "-o"])
        .arg(&trace)
        .arg(env!("CARGO_BIN_EXE_raysweepd"))
        .arg("--rig")
        .arg(folder.join("rig.toml"))
        .arg("--socket")
        .arg(&socket)
        .arg("--data")
        .arg(&data)
        .stderr(std::process::Stdio::null());
    let mut daemon = Process::start(&mut command);
    let client = || Client::connect(&socket).ok();
    let watcher = wait_for("the daemon does not listen under strace", || {
        assert!(!daemon.has_ended(), "the daemon has ended");
        client()
    });
    let mut watcher = watcher.subscribe().unwrap();
    client().unwrap().run(&RunParams { plan: plan.into(), ..RunParams::default() }).unwrap();
    let session = watcher.find_map(|event| match event.unwrap() {
        Event::Finished { session, state, error, .. } => {
            assert_eq!(state, "complete", "{error:?}");
            Some(session)
        }
        _ => None,
    });
    daemon.signal(Signal::SIGTERM);
    assert!(daemon.wait().success());
    // The trace is whole when it tells of the daemon's exit.
    let text = wait_for("strace has not ended", || {
        let text = std::fs::read_to_string(&trace).unwrap();
        text.ends_with("+++ exited with 0 +++\n").then_some(text)
    });
    (calls(&text, &data), session.expect("a run that ended"))
}

/// The successful calls of a trace that concern a folder, in the order in which they returned.
fn calls(trace: &str, folder: &Path) -> Vec<Recorded> {
    let mut recorded = Vec::new();
    // Of each thread whose call has not returned: its text so far, and how many calls had returned.
    let mut under_way = std::collections::BTreeMap::new();
    for line in trace.lines() {
        let (thread, text) = line.split_once(' ').unwrap();
        let text = text.trim_start();
        if let Some(begun) = text.strip_suffix(" <unfinished ...>") {
            under_way.insert(thread, (begun, recorded.len()));
            continue;
        }
        let resumed = text.strip_prefix("<... ").and_then(|rest| rest.split_once(" resumed>"));
        let (text, begun) = match resumed {
            Some((_, rest)) => {
                let (head, begun) = under_way.remove(thread).unwrap();
                (format!("{head}{rest}"), begun)
            }
            None => (text.to_owned(), recorded.len()),
        };
        if let Some(call) = call(&text).filter(|call| call.concerns(folder)) {
            recorded.push(Recorded { call, thread: thread.parse().unwrap(), begun });
        }
    }
    recorded
}

impl Call {
    fn concerns(&self, folder: &Path) -> bool {
        let path = match self {
            Call::Other { strings, .. } => return strings.contains(&*folder.to_string_lossy()),
            Call::MakeDir(path) | Call::Remove(path) | Call::Sync(path) => path,
            Call::Open { path, .. } | Call::Truncate { path, .. } | Call::Seek { path, .. } => path,
            Call::Write { path, .. } | Call::WriteAt { path, .. } => path,
            Call::Rename { to, .. } | Call::Exchange(_, to) => to,
        };
        path.starts_with(folder)
    }
}

/// A line of the trace, without its thread: `name(arguments) = result`.
fn call(text: &str) -> Option<Call> {
    let (name, rest) = text.split_once('(')?;
    let (arguments, result) = rest.rsplit_once(" = ")?;
    let arguments = arguments.trim_end().strip_suffix(')')?;
    if result.starts_with('-') || result.starts_with('?') {
        return None;
    }
    // All strings are in hexadecimal, so no comma, bracket or quote is part of one.
    let arguments: Vec<&str> = arguments.split(", ").collect();
    let path = |index: usize| PathBuf::from(String::from_utf8(unhex(quoted(arguments[index]))).unwrap());
    let at_folder = |index: usize| match path(index + 1) {
        absolute if absolute.is_absolute() => absolute,
        relative => descriptor(arguments[index]).1.join(relative),
    };
    let number = |index: usize| arguments[index].parse::<u64>().unwrap();
    let opened = |flags: &str| {
        let (fd, path) = descriptor(result);
        let has = |flag: &str| flags.split('|').any(|set| set == flag);
        let (create, truncate) = (has("O_CREAT"), has("O_TRUNC"));
        Call::Open { path, fd, create, truncate, append: has("O_APPEND") }
    };
    let made = match name {
        "open" => opened(arguments[1]),
        "openat" => opened(arguments[2]),
        // Reads what clients name, and changes nothing.
        "openat2" => return None,
        "mkdir" => Call::MakeDir(path(0)),
        "mkdirat" => Call::MakeDir(at_folder(0)),
        "unlink" | "rmdir" => Call::Remove(path(0)),
        "unlinkat" => Call::Remove(at_folder(0)),
        "rename" => Call::Rename { from: path(0), to: path(1) },
        "renameat2" if arguments[4] == "RENAME_EXCHANGE" => Call::Exchange(at_folder(0), at_folder(2)),
        "renameat" | "renameat2" => Call::Rename { from: at_folder(0), to: at_folder(2) },
        "fsync" | "fdatasync" => Call::Sync(descriptor(arguments[0]).1),
        "ftruncate" => Call::Truncate { path: descriptor(arguments[0]).1, len: number(1) },
        "truncate" => Call::Truncate { path: path(0), len: number(1) },
        "lseek" => {
            let (fd, path) = descriptor(arguments[0]);
            Call::Seek { path, fd, to: result.parse().unwrap() }
        }
        "write" | "pwrite64" => {
            let (fd, path) = descriptor(arguments[0]);
            let mut bytes = unhex(quoted(arguments[1]));
            bytes.truncate(result.parse().unwrap());
            match name {
                "write" => Call::Write { path, fd, bytes },
                _ => Call::WriteAt { path, bytes, at: number(3) },
            }
        }
        "mmap" if !arguments[3].contains("MAP_SHARED") || !arguments[2].contains("PROT_WRITE") => {
            return None;
        }
        _ => Call::Other { name: name.into(), strings: String::from_utf8_lossy(&unhex(text)).into_owned() },
    };
    Some(made)
}

/// The descriptor and the path of `15</path>`, where the path is in hexadecimal. A file that was removed has no path.
fn descriptor(text: &str) -> (i32, PathBuf) {
    let (fd, path) = text.split_once('<').unwrap_or((text, ""));
    let path = match path.ends_with("(deleted)") {
        true => PathBuf::new(),
        false => String::from_utf8_lossy(&unhex(path)).into_owned().into(),
    };
    (fd.parse().unwrap_or(-1), path)
}

fn quoted(text: &str) -> &str {
    text.trim_matches('"')
}

/// The bytes that a text has as `\x61\x62`.
fn unhex(text: &str) -> Vec<u8> {
    assert!(!text.contains("..."), "strace has cut a string off");
    text.split("\\x").skip(1).map(|byte| u8::from_str_radix(&byte[..2], 16).unwrap()).collect()
}
