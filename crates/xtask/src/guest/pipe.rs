//! Pairs of connected character devices of QEMU. It cannot connect two directly, so their bytes pass through here.
//!
//! Connected through a socket alone, they could stop QEMU for ever: its serial converter waits for the socket to take a
//! byte, meanwhile nothing else in QEMU runs, not even the other end's reader, and a socket is full after 17 kB of small
//! writes.

use std::fs::DirBuilder;
use std::io::{self, Read, Write};
use std::os::unix::fs::DirBuilderExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::channel;
use std::thread::spawn;

use crate::run::Done;

/// Adds a pair: `name` for a device or the monitor, and a port that programs in the guest open as
/// `/dev/virtio-ports/NAME`.
pub fn pipe(qemu: &mut Command, name: &str) -> Done {
    let folder = folder();
    let listener =
        listen(&folder).map_err(|error| format!("cannot make a socket in {}: {error}", folder.display()))?;
    let path = socket(&folder);
    for end in [name, &format!("{name}-guest")] {
        qemu.args(["-chardev", &format!("socket,id={end},path={}", path.display())]);
    }
    qemu.args(["-device", &format!("virtserialport,chardev={name}-guest,name={name}")]);
    // QEMU connects both as it starts.
    spawn(move || {
        if let Err(error) = connect(&listener) {
            eprintln!("{}: {error}", path.display());
        }
        let _ = std::fs::remove_dir_all(folder);
    });
    Ok(())
}

/// A folder for a socket, for us alone: whoever connects is the monitor's master. Paths of sockets are limited to 108
/// bytes, and target folders may be longer.
fn folder() -> PathBuf {
    static OPENED: AtomicU32 = AtomicU32::new(0);
    let number = OPENED.fetch_add(1, Ordering::Relaxed);
    std::env::temp_dir().join(format!("raysweep-guest-{}-{number}", std::process::id()))
}

fn socket(folder: &Path) -> PathBuf {
    folder.join("socket")
}

fn listen(folder: &Path) -> io::Result<UnixListener> {
    // Another process of this number may have left it.
    let _ = std::fs::remove_dir_all(folder);
    DirBuilder::new().mode(0o700).create(folder)?;
    UnixListener::bind(socket(folder))
}

/// Connects the first two that come.
fn connect(listener: &UnixListener) -> io::Result<()> {
    let ((one, _), (other, _)) = (listener.accept()?, listener.accept()?);
    carry(one.try_clone()?, other.try_clone()?);
    carry(other, one);
    Ok(())
}

/// Carries bytes until QEMU ends. They are taken at once, however slowly they are passed on.
fn carry(mut from: UnixStream, mut to: UnixStream) {
    let (taken, passed) = channel::<Vec<u8>>();
    spawn(move || {
        let mut buffer = [0; 4096];
        while let Ok(count @ 1..) = from.read(&mut buffer) {
            if taken.send(buffer[..count].to_vec()).is_err() {
                break;
            }
        }
    });
    spawn(move || passed.iter().try_for_each(|bytes| to.write_all(&bytes)));
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const HUNG: Duration = Duration::from_secs(600);

    #[test]
    fn an_end_takes_what_the_other_does_not_read_and_passes_it_on_in_order() {
        let folder = folder();
        let listener = listen(&folder).unwrap();
        let [mut one, mut other] = [(); 2].map(|()| UnixStream::connect(socket(&folder)).unwrap());
        connect(&listener).unwrap();
        std::fs::remove_dir_all(folder).unwrap();
        [&one, &other].iter().for_each(|end| end.set_read_timeout(Some(HUNG)).unwrap());
        one.set_write_timeout(Some(HUNG)).unwrap();
        let sent: Vec<u8> = (0..1_000_000_u32).map(|n| (n % 251) as u8).collect();
        // Pieces as small as packets of USB fill a socket soonest.
        sent.chunks(64).for_each(|piece| one.write_all(piece).unwrap());
        other.write_all(b"pong").unwrap();
        let mut pong = [0; 4];
        one.read_exact(&mut pong).unwrap();
        assert_eq!(&pong, b"pong");
        let mut received = vec![0; sent.len()];
        other.read_exact(&mut received).unwrap();
        assert!(received == sent);
    }
}
