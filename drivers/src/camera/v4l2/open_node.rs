//! One opening of a node: from the path to mapped buffers, with all settings of the rig file.

use std::io;

use nix::libc::ENOTTY;
use raysweep_core::{CameraCapabilities, CameraSettings, DeviceError, DeviceErrorKind, PixelFormat, Shutter};

use super::controls::{ControlError, Controls, TimedControl};
use super::node::{FLAG_ERROR, Filled, Format, Identity, Node, NodeOpener};
use super::setup::V4l2Setup;
use super::{error, fourcc, kernel_error, kernel_error_at};

/// Maximum relative deviation of row times, the same as elsewhere between camera and projector.
const ROW_TIME_TOLERANCE: f64 = 0.01;
/// Maximum relative deviation of frame rates due to rounding.
const FRAME_RATE_TOLERANCE: f64 = 1e-3;

/// Layout of a frame in a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    row_bytes: usize,
    /// Bytes from one row to the next.
    stride: usize,
    rows: usize,
}

impl Layout {
    /// Bytes of a frame without gaps between rows.
    pub(super) fn frame_bytes(&self) -> usize {
        self.row_bytes * self.rows
    }

    /// Bytes of a buffer up to its last pixel.
    fn reach(&self) -> usize {
        self.stride * (self.rows - 1) + self.row_bytes
    }
}

/// An open node, ready to stream.
pub(super) struct OpenNode {
    pub(super) node: Box<dyn Node>,
    identity: Identity,
    layout: Layout,
    buffers: u32,
    row_time_us: f64,
    exposure: TimedControl,
    trigger_delay: Option<TimedControl>,
}

impl OpenNode {
    pub(super) fn open(opener: &mut dyn NodeOpener, setup: &V4l2Setup) -> Result<Box<Self>, DeviceError> {
        let config = &setup.config;
        let at = |cause| kernel_error_at(&config.device.display().to_string(), cause);
        let mut node = opener.open(&config.device).map_err(at)?;
        let identity = node.identity().map_err(at)?;
        if !identity.captures {
            let what = format!(
                "camera.v4l2.device = {}: {} ({}) does not capture video into single-planar mapped buffers; take the node that does (v4l2-ctl --list-devices)",
                config.device.display(),
                identity.card,
                identity.driver
            );
            return Err(error(DeviceErrorKind::Unsupported, what));
        }
        let layout = set_format(node.as_mut(), setup)?;
        if let Some(wanted) = config.frames_per_s {
            set_frame_rate(node.as_mut(), wanted)?;
        }

        let controls = Controls::of(node.as_ref()).map_err(at)?;
        for (name, value) in &config.controls {
            controls.write(node.as_mut(), name, *value).map_err(control_error)?;
        }
        let derived_us = controls.row_time_us(node.as_ref(), config.width).map_err(at)?;
        let row_time_us = derived_us.unwrap_or(setup.row_time_us);
        if (row_time_us - setup.row_time_us).abs() > ROW_TIME_TOLERANCE * setup.row_time_us {
            let what = format!(
                "the camera's rows take {row_time_us:.3} us, by its horizontal_blanking and pixel_rate, and camera.row_time_us asks for {:.3}: set horizontal_blanking among camera.v4l2.controls so that they agree, or correct camera.row_time_us",
                setup.row_time_us
            );
            return Err(error(DeviceErrorKind::OutOfRange, what));
        }
        // Ranges may depend on the controls written before.
        let controls = Controls::of(node.as_ref()).map_err(at)?;
        let exposure = controls.exposure(config.exposure.as_ref(), row_time_us).map_err(control_error)?;
        let trigger_delay = controls.trigger_delay(config.trigger_delay.as_ref()).map_err(control_error)?;
        let buffers = node.map_buffers(config.buffers).map_err(at)?;
        if buffers < 2 {
            let what = format!(
                "camera.v4l2.buffers = {}: the camera's driver gives {buffers}, and two are needed: another program may hold its memory",
                config.buffers
            );
            return Err(error(DeviceErrorKind::Busy, what));
        }
        Ok(Box::new(Self { node, identity, layout, buffers, row_time_us, exposure, trigger_delay }))
    }

    pub(super) fn layout(&self) -> Layout {
        self.layout
    }

    pub(super) fn capabilities(&self, setup: &V4l2Setup) -> CameraCapabilities {
        let config = &setup.config;
        CameraCapabilities {
            model: format!("{} ({})", self.identity.card, self.identity.driver),
            width: config.width as usize,
            height: config.height as usize,
            format: setup.format,
            row_time_us: self.row_time_us,
            trigger_latency_us: config.trigger_latency_us,
            readout_us: f64::from(config.height) * self.row_time_us,
            readout: config.readout,
            exposure_us: self.exposure.range_us(),
            trigger_delay_us: self.trigger_delay.as_ref().map_or(0.0..=0.0, TimedControl::range_us),
        }
    }

    /// The present settings of the camera.
    pub(super) fn settings(&self) -> io::Result<CameraSettings> {
        let delay = self.trigger_delay.as_ref();
        Ok(CameraSettings {
            shutter: Shutter::Rolling,
            exposure_us: self.exposure.read_us(self.node.as_ref())?,
            trigger_delay_us: delay.map_or(Ok(0.0), |delay| delay.read_us(self.node.as_ref()))?,
        })
    }

    /// The nearest settings that the camera supports.
    pub(super) fn nearest(&self, settings: &CameraSettings) -> CameraSettings {
        let delay = self.trigger_delay.as_ref();
        CameraSettings {
            shutter: settings.shutter,
            exposure_us: self.exposure.nearest_us(settings.exposure_us),
            trigger_delay_us: delay.map_or(0.0, |delay| delay.nearest_us(settings.trigger_delay_us)),
        }
    }

    /// Writes settings and returns those that the camera applied.
    pub(super) fn write(&mut self, settings: &CameraSettings) -> io::Result<CameraSettings> {
        let node = self.node.as_mut();
        let exposure_us = self.exposure.write_us(node, settings.exposure_us)?;
        let delay = self.trigger_delay.as_ref();
        let trigger_delay_us =
            delay.map_or(Ok(0.0), |delay| delay.write_us(node, settings.trigger_delay_us))?;
        Ok(CameraSettings { shutter: settings.shutter, exposure_us, trigger_delay_us })
    }

    /// Passes all buffers to the driver and starts.
    pub(super) fn start(&mut self) -> io::Result<()> {
        let queued = (0..self.buffers).try_for_each(|index| self.node.queue(index));
        queued.and_then(|()| self.node.start()).inspect_err(|_| {
            // Takes the buffers back. If this fails too, the first error is more useful.
            let _ = self.node.stop();
        })
    }

    /// Copies a frame from its buffer, without gaps between rows; returns `false` if it is damaged.
    pub(super) fn copy(&self, filled: &Filled, into: &mut [u8]) -> io::Result<bool> {
        let Layout { row_bytes, stride, .. } = self.layout;
        if filled.flags & FLAG_ERROR != 0 || (filled.bytes_used as usize) < self.layout.reach() {
            return Ok(false);
        }
        if stride == row_bytes {
            self.node.copy(filled.index, 0, into)?;
        } else {
            for (row, into) in into.chunks_exact_mut(row_bytes).enumerate() {
                self.node.copy(filled.index, row * stride, into)?;
            }
        }
        Ok(true)
    }
}

fn set_format(node: &mut dyn Node, setup: &V4l2Setup) -> Result<Layout, DeviceError> {
    let (width, height) = (setup.config.width, setup.config.height);
    let Some(fourcc) = fourcc(setup.format) else {
        let names: Vec<String> =
            PixelFormat::all().filter(|f| super::fourcc(*f).is_some()).map(|f| f.to_string()).collect();
        let what = format!(
            "camera.pixel_format = {}: V4L2 has no such format; it has {}",
            setup.format,
            names.join(", ")
        );
        return Err(error(DeviceErrorKind::Unsupported, what));
    };
    let row_bytes = setup.format.frame_bytes(width as usize);
    if row_bytes * 8 != width as usize * setup.format.packing.occupied_bits() as usize {
        let what = format!(
            "camera.v4l2.width = {width}: a row of {} must end with a whole group of pixels; take a multiple of 4",
            setup.format
        );
        return Err(error(DeviceErrorKind::OutOfRange, what));
    }
    let wanted = Format { fourcc, width, height, bytes_per_line: 0 };
    let found = node.set_format(wanted).map_err(kernel_error)?;
    let stride = if found.bytes_per_line == 0 { row_bytes } else { found.bytes_per_line as usize };
    if (Format { bytes_per_line: 0, ..found }) != wanted || stride < row_bytes {
        let what = format!(
            "camera.v4l2: {} x {} pixels of {} ({}) were asked for, the driver makes it {} x {} of {}: v4l2-ctl --list-formats-ext shows what there is",
            width,
            height,
            setup.format,
            fourcc.escape_ascii(),
            found.width,
            found.height,
            found.fourcc.escape_ascii()
        );
        return Err(error(DeviceErrorKind::OutOfRange, what));
    }
    Ok(Layout { row_bytes, stride, rows: height as usize })
}

/// Drivers silently use the nearest rate that they support.
fn set_frame_rate(node: &mut dyn Node, wanted: f64) -> Result<(), DeviceError> {
    let found = node.set_frame_rate(wanted).map_err(|cause| match cause.raw_os_error() {
        Some(ENOTTY) => error(
            DeviceErrorKind::Unsupported,
            format!("camera.v4l2.frames_per_s = {wanted}: the rate cannot be set; leave the key out"),
        ),
        _ => kernel_error(cause),
    })?;
    if (found - wanted).abs() <= FRAME_RATE_TOLERANCE * wanted {
        return Ok(());
    }
    let what = format!(
        "camera.v4l2.frames_per_s = {wanted}: the driver makes it {found:.3} at this size and format"
    );
    Err(error(DeviceErrorKind::OutOfRange, what))
}

fn control_error(cause: ControlError) -> DeviceError {
    match cause {
        ControlError::Value(what) => error(DeviceErrorKind::OutOfRange, what),
        ControlError::Kernel(what, cause) => kernel_error_at(&what, cause),
    }
}
