//! Picture sources of the camera: the simulated scene, or precomputed test pictures.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use raysweep_core::{
    Camera, CameraCapabilities, CameraSettings, Clock, ClockHandle, DeviceError, PixelFormat, Readout,
    SettingsId,
};

use super::gvsp::{FrameLayout, SentBlock};
use super::locks::lock;
use crate::devices::PlaneCamera;
use crate::line::VsyncLine;
pub use crate::line::{Sets, TriggeredBy};

/// Number of pictures kept for resend requests; test pictures repeat with this period.
pub const BLOCKS: usize = 16;

/// The control side of a source, used by the thread of the control protocol.
pub trait SourceControls: Send + Sync {
    /// Capabilities of the camera.
    fn capabilities(&self) -> CameraCapabilities;
    /// Applies settings; returns the actual values.
    ///
    /// # Errors
    /// `OutOfRange`; the old settings then remain.
    fn configure(&self, settings: &CameraSettings) -> Result<CameraSettings, DeviceError>;
    /// Steps through sets from `first` on, one per frame, until [`SourceControls::configure`].
    fn set_sequence(&self, sets: Sets, first: usize);
    /// The set of the newest frame, while a sequence is running.
    fn active_set(&self) -> Option<usize>;
    /// Selects what starts exposures.
    fn set_triggered_by(&self, triggered_by: TriggeredBy);
    /// Responds to triggers from now on; returns the number of the next exposure.
    fn arm(&self) -> u64;
    /// Stops responding to triggers.
    fn disarm(&self);
    /// Triggers by software.
    fn fire(&self);
    /// Sets how many frames after a change still use the old settings; `None`: as configured.
    fn set_late_frames(&self, frames: Option<u32>);
}

/// One exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExposedPicture {
    /// Its number; all exposures are counted.
    pub seq: u64,
    /// Start of row 0's exposure on the host's clock.
    pub start_ns: i64,
    /// Exposure time of each row.
    pub exposure_us: f64,
    /// Active sequencer set; 0 while the sequencer is off.
    pub set: u64,
}

/// The picture side of a source, used by the sending thread.
pub trait Pictures: Send {
    /// Waits for the next exposure; exposure starts with the first row of the region.
    fn wait(&mut self, view: &FrameLayout, timeout: Duration) -> Option<ExposedPicture>;
    /// Writes the pixels of the last exposure; `block` is the one at `seq` modulo [`BLOCKS`].
    fn write(&mut self, exposed: &ExposedPicture, block: &mut SentBlock);
}

/// Control side of the simulated scene.
struct SceneControls {
    camera: Mutex<PlaneCamera>,
    /// Number of settings written so far, which keys noise in place of a sweep's points.
    written: AtomicU32,
}

struct ScenePictures {
    camera: PlaneCamera,
    region: Vec<u16>,
}

/// Control and picture side of the simulated scene, from two handles to its camera.
pub fn scene(written: PlaneCamera, read: PlaneCamera) -> (Arc<dyn SourceControls>, Box<dyn Pictures>) {
    let region = Vec::with_capacity(read.counts().len());
    (
        Arc::new(SceneControls { camera: Mutex::new(written), written: AtomicU32::new(0) }),
        Box::new(ScenePictures { camera: read, region }),
    )
}

impl SceneControls {
    fn with_line<T>(&self, work: impl FnOnce(&mut VsyncLine, i64) -> T) -> T {
        lock(&self.camera).with_line(work)
    }
}

impl SourceControls for SceneControls {
    fn capabilities(&self) -> CameraCapabilities {
        lock(&self.camera).capabilities().clone()
    }

    fn configure(&self, settings: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        let attempt = self.written.fetch_add(1, Ordering::Relaxed);
        let applied = lock(&self.camera).configure(SettingsId { point: 0, attempt }, settings)?;
        Ok(applied.actual)
    }

    fn set_sequence(&self, sets: Sets, first: usize) {
        self.with_line(|line, now_ns| line.set_sequence(now_ns, sets, first));
    }

    fn active_set(&self) -> Option<usize> {
        self.with_line(|line, now_ns| line.active_set(now_ns))
    }

    fn set_triggered_by(&self, triggered_by: TriggeredBy) {
        self.with_line(|line, now_ns| line.set_triggered_by(now_ns, triggered_by));
    }

    fn arm(&self) -> u64 {
        self.with_line(|line, now_ns| {
            line.set_armed(now_ns, true);
            line.next_seq()
        })
    }

    fn disarm(&self) {
        self.with_line(|line, now_ns| line.set_armed(now_ns, false));
    }

    fn fire(&self) {
        self.with_line(|line, now_ns| line.fire(now_ns));
    }

    fn set_late_frames(&self, frames: Option<u32>) {
        self.with_line(|line, _| line.set_late_frames(frames));
    }
}

impl Pictures for ScenePictures {
    fn wait(&mut self, view: &FrameLayout, timeout: Duration) -> Option<ExposedPicture> {
        let exposure = self.camera.next_exposure(view.y, timeout)?;
        let (seq, start_ns) = (exposure.seq, exposure.stamped_ns);
        // Sequencer sets are keyed by their index; other settings have point 0.
        let [set, ..] = exposure.key;
        Some(ExposedPicture { seq, start_ns, exposure_us: exposure.settings.exposure_us, set })
    }

    fn write(&mut self, _: &ExposedPicture, block: &mut SentBlock) {
        let view = block.view;
        // The converter has the bits of the rig's format; other formats keep the upper bits or set the lower ones to 0.
        let (from, to) = (self.camera.capabilities().format.bits(), view.format.bits());
        self.region.clear();
        for row in
            self.camera.counts().chunks(self.camera.capabilities().width).skip(view.y).take(view.height)
        {
            let pixels = row[view.x..view.x + view.width].iter();
            self.region.extend(
                pixels.map(|&count| if to < from { count >> (from - to) } else { count << (to - from) }),
            );
        }
        pack(view.format, &self.region, block);
    }
}

fn pack(format: PixelFormat, pixels: &[u16], block: &mut SentBlock) {
    // The block has room for exactly its own view.
    let packed = format.pack_into(pixels, block.image_mut());
    debug_assert!(packed.is_ok(), "{packed:?}");
}

/// Test pictures: nothing is simulated, so that benchmarks measure only the receiver.
struct Pattern {
    size: (usize, usize),
    state: Mutex<PatternState>,
    changed: Condvar,
    clock: Clock,
}

struct PatternState {
    settings: CameraSettings,
    triggered_by: TriggeredBy,
    armed: bool,
    next_seq: u64,
    next_free_ns: i64,
    fired: u64,
}

struct PatternPictures {
    pattern: Arc<Pattern>,
    clock: ClockHandle,
    /// View of the picture that each block already contains.
    made: [Option<FrameLayout>; BLOCKS],
    pixels: Vec<u16>,
}

/// Pixel value of test picture `picture`: a diagonal ramp that moves by 16 per picture.
pub fn test_pixel(x: usize, y: usize, picture: usize, format: PixelFormat) -> u16 {
    ((x + y + 16 * picture) as u16) & format.max_value()
}

/// Control and picture side of a camera of `size` (rows, columns) that sends test pictures.
pub fn pattern(size: (usize, usize)) -> (Arc<dyn SourceControls>, Box<dyn Pictures>) {
    let clock = Clock::real();
    let idle = CameraSettings {
        shutter: raysweep_core::Shutter::Rolling,
        exposure_us: 1000.0,
        trigger_delay_us: 0.0,
    };
    let state = PatternState {
        settings: idle,
        triggered_by: TriggeredBy::Software,
        armed: false,
        next_seq: 0,
        next_free_ns: 0,
        fired: 0,
    };
    let handle = clock.register();
    let pattern = Arc::new(Pattern { size, state: Mutex::new(state), changed: Condvar::new(), clock });
    let pictures = PatternPictures {
        pattern: pattern.clone(),
        clock: handle,
        made: [None; BLOCKS],
        pixels: Vec::with_capacity(size.0 * size.1),
    };
    (pattern, Box::new(pictures))
}

impl SourceControls for Pattern {
    fn capabilities(&self) -> CameraCapabilities {
        let (height, width) = self.size;
        CameraCapabilities {
            model: "raysweep test picture".into(),
            width,
            height,
            format: PixelFormat::Mono8,
            row_time_us: 0.0,
            trigger_latency_us: 0.0,
            readout_us: 0.0,
            readout: Readout::Overlapped,
            exposure_us: 1.0..=1e6,
            trigger_delay_us: 0.0..=16e6,
        }
    }

    fn configure(&self, settings: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        lock(&self.state).settings = *settings;
        Ok(*settings)
    }

    fn set_sequence(&self, _: Sets, _: usize) {
        // Test pictures do not depend on settings.
    }

    fn active_set(&self) -> Option<usize> {
        None
    }

    fn set_triggered_by(&self, triggered_by: TriggeredBy) {
        let mut state = lock(&self.state);
        state.triggered_by = triggered_by;
        state.next_free_ns = self.clock.now_ns();
        self.changed.notify_all();
    }

    fn arm(&self) -> u64 {
        let mut state = lock(&self.state);
        (state.armed, state.fired, state.next_free_ns) = (true, 0, self.clock.now_ns());
        self.changed.notify_all();
        state.next_seq
    }

    fn disarm(&self) {
        lock(&self.state).armed = false;
    }

    fn fire(&self) {
        let mut state = lock(&self.state);
        state.fired += u64::from(state.armed && state.triggered_by == TriggeredBy::Software);
        self.changed.notify_all();
    }

    fn set_late_frames(&self, _: Option<u32>) {
        // Test pictures do not depend on settings, so none can be late.
    }
}

impl PatternState {
    /// Start time of the next exposure, if any.
    fn due_ns(&self, now_ns: i64) -> Option<i64> {
        match self.triggered_by {
            _ if !self.armed => None,
            TriggeredBy::FreeRun { .. } => Some(self.next_free_ns),
            TriggeredBy::Software if self.fired > 0 => Some(now_ns),
            TriggeredBy::Software | TriggeredBy::Edges => None,
        }
    }
}

impl Pictures for PatternPictures {
    fn wait(&mut self, _: &FrameLayout, timeout: Duration) -> Option<ExposedPicture> {
        let mut state = lock(&self.pattern.state);
        let now_ns = self.clock.now_ns();
        let Some(due_ns) = state.due_ns(now_ns) else {
            // The next call handles whatever has changed by then.
            drop(self.pattern.changed.wait_timeout(state, timeout));
            return None;
        };
        if due_ns > now_ns {
            drop(state);
            let latest_ns = now_ns.saturating_add(timeout.as_nanos() as i64);
            self.clock.sleep_until(due_ns.min(latest_ns));
            if due_ns > latest_ns {
                return None;
            }
            state = lock(&self.pattern.state);
        }
        if let TriggeredBy::FreeRun { period_ns } = state.triggered_by {
            // Do not catch up with a burst after a delay of the host.
            state.next_free_ns = (due_ns + period_ns).max(now_ns - period_ns);
        }
        state.fired = state.fired.saturating_sub(1);
        let seq = state.next_seq;
        state.next_seq += 1;
        Some(ExposedPicture { seq, start_ns: due_ns, exposure_us: state.settings.exposure_us, set: 0 })
    }

    fn write(&mut self, exposed: &ExposedPicture, block: &mut SentBlock) {
        let slot = (exposed.seq % BLOCKS as u64) as usize;
        let view = FrameLayout { chunks: None, ..block.view };
        if self.made[slot] == Some(view) {
            return;
        }
        self.made[slot] = Some(view);
        self.pixels.clear();
        for y in view.y..view.y + view.height {
            self.pixels.extend((view.x..view.x + view.width).map(|x| test_pixel(x, y, slot, view.format)));
        }
        pack(view.format, &self.pixels, block);
    }
}
