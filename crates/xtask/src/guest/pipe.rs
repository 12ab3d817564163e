//! Pairs of connected character devices of QEMU. It cannot connect two directly, so their bytes pass through here.
//!
//! Connected through a socket alone, they could stop QEMU for ever: its serial converter waits for the socket to take a
//! byte, meanwhile nothing else in QEMU runs, not even the other end's reader, and a socket is full after 17 kB of small
//! writes.

use std::io::{self, Read, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::channel;
use std::thread::spawn;

use crate::run::Done;

/// Adds a pair: `name` for a device or the monitor, and a port that programs in the guest open as
/// `/dev/virtio-ports/NAME`.
pub fn pipe(qemu: &mut Command, name: &str) -> Done {
    static OPENED: AtomicU32 = AtomicU32::new(0);
    // A name instead of a file: paths of sockets are limited to 108 bytes, and target folders may be longer.
    let number = OPENED.fetch_add(1, Ordering::Relaxed);
    let address = format!("raysweep-guest-{}-{number}", std::process::id());
    let listener =
        listen(&address).map_err(|error| format!("cannot listen at the socket @{address}: {error}"))?;
    for end in [name, &format!("{name}-guest")] {
        qemu.args(["-chardev", &format!("socket,id={end},path={address},abstract=on")]);
    }
    qemu.args(["-device", &format!("virtserialport,chardev={name}-guest,name={name}")]);
    // Ends with QEMU, which connects both as it starts.
    spawn(move || connect(&listener));
    Ok(())
}

fn listen(name: &str) -> io::Result<UnixListener> {
    UnixListener::bind_addr(&SocketAddr::from_abstract_name(name)?)
}

/// Connects the first two that come.
fn connect(listener: &UnixListener) -> io::Result<()> {
    let ((one, _), (other, _)) = (listener.accept()?, listener.accept()?);
    carry(one.try_clone()?, other.try_clone()?);
    carry(other, one);
    Ok(())
}

/// Carries bytes until either end closes. They are taken at once, however slowly they are passed on.
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

    #[test]
    fn an_end_takes_what_the_other_does_not_read_and_passes_it_on_in_order() {
        let name = format!("raysweep-pipe-{}", std::process::id());
        let listener = listen(&name).unwrap();
        let address = SocketAddr::from_abstract_name(&name).unwrap();
        let [mut one, mut other] = [(); 2].map(|()| UnixStream::connect_addr(&address).unwrap());
        connect(&listener).unwrap();
        one.set_write_timeout(Some(Duration::from_secs(60))).unwrap();
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
