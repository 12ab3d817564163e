//! Panics in the threads of a dot rig: whichever it is, the mirror is parked, which turns its light off.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use raysweep::Probes;
use raysweep::rig::DotDevices;
use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, DeviceError, DeviceState, FrameBuf, FrameStamp,
    Mirror, MirrorCapabilities, MirrorPath, MirrorProgress, SettingsId,
};
use raysweep_tests::Bench;
use raysweep_tests::dots::{plan, rig};

/// The call in which a thread panics: of the camera's, the mirror's, or the run's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Call {
    NextFrame,
    Feed,
    Start,
}

/// What devices under test share.
struct Shared {
    panics: Call,
    /// Such calls on a lit path until they panic.
    calls_left: AtomicU32,
    is_mended: AtomicBool,
    is_lit: AtomicBool,
    /// What has been asked of the mirror, feeding left out.
    asked: Mutex<Vec<&'static str>>,
}

impl Shared {
    fn called(&self, call: Call) {
        if call == self.panics
            && self.is_lit.load(Ordering::Relaxed)
            && !self.is_mended.load(Ordering::Relaxed)
        {
            let left = self.calls_left.load(Ordering::Relaxed);
            self.calls_left.store(left.saturating_sub(1), Ordering::Relaxed);
            assert_ne!(left, 0, "as planned");
        }
    }

    fn asked(&self, what: &'static str) {
        self.asked.lock().unwrap().push(what);
    }
}

/// A device and what it shares with the others.
struct Watched<D>(D, Arc<Shared>);

impl Mirror for Watched<Box<dyn Mirror>> {
    fn capabilities(&self) -> &MirrorCapabilities {
        self.0.capabilities()
    }

    fn load(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        self.1.asked("load");
        self.1.is_lit.store(path.is_lit(), Ordering::Relaxed);
        self.0.load(path)
    }

    fn start(&mut self, batches: u32) -> Result<(), DeviceError> {
        self.1.asked("start");
        self.1.called(Call::Start);
        self.0.start(batches)
    }

    fn feed(&mut self) -> Result<MirrorProgress, DeviceError> {
        self.1.called(Call::Feed);
        self.0.feed()
    }

    fn park(&mut self) -> Result<(), DeviceError> {
        self.0.park()?;
        self.1.asked("park");
        Ok(())
    }
}

impl Camera for Watched<Box<dyn Camera>> {
    fn capabilities(&self) -> &CameraCapabilities {
        self.0.capabilities()
    }

    fn state(&self) -> DeviceState {
        self.0.state()
    }

    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        self.0.configure(id, settings)
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.0.arm()
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        // Read first, as a virtual clock stops if nobody reads the camera.
        let frame = self.0.next_frame(buf, timeout);
        self.1.called(Call::NextFrame);
        frame
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.0.disarm()
    }
}

/// A run in which a thread panics after some such calls on a lit path is faulted, with the mirror parked; the next run
/// of the same daemon is complete.
fn panics_and_goes_on(call: Call, calls: u32) {
    let shared = Arc::new(Shared {
        panics: call,
        calls_left: AtomicU32::new(calls),
        is_mended: AtomicBool::new(false),
        is_lit: AtomicBool::new(false),
        asked: Mutex::default(),
    });
    let watched = shared.clone();
    let instead = move |mut devices: DotDevices| {
        let mirror = devices.mirror.take().map(|mirror| Watched(mirror, watched.clone()));
        devices.mirror = mirror.map(|mirror| Box::new(mirror) as Box<dyn Mirror>);
        devices.camera = Box::new(Watched(devices.camera, watched.clone()));
        devices
    };
    let bench = Bench::dots_with_probes(
        &rig(""),
        Probes { dot_devices: Some(Arc::new(instead)), ..Probes::default() },
    );
    let plan = plan("product = [{ kind = \"floodlit\" }]", 2);
    let faulted = bench.run(&plan);
    assert_eq!(faulted.state, "faulted", "{call:?}");
    let (_, state) = faulted.open();
    let stored = state.batches().count();
    println!("{call:?}: {:?}; {stored} of 6 batches stored", faulted.error);
    assert!(faulted.error.unwrap().contains("panicked"), "{call:?}");
    assert!(stored < 6, "{call:?}: {stored}");
    let asked = std::mem::take(&mut *shared.asked.lock().unwrap());
    assert_eq!(asked.last(), Some(&"park"), "{call:?}: {asked:?}");
    shared.is_mended.store(true, Ordering::Relaxed);
    assert_eq!(bench.run(&plan).state, "complete", "{call:?}");
}

#[test]
fn a_panic_of_a_dot_camera_s_thread_parks_the_mirror() {
    panics_and_goes_on(Call::NextFrame, 700);
}

#[test]
fn a_panic_of_the_mirror_s_thread_parks_the_mirror() {
    panics_and_goes_on(Call::Feed, 20);
}

#[test]
fn a_panic_before_the_mirror_plays_parks_the_mirror() {
    panics_and_goes_on(Call::Start, 2);
}
