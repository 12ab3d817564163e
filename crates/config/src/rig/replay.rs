//! `[camera.replay]`: the recording and its playback speed.

use std::path::PathBuf;

use serde::Deserialize;

/// `[camera.replay]`
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReplayConfig {
    /// A file of consecutive raw frames, an `.npy` file `[frames, rows, columns]`, or a folder of such files or PNG
    /// pictures, sorted by name with numbers in numeric order.
    pub path: PathBuf,
    /// Columns of raw frames; other formats contain their size.
    pub width: Option<usize>,
    /// Rows of raw frames.
    pub height: Option<usize>,
    /// Bytes at the beginning of each raw file to skip.
    #[serde(default)]
    pub header_bytes: u64,
    /// Packing of pixels in raw files, if it differs from the pixel format.
    #[serde(default)]
    pub packing: RawPacking,
    /// Playback speed.
    #[serde(default)]
    pub pace: ReplayPace,
}

/// Packing of pixels in raw files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RawPacking {
    /// As in the pixel format.
    #[default]
    PixelFormat,
    /// Two 12-bit pixels in three bytes, most significant bits first, as in Photron's `.mraw`.
    Mraw12,
}

/// Playback speed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ReplayPace {
    /// As fast as the frames are taken.
    #[default]
    Pipeline,
    /// As fast as they were recorded, even if there is no room for them.
    Recorded,
}
