//! The simulated devices of a plane rig: all in one simulation, on one clock, in this process or in a separate bench
//! process.

use std::path::{Path, PathBuf};

use raysweep_config::RigFile;
use raysweep_config::rig::plane::CameraDriver;
use raysweep_core::{Camera, Clock, DeviceError, Pattern, Projector, Shown, Subject, Vsync};
use raysweep_drivers::projector::external::External;
use raysweep_sim::bench::{RemoteProjector, RemoteVsync, remote_subject};
use raysweep_sim::scene::{BUILTIN_NAMES, MOVING_NAMES, is_file};
use raysweep_sim::{PlaneDevices, PlaneRig, PlaneSetup, SimError, SubjectSwitch};

use super::{Rig, RigError, Stand};

/// Whether there is a scene of this name: one that is built in, or a file, relative to `folder`.
///
/// # Errors
/// With the names that are allowed.
pub fn check_scene(name: &str, folder: &Path) -> Result<(), String> {
    let known = BUILTIN_NAMES.iter().chain(&MOVING_NAMES).copied().collect::<Vec<_>>();
    match known.contains(&name) || (is_file(Path::new(name)) && folder.join(name).is_file()) {
        true => Ok(()),
        false => Err(format!(
            "no such scene; allowed: {}, or a file that ends in .npz, relative to the rig file",
            known.join(", ")
        )),
    }
}

/// Builds the simulated rig that a file describes; scene paths are relative to `folder`.
pub(super) fn simulate(file: &RigFile, folder: &Path) -> Result<PlaneRig, SimError> {
    let setup = PlaneSetup {
        raster: file.raster(),
        camera_row_time_us: file.camera_row_time_us(),
        row_pitch: file.camera.row_pitch,
        white_dn: file.camera.white_dn(),
        black_dn: file.camera.black_dn(),
        format: file.camera.pixel_format,
        first_row: file.camera.first_projector_row,
    };
    tracing::info!("building the scene {}", file.sim.scene.display());
    PlaneRig::new(file.sim.clone(), setup, folder)
}

/// The devices of a simulated rig, to be taken one by one; those with a real counterpart are dropped.
#[derive(Default)]
pub(super) struct Simulated {
    camera: Option<(Box<dyn Camera>, Clock)>,
    vsync: Option<Box<dyn Vsync>>,
    projector: Option<Box<dyn Projector>>,
    subject: Option<SubjectSwitch>,
    /// Socket of the bench process, if the devices are simulated there.
    bench: Option<PathBuf>,
}

impl Simulated {
    /// Opens the simulated devices of a rig, if any; with `free_hz`, its camera runs freely.
    pub(super) fn open(rig: &Rig, free_hz: Option<f64>) -> Result<Self, RigError> {
        match (&rig.file.sim.bench, rig.simulated()) {
            (Some(_), _) if rig.file.camera.driver == CameraDriver::Sim => {
                let message = "sim.bench: the camera of a bench is connected by a real wire: set camera.driver to the driver of that camera, or leave sim.bench out";
                Err(RigError::Config(message.into()))
            }
            (Some(bench), _) => Ok(Self { bench: Some(bench.clone()), ..Self::default() }),
            (None, Some(sim)) => {
                let devices = sim.open();
                if let Some(free_hz) = free_hz {
                    devices.free_run(free_hz);
                }
                let PlaneDevices { camera, vsync, projector, subject, clock, .. } = devices;
                let camera = Some((camera, clock));
                let (vsync, projector, subject) = (Some(vsync), Some(projector), Some(subject));
                Ok(Self { camera, vsync, projector, subject, bench: None })
            }
            (None, None) => Ok(Self::default()),
        }
    }

    /// The camera, the clock of its timestamps, and what places subjects before it.
    pub(super) fn camera_and_stand(&mut self) -> Result<(Box<dyn Camera>, Clock, Stand), RigError> {
        let (camera, subject) = (self.camera.take(), self.subject.take());
        let both = camera.zip(subject).ok_or_else(|| not_simulated("camera"))?;
        let ((camera, clock), subject) = both;
        Ok((camera, clock, Stand::Simulated(subject)))
    }

    /// What places subjects in front of a camera that this process does not simulate. On a bench, which outlives runs,
    /// each begins with the scene there, as on a rig that this process simulates.
    pub(super) fn stand(&self) -> Result<Stand, RigError> {
        let Some(bench) = &self.bench else { return Ok(Stand::Operator) };
        let subject = remote_subject(bench)?;
        subject.place(Subject::Scene)?;
        Ok(Stand::Simulated(subject))
    }

    /// The watcher of the VSYNC line.
    pub(super) fn vsync(&mut self) -> Result<Box<dyn Vsync>, RigError> {
        match &self.bench {
            Some(bench) => Ok(Box::new(RemoteVsync::open(bench)?)),
            None => self.vsync.take().ok_or_else(|| not_simulated("vsync")),
        }
    }

    /// The projector.
    pub(super) fn projector(&mut self) -> Result<Box<dyn Projector>, RigError> {
        match &self.bench {
            Some(bench) => Ok(Box::new(RemoteProjector::open(bench)?)),
            None => self.projector.take().ok_or_else(|| not_simulated("projector")),
        }
    }

    /// A projector that its operator works. In a simulation, the light then is as the operator has said that it is.
    pub(super) fn followed(&mut self, operated: External) -> Box<dyn Projector> {
        match self.projector.take() {
            Some(light) => Box::new(Followed { operated, light }),
            None => Box::new(operated),
        }
    }
}

/// A simulated projector that shows what its operator has confirmed.
struct Followed {
    operated: External,
    light: Box<dyn Projector>,
}

impl Projector for Followed {
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError> {
        self.operated.show(pattern)?;
        self.light.show(pattern)
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        // Dark in any case: nobody waits for the operator at the end of a run.
        let (operated, light) = (self.operated.blank(), self.light.blank());
        operated.and(light)
    }
}

fn not_simulated(section: &str) -> RigError {
    RigError::Config(format!(
        "{section}.driver: no device of this rig is simulated; name the driver of a real device"
    ))
}
