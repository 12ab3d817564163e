//! The factory: from a rig file to open devices.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use raysweep_core::{Camera, DeviceError, Projector, Vsync};
use raysweep_sim::bench::{RemoteProjector, RemoteVsync};
use raysweep_sim::{PlaneRig, PlaneSetup};

use crate::config::{ConfigError, Driver, RigFile};

/// Why a rig cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no rig.
    #[error("{0}")]
    Config(String),
    /// A device cannot be opened.
    #[error(transparent)]
    Device(#[from] DeviceError),
}

/// A rig whose devices can be opened, one run at a time.
pub struct Rig {
    /// What its file says.
    pub file: RigFile,
    /// The file's text, as sessions keep it.
    pub text: String,
    sim: Arc<PlaneRig>,
}

/// The open devices of a rig.
pub struct Devices {
    /// The camera.
    pub camera: Box<dyn Camera>,
    /// The watcher of the VSYNC line.
    pub vsync: Box<dyn Vsync>,
    /// The projector.
    pub projector: Box<dyn Projector>,
    /// Whether the devices wait for the pipeline (a virtual clock does) or frames come as they come.
    pub pace: Pace,
}

/// Who sets the pace of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pace {
    /// The devices wait until there is room.
    Pipeline,
    /// Frames come whether there is room or not.
    Devices,
}

impl Rig {
    /// Reads a rig file and builds what can be built before devices are opened.
    ///
    /// # Errors
    /// With file, line and field.
    pub fn load(path: &Path) -> Result<Self, RigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| RigError::Read { path: path.to_owned(), source })?;
        let shown = |error: ConfigError| RigError::Config(error.render(&path.display().to_string(), &text));
        let mut file = RigFile::parse(&text).map_err(shown)?;
        let setup = PlaneSetup {
            raster: file.raster(),
            camera_row_time_us: file.camera_row_time_us(),
            row_pitch: file.camera.row_pitch,
            white_dn: file.camera.white_dn(),
            black_dn: file.camera.black_dn(),
            format: file.camera.pixel_format,
            first_row: file.camera.first_projector_row,
        };
        let folder = path.parent().unwrap_or(Path::new("."));
        file.sim.bench = file.sim.bench.map(|bench| folder.join(bench));
        let sim = PlaneRig::new(file.sim.clone(), setup, folder).map_err(|error| {
            let path: Vec<&str> = ["sim"].into_iter().chain(error.key().split('.')).collect();
            shown(ConfigError::at(&text, &path, error.to_string()))
        })?;
        let sim = Arc::new(sim);
        Ok(Self { file, text, sim })
    }

    /// Projector row that camera row 0 sees.
    pub fn first_row(&self) -> usize {
        self.sim.first_row()
    }

    /// The simulated rig.
    pub fn simulated(&self) -> &PlaneRig {
        &self.sim
    }

    /// Opens all devices.
    ///
    /// # Errors
    /// The first device that does not open.
    pub fn open(&self) -> Result<Devices, RigError> {
        let (Driver::Sim, Driver::Sim, Driver::Sim) =
            (self.file.camera.driver, self.file.vsync.driver, self.file.projector.driver);
        if self.file.sim.bench.is_some() && self.file.camera.driver == Driver::Sim {
            let message = "sim.bench: the camera of a bench is reached over its wire: set camera.driver to the driver that does, or leave sim.bench out";
            return Err(RigError::Config(message.into()));
        }
        let sim = self.sim.open();
        let (vsync, projector): (Box<dyn Vsync>, Box<dyn Projector>) = match &self.file.sim.bench {
            Some(bench) => (Box::new(RemoteVsync::open(bench)?), Box::new(RemoteProjector::open(bench)?)),
            None => (sim.vsync, sim.projector),
        };
        let by_the_clock = self.file.sim.realtime || self.file.sim.bench.is_some();
        let pace = if by_the_clock { Pace::Devices } else { Pace::Pipeline };
        Ok(Devices { camera: sim.camera, vsync, projector, pace })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert!(error.to_string().contains("camera.driver"), "{error}");
    }
}
