//! Cameras of this machine's kernel.

use std::path::PathBuf;

use raysweep_core::PixelFormat;
use v4l::Device;
use v4l::capability::Flags;
use v4l::context::enum_devices;
use v4l::framesize::FrameSizeEnum;
use v4l::video::Capture;

use super::fourcc;

/// A camera node.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundNode {
    /// Its path.
    pub path: PathBuf,
    /// What its driver calls it.
    pub card: String,
    /// Its formats that this project unpacks, each with the sizes (width, height) that it names.
    pub formats: Vec<(PixelFormat, Vec<(u32, u32)>)>,
}

/// The nodes that capture frames in a format that this project unpacks.
pub fn nodes() -> Vec<FoundNode> {
    let mut found: Vec<FoundNode> =
        enum_devices().into_iter().filter_map(|node| facts(node.path())).collect();
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

fn facts(path: &std::path::Path) -> Option<FoundNode> {
    let device = Device::with_path(path).ok()?;
    let capabilities = device.query_caps().ok()?;
    if !capabilities.capabilities.contains(Flags::VIDEO_CAPTURE) {
        return None;
    }
    let formats: Vec<_> = device
        .enum_formats()
        .ok()?
        .into_iter()
        .filter_map(|found| {
            let format = PixelFormat::all().find(|format| fourcc(*format) == Some(found.fourcc.repr))?;
            let sizes = device.enum_framesizes(found.fourcc).unwrap_or_default();
            let sizes = sizes.into_iter().map(|size| match size.size {
                FrameSizeEnum::Discrete(size) => (size.width, size.height),
                FrameSizeEnum::Stepwise(size) => (size.max_width, size.max_height),
            });
            Some((format, sizes.collect()))
        })
        .collect();
    (!formats.is_empty()).then(|| FoundNode { path: path.to_owned(), card: capabilities.card, formats })
}
