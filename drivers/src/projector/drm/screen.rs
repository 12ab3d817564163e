//! A display output with two buffers.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use drm::Device as _;
use drm::buffer::{Buffer as _, DrmFourcc};
use drm::control::dumbbuffer::DumbBuffer;
use drm::control::{Device as _, Event, PageFlipFlags, connector, crtc, framebuffer};
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use raysweep_core::{DeviceError, DeviceErrorKind};

use super::{DEVICE, DrmConfig, Timing};

/// A flip takes at most two video frames; an output that takes this long is stuck.
const FLIP_LIMIT: Duration = Duration::from_secs(1);

/// Errors of the display output.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{}: cannot {call}: {source}", card.display())]
    System { card: PathBuf, call: &'static str, source: io::Error },
    #[error("{}: another program draws on this card: stop the desktop (systemctl isolate multi-user.target)", .0.display())]
    Busy(PathBuf),
    #[error("{}: no output `{name}`; it has {known}", card.display())]
    NoSuchOutput { card: PathBuf, name: String, known: String },
    #[error("{}: no output reports a display: name one as `connector`; it has {known}", card.display())]
    NoDisplay { card: PathBuf, known: String },
    #[error("{}: {connector} can be driven by no part of the card", card.display())]
    NoCrtc { card: PathBuf, connector: String },
    #[error("{}: {connector} does not take the timing {timing:?}: {source}", card.display())]
    Timing { card: PathBuf, connector: String, timing: Timing, source: io::Error },
    #[error("{}: a flip was not done within {FLIP_LIMIT:?}", .0.display())]
    Stuck(PathBuf),
}

impl Error {
    /// Converts to a device error of a kind that a caller can act on.
    pub fn into_device_error(self) -> DeviceError {
        let kind = match &self {
            Self::System { source, .. } => match source.kind() {
                io::ErrorKind::PermissionDenied => DeviceErrorKind::NotReady,
                io::ErrorKind::Unsupported => DeviceErrorKind::Unsupported,
                _ => DeviceErrorKind::Disconnected,
            },
            Self::Busy(_) => DeviceErrorKind::Busy,
            Self::NoSuchOutput { .. } | Self::NoDisplay { .. } => DeviceErrorKind::Disconnected,
            Self::NoCrtc { .. } | Self::Timing { .. } => DeviceErrorKind::Unsupported,
            Self::Stuck(_) => DeviceErrorKind::Timeout,
        };
        DeviceError::new(DEVICE, kind, self)
    }
}

/// The card; the traits of the crate `drm` provide the functions.
struct Card {
    path: PathBuf,
    file: File,
}

impl AsFd for Card {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

impl drm::Device for Card {}
impl drm::control::Device for Card {}

impl Card {
    fn open(path: &Path) -> Result<Self, Error> {
        let file = OpenOptions::new().read(true).write(true).open(path);
        let system = |call| move |source| Error::System { card: path.to_owned(), call, source };
        let card = Self { path: path.to_owned(), file: file.map_err(system("open it"))? };
        card.acquire_master_lock().map_err(|source| match source.raw_os_error().map(Errno::from_raw) {
            Some(Errno::EBUSY | Errno::EACCES) => Error::Busy(card.path.clone()),
            Some(Errno::ENOTTY | Errno::EINVAL) => {
                let source = io::Error::new(io::ErrorKind::Unsupported, "not a graphics card with outputs");
                Error::System { card: card.path.clone(), call: "draw on it", source }
            }
            _ => Error::System { card: card.path.clone(), call: "become its master", source },
        })?;
        Ok(card)
    }

    fn failed(&self, call: &'static str) -> impl FnOnce(io::Error) -> Error {
        let card = self.path.clone();
        move |source| Error::System { card, call, source }
    }

    /// The named output, or the first with a display.
    fn connector(&self, name: Option<&str>) -> Result<connector::Info, Error> {
        let handles = self.resource_handles().map_err(self.failed("list its outputs"))?;
        let outputs = handles.connectors().iter().map(|&handle| self.get_connector(handle, true));
        let outputs: Vec<connector::Info> =
            outputs.collect::<io::Result<_>>().map_err(self.failed("look at its outputs"))?;
        let known = || outputs.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        let chosen = outputs.iter().find(|output| match name {
            Some(name) => output.to_string() == name,
            None => output.state() == connector::State::Connected,
        });
        chosen.cloned().ok_or_else(|| match name {
            Some(name) => {
                Error::NoSuchOutput { card: self.path.clone(), name: name.to_owned(), known: known() }
            }
            None => Error::NoDisplay { card: self.path.clone(), known: known() },
        })
    }

    /// Finds a CRTC of the card that can drive this output.
    fn crtc(&self, output: &connector::Info) -> Result<crtc::Handle, Error> {
        let handles = self.resource_handles().map_err(self.failed("list its outputs"))?;
        let encoders = output.encoders().iter().filter_map(|&encoder| self.get_encoder(encoder).ok());
        let mut crtcs = encoders.flat_map(|encoder| handles.filter_crtcs(encoder.possible_crtcs()));
        crtcs.next().ok_or_else(|| Error::NoCrtc { card: self.path.clone(), connector: output.to_string() })
    }

    /// Makes codes proportional to light levels: replaces gamma tables left by desktops.
    fn set_linear_gamma(&self, crtc: crtc::Handle) -> Result<(), Error> {
        let entries = self.get_crtc(crtc).map_err(self.failed("look at its gamma table"))?.gamma_length();
        if entries < 2 {
            return Ok(());
        }
        let ramp: Vec<u16> =
            (0..entries).map(|k| (u64::from(k) * 0xffff / u64::from(entries - 1)) as u16).collect();
        self.set_gamma(crtc, &ramp, &ramp, &ramp).map_err(self.failed("set its gamma table"))
    }

    fn new_buffer(&self, (columns, rows): (u16, u16)) -> Result<Buffer, Error> {
        let size = (u32::from(columns), u32::from(rows));
        let memory = self.create_dumb_buffer(size, DrmFourcc::Xrgb8888, 32);
        let memory = memory.map_err(self.failed("make a buffer"))?;
        let shown = self.add_framebuffer(&memory, 24, 32).map_err(self.failed("make a buffer to show"))?;
        Ok(Buffer { memory, shown })
    }
}

struct Buffer {
    memory: DumbBuffer,
    shown: framebuffer::Handle,
}

/// An output of a card, driven with a forced timing. The kernel releases everything when the card is closed.
pub struct Screen {
    card: Card,
    crtc: crtc::Handle,
    size: (usize, usize),
    front: Buffer,
    back: Buffer,
}

impl Screen {
    /// Takes control of the output and shows black.
    pub fn open(config: &DrmConfig) -> Result<Self, Error> {
        let card = Card::open(&config.card)?;
        let output = card.connector(config.connector.as_deref())?;
        let crtc = card.crtc(&output)?;
        let mode = config.timing.mode();
        // New buffers are zero, which is black.
        let (front, back) = (card.new_buffer(mode.size())?, card.new_buffer(mode.size())?);
        card.set_crtc(crtc, Some(front.shown), (0, 0), &[output.handle()], Some(mode)).map_err(|source| {
            let (card, connector) = (card.path.clone(), output.to_string());
            Error::Timing { card, connector, timing: config.timing, source }
        })?;
        card.set_linear_gamma(crtc)?;
        let (columns, rows) = mode.size();
        Ok(Self { card, crtc, size: (columns.into(), rows.into()), front, back })
    }

    /// Number of columns and rows.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Shows a picture of [`Screen::size`], row by row; returns the time of the flip on the kernel's
    /// monotonic clock.
    pub fn flip(&mut self, picture: &[[u8; 3]]) -> Result<i64, Error> {
        let pitch = self.back.memory.pitch() as usize;
        {
            let mapping = self.card.map_dumb_buffer(&mut self.back.memory);
            let mut mapping = mapping.map_err(self.card.failed("map a buffer"))?;
            for (line, row) in mapping.chunks_exact_mut(pitch).zip(picture.chunks_exact(self.size.0)) {
                for (pixel, &[red, green, blue]) in line.as_chunks_mut::<4>().0.iter_mut().zip(row) {
                    *pixel = [blue, green, red, 0];
                }
            }
        }
        self.card
            .page_flip(self.crtc, self.back.shown, PageFlipFlags::EVENT, None)
            .map_err(self.card.failed("flip"))?;
        let flipped_ns = self.wait_for_flip()?;
        std::mem::swap(&mut self.front, &mut self.back);
        Ok(flipped_ns)
    }

    fn wait_for_flip(&self) -> Result<i64, Error> {
        let deadline = Instant::now() + FLIP_LIMIT;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(Error::Stuck(self.card.path.clone()));
            }
            let mut ready = [PollFd::new(self.card.as_fd(), PollFlags::POLLIN)];
            match poll(&mut ready, PollTimeout::try_from(left).unwrap_or(PollTimeout::MAX)) {
                Ok(0) | Err(Errno::EINTR) => continue,
                Ok(_) => {}
                Err(errno) => return Err(self.card.failed("wait for a flip")(errno.into())),
            }
            let mut events = self.card.receive_events().map_err(self.card.failed("read its events"))?;
            let flip = events.find_map(|event| match event {
                Event::PageFlip(flip) => Some(flip.duration.as_nanos() as i64),
                _ => None,
            });
            if let Some(flipped_ns) = flip {
                return Ok(flipped_ns);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_card_is_refused() {
        let open = |card: &str| {
            let config =
                DrmConfig { card: card.into(), connector: None, timing: Timing::HD_720P60, settle_frames: 2 };
            Screen::open(&config).err().unwrap().into_device_error()
        };
        let (missing, other) = (open("/dev/dri/card-none"), open("/dev/null"));
        assert_eq!(missing.kind, DeviceErrorKind::Disconnected, "{missing}");
        assert_eq!(other.kind, DeviceErrorKind::Unsupported, "{other}");
    }
}
