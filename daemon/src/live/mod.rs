//! The live view: a running estimate of the transport, in a file that clients map.
//!
//! Nothing here is part of the measurement: what is slow or fails costs pictures, never a frame or a bit of the results.

mod estimate;
mod file;
mod reader;

use std::io;
use std::path::PathBuf;

pub(crate) use estimate::{LiveEstimate, Outlet};
pub use file::LiveFile;
pub use reader::{LiveImage, LiveReader};

/// Names of the images that a sweep's estimate is shown by.
pub const EPIPOLAR: &str = "epipolar";
/// Light from all other rows.
pub const INDIRECT: &str = "indirect";
/// All light.
pub const TOTAL: &str = "total";

/// Name of the image that a flying dot's newest batch is shown by.
pub const FLOODLIT: &str = "floodlit";

/// Why there are no live images.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// The system refused to make it.
    #[error("cannot make {}: {source}; its folder must exist and be writable, or choose another --live", path.display())]
    Make {
        /// Where.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The system refused.
    #[error("cannot {what} {}: {source}", path.display())]
    Io {
        /// What was tried.
        what: &'static str,
        /// With which file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Another daemon writes there.
    #[error("another raysweepd writes {}: stop it, or choose another --live", .0.display())]
    Taken(PathBuf),
    /// Something else is there.
    #[error("{} is no live file: {why}", path.display())]
    NotLive {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// An image that has no place in the file.
    #[error("live image {name:?}: {why}")]
    Refused {
        /// Its name.
        name: String,
        /// What is wrong, what is allowed.
        why: String,
    },
    /// The writer was always ahead.
    #[error("{} was written too often to be read: try again", .0.display())]
    Outrun(PathBuf),
}

impl LiveError {
    fn io(what: &'static str, path: &std::path::Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { what, path, source }
    }
}
