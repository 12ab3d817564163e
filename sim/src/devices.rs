//! Simulated devices: the traits of `raysweep-core` over one [`VsyncLine`] and one clock.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, Clock, ClockHandle, DeviceError, DeviceErrorKind,
    DeviceState, Edge, FirstFrame, FrameBuf, FrameStamp, Pattern, Projector, SettingsId, Shown, Subject,
    Vsync, ns_from_us, us_from_ns,
};

use crate::error::SimError;
use crate::line::{Exposure, Light, LineTruth, TriggeredBy, VsyncLine};
use crate::sensor::SensorExposure;
use crate::subject::{SubjectSwitch, not_there};
use crate::world::PlaneWorld;

/// The devices of one rig, sharing one clock.
pub struct PlaneDevices {
    /// The camera.
    pub camera: Box<dyn Camera>,
    /// The VSYNC monitor.
    pub vsync: Box<dyn Vsync>,
    /// The projector, initially dark.
    pub projector: Box<dyn Projector>,
    /// Changes what stands before the camera, initially the scene.
    pub subject: SubjectSwitch,
    /// The devices' clock.
    pub clock: Clock,
    /// The line behind them, with its ground truth.
    pub truth: TruthProbe,
}

impl PlaneDevices {
    /// Lets the camera run freely, at this rate, instead of by the edges of the line.
    pub fn free_run(&self, rate_hz: f64) {
        let triggered_by = TriggeredBy::FreeRun { period_ns: ns_from_us(1e6 / rate_hz) };
        self.truth.0.lock().set_triggered_by(self.clock.now_ns(), triggered_by);
    }
}

/// The line behind the devices; its ground truth is for tests only.
#[derive(Clone)]
pub struct TruthProbe(SharedLine);

impl TruthProbe {
    /// Ground truth so far.
    pub fn read(&self) -> LineTruth {
        self.0.lock().truth()
    }
}

#[derive(Clone)]
struct SharedLine(Arc<Mutex<VsyncLine>>);

impl SharedLine {
    fn lock(&self) -> MutexGuard<'_, VsyncLine> {
        // A panic in a device ends only that device's thread; the line is never left half changed.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until `ready` returns a value or `timeout` has passed.
    fn wait<T>(
        &self,
        clock: &ClockHandle,
        timeout: Duration,
        mut ready: impl FnMut(&mut VsyncLine, i64) -> Option<T>,
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
                // A frame that has already arrived wakes nobody: the waiting thread is not the one that takes it.
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

pub fn open(world: &Arc<PlaneWorld>, line: VsyncLine, clock: Clock) -> PlaneDevices {
    let line = SharedLine(Arc::new(Mutex::new(line)));
    PlaneDevices {
        camera: Box::new(PlaneCamera::new(world.clone(), line.clone(), clock.register())),
        vsync: Box::new(SimVsync { line: line.clone(), clock: clock.register() }),
        projector: Box::new(SimProjector { world: world.clone(), line: line.clone(), clock: clock.clone() }),
        subject: subject_switch(world.clone(), line.clone(), clock.clone()),
        truth: TruthProbe(line),
        clock,
    }
}

/// Scene, board and cap before the camera.
fn subject_switch(world: Arc<PlaneWorld>, line: SharedLine, clock: Clock) -> SubjectSwitch {
    SubjectSwitch::new(move |subject| {
        if matches!(subject, Subject::Plane(_) | Subject::Diffuser) {
            return Err(not_there(format!("{subject}: a plane rig has the scene, a board and a cap")));
        }
        let shown = line.lock().all_shown();
        for shown in shown {
            world.prepare(&shown, subject).map_err(refusal)?;
        }
        line.lock().place(clock.now_ns(), subject);
        Ok(())
    })
}

/// The error of a pattern that cannot be simulated.
fn refusal(error: SimError) -> DeviceError {
    let kind = match error {
        SimError::AlongRows | SimError::Picture => DeviceErrorKind::Unsupported,
        _ => DeviceErrorKind::OutOfRange,
    };
    DeviceError::new("projector", kind, error)
}

/// All devices of a rig but its camera.
pub struct BenchDevices {
    /// The VSYNC monitor.
    pub vsync: Box<dyn Vsync>,
    /// The projector, initially dark.
    pub projector: Box<dyn Projector>,
    /// What is in front of the camera, initially the scene.
    pub subject: SubjectSwitch,
    /// Ground truth of the line, for tests only.
    pub truth: TruthProbe,
}

/// The devices on the host's clock, with two handles to the camera: one writes settings while the other
/// waits for frames.
pub type Shared = ([PlaneCamera; 2], BenchDevices);

/// The devices of [`open`] on the host's clock.
pub fn open_shared(world: &Arc<PlaneWorld>, line: VsyncLine) -> Shared {
    let (line, clock) = (SharedLine(Arc::new(Mutex::new(line))), Clock::real());
    let camera = || PlaneCamera::new(world.clone(), line.clone(), clock.register());
    let cameras = [camera(), camera()];
    let vsync = Box::new(SimVsync { line: line.clone(), clock: clock.register() });
    let projector = Box::new(SimProjector { world: world.clone(), line: line.clone(), clock: clock.clone() });
    let subject = subject_switch(world.clone(), line.clone(), clock);
    (cameras, BenchDevices { vsync, projector, subject, truth: TruthProbe(line) })
}

pub struct PlaneCamera {
    world: Arc<PlaneWorld>,
    line: SharedLine,
    clock: ClockHandle,
    capabilities: CameraCapabilities,
    light: Vec<f32>,
    counts: Vec<u16>,
}

impl PlaneCamera {
    fn new(world: Arc<PlaneWorld>, line: SharedLine, clock: ClockHandle) -> Self {
        let (height, width) = world.size;
        let capabilities = world.capabilities();
        Self {
            world,
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

    /// Calls `work` with the line that triggers the camera, and the current time.
    pub fn with_line<T>(&self, work: impl FnOnce(&mut VsyncLine, i64) -> T) -> T {
        let now_ns = self.clock.now_ns();
        work(&mut self.line.lock(), now_ns)
    }

    /// Waits for the next exposure and reads the sensor; the shutter starts at row `first_row` and skips the rows
    /// above.
    pub fn next_exposure(&mut self, first_row: usize, timeout: Duration) -> Option<Exposure> {
        let taken = self.line.wait(&self.clock, timeout, |line, now_ns| line.take_frame(now_ns));
        let (exposure, lights) = taken?;
        self.render(&exposure, &lights, first_row);
        Some(exposure)
    }

    /// Integrates the light of an exposure and reads the sensor.
    fn render(&mut self, exposure: &Exposure, lights: &[Light], first_row: usize) {
        let (_, width) = self.world.size;
        let exposure_us = exposure.settings.exposure_us;
        let subject = exposure.subject;
        // The light as the projector's lens lets it pass now, with the times at which it begins.
        let lights: Vec<_> = lights
            .iter()
            .filter_map(|light| {
                let optics = self.world.optics(light.shown.as_ref()?, subject)?;
                Some((light, optics))
            })
            .collect();
        for (t, row) in self.light.chunks_mut(width).enumerate().skip(first_row) {
            let row_start_us = self.world.row_start_us(exposure.settings.shutter, t - first_row);
            let is_capped = subject == Subject::Cap;
            row.fill(if is_capped { 0.0 } else { self.world.ambient(exposure, row_start_us) });
            for (light, optics) in &lights {
                let from_us = us_from_ns(exposure.start_ns - light.start_ns) + row_start_us;
                optics[light.key % optics.len()].expose_row(t, from_us, from_us + exposure_us, row);
            }
        }
        if let (_, Some(disc)) = self.world.camera_lens.now() {
            disc.blur(&mut self.light, width);
        }
        let exposed = SensorExposure { light: &mut self.light, exposure_us, key: exposure.key };
        self.world.sensor.read(exposed, &mut self.counts);
    }
}

impl Camera for PlaneCamera {
    fn capabilities(&self) -> &CameraCapabilities {
        &self.capabilities
    }

    fn state(&self) -> DeviceState {
        if self.line.lock().is_armed() { DeviceState::Streaming } else { DeviceState::Ready }
    }

    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        let camera = &self.world.config.camera;
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
        // As with a real camera, only the maximum lateness is known.
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
        self.world
            .format
            .pack_into(&self.counts, buf)
            .map_err(|error| DeviceError::new("camera", DeviceErrorKind::Protocol, error))?;
        Ok(Some(FrameStamp {
            seq: exposure.seq,
            device_ns: exposure.stamped_ns,
            exposure_start_ns: exposure.stamped_ns,
            host_ns: exposure.done_ns,
            exposure_us: self.world.config.camera.chunk_exposure.then_some(exposure.settings.exposure_us),
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
    world: Arc<PlaneWorld>,
    line: SharedLine,
    clock: Clock,
}

impl Projector for SimProjector {
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError> {
        let subject = self.line.lock().subject();
        let shown = self.world.show(pattern, subject).map_err(refusal)?;
        Ok(Shown { not_before_ns: self.line.lock().show(self.clock.now_ns(), Some(shown)) })
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        Ok(Shown { not_before_ns: self.line.lock().show(self.clock.now_ns(), None) })
    }
}
