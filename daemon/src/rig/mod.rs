//! Opens the devices of a rig according to its rig file.

mod dots;
mod simulated;
mod stand;
mod vsync;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use raysweep_config::rig::plane::{CameraDriver, DrmSection, ProjectorDriver};
use raysweep_config::rig::vsync::VsyncDriver;
use raysweep_config::{AnyRigFile, ConfigError, Places, RigFile};
use raysweep_core::{Camera, CameraCapabilities, Clock, DeviceError, Projector, Vsync, io_text};
use raysweep_drivers::camera::v4l2::{self, V4l2Setup};
use raysweep_drivers::projector::drm::{DrmConfig, DrmProjector, Timing};
use raysweep_drivers::projector::external::{External, ShowRequest};
use raysweep_session::input;
use raysweep_sim::PlaneRig;

use self::simulated::{Simulated, simulate};
use self::vsync::Unwatched;

pub use self::dots::{DotDevices, DotRig};
pub use self::simulated::check_scene;
pub use self::stand::Stand;

/// Why a rig cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The file cannot be read.
    #[error("cannot read {}: {}", path.display(), io_text(source))]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file is not a valid rig file.
    #[error("{0}")]
    Config(String),
    /// A device cannot be opened.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// Several devices cannot be opened.
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Several(Vec<RigError>),
}

/// A rig of either kind.
pub enum AnyRig {
    /// Raster projector and rolling-shutter camera.
    Plane(Box<Rig>),
    /// Mirror and fast camera.
    Dots(Box<DotRig>),
}

impl From<Rig> for AnyRig {
    fn from(rig: Rig) -> Self {
        Self::Plane(Box::new(rig))
    }
}

impl From<DotRig> for AnyRig {
    fn from(rig: DotRig) -> Self {
        Self::Dots(Box::new(rig))
    }
}

impl AnyRig {
    /// Reads a rig file of either kind.
    ///
    /// # Errors
    /// With file, line and field.
    pub fn load(path: &Path) -> Result<Self, RigError> {
        let source = Source::read(path)?;
        match AnyRigFile::parse(&source.text).map_err(|error| source.shown(&error))? {
            AnyRigFile::Plane(file) => Rig::of(*file, source).map(Self::from),
            AnyRigFile::Dots(file) => DotRig::of(*file, source).map(Self::from),
        }
    }
}

/// A rig of either kind, which runs share.
#[derive(Clone)]
pub enum SharedRig {
    /// Raster projector and rolling-shutter camera.
    Plane(Arc<Rig>),
    /// Mirror and fast camera.
    Dots(Arc<DotRig>),
}

impl From<AnyRig> for SharedRig {
    fn from(rig: AnyRig) -> Self {
        match rig {
            AnyRig::Plane(rig) => Self::Plane(rig.into()),
            AnyRig::Dots(rig) => Self::Dots(rig.into()),
        }
    }
}

impl SharedRig {
    /// Whether a session's rig file is this rig's.
    pub fn is_of(&self, stored: &str) -> bool {
        let written = match self {
            Self::Plane(rig) => &rig.written,
            Self::Dots(rig) => &rig.written,
        };
        stored == self.text() || stored == written
    }

    /// The rig file's text, as sessions store it.
    pub fn text(&self) -> &str {
        match self {
            Self::Plane(rig) => &rig.text,
            Self::Dots(rig) => &rig.text,
        }
    }
}

/// Longest rig file that is read.
const MOST_BYTES: u64 = 1 << 24;

/// The text of a rig file and its path.
struct Source<'a> {
    path: &'a Path,
    text: String,
}

impl<'a> Source<'a> {
    fn read(path: &'a Path) -> Result<Self, RigError> {
        let text = input::read_text(path, MOST_BYTES)
            .map_err(|source| RigError::Read { path: path.to_owned(), source })?;
        Ok(Self { path, text })
    }

    /// The folder that the file's paths are relative to.
    fn folder(&self) -> &Path {
        self.path.parent().unwrap_or(Path::new("."))
    }

    /// The text for a session, in whose folder relative paths would lead nowhere: with absolute ones, as far as there is
    /// something at them.
    fn for_sessions(&self, places: &Places, paths: Vec<(Vec<String>, PathBuf)>) -> String {
        let absolute = |(keys, path): (Vec<String>, PathBuf)| {
            let found = path.is_relative().then(|| self.folder().join(&path).canonicalize())?.ok()?;
            Some((keys, found.to_str()?.to_owned()))
        };
        let strings: Vec<_> = paths.into_iter().filter_map(absolute).collect();
        places.with_strings(&self.text, &strings)
    }

    fn shown(&self, error: &ConfigError) -> RigError {
        RigError::Config(error.render(&self.path.display().to_string(), &self.text))
    }
}

/// A plane rig whose devices can be opened, one run at a time.
pub struct Rig {
    /// Contents of its rig file.
    pub file: RigFile,
    /// The file's text with absolute paths, which sessions store.
    pub text: String,
    /// The file's text as it was written, which earlier versions stored.
    written: String,
    /// The simulated rig, if any device is simulated.
    sim: Option<Arc<PlaneRig>>,
}

/// The open devices of a rig.
pub struct Devices {
    /// The camera.
    pub camera: Box<dyn Camera>,
    /// The watcher of the VSYNC line.
    pub vsync: Box<dyn Vsync>,
    /// The projector.
    pub projector: Box<dyn Projector>,
    /// The projector's requests to its operator, if a person operates it.
    pub questions: Option<Receiver<ShowRequest>>,
    /// Places scene, board and cap in front of the camera.
    pub stand: Stand,
    /// The clock of their timestamps.
    pub clock: Clock,
    /// Whether the devices or the pipeline set the pace.
    pub pace: Pace,
}

/// A projector, and its requests to its operator, if a person operates it.
type OpenProjector = (Box<dyn Projector>, Option<Receiver<ShowRequest>>);

/// The devices of a rig: each open, or why it is not.
pub struct OpenedEach {
    /// The camera, the clock of its timestamps, and what places subjects in front of it.
    pub camera: Result<(Box<dyn Camera>, Clock, Stand), RigError>,
    /// The watcher of the VSYNC line.
    pub vsync: Result<Box<dyn Vsync>, RigError>,
    /// The projector.
    pub projector: Result<OpenProjector, RigError>,
    /// Whether the devices or the pipeline set the pace.
    pub pace: Pace,
}

impl OpenedEach {
    /// All devices, or the errors of those that are not open.
    fn all(self) -> Result<Devices, RigError> {
        let Self { camera, vsync, projector, pace } = self;
        match (camera, vsync, projector) {
            (Ok((camera, clock, stand)), Ok(vsync), Ok((projector, questions))) => {
                Ok(Devices { camera, vsync, projector, questions, stand, clock, pace })
            }
            (camera, vsync, projector) => {
                let failed = [camera.err(), vsync.err(), projector.err()];
                let mut errors: Vec<RigError> = failed.into_iter().flatten().collect();
                Err(if errors.len() == 1 { errors.remove(0) } else { RigError::Several(errors) })
            }
        }
    }
}

/// What sets the pace of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pace {
    /// The pipeline: the devices, on a virtual clock or a recording, wait until there is room.
    Pipeline,
    /// The devices: frames arrive whether there is room or not.
    Devices,
}

impl Rig {
    /// Reads a rig file and builds what can be built without opening devices.
    ///
    /// # Errors
    /// With file, line and field.
    pub fn load(path: &Path) -> Result<Self, RigError> {
        let source = Source::read(path)?;
        let file = RigFile::parse(&source.text).map_err(|error| source.shown(&error))?;
        Self::of(file, source)
    }

    fn of(mut file: RigFile, source: Source<'_>) -> Result<Self, RigError> {
        let text = source.for_sessions(&file.places, file.paths());
        file.sim.bench = file.sim.bench.map(|bench| source.folder().join(bench));
        let simulate = || {
            simulate(&file, source.folder()).map_err(|error| {
                let path: Vec<&str> = ["sim"].into_iter().chain(error.key().split('.')).collect();
                source.shown(&file.places.error(&path, error.to_string()))
            })
        };
        let sim = file.has_simulated_device().then(simulate).transpose()?;
        Ok(Self { sim: sim.map(Arc::new), file, text, written: source.text })
    }

    /// Projector row that row 0 of its camera sees.
    pub fn first_row(&self, camera: &CameraCapabilities) -> usize {
        let RigFile { camera: section, projector, sim, .. } = &self.file;
        let is_simulated = section.driver == CameraDriver::Sim || sim.bench.is_some();
        if let Some(sim) = self.sim.as_ref().filter(|_| is_simulated) {
            return sim.first_row();
        }
        let middle = projector.rows.saturating_sub(self.projector_rows_of(camera)) / 2;
        section.first_projector_row.unwrap_or(middle)
    }

    /// Number of projector rows that the camera's rows span.
    fn projector_rows_of(&self, camera: &CameraCapabilities) -> usize {
        (camera.height.saturating_sub(1) as f64 * self.file.camera.row_pitch).round() as usize + 1
    }

    /// Checks that the camera's rows lie within the projector's.
    fn check_rows(&self, camera: &CameraCapabilities) -> Result<(), RigError> {
        let (first, rows) = (self.first_row(camera), self.projector_rows_of(camera));
        let projector_rows = self.file.projector.rows;
        if first + rows <= projector_rows {
            return Ok(());
        }
        Err(RigError::Config(format!(
            "the camera's {} rows cover {rows} projector rows from row {first} on, but the projector has only {projector_rows}: read out a smaller region of its sensor, lower camera.row_pitch or set camera.first_projector_row",
            camera.height
        )))
    }

    /// The simulated rig, if any device is simulated; its truth is for tests only.
    pub fn simulated(&self) -> Option<&PlaneRig> {
        self.sim.as_deref()
    }

    /// Opens all devices.
    ///
    /// # Errors
    /// The devices that cannot be opened.
    pub fn open(&self) -> Result<Devices, RigError> {
        self.sound(self.open_each()?)
    }

    /// Opens what a viewfinder without the trigger needs: a camera that runs freely at this frame rate, and the
    /// projector.
    ///
    /// # Errors
    /// As [`Rig::open`].
    pub fn open_free_running(&self, free_hz: f64) -> Result<Devices, RigError> {
        self.sound(self.open_each_by(Some(free_hz))?)
    }

    /// Opens all devices to see that they are there. A missing watcher of the VSYNC is only logged: without it, the rig
    /// can still be focused. A service that resumes by itself waits for it: the sweep that was cut off needs it.
    ///
    /// # Errors
    /// The other devices that cannot be opened.
    pub fn look_for_camera(&self) -> Result<CameraCapabilities, RigError> {
        let mut each = self.open_each()?;
        if let Err(RigError::Device(error)) = &each.vsync
            && !self.file.auto_resume
        {
            tracing::warn!(%error, "until it can be opened, nothing runs but `raysweep viewfinder --trigger none`");
            each.vsync = Ok(Box::new(Unwatched));
        }
        Ok(self.sound(each)?.camera.capabilities().clone())
    }

    fn sound(&self, opened: OpenedEach) -> Result<Devices, RigError> {
        let devices = opened.all()?;
        self.check_rows(devices.camera.capabilities())?;
        Ok(devices)
    }

    /// Opens each device, even if another one cannot be opened.
    ///
    /// # Errors
    /// For a rig file whose devices do not go together.
    pub fn open_each(&self) -> Result<OpenedEach, RigError> {
        self.open_each_by(None)
    }

    /// With `free_hz`, frames come at that rate, and nobody watches the VSYNC.
    fn open_each_by(&self, free_hz: Option<f64>) -> Result<OpenedEach, RigError> {
        self.check_pace()?;
        let mut simulated = Simulated::open(self, free_hz)?;
        let vsync: Result<Box<dyn Vsync>, _> = match free_hz {
            Some(_) => Ok(Box::new(Unwatched)),
            None => vsync::open(&self.file.vsync).map_err(RigError::from).and_then(|real| match real {
                Some(real) => Ok(real),
                None => simulated.vsync(),
            }),
        };
        let projector: Result<OpenProjector, _> = match self.file.projector.driver {
            ProjectorDriver::Drm => self.open_drm().map(|drm| (Box::new(drm) as _, None)),
            ProjectorDriver::External => {
                // A run that waits for its operator can be cancelled, so there is no need for a timeout.
                let (operated, questions) = External::new(Duration::MAX);
                Ok((simulated.followed(operated), Some(questions)))
            }
            ProjectorDriver::Sim => simulated.projector().map(|projector| (projector, None)),
        };
        // Real devices use the host's clock, even if others of the rig are simulated.
        let real =
            |camera: Result<Box<dyn Camera>, RigError>| Ok((camera?, Clock::real(), simulated.stand()?));
        let camera = match self.file.camera.driver {
            CameraDriver::Sim => simulated.camera_and_stand(),
            CameraDriver::Aravis => real(self.open_aravis(free_hz)),
            CameraDriver::V4l2 => real(self.open_v4l2(free_hz)),
        };
        let by_the_clock = self.file.sim.realtime || self.file.camera.driver != CameraDriver::Sim;
        let pace = if by_the_clock { Pace::Devices } else { Pace::Pipeline };
        Ok(OpenedEach { camera, vsync, projector, pace })
    }

    /// Real devices use the host's clock, so simulated devices beside them must run in real time.
    fn check_pace(&self) -> Result<(), RigError> {
        let RigFile { camera, vsync, projector, sim, .. } = &self.file;
        let real = vsync.driver != VsyncDriver::Sim || projector.driver != ProjectorDriver::Sim;
        if real && camera.driver == CameraDriver::Sim && !sim.realtime {
            let message = "sim.realtime = false: a simulated camera beside a real VSYNC line or projector runs by the host's clock; set sim.realtime = true";
            return Err(RigError::Config(message.into()));
        }
        Ok(())
    }

    fn open_drm(&self) -> Result<DrmProjector, RigError> {
        let DrmSection { card, connector, settle_frames } = self.file.projector.drm.clone();
        let config = DrmConfig { card, connector, timing: Timing::HD_720P60, settle_frames };
        Ok(DrmProjector::open(&config)?)
    }

    fn open_v4l2(&self, free_hz: Option<f64>) -> Result<Box<dyn Camera>, RigError> {
        let RigFile { camera, vsync, .. } = &self.file;
        let Some(config) = &camera.v4l2 else {
            return Err(RigError::Config("[camera.v4l2] is missing".into()));
        };
        let setup = V4l2Setup {
            config: if free_hz.is_some() { config.free_running() } else { config.clone() },
            format: camera.pixel_format,
            row_time_us: self.file.camera_row_time_us(),
            trigger_period_us: vsync.period_us,
            reopen: Duration::from_secs_f64(camera.reopen_s),
        };
        Ok(Box::new(v4l2::open(setup)?))
    }

    #[cfg(feature = "aravis")]
    fn open_aravis(&self, free_hz: Option<f64>) -> Result<Box<dyn Camera>, RigError> {
        use raysweep_drivers::camera::aravis::{AravisCamera, RigFacts};

        let RigFile { camera, vsync, .. } = &self.file;
        let facts = RigFacts {
            format: camera.pixel_format,
            row_time_us: self.file.camera_row_time_us(),
            trigger_period_us: vsync.period_us,
            trigger_margin_us: vsync.gate_us,
            reopen: Duration::from_secs_f64(camera.reopen_s),
            free_hz,
        };
        Ok(Box::new(AravisCamera::open(&camera.aravis, facts)?))
    }

    #[cfg(not(feature = "aravis"))]
    fn open_aravis(&self, _: Option<f64>) -> Result<Box<dyn Camera>, RigError> {
        Err(built_without_aravis())
    }
}

#[cfg(not(feature = "aravis"))]
fn built_without_aravis() -> RigError {
    RigError::Config(
        "camera.driver = \"aravis\": this raysweepd was built without the feature `aravis`; build it with `cargo build --release --features aravis`, which needs libaravis-dev and libusb-1.0-0-dev".into(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rig_of_real_devices_has_no_simulation_that_must_fit_it() {
        let folder = tempfile::tempdir().unwrap();
        let load = |driver: &str| {
            let text = format!(
                "kind = \"plane\"\n[camera]\ndriver = \"v4l2\"\nfirst_projector_row = 650\n[camera.v4l2]\ndevice = \"/nowhere\"\nwidth = 8\nheight = 8\n\
                 [vsync]\ndriver = \"fx2lafw\"\n[projector]\ndriver = \"{driver}\"\n"
            );
            let path = folder.path().join("rig.toml");
            std::fs::write(&path, text).unwrap();
            Rig::load(&path)
        };
        assert!(load("external").unwrap().simulated().is_none());
        // The simulated scene has 128 rows, and the projector 720.
        let Err(error) = load("sim") else { panic!("the scene does not fit") };
        assert!(matches!(error, RigError::Config(_)), "{error}");
    }

    #[test]
    fn the_rig_files_of_the_shopping_lists_simulate_nothing() {
        let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/rigs");
        for name in ["lab-gige.toml", "lab-mipi.toml", "lab-dots.toml"] {
            let is_real = match AnyRig::load(&rigs.join(name)) {
                Ok(AnyRig::Plane(rig)) => rig.simulated().is_none() && !rig.file.has_simulated_device(),
                Ok(AnyRig::Dots(rig)) => rig.simulated().is_none() && rig.has_real_mirror(),
                Err(error) => panic!("{error}"),
            };
            assert!(is_real, "{name}");
        }
    }

    #[test]
    fn a_bench_stands_beside_the_rig_file_and_goes_with_a_camera_on_a_wire() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        let text = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
                    [sim]\nbench = \"bench.sock\"\nscene_rows = 8\nscene_columns = 8\n";
        std::fs::write(&path, text).unwrap();
        let rig = Rig::load(&path).unwrap();
        assert_eq!(rig.file.sim.bench, Some(folder.path().join("bench.sock")));
        let Err(error) = rig.open() else { panic!("the camera cannot be in both processes") };
        assert!(matches!(error, RigError::Config(_)), "{error}");
    }
}
