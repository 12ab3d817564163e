//! Where the camera's pictures come from: the simulated scene, or test pictures made in advance.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use raysweep_core::{
    Camera, CameraCapabilities, CameraSettings, Clock, ClockHandle, DeviceError, PixelFormat, Readout,
    SettingsId,
};

use super::gvsp::{Block, View};
use super::lock;
use crate::devices::SimCamera;
use crate::line::Line;
pub use crate::line::{Sets, TriggeredBy};

/// Pictures that are kept for clients that miss packets; test pictures repeat after as many.
pub const BLOCKS: usize = 16;

/// What a client's writes do, from the thread of the control protocol.
pub trait Controls: Send + Sync {
    /// What the camera is.
    fn capabilities(&self) -> CameraCapabilities;
    /// Takes settings; returns what the sensor made of them.
    ///
    /// # Errors
    /// `OutOfRange`; the old settings then stay.
    fn configure(&self, settings: &CameraSettings) -> Result<CameraSettings, DeviceError>;
    /// Takes frames through settings from the set `first` on, until [`Controls::configure`].
    fn set_sequence(&self, sets: Sets, first: usize);
    /// The set of the newest frame, while frames go through some.
    fn active_set(&self) -> Option<usize>;
    /// Chooses what starts exposures.
    fn set_triggered_by(&self, triggered_by: TriggeredBy);
    /// Triggers are answered from now on; returns the number of the next exposure.
    fn arm(&self) -> u64;
    /// No further trigger is answered.
    fn disarm(&self);
    /// Triggers by command.
    fn fire(&self);
    /// How many frames still have the old settings after a change; `None`: as configured.
    fn set_late_frames(&self, frames: Option<u32>);
}

/// One exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exposed {
    /// Its number; counts every exposure.
    pub seq: u64,
    /// Start of row 0's exposure on the host's clock.
    pub start_ns: i64,
    /// How long each row was exposed.
    pub exposure_us: f64,
    /// The sequencer's set; 0 while it is off.
    pub set: u64,
}

/// Pictures, from the thread that sends them.
pub trait Pictures: Send {
    /// Waits for the next exposure; a region's rows begin to be exposed with its first.
    fn wait(&mut self, view: &View, timeout: Duration) -> Option<Exposed>;
    /// Writes the last one's pixels; `slot` is `seq` modulo [`BLOCKS`], and so is the block.
    fn write(&mut self, exposed: &Exposed, block: &mut Block);
}

/// The simulated scene behind the wire.
struct SceneControls {
    camera: Mutex<SimCamera>,
    /// Settings written so far: what noise is keyed by, in the place of a sweep's points.
    written: AtomicU32,
}

struct ScenePictures {
    camera: SimCamera,
    region: Vec<u16>,
}

/// Both sides of the simulated scene, from two handles of its camera.
pub fn scene(written: SimCamera, read: SimCamera) -> (Arc<dyn Controls>, Box<dyn Pictures>) {
    let region = Vec::with_capacity(read.counts().len());
    (
        Arc::new(SceneControls { camera: Mutex::new(written), written: AtomicU32::new(0) }),
        Box::new(ScenePictures { camera: read, region }),
    )
}

impl SceneControls {
    fn with_line<T>(&self, work: impl FnOnce(&mut Line, i64) -> T) -> T {
        lock(&self.camera).with_line(work)
    }
}

impl Controls for SceneControls {
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
    fn wait(&mut self, view: &View, timeout: Duration) -> Option<Exposed> {
        let exposure = self.camera.next_exposure(view.y, timeout)?;
        let (seq, start_ns) = (exposure.seq, exposure.start_ns);
        // Sets are keyed by their number, other settings as point 0.
        let [set, ..] = exposure.key;
        Some(Exposed { seq, start_ns, exposure_us: exposure.settings.exposure_us, set })
    }

    fn write(&mut self, _: &Exposed, block: &mut Block) {
        let view = block.view;
        // The converter's bits are the rig's format's; another format keeps the upper ones, or leaves the lower ones 0.
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

fn pack(format: PixelFormat, pixels: &[u16], block: &mut Block) {
    // The block has room for exactly its view.
    let packed = format.pack_into(pixels, block.image_mut());
    debug_assert!(packed.is_ok(), "{packed:?}");
}

/// Test pictures: nothing is simulated, so that whoever receives them is what is measured.
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
    /// What each block holds already.
    made: [Option<View>; BLOCKS],
    pixels: Vec<u16>,
}

/// The value of a pixel of test picture `picture`: a diagonal ramp that moves by 16 a picture.
pub fn test_pixel(x: usize, y: usize, picture: usize, format: PixelFormat) -> u16 {
    ((x + y + 16 * picture) as u16) & format.max_value()
}

/// Both sides of a camera of `size` (rows, columns) that sends test pictures.
pub fn pattern(size: (usize, usize)) -> (Arc<dyn Controls>, Box<dyn Pictures>) {
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

impl Controls for Pattern {
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
        // A test picture shows no settings, whichever set they are of.
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
        // A test picture shows no settings, so none can be late.
    }
}

impl PatternState {
    /// When the next exposure starts, if one does.
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
    fn wait(&mut self, _: &View, timeout: Duration) -> Option<Exposed> {
        let mut state = lock(&self.pattern.state);
        let now_ns = self.clock.now_ns();
        let Some(due_ns) = state.due_ns(now_ns) else {
            // What there is after the wait, the next call finds.
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
            // A host that was busy elsewhere is not made up for by a burst.
            state.next_free_ns = (due_ns + period_ns).max(now_ns - period_ns);
        }
        state.fired = state.fired.saturating_sub(1);
        let seq = state.next_seq;
        state.next_seq += 1;
        Some(Exposed { seq, start_ns: due_ns, exposure_us: state.settings.exposure_us, set: 0 })
    }

    fn write(&mut self, exposed: &Exposed, block: &mut Block) {
        let slot = (exposed.seq % BLOCKS as u64) as usize;
        let view = View { chunks: None, ..block.view };
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
