//! A GigE Vision 2.0 camera on the network: GVCP and GVSP over UDP with a GenICam description, showing the simulated
//! rig or test pictures. The code is independent of any client library, so that it can be used to test them.

mod clock;
mod control;
mod faults;
mod features;
mod genicam;
pub mod gvcp;
mod gvsp;
mod locks;
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
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

pub use clock::CameraClock;
pub use faults::{Faults, TriggerOrder, WireTruth};
pub use source::test_pixel;

use self::control::ControlChannel;
use self::locks::lock;
use self::registers::{CameraIdentity, Registers};
use self::source::{Pictures, SourceControls};
use self::stream::StreamChannel;
use crate::devices::PlaneCamera;

/// Longest wait for a datagram, and so the longest delay in detecting a lost client or a stop.
const PATIENCE: Duration = Duration::from_millis(20);
/// Receive buffer size; GVCP datagrams are smaller.
const MAX_DATAGRAM: usize = 2048;

/// Why the camera cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum GigeError {
    /// Its address is in use or not an address of this machine.
    #[error(
        "cannot listen on {address}: {source}; give an address of this machine (any of 127.0.0.0/8 is) that no other camera has"
    )]
    Listen {
        /// Address and port.
        address: SocketAddrV4,
        /// The system's error.
        source: io::Error,
    },
    /// A thread or a socket cannot be created.
    #[error("cannot start the simulated camera: {0}")]
    System(#[from] io::Error),
}

/// Network configuration of the camera.
#[derive(Debug, Clone, PartialEq)]
pub struct GigeSetup {
    /// Address to listen on.
    pub address: Ipv4Addr,
    /// Serial number, at most 15 characters.
    pub serial: String,
    /// Its clock.
    pub clock: CameraClock,
    /// Initial faults.
    pub faults: Faults,
    /// Whether the description is served as a zip file.
    pub zipped: bool,
}

/// The camera's picture source.
pub struct Look(Arc<dyn SourceControls>, Box<dyn Pictures>);

impl Look {
    /// The simulated scene.
    pub(crate) fn at_scene(written: PlaneCamera, read: PlaneCamera) -> Self {
        let (controls, pictures) = source::scene(written, read);
        Self(controls, pictures)
    }

    /// Test pictures of this many rows and columns, see [`test_pixel`], sent as fast as a client receives them.
    pub fn at_test_pictures(size: (usize, usize)) -> Self {
        let (controls, pictures) = source::pattern(size);
        Self(controls, pictures)
    }
}

/// A running camera, which stops when dropped.
pub struct GigeCamera {
    stream: Arc<StreamChannel>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl GigeCamera {
    /// Starts the camera.
    ///
    /// # Errors
    /// When it cannot listen on its address.
    pub fn start(setup: &GigeSetup, look: Look) -> Result<Self, GigeError> {
        let address = SocketAddrV4::new(setup.address, gvcp::PORT);
        let listen = |address| listen(address).map_err(|source| GigeError::Listen { address, source });
        let socket = listen(address)?;
        let broadcast = listen(SocketAddrV4::new(Ipv4Addr::BROADCAST, gvcp::PORT))?;
        let Look(controls, pictures) = look;
        let capabilities = controls.capabilities();
        let out = UdpSocket::bind(SocketAddrV4::new(setup.address, 0))?;
        let pixels = capabilities.width * capabilities.height;
        let stream = Arc::new(StreamChannel::new(out, pixels, setup.clock, setup.faults));
        let features = features::features(&capabilities);
        let description = genicam::describe(&features, &capabilities.model);
        let description = if setup.zipped {
            (genicam::zip(&description)?, "raysweep.zip")
        } else {
            (description.into_bytes(), "raysweep.xml")
        };
        let identity = CameraIdentity {
            address: setup.address,
            model: &capabilities.model,
            serial: &setup.serial,
            tick_frequency_hz: setup.clock.tick_frequency_hz,
            description,
        };
        let registers = Registers::new(features, identity);
        let control = ControlChannel::new(registers, controls.clone(), stream.clone(), stream.wire()?);

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

    /// The current faults.
    pub fn faults(&self) -> Faults {
        *lock(&self.stream.faults)
    }

    /// Changes the faults from now on.
    pub fn set_faults(&self, faults: Faults) {
        *lock(&self.stream.faults) = faults;
    }

    /// Ground truth of what the camera sent, for tests only; real cameras have none.
    pub fn truth(&self) -> WireTruth {
        *lock(&self.stream.truth)
    }
}

impl Drop for GigeCamera {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A panic was already reported on stderr.
            let _ = thread.join();
        }
    }
}

/// Opens a socket that can share a broadcast address with other cameras of this machine.
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

/// Answers datagrams on both `sockets` until `stop`; answers are sent from the first.
fn serve(mut control: ControlChannel, stream: &StreamChannel, sockets: &[UdpSocket; 2], stop: &AtomicBool) {
    use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
    use std::os::fd::AsFd;
    let mut datagram = [0; MAX_DATAGRAM];
    let mut reply = Vec::with_capacity(MAX_DATAGRAM);
    let mut faults = None;
    while !stop.load(Ordering::Relaxed) {
        let mut ready = sockets.each_ref().map(|socket| PollFd::new(socket.as_fd(), PollFlags::POLLIN));
        // An interrupted wait counts as a completed one.
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
    // A lost answer needs no handling: a client that is still there repeats its request.
    let _ = socket.send_to(reply, to);
}
