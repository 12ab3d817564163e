//! Cameras of this machine's kernel.

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use raysweep_core::PixelFormat;
use v4l::Device;
use v4l::capability::Flags;
use v4l::context::enum_devices;
use v4l::fraction::Fraction;
use v4l::frameinterval::FrameIntervalEnum;
use v4l::framesize::FrameSizeEnum;
use v4l::video::Capture;

use super::NodeOpener;
use super::controls::Controls;
use super::fourcc;
use super::kernel::Kernel;
use crate::camera::CameraFacts;
use crate::search::permanent;

/// A camera node.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundNode {
    /// The path that stays with the camera, if it has one.
    pub path: PathBuf,
    /// What it offers. Its own controls may delay the trigger; their names do not tell.
    pub facts: CameraFacts,
}

/// The nodes that capture frames in a format that this project unpacks.
pub fn nodes() -> Vec<FoundNode> {
    let mut found: Vec<FoundNode> =
        enum_devices().into_iter().filter_map(|node| facts(node.path())).collect();
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

fn facts(path: &Path) -> Option<FoundNode> {
    let device = Device::with_path(path).ok()?;
    let capabilities = device.query_caps().ok()?;
    if !capabilities.capabilities.contains(Flags::VIDEO_CAPTURE) {
        return None;
    }
    let mut rates_hz = Vec::new();
    let mut formats = Vec::new();
    for found in device.enum_formats().ok()? {
        let known = PixelFormat::all().find(|format| fourcc(*format) == Some(found.fourcc.repr));
        let Some(format) = known else { continue };
        let sizes = device.enum_framesizes(found.fourcc).unwrap_or_default();
        let sizes: Vec<(u32, u32)> = sizes
            .into_iter()
            .map(|size| match size.size {
                FrameSizeEnum::Discrete(size) => (size.height, size.width),
                FrameSizeEnum::Stepwise(size) => (size.max_height, size.max_width),
            })
            .collect();
        for &(rows, columns) in &sizes {
            let intervals = device.enum_frameintervals(found.fourcc, columns, rows).unwrap_or_default();
            rates_hz.extend(intervals.iter().flat_map(|interval| match &interval.interval {
                FrameIntervalEnum::Discrete(time) => vec![rate_hz(time)],
                FrameIntervalEnum::Stepwise(times) => vec![rate_hz(&times.min), rate_hz(&times.max)],
            }));
        }
        formats.push((format, sizes));
    }
    let width = formats.first().and_then(|(_, sizes)| sizes.first()).map_or(0, |(_, columns)| *columns);
    let facts = CameraFacts {
        model: capabilities.card,
        exposure_us: exposure_us(path, width),
        rate_hz: rates_hz
            .iter()
            .copied()
            .reduce(f64::min)
            .zip(rates_hz.iter().copied().reduce(f64::max))
            .map(|(least, most)| least..=most),
        formats,
        ..CameraFacts::default()
    };
    let path = permanent(Path::new("/dev/v4l/by-id"), path.to_owned());
    (!facts.formats.is_empty()).then_some(FoundNode { path, facts })
}

fn rate_hz(time: &Fraction) -> f64 {
    f64::from(time.denominator) / f64::from(time.numerator)
}

/// The exposures by the kernel's control, if its unit is known: that of a sensor is rows.
fn exposure_us(path: &Path, width: u32) -> Option<RangeInclusive<f64>> {
    let node = Kernel.open(path).ok()?;
    let controls = Controls::of(node.as_ref()).ok()?;
    let row_time_us = controls.row_time_us(node.as_ref(), width).ok()?;
    let range = controls.exposure(None, row_time_us.unwrap_or(f64::NAN)).ok()?.range_us();
    range.end().is_finite().then_some(range)
}
