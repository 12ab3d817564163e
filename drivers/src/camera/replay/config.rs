//! `[camera.replay]`: which recording, and how fast it comes.

use std::path::PathBuf;

use serde::Deserialize;

/// `[camera.replay]`
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReplayConfig {
    /// A file of raw frames one after the other, an `.npy` file `[frames, rows, columns]`, or a folder of such files or
    /// of PNG pictures, taken by name with numbers in their order.
    pub path: PathBuf,
    /// Columns of raw frames; other files say it themselves.
    pub width: Option<usize>,
    /// Rows of raw frames.
    pub height: Option<usize>,
    /// Bytes at the beginning of each raw file that are no frame.
    #[serde(default)]
    pub header_bytes: u64,
    /// How pixels lie in raw files, where that is none of the camera's pixel formats.
    #[serde(default)]
    pub packing: RawPacking,
    /// How fast frames come.
    #[serde(default)]
    pub pace: ReplayPace,
}

/// How pixels lie in raw files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RawPacking {
    /// As the pixel format says.
    #[default]
    PixelFormat,
    /// Two 12-bit pixels in three bytes, most significant bits first, as in Photron's `.mraw`.
    Mraw12,
}

/// How fast frames come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ReplayPace {
    /// As fast as they are taken.
    #[default]
    Pipeline,
    /// As fast as they were recorded, whether there is room or not.
    Recorded,
}
