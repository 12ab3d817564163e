//! The simulated devices: the traits of `raysweep-core` over one [`Line`] and one clock.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, Clock, ClockHandle, DeviceError, DeviceErrorKind,
    Edge, FirstFrame, FrameBuf, FrameStamp, Pattern, Projector, SettingsId, Shown, Vsync, us_from_ns,
};

use crate::line::{Exposure, Light, Line, LineTruth, TriggeredBy};
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
                line.next_event_ns().min(line.next_frame_ns().unwrap_or(i64::MAX)).max(now_ns + 1)
            };
            if now_ns >= deadline_ns {
                return None;
            }
            clock.sleep_until(wake_ns.min(deadline_ns));
        }
    }
}

pub fn open(bench: &Arc<Bench>, line: Line, clock: Clock) -> Devices {
    let (camera, vsync, projector, truth) = open_parts(bench, line, &clock);
    Devices { camera: Box::new(camera), vsync: Box::new(vsync), projector: Box::new(projector), truth, clock }
}

/// The devices of [`open`] by their own types.
pub fn open_parts(
    bench: &Arc<Bench>,
    line: Line,
    clock: &Clock,
) -> (SimCamera, SimVsync, SimProjector, TruthProbe) {
    let line = SharedLine(Arc::new(Mutex::new(line)));
    let control = CameraControl { bench: bench.clone(), line: line.clone(), clock: clock.clone() };
    (
        SimCamera::new(control, clock.register()),
        SimVsync { line: line.clone(), clock: clock.register() },
        SimProjector { bench: bench.clone(), line: line.clone(), clock: clock.clone() },
        TruthProbe(line),
    )
}

/// What is written to the camera, from whichever thread.
#[derive(Clone)]
pub struct CameraControl {
    bench: Arc<Bench>,
    line: SharedLine,
    clock: Clock,
}

impl CameraControl {
    fn error(kind: DeviceErrorKind, what: impl Into<String>) -> DeviceError {
        DeviceError::new("camera", kind, what.into())
    }

    pub fn capabilities(&self) -> CameraCapabilities {
        self.bench.capabilities()
    }

    pub fn configure(&self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        let camera = &self.bench.config.camera;
        let stepped = |value: f64, step: f64| if step > 0.0 { (value / step).round() * step } else { value };
        let actual = CameraSettings {
            shutter: settings.shutter,
            exposure_us: stepped(settings.exposure_us, camera.exposure_step_us),
            trigger_delay_us: stepped(settings.trigger_delay_us, camera.delay_step_us),
        };
        if let Err(what) = self.capabilities().allows(&actual) {
            return Err(Self::error(DeviceErrorKind::OutOfRange, what));
        }
        let next_seq = self.line.lock().configure(self.clock.now_ns(), id, actual);
        let certain = next_seq + u64::from(camera.late_frames_max);
        let first_frame = if camera.late_frames_min == camera.late_frames_max {
            FirstFrame::Exactly(certain)
        } else {
            FirstFrame::Within(certain)
        };
        Ok(Applied { actual, first_frame })
    }

    pub fn set_armed(&self, armed: bool) {
        self.line.lock().set_armed(self.clock.now_ns(), armed);
    }

    pub fn set_triggered_by(&self, triggered_by: TriggeredBy) {
        self.line.lock().set_triggered_by(self.clock.now_ns(), triggered_by);
    }

    /// Triggers by command; whether the camera answered.
    pub fn fire(&self) -> bool {
        self.line.lock().fire(self.clock.now_ns())
    }

    /// The number of the next exposure.
    pub fn next_seq(&self) -> u64 {
        self.line.lock().next_seq()
    }

    pub fn set_late_frames(&self, frames: Option<u32>) {
        self.line.lock().set_late_frames(frames);
    }
}

pub struct SimCamera {
    control: CameraControl,
    clock: ClockHandle,
    capabilities: CameraCapabilities,
    light: Vec<f32>,
    counts: Vec<u16>,
}

impl SimCamera {
    fn new(control: CameraControl, clock: ClockHandle) -> Self {
        let capabilities = control.capabilities();
        let pixels = capabilities.height * capabilities.width;
        Self { control, clock, capabilities, light: vec![0.0; pixels], counts: vec![0; pixels] }
    }

    pub fn control(&self) -> CameraControl {
        self.control.clone()
    }

    /// The counts of the last exposure that was waited for, `[t, s]` row-major.
    pub fn counts(&self) -> &[u16] {
        &self.counts
    }

    /// Waits for the next exposure and reads the sensor; its shutter starts at row `first_row` and leaves out those
    /// above.
    pub fn next_exposure(&mut self, first_row: usize, timeout: Duration) -> Option<Exposure> {
        let taken = self.control.line.wait(&self.clock, timeout, |line, now_ns| line.take_frame(now_ns));
        let (exposure, lights) = taken?;
        self.render(&exposure, &lights, first_row);
        Some(exposure)
    }

    /// Integrates the light of an exposure and reads the sensor.
    fn render(&mut self, exposure: &Exposure, lights: &[Light], first_row: usize) {
        let bench = &self.control.bench;
        let (_, width) = bench.size;
        let exposure_us = exposure.settings.exposure_us;
        let ambient = bench.ambient(exposure);
        for (t, row) in self.light.chunks_mut(width).enumerate().skip(first_row) {
            row.fill(ambient);
            let row_start_us = bench.row_start_us(exposure.settings.shutter, t - first_row);
            for light in lights {
                if let Some(optics) = &light.optics {
                    let from_us = us_from_ns(exposure.start_ns - light.start_ns) + row_start_us;
                    optics.expose_row(t, from_us, from_us + exposure_us, row);
                }
            }
        }
        let exposed = Exposed { light: &mut self.light, exposure_us, key: exposure.key };
        bench.sensor.read(exposed, &mut self.counts);
    }
}

impl Camera for SimCamera {
    fn capabilities(&self) -> &CameraCapabilities {
        &self.capabilities
    }

    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        self.control.configure(id, settings)
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.control.set_armed(true);
        Ok(())
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        if !self.control.line.lock().is_armed() {
            return Err(CameraControl::error(
                DeviceErrorKind::NotReady,
                "next_frame before arm: arm the camera first",
            ));
        }
        let Some(exposure) = self.next_exposure(0, timeout) else { return Ok(None) };
        let bench = &self.control.bench;
        bench
            .format
            .pack_into(&self.counts, buf)
            .map_err(|error| DeviceError::new("camera", DeviceErrorKind::Protocol, error))?;
        Ok(Some(FrameStamp {
            seq: exposure.seq,
            device_ns: exposure.start_ns,
            exposure_start_ns: exposure.start_ns,
            host_ns: exposure.done_ns,
            exposure_us: bench.config.camera.chunk_exposure.then_some(exposure.settings.exposure_us),
        }))
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.control.set_armed(false);
        Ok(())
    }
}

pub struct SimVsync {
    line: SharedLine,
    clock: ClockHandle,
}

impl Vsync for SimVsync {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        Ok(self.line.wait(&self.clock, timeout, |line, _| line.take_edge()))
    }
}

pub struct SimProjector {
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
