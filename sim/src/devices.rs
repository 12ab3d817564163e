//! The simulated devices: the traits of `raysweep-core` over one [`Line`] and one clock.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, Clock, ClockHandle, DeviceError, DeviceErrorKind,
    DeviceState, Edge, FirstFrame, FrameBuf, FrameStamp, Pattern, Projector, SettingsId, Shown, Vsync,
    us_from_ns,
};

use crate::gige::Look;
use crate::line::{Exposure, Light, Line, LineTruth};
use crate::rig::Bench;
use crate::sensor::Exposed;

/// The devices of one rig, all on one clock.
pub struct Devices {
    /// The camera.
    pub camera: Box<dyn Camera>,
    /// The watcher of the VSYNC line.
    pub vsync: Box<dyn Vsync>,
    /// The projector; dark at first.
    pub projector: Box<dyn Projector>,
    /// The clock that they live by.
    pub clock: Clock,
    /// What really happens on the line. A real rig has no such thing: it is for tests alone.
    pub truth: TruthProbe,
}

/// The devices of one rig, by the host's clock, with the camera behind a wire.
pub struct WireDevices {
    /// What the camera looks at.
    pub camera: Look,
    /// The watcher of the VSYNC line.
    pub vsync: Box<dyn Vsync>,
    /// The projector; dark at first.
    pub projector: Box<dyn Projector>,
    /// What really happens on the line, for tests alone.
    pub truth: TruthProbe,
}

/// Looks behind the devices, for tests alone.
#[derive(Clone)]
pub struct TruthProbe(SharedLine);

impl TruthProbe {
    /// What has really happened so far.
    pub fn read(&self) -> LineTruth {
        self.0.lock().truth()
    }
}

#[derive(Clone)]
struct SharedLine(Arc<Mutex<Line>>);

impl SharedLine {
    fn lock(&self) -> MutexGuard<'_, Line> {
        // A device that panicked has ended its own thread; the line itself is never left half changed.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until `ready` gives something or `timeout` has passed.
    fn wait<T>(
        &self,
        clock: &ClockHandle,
        timeout: Duration,
        mut ready: impl FnMut(&mut Line, i64) -> Option<T>,
    ) -> Option<T> {
        let deadline_ns =
            clock.now_ns().saturating_add(i64::try_from(timeout.as_nanos()).unwrap_or(i64::MAX));
        loop {
            let now_ns = clock.now_ns();
            let wake_ns = {
                let mut line = self.lock();
                line.advance(now_ns);
                if let Some(found) = ready(&mut line, now_ns) {
                    return Some(found);
                }
                // A frame that is there already wakes nobody: whoever waits is not the one who takes it.
                let frame_ns = line.next_frame_ns().filter(|at_ns| *at_ns > now_ns);
                line.next_event_ns().min(frame_ns.unwrap_or(i64::MAX)).max(now_ns + 1)
            };
            if now_ns >= deadline_ns {
                return None;
            }
            clock.sleep_until(wake_ns.min(deadline_ns));
        }
    }
}

pub fn open(bench: &Arc<Bench>, line: Line, clock: Clock) -> Devices {
    let line = SharedLine(Arc::new(Mutex::new(line)));
    Devices {
        camera: Box::new(SimCamera::new(bench.clone(), line.clone(), clock.register())),
        vsync: Box::new(SimVsync { line: line.clone(), clock: clock.register() }),
        projector: Box::new(SimProjector { bench: bench.clone(), line: line.clone(), clock: clock.clone() }),
        truth: TruthProbe(line),
        clock,
    }
}

/// The devices of [`open`], with two handles of the camera: one writes its settings while the other waits for frames.
pub fn open_for_wire(bench: &Arc<Bench>, line: Line) -> WireDevices {
    let (line, clock) = (SharedLine(Arc::new(Mutex::new(line))), Clock::real());
    let camera = || SimCamera::new(bench.clone(), line.clone(), clock.register());
    WireDevices {
        camera: Look::at_scene(camera(), camera()),
        vsync: Box::new(SimVsync { line: line.clone(), clock: clock.register() }),
        projector: Box::new(SimProjector { bench: bench.clone(), line: line.clone(), clock }),
        truth: TruthProbe(line),
    }
}

pub struct SimCamera {
    bench: Arc<Bench>,
    line: SharedLine,
    clock: ClockHandle,
    capabilities: CameraCapabilities,
    light: Vec<f32>,
    counts: Vec<u16>,
}

impl SimCamera {
    fn new(bench: Arc<Bench>, line: SharedLine, clock: ClockHandle) -> Self {
        let (height, width) = bench.size;
        let capabilities = bench.capabilities();
        Self {
            bench,
            line,
            clock,
            capabilities,
            light: vec![0.0; height * width],
            counts: vec![0; height * width],
        }
    }

    fn error(kind: DeviceErrorKind, what: impl Into<String>) -> DeviceError {
        DeviceError::new("camera", kind, what.into())
    }

    /// The counts of the last exposure, `[t, s]` row-major.
    pub fn counts(&self) -> &[u16] {
        &self.counts
    }

    /// The line that triggers it.
    pub fn with_line<T>(&self, work: impl FnOnce(&mut Line, i64) -> T) -> T {
        let now_ns = self.clock.now_ns();
        work(&mut self.line.lock(), now_ns)
    }

    /// Waits for the next exposure and reads the sensor; the shutter starts at row `first_row` and leaves out those above.
    pub fn next_exposure(&mut self, first_row: usize, timeout: Duration) -> Option<Exposure> {
        let taken = self.line.wait(&self.clock, timeout, |line, now_ns| line.take_frame(now_ns));
        let (exposure, lights) = taken?;
        self.render(&exposure, &lights, first_row);
        Some(exposure)
    }

    /// Integrates the light of an exposure and reads the sensor.
    fn render(&mut self, exposure: &Exposure, lights: &[Light], first_row: usize) {
        let (_, width) = self.bench.size;
        let exposure_us = exposure.settings.exposure_us;
        let ambient = self.bench.ambient(exposure);
        for (t, row) in self.light.chunks_mut(width).enumerate().skip(first_row) {
            row.fill(ambient);
            let row_start_us = self.bench.row_start_us(exposure.settings.shutter, t - first_row);
            for light in lights {
                if let Some(optics) = &light.optics {
                    let from_us = us_from_ns(exposure.start_ns - light.start_ns) + row_start_us;
                    optics.expose_row(t, from_us, from_us + exposure_us, row);
                }
            }
        }
        let exposed = Exposed { light: &mut self.light, exposure_us, key: exposure.key };
        self.bench.sensor.read(exposed, &mut self.counts);
    }
}

impl Camera for SimCamera {
    fn capabilities(&self) -> &CameraCapabilities {
        &self.capabilities
    }

    fn state(&self) -> DeviceState {
        if self.line.lock().is_armed() { DeviceState::Streaming } else { DeviceState::Ready }
    }

    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        let camera = &self.bench.config.camera;
        let stepped = |value: f64, step: f64| if step > 0.0 { (value / step).round() * step } else { value };
        let actual = CameraSettings {
            shutter: settings.shutter,
            exposure_us: stepped(settings.exposure_us, camera.exposure_step_us),
            trigger_delay_us: stepped(settings.trigger_delay_us, camera.delay_step_us),
        };
        if let Err(what) = self.capabilities.allows(&actual) {
            return Err(Self::error(DeviceErrorKind::OutOfRange, what));
        }
        let next_seq = self.line.lock().configure(self.clock.now_ns(), id, actual);
        // As of a real camera, no more is known than how late it may be.
        let first_frame = match u64::from(camera.late_frames_max) {
            0 => FirstFrame::Exactly(next_seq),
            late => FirstFrame::Within { earliest: next_seq, certain: next_seq + late },
        };
        Ok(Applied { actual, first_frame })
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.line.lock().set_armed(self.clock.now_ns(), true);
        Ok(())
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        if !self.line.lock().is_armed() {
            return Err(Self::error(
                DeviceErrorKind::NotReady,
                "next_frame before arm: arm the camera first",
            ));
        }
        let Some(exposure) = self.next_exposure(0, timeout) else { return Ok(None) };
        self.bench
            .format
            .pack_into(&self.counts, buf)
            .map_err(|error| DeviceError::new("camera", DeviceErrorKind::Protocol, error))?;
        Ok(Some(FrameStamp {
            seq: exposure.seq,
            device_ns: exposure.start_ns,
            exposure_start_ns: exposure.start_ns,
            host_ns: exposure.done_ns,
            exposure_us: self.bench.config.camera.chunk_exposure.then_some(exposure.settings.exposure_us),
        }))
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.line.lock().set_armed(self.clock.now_ns(), false);
        Ok(())
    }
}

struct SimVsync {
    line: SharedLine,
    clock: ClockHandle,
}

impl Vsync for SimVsync {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        Ok(self.line.wait(&self.clock, timeout, |line, _| line.take_edge()))
    }
}

struct SimProjector {
    bench: Arc<Bench>,
    line: SharedLine,
    clock: Clock,
}

impl Projector for SimProjector {
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError> {
        let optics = self
            .bench
            .optics_of(pattern)
            .map_err(|error| DeviceError::new("projector", DeviceErrorKind::OutOfRange, error))?;
        Ok(Shown { not_before_ns: self.line.lock().show(self.clock.now_ns(), Some(optics)) })
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        Ok(Shown { not_before_ns: self.line.lock().show(self.clock.now_ns(), None) })
    }
}
