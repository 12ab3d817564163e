//! Simulated rigs whose devices and disk can be made to fail.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use raysweep::control::Control;
use raysweep::rig::{AnyRig, Devices, DotDevices};
use raysweep::{Probes, Runner};
use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, DeviceError, DeviceErrorKind, DeviceState, Edge,
    FrameBuf, FrameStamp, Mirror, MirrorCapabilities, MirrorPath, MirrorProgress, Pattern, Projector,
    SettingsId, Shown, Vsync,
};
use tempfile::TempDir;

const PLANE: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                     [projector]\ndriver = \"sim\"\nrows = 8\n\
                     [sim]\nscene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\nseed = 11\n";
const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
                    [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n";

/// Plans of the plane rig: long enough for requests in their middle, and one that ends at once.
pub const PLANS: [&str; 5] = [
    "kind = \"sweep\"\n[sweep]\naverage = 150\ndelay_us = [-60, 0, 60]\nexposure_us = [50, 100, 150]\n",
    "kind = \"sweep\"\n[sweep]\naverage = 1\ndelay_us = [-60, 0, 60]\nexposure_us = [50]\n",
    "kind = \"film\"\n[film]\ncycles = 40\ndelay_us = [-60, 0, 60]\nexposure_us = 50\n",
    "kind = \"darks\"\n[darks]\nexposure_us = [50, 100]\nframes = 100\n",
    "kind = \"viewfinder\"\n[viewfinder]\npictures_per_s = 30\n",
];
/// Plans of the dot rig.
const DOT_PLANS: [&str; 3] = [
    "kind = \"batches\"\nproduct = [{ kind = \"floodlit\" }]\n[batches]\ncount = 4\ndots = 60\n\
     exposure_us = 100\ndark_frames = 64\ntrailing_region = [112, 128, 48, 80]\n\
     background_indices = [0]\ncalibration = []\n[batches.path]\nshape = \"lissajous\"\n\
     cycles = [7, 1]\namplitude_deg = [2.3, 1.3]\nsamples = 1500\nrate_hz = 30000\n",
    "kind = \"response\"\n[response]\nchirp_s = 0.2\nrest_s = 0.1\nrate_hz = 30000\n\
     camera_rate_hz = 4000\nexposure_us = 100\ndark_frames = 64\nregion = [0, 112, 0, 128]\n",
    "kind = \"viewfinder\"\n[viewfinder]\npictures_per_s = 30\n",
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RigKind {
    Plane,
    /// A plane rig with a person as its projector.
    Operated,
    Dots,
}

impl RigKind {
    /// A plan of [`PLANS`], or what this rig runs instead.
    pub fn plan(self, number: usize) -> String {
        match self {
            Self::Plane => PLANS[number].to_owned(),
            // In real time.
            Self::Operated => {
                PLANS[number].replace("average = 150", "average = 3").replace("frames = 100", "frames = 3")
            }
            Self::Dots => DOT_PLANS[number % DOT_PLANS.len()].to_owned(),
        }
    }
}

/// Which devices are gone.
#[derive(Default)]
pub struct Faults {
    pub camera: AtomicBool,
    pub watcher: AtomicBool,
    pub projector: AtomicBool,
    pub mirror: AtomicBool,
}

impl Faults {
    pub fn begin(device: &AtomicBool) {
        device.store(true, Ordering::Relaxed);
    }

    fn check(device: &AtomicBool, name: &'static str) -> Result<(), DeviceError> {
        match device.load(Ordering::Relaxed) {
            true => {
                Err(DeviceError::new(name, DeviceErrorKind::Disconnected, "somebody has pulled the plug"))
            }
            false => Ok(()),
        }
    }
}

/// A device that can be gone.
struct Unpluggable<D> {
    device: D,
    faults: Arc<Faults>,
    is_lit: Arc<Mutex<bool>>,
}

impl Camera for Unpluggable<Box<dyn Camera>> {
    fn capabilities(&self) -> &CameraCapabilities {
        self.device.capabilities()
    }

    fn state(&self) -> DeviceState {
        self.device.state()
    }

    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        Faults::check(&self.faults.camera, "camera")?;
        self.device.configure(id, settings)
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        Faults::check(&self.faults.camera, "camera")?;
        self.device.arm()
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        // Read first, as a virtual clock stops if nobody reads the camera.
        let frame = self.device.next_frame(buf, timeout);
        Faults::check(&self.faults.camera, "camera")?;
        frame
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.device.disarm()
    }
}

impl Mirror for Unpluggable<Box<dyn Mirror>> {
    fn capabilities(&self) -> &MirrorCapabilities {
        self.device.capabilities()
    }

    fn load(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        Faults::check(&self.faults.mirror, "mirror")?;
        self.device.load(path)
    }

    fn start(&mut self, batches: u32) -> Result<(), DeviceError> {
        Faults::check(&self.faults.mirror, "mirror")?;
        *self.is_lit.lock().unwrap() = true;
        self.device.start(batches)
    }

    fn feed(&mut self) -> Result<MirrorProgress, DeviceError> {
        Faults::check(&self.faults.mirror, "mirror")?;
        self.device.feed()
    }

    /// A mirror that is gone has no light either.
    fn park(&mut self) -> Result<(), DeviceError> {
        self.device.park()?;
        *self.is_lit.lock().unwrap() = false;
        Faults::check(&self.faults.mirror, "mirror")
    }
}

impl Vsync for Unpluggable<Box<dyn Vsync>> {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        Faults::check(&self.faults.watcher, "vsync")?;
        self.device.next_edge(timeout)
    }
}

impl Projector for Unpluggable<Box<dyn Projector>> {
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError> {
        Faults::check(&self.faults.projector, "projector")?;
        *self.is_lit.lock().unwrap() = true;
        self.device.show(pattern)
    }

    /// A projector that is gone gives no light either.
    fn blank(&mut self) -> Result<Shown, DeviceError> {
        *self.is_lit.lock().unwrap() = false;
        self.device.blank()
    }
}

/// A daemon's core on a rig that can fail.
pub struct Laboratory {
    pub runner: Runner,
    pub faults: Arc<Faults>,
    kind: RigKind,
    folder: TempDir,
    is_lit: Arc<Mutex<bool>>,
    /// Folders of data that are away, with their places.
    away: Mutex<Vec<(PathBuf, PathBuf)>>,
}

impl Laboratory {
    pub fn new(kind: RigKind) -> Self {
        let folder = tempfile::tempdir_in("/dev/shm").unwrap();
        let rig = match kind {
            RigKind::Plane => PLANE.to_owned(),
            RigKind::Operated => PLANE
                .replace("[projector]\ndriver = \"sim\"", "[projector]\ndriver = \"external\"")
                .replace("seed = 11", "seed = 11\nrealtime = true"),
            RigKind::Dots => DOTS.to_owned(),
        };
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        let (faults, is_lit) = (Arc::new(Faults::default()), Arc::new(Mutex::new(false)));
        let (unpluggable, lit) = (faults.clone(), is_lit.clone());
        let devices = move |devices: Devices| {
            let (faults, is_lit) = (unpluggable.clone(), lit.clone());
            let camera =
                Unpluggable { device: devices.camera, faults: faults.clone(), is_lit: is_lit.clone() };
            let vsync = Unpluggable { device: devices.vsync, faults: faults.clone(), is_lit: is_lit.clone() };
            let projector = Unpluggable { device: devices.projector, faults, is_lit };
            Devices {
                camera: Box::new(camera),
                vsync: Box::new(vsync),
                projector: Box::new(projector),
                ..devices
            }
        };
        let (unpluggable, lit) = (faults.clone(), is_lit.clone());
        let dot_devices = move |devices: DotDevices| {
            let (faults, is_lit) = (unpluggable.clone(), lit.clone());
            let camera =
                Unpluggable { device: devices.camera, faults: faults.clone(), is_lit: is_lit.clone() };
            let mirror = devices.mirror.map(|device| Unpluggable { device, faults, is_lit });
            DotDevices {
                camera: Box::new(camera),
                mirror: mirror.map(|mirror| Box::new(mirror) as Box<dyn Mirror>),
                ..devices
            }
        };
        // Long enough for an order while a run is prepared.
        let preparing = || std::thread::sleep(Duration::from_millis(5));
        let probes = Probes {
            devices: Some(Arc::new(devices)),
            dot_devices: Some(Arc::new(dot_devices)),
            preparing: Some(Arc::new(preparing)),
            ..Probes::default()
        };
        let runner = start(folder.path()).with_probes(probes);
        Self { runner, faults, kind, folder, is_lit, away: Mutex::default() }
    }

    /// Another core on the same sessions, with sound devices.
    pub fn again(&self) -> Runner {
        start(self.folder.path())
    }

    pub fn data(&self) -> PathBuf {
        self.folder.path().join("sessions")
    }

    /// Takes the places of a session's images away and puts files in their way, so that none can be written.
    pub fn block_disk(&self, session: Option<&Path>) {
        let Some(session) = session else { return };
        for array in ["stack.zarr/sum", "stack.zarr/dark", "film.zarr/film"] {
            let mut moved = self.away.lock().unwrap();
            let (place, away) =
                (session.join(array), self.folder.path().join(format!("away-{}", moved.len())));
            if place.is_dir() && fs::rename(&place, &away).is_ok() {
                fs::write(&place, "").unwrap();
                moved.push((place, away));
            }
        }
    }

    /// All devices and the disk are there again.
    pub fn mend(&self) {
        let Faults { camera, watcher, projector, mirror } = &*self.faults;
        for device in [camera, watcher, projector, mirror] {
            device.store(false, Ordering::Relaxed);
        }
        for (place, away) in self.away.lock().unwrap().drain(..) {
            fs::remove_file(&place).unwrap();
            fs::rename(away, place).unwrap();
        }
    }

    /// Whether no device gives light, and the mirror is at its origin.
    pub fn is_dark(&self) {
        assert!(!*self.is_lit.lock().unwrap(), "{:?}: the projector or the mirror is lit", self.kind);
        if let Some(mirror) = self.runner.status().mirror {
            assert!(mirror.parked && !mirror.laser, "{:?}: {mirror:?}", self.kind);
        }
    }
}

fn start(folder: &Path) -> Runner {
    let rig = AnyRig::load(&folder.join("rig.toml")).unwrap_or_else(|error| panic!("{error}"));
    Runner::new(rig, folder.join("sessions")).unwrap_or_else(|error| panic!("{error}"))
}
