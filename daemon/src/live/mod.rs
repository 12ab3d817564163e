//! The live view: a running estimate of the transport, in a file that clients map.
//!
//! Nothing here is part of the measurement: slowness or failure costs live images, never a frame or a bit of the
//! results.

mod estimate;
mod file;
mod reader;

use std::io;
use std::path::PathBuf;

use raysweep_core::io_text;

pub(crate) use estimate::{LiveEstimate, Outlet};
pub use file::LiveFile;
pub use reader::{LiveImage, LiveReader};

/// Name of the image of a sweep's epipolar light.
pub const EPIPOLAR: &str = "epipolar";
/// Name of the image of the light from all other rows.
pub const INDIRECT: &str = "indirect";
/// Name of the image of all light.
pub const TOTAL: &str = "total";

/// Name of the image of a flying dot's newest batch.
pub const FLOODLIT: &str = "floodlit";

/// Name of the picture of the viewfinder.
pub const VIEWFINDER: &str = "viewfinder";

/// Why there are no live images.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// The file cannot be created.
    #[error("cannot create {}: {}; its folder must exist and be writable, or choose another --live", path.display(), io_text(source))]
    Make {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// An operation on the file failed.
    #[error("cannot {what} {}: {}", path.display(), io_text(source))]
    Io {
        /// The operation.
        what: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// Another daemon writes the file.
    #[error("another raysweepd writes {}: stop it, or choose another --live", .0.display())]
    Taken(PathBuf),
    /// The path exists, but is not a live file.
    #[error("{} is not a live file: {why}", path.display())]
    NotLive {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// An image that does not fit into the file.
    #[error("live image {name:?}: {why}")]
    Refused {
        /// Name of the image.
        name: String,
        /// What is wrong and what is allowed.
        why: String,
    },
    /// The writer overwrote the image during every attempt to read it.
    #[error("{} changed during every attempt to read it: try again", .0.display())]
    Outrun(PathBuf),
}

impl LiveError {
    fn io(what: &'static str, path: &std::path::Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { what, path, source }
    }
}
