//! The simulated high-speed camera: global shutter, one frame per trigger.

use std::sync::Arc;
use std::time::Duration;

use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, ClockHandle, DeviceError, DeviceErrorKind,
    DeviceState, FirstFrame, FrameBuf, FrameStamp, Readout, SettingsId, Shutter, Subject,
};

use super::scene::{SpotImages, Still};
use super::world::{Due, FrameFate, Next, World, even_light};
use crate::sensor::SensorExposure;

/// Standard deviation of the trailing dot, as a fraction of the margin's rows.
const TRAILING_SIGMA: f64 = 0.15;
/// Light at which every pixel is overexposed.
const FLASH: f32 = 100.0;

pub struct DotCamera {
    world: Arc<World>,
    clock: ClockHandle,
    capabilities: CameraCapabilities,
    exposure_us: f64,
    before: Option<Before>,
    light: SpotImages,
    /// Light of the whole sensor, `[row, column]` row-major; `counts` has the same layout.
    sensor_light: Vec<f32>,
    counts: Vec<u16>,
    /// The trailing dot's image in the margin.
    trailing: Vec<f32>,
    /// Stamp of the last frame, if it is to be delivered a second time.
    again: Option<FrameStamp>,
}

/// The scene or plane in front of the camera during one batch.
struct Before {
    still: Arc<dyn Still>,
    /// Subject, path and batch.
    key: (Subject, u64, u64),
}

impl DotCamera {
    pub fn new(world: Arc<World>, clock: ClockHandle) -> Self {
        let bench = &world.bench;
        let ((height, width), margin) = (bench.size, bench.config.margin_rows);
        let period_us = 1e6 / world.frame_rate_hz;
        let capabilities = CameraCapabilities {
            model: "raysweep simulated high-speed camera".into(),
            width,
            height,
            format: bench.setup.format,
            row_time_us: 0.0,
            trigger_latency_us: 0.0,
            readout_us: 0.0,
            readout: Readout::Overlapped,
            exposure_us: 0.1..=period_us,
            trigger_delay_us: 0.0..=0.0,
        };
        let trailing = (0..margin * width)
            .map(|pixel| {
                let (row, column) = ((pixel / width) as f64, (pixel % width) as f64);
                let square =
                    (row + 0.5 - margin as f64 / 2.0).powi(2) + (column + 0.5 - width as f64 / 2.0).powi(2);
                (-0.5 * square / (TRAILING_SIGMA * margin as f64).powi(2)).exp() as f32
            })
            .collect();
        Self {
            clock,
            capabilities,
            exposure_us: period_us,
            before: None,
            light: world.dark(),
            sensor_light: vec![0.0; height * width],
            counts: vec![0; height * width],
            trailing,
            again: None,
            world,
        }
    }

    fn error(kind: DeviceErrorKind, what: impl Into<String>) -> DeviceError {
        DeviceError::new("camera", kind, what.into())
    }

    fn expose(&mut self, due: &Due) {
        let [scan, frame] = due.key;
        let key = (due.subject, scan, due.batch);
        if self.before.as_ref().is_none_or(|before| before.key != key) {
            let still = self.world.still_in(due.subject, due.batch);
            self.before = still.map(|still| Before { still, key });
        }
        self.light.direct.fill(0.0);
        self.light.global.fill(0.0);
        let mut trailing = 0.0;
        if let Some(Before { still, .. }) = &self.before {
            trailing = self.world.render(&due.lit, self.exposure_us, &**still, &mut self.light);
        }
        let SpotImages { direct, global } = &self.light;
        let (scene, margin) = self.sensor_light.split_at_mut(direct.len());
        scene
            .iter_mut()
            .zip(direct.iter().zip(global))
            .for_each(|(sum, (direct, global))| *sum = direct + global);
        margin.iter_mut().zip(&self.trailing).for_each(|(sum, light)| *sum = light * trailing as f32);
        if let Some(even) = even_light(due.subject) {
            self.sensor_light.fill(even);
        }
        if due.fate == FrameFate::Saturated {
            self.sensor_light.fill(FLASH);
        }
        let light = &mut self.sensor_light;
        let exposed = SensorExposure { light, exposure_us: self.exposure_us, key: [scan, frame, 0] };
        self.world.bench.sensor.read(exposed, &mut self.counts);
    }

    fn pack(&self, buf: &mut FrameBuf) -> Result<(), DeviceError> {
        self.capabilities
            .format
            .pack_into(&self.counts, buf)
            .map_err(|error| DeviceError::new("camera", DeviceErrorKind::Protocol, error))
    }
}

impl Camera for DotCamera {
    fn capabilities(&self) -> &CameraCapabilities {
        &self.capabilities
    }

    fn state(&self) -> DeviceState {
        if self.world.is_armed() { DeviceState::Streaming } else { DeviceState::Ready }
    }

    fn configure(&mut self, _: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        let actual = CameraSettings { shutter: Shutter::Global, ..*settings };
        self.capabilities.allows(&actual).map_err(|what| Self::error(DeviceErrorKind::OutOfRange, what))?;
        self.exposure_us = actual.exposure_us;
        Ok(Applied { actual, first_frame: FirstFrame::Exactly(self.world.next_seq()) })
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.world.set_armed(true);
        Ok(())
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        if !self.world.is_armed() {
            let what = "next_frame before arm: arm the camera first";
            return Err(Self::error(DeviceErrorKind::NotReady, what));
        }
        if let Some(stamp) = self.again.take() {
            self.pack(buf)?;
            return Ok(Some(stamp));
        }
        let timeout_ns = i64::try_from(timeout.as_nanos()).unwrap_or(i64::MAX);
        let deadline_ns = self.clock.now_ns().saturating_add(timeout_ns);
        loop {
            let now_ns = self.clock.now_ns();
            let wake_ns = match self.world.next(now_ns, self.exposure_us) {
                Next::Frame(due) => {
                    self.expose(&due);
                    self.pack(buf)?;
                    let stamp = FrameStamp {
                        seq: due.seq,
                        device_ns: due.start_ns,
                        exposure_start_ns: due.start_ns,
                        host_ns: due.done_ns,
                        exposure_us: Some(self.exposure_us),
                    };
                    self.again = (due.fate == FrameFate::Duplicated).then_some(stamp);
                    return Ok(Some(stamp));
                }
                Next::At(due_ns) => due_ns,
                // A path can be started at any time.
                Next::Nothing => now_ns.saturating_add(IDLE_NS),
            };
            if now_ns >= deadline_ns {
                return Ok(None);
            }
            self.clock.sleep_until(wake_ns.min(deadline_ns));
        }
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.again = None;
        self.world.set_armed(false);
        Ok(())
    }
}

/// Poll interval of a camera without triggers.
const IDLE_NS: i64 = 1_000_000;
