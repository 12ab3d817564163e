//! A GigE Vision 2.0 camera on real wires: GVCP and GVSP over UDP, described in GenICam, in front of the simulated rig or
//! of test pictures. Nothing here knows any client library, so that those can be tested against it.

mod clock;
mod control;
mod faults;
mod features;
mod genicam;
mod gvcp;
mod gvsp;
mod registers;
mod sequencer;
mod source;
mod stream;
#[cfg(test)]
mod tests;
mod wire;

use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::os::fd::AsRawFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

pub use clock::DeviceClock;
pub use faults::{Faults, TriggerOrder, WireTruth};
pub use source::test_pixel;

use self::control::Control;
use self::registers::{Identity, Registers};
use self::source::{Controls, Pictures};
use self::stream::Stream;
use crate::devices::SimCamera;

/// Longest wait for a datagram, and so the longest that a lost client or a stop waits.
const PATIENCE: Duration = Duration::from_millis(20);
/// Datagrams of GVCP are smaller.
const MAX_DATAGRAM: usize = 2048;

/// Why the camera cannot be there.
#[derive(Debug, thiserror::Error)]
pub enum GigeError {
    /// Its address is taken, or not this machine's.
    #[error(
        "cannot listen on {address}: {source}; give an address of this machine (any of 127.0.0.0/8 is) that no other camera has"
    )]
    Listen {
        /// Address and port.
        address: SocketAddrV4,
        /// What the system said.
        source: io::Error,
    },
    /// A thread or a socket cannot be had.
    #[error("cannot start the simulated camera: {0}")]
    System(#[from] io::Error),
}

/// What the camera is on the network.
#[derive(Debug, Clone, PartialEq)]
pub struct GigeSetup {
    /// Where it listens.
    pub address: Ipv4Addr,
    /// Serial number, at most 15 characters.
    pub serial: String,
    /// Its clock.
    pub clock: DeviceClock,
    /// What goes wrong at first.
    pub faults: Faults,
    /// Whether its description is downloaded as a zip file.
    pub zipped: bool,
}

/// What the camera looks at.
pub struct Look(Arc<dyn Controls>, Box<dyn Pictures>);

impl Look {
    /// At the simulated scene.
    pub(crate) fn at_scene(written: SimCamera, read: SimCamera) -> Self {
        let (controls, pictures) = source::scene(written, read);
        Self(controls, pictures)
    }

    /// At test pictures of so many rows and columns, see [`test_pixel`]: as fast as a client takes them.
    pub fn at_test_pictures(size: (usize, usize)) -> Self {
        let (controls, pictures) = source::pattern(size);
        Self(controls, pictures)
    }
}

/// A camera that answers until it is dropped.
pub struct GigeCamera {
    stream: Arc<Stream>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl GigeCamera {
    /// Connects the camera.
    ///
    /// # Errors
    /// When its address cannot be had.
    pub fn start(setup: &GigeSetup, look: Look) -> Result<Self, GigeError> {
        let address = SocketAddrV4::new(setup.address, gvcp::PORT);
        let listen = |address| listen(address).map_err(|source| GigeError::Listen { address, source });
        let socket = listen(address)?;
        let broadcast = listen(SocketAddrV4::new(Ipv4Addr::BROADCAST, gvcp::PORT))?;
        let Look(controls, pictures) = look;
        let capabilities = controls.capabilities();
        let out = UdpSocket::bind(SocketAddrV4::new(setup.address, 0))?;
        let pixels = capabilities.width * capabilities.height;
        let stream = Arc::new(Stream::new(out, pixels, setup.clock, setup.faults));
        let features = features::features(&capabilities);
        let description = genicam::describe(&features, &capabilities.model);
        let description = if setup.zipped {
            (genicam::zip(&description)?, "raysweep.zip")
        } else {
            (description.into_bytes(), "raysweep.xml")
        };
        let identity = Identity {
            address: setup.address,
            model: &capabilities.model,
            serial: &setup.serial,
            tick_frequency_hz: setup.clock.tick_frequency_hz,
            description,
        };
        let registers = Registers::new(features, identity);
        let control = Control::new(registers, controls.clone(), stream.clone(), stream.wire()?);

        let mut camera = Self { stream: stream.clone(), stop: Arc::default(), threads: Vec::new() };
        let wire = stream.wire()?;
        let (shared, stop) = (stream.clone(), camera.stop.clone());
        camera.thread("gvcp", move || serve(control, &shared, &[socket, broadcast], &stop))?;
        let stop = camera.stop.clone();
        camera.thread("gvsp", move || stream.run(&*controls, pictures, wire, &stop))?;
        Ok(camera)
    }

    fn thread(&mut self, name: &str, work: impl FnOnce() + Send + 'static) -> io::Result<()> {
        self.threads.push(std::thread::Builder::new().name(name.into()).spawn(work)?);
        Ok(())
    }

    /// What goes wrong at present.
    pub fn faults(&self) -> Faults {
        *lock(&self.stream.faults)
    }

    /// Changes what goes wrong from now on.
    pub fn set_faults(&self, faults: Faults) {
        *lock(&self.stream.faults) = faults;
    }

    /// What really left the camera. A real one has no such thing: it is for tests alone.
    pub fn truth(&self) -> WireTruth {
        *lock(&self.stream.truth)
    }
}

impl Drop for GigeCamera {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A thread that panicked has said so on stderr.
            let _ = thread.join();
        }
    }
}

/// A socket that other cameras of this machine may share a broadcast address with.
fn listen(address: SocketAddrV4) -> io::Result<UdpSocket> {
    use nix::sys::socket::{
        AddressFamily, SockFlag, SockType, SockaddrIn, bind, setsockopt, socket, sockopt,
    };
    let fd = socket(AddressFamily::Inet, SockType::Datagram, SockFlag::SOCK_CLOEXEC, None)?;
    if *address.ip() == Ipv4Addr::BROADCAST {
        setsockopt(&fd, sockopt::ReuseAddr, &true)?;
    }
    bind(fd.as_raw_fd(), &SockaddrIn::from(address))?;
    let socket = UdpSocket::from(fd);
    socket.set_nonblocking(true)?;
    Ok(socket)
}

/// Answers datagrams on `sockets`, from the first, until `stop`.
fn serve(mut control: Control, stream: &Stream, sockets: &[UdpSocket; 2], stop: &AtomicBool) {
    use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
    use std::os::fd::AsFd;
    let mut datagram = [0; MAX_DATAGRAM];
    let mut reply = Vec::with_capacity(MAX_DATAGRAM);
    let mut faults = None;
    while !stop.load(Ordering::Relaxed) {
        let mut ready = sockets.each_ref().map(|socket| PollFd::new(socket.as_fd(), PollFlags::POLLIN));
        // An interrupted wait is as good as one that is over.
        let _ = poll(&mut ready, PollTimeout::try_from(PATIENCE).unwrap_or(PollTimeout::ZERO));
        let present = *lock(&stream.faults);
        if faults.replace(present) != Some(present) {
            if present.dead {
                control.restart();
            }
            control.faults_changed();
        }
        let now = Instant::now();
        for socket in sockets {
            while let Ok((bytes, from)) = socket.recv_from(&mut datagram) {
                let answer = !present.dead && control.handle(&datagram[..bytes], from, now, &mut reply);
                if answer {
                    send(&sockets[0], &reply, from);
                }
            }
        }
        control.check_heartbeat(now);
    }
}

fn send(socket: &UdpSocket, reply: &[u8], to: SocketAddr) {
    // A client that is gone asks no more; one that is there asks again.
    let _ = socket.send_to(reply, to);
}

// What these guard is never left half changed, so a panic elsewhere does not spoil it.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn read<T>(shared: &RwLock<T>) -> RwLockReadGuard<'_, T> {
    shared.read().unwrap_or_else(PoisonError::into_inner)
}

fn write<T>(shared: &RwLock<T>) -> RwLockWriteGuard<'_, T> {
    shared.write().unwrap_or_else(PoisonError::into_inner)
}
