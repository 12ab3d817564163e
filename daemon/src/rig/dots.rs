//! Opens the devices of a dot rig according to its rig file.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use raysweep_config::DotRigFile;
use raysweep_config::rig::dots::{DotCameraDriver, MirrorDriver};
use raysweep_core::{Camera, Clock, MechanicalDeg, Mirror};
use raysweep_drivers::camera::replay::{ReplayCamera, ReplayConfig, ReplayPace};
use raysweep_drivers::camera::v4l2::{self, V4l2Setup};
use raysweep_drivers::mirror::{
    LightGuard, Mti, MtiConfig, Optotune, OptotuneConfig, PlayzerX, PlayzerXConfig, RtsLaser,
};
use raysweep_sim::dots::{DotsDevices, DotsRig, DotsSetup, DotsTruth};

use super::{Pace, RigError, Source, Stand};
use crate::mirror;

/// A dot rig whose devices can be opened, one run at a time.
pub struct DotRig {
    /// Contents of its rig file.
    pub file: DotRigFile,
    /// The file's text with absolute paths, which sessions store.
    pub text: String,
    /// The file's text as it was written, which earlier versions stored.
    pub(super) written: String,
    sim: Option<Arc<DotsRig>>,
    /// The file's folder, which its paths are relative to.
    folder: PathBuf,
}

/// The open devices of a dot rig.
pub struct DotDevices {
    /// The camera, with one dot per frame.
    pub camera: Box<dyn Camera>,
    /// The mirror and its light; `None` if the frames come from a recording.
    pub mirror: Option<Box<dyn Mirror>>,
    /// Places planes and scene in front of the camera.
    pub stand: Stand,
    /// The clock of the camera's timestamps.
    pub clock: Clock,
    /// Whether the devices or the pipeline set the pace.
    pub pace: Pace,
    /// Ground truth of a simulated camera, for tests only.
    pub truth: Option<DotsTruth>,
}

impl DotRig {
    /// Reads a rig file and builds what can be built without opening devices.
    ///
    /// # Errors
    /// With file, line and field.
    pub fn load(path: &Path) -> Result<Self, RigError> {
        let source = Source::read(path)?;
        let file = DotRigFile::parse(&source.text).map_err(|error| source.shown(&error))?;
        Self::of(file, source)
    }

    pub(super) fn of(mut file: DotRigFile, source: Source<'_>) -> Result<Self, RigError> {
        let folder = source.folder().to_owned();
        let text = source.for_sessions(&file.places, file.paths());
        file.plan_folders.iter_mut().for_each(|allowed| *allowed = folder.join(&*allowed));
        let setup = DotsSetup {
            format: file.camera.pixel_format,
            white_dn: file.camera.white_dn(),
            white_exposure_us: file.camera.white_exposure_us,
            black_dn: file.camera.black_dn(),
            incidence: file.incidence(),
            limits: file.limits(),
        };
        let sim = match file.camera.driver {
            DotCameraDriver::Sim => {
                let sim = DotsRig::new(file.sim.dots.clone(), setup, &folder).map_err(|error| {
                    let path: Vec<&str> = ["sim", "dots"].into_iter().chain(error.key().split('.')).collect();
                    source.shown(&file.places.error(&path, error.to_string()))
                })?;
                Some(Arc::new(sim))
            }
            _ => None,
        };
        Ok(Self { file, text, written: source.text, sim, folder })
    }

    /// The simulated rig, if the camera is simulated.
    pub fn simulated(&self) -> Option<&DotsRig> {
        self.sim.as_deref()
    }

    /// Whether the devices or the pipeline set the pace of a run.
    pub fn pace(&self) -> Pace {
        let has_own_mirror =
            self.file.mirror.as_ref().is_some_and(|mirror| mirror.driver != MirrorDriver::Sim);
        let waits = match self.file.camera.driver {
            DotCameraDriver::Sim => !self.file.sim.dots.realtime && !has_own_mirror,
            DotCameraDriver::Replay => {
                self.file.camera.replay.as_ref().is_none_or(|replay| replay.pace == ReplayPace::Pipeline)
            }
            _ => false,
        };
        if waits { Pace::Pipeline } else { Pace::Devices }
    }

    /// Opens all devices; the mirror's driver stores its state in the daemon's data folder. A camera with an internal
    /// frame clock runs at `frame_rate_hz` frames per second.
    ///
    /// # Errors
    /// The first device that cannot be opened.
    pub fn open(&self, data: &Path, frame_rate_hz: f64) -> Result<DotDevices, RigError> {
        let mirror = self.open_mirror(data)?;
        if let Some(sim) = &self.sim {
            let DotsDevices { camera, mirror, subject, clock, truth } = sim.open(frame_rate_hz, mirror);
            return Ok(DotDevices {
                camera,
                mirror: Some(mirror),
                stand: Stand::Simulated(subject),
                clock,
                pace: self.pace(),
                truth: Some(truth),
            });
        }
        let (camera, stand) = self.open_real_camera(frame_rate_hz)?;
        Ok(DotDevices { camera, mirror, stand, clock: Clock::real(), pace: self.pace(), truth: None })
    }

    /// Opens only the camera, if it is real or a recording, at this frame rate.
    ///
    /// # Errors
    /// When it cannot be opened.
    pub fn open_camera(&self, frame_rate_hz: f64) -> Result<Option<Box<dyn Camera>>, RigError> {
        match self.sim {
            Some(_) => Ok(None),
            None => self.open_real_camera(frame_rate_hz).map(|(camera, _)| Some(camera)),
        }
    }

    fn open_real_camera(&self, frame_rate_hz: f64) -> Result<(Box<dyn Camera>, Stand), RigError> {
        Ok(match self.file.camera.driver {
            DotCameraDriver::Replay => {
                let Some(replay) = &self.file.camera.replay else {
                    return Err(RigError::Config("[camera.replay] is missing".into()));
                };
                let config = ReplayConfig { path: self.folder.join(&replay.path), ..replay.clone() };
                let format = self.file.camera.pixel_format;
                (Box::new(ReplayCamera::open(&config, format, frame_rate_hz)?), Stand::Recorded)
            }
            DotCameraDriver::Aravis => (self.open_aravis(frame_rate_hz)?, Stand::Operator),
            _ => (self.open_v4l2(frame_rate_hz)?, Stand::Operator),
        })
    }

    /// Opens only the mirror, if it has its own driver, which stores its state in the daemon's data folder.
    ///
    /// # Errors
    /// When it cannot be opened.
    pub fn open_mirror(&self, data: &Path) -> Result<Option<Box<dyn Mirror>>, RigError> {
        let Some(section) = &self.file.mirror else { return Ok(None) };
        let (state, light) = (mirror::state_file(data), self.light_guard(data));
        let full_scale = MechanicalDeg(section.full_scale_deg);
        let limits = section.limits;
        let port = section.port.clone().unwrap_or_default();
        Ok(Some(match section.driver {
            MirrorDriver::Sim => return Ok(None),
            MirrorDriver::PlayzerX => {
                let link = section.link;
                Box::new(PlayzerX::open(PlayzerXConfig { port, link, full_scale, limits, state, light })?)
            }
            MirrorDriver::Mti => {
                let (drive, most) = (section.drive, section.max_drive);
                Box::new(Mti::open(MtiConfig { port, drive, most, full_scale, limits, state, light })?)
            }
            MirrorDriver::Optotune => {
                let laser_port = section.laser_port.clone();
                let laser = Box::new(RtsLaser::open(laser_port.as_deref().unwrap_or(Path::new("")))?);
                Box::new(Optotune::open(OptotuneConfig { port, laser_port, limits, state, light }, laser)?)
            }
        }))
    }

    /// The guard that permits light on this rig.
    pub fn light_guard(&self, data: &Path) -> LightGuard {
        mirror::light_guard(data, self.file.mirror.as_ref().and_then(|mirror| mirror.interlock.clone()))
    }

    /// Whether the mirror and its light are real.
    pub fn has_real_mirror(&self) -> bool {
        self.file.mirror.as_ref().is_some_and(|mirror| mirror.driver != MirrorDriver::Sim)
    }

    fn open_v4l2(&self, frame_rate_hz: f64) -> Result<Box<dyn Camera>, RigError> {
        let camera = &self.file.camera;
        let Some(config) = camera.v4l2.clone() else {
            return Err(RigError::Config("[camera.v4l2] is missing".into()));
        };
        let setup = V4l2Setup {
            config,
            format: camera.pixel_format,
            row_time_us: 0.0,
            trigger_period_us: 1e6 / frame_rate_hz,
            reopen: Duration::from_secs_f64(camera.reopen_s),
        };
        Ok(Box::new(v4l2::open(setup)?))
    }

    #[cfg(feature = "aravis")]
    fn open_aravis(&self, frame_rate_hz: f64) -> Result<Box<dyn Camera>, RigError> {
        use raysweep_drivers::camera::aravis::{AravisCamera, RigFacts};

        let camera = &self.file.camera;
        let period_us = 1e6 / frame_rate_hz;
        let facts = RigFacts {
            format: camera.pixel_format,
            row_time_us: 0.0,
            trigger_period_us: period_us,
            trigger_margin_us: period_us / 8.0,
            reopen: Duration::from_secs_f64(camera.reopen_s),
            free_hz: None,
        };
        Ok(Box::new(AravisCamera::open(&camera.aravis, facts)?))
    }

    #[cfg(not(feature = "aravis"))]
    fn open_aravis(&self, _: f64) -> Result<Box<dyn Camera>, RigError> {
        Err(super::built_without_aravis())
    }
}

#[cfg(test)]
mod tests {
    use raysweep_core::{DeviceState, FramePool, Subject};

    use super::*;
    use crate::rig::AnyRig;

    fn load(folder: &Path, text: &str) -> Result<DotRig, RigError> {
        let path = folder.join("rig.toml");
        std::fs::write(&path, text).unwrap();
        match AnyRig::load(&path)? {
            AnyRig::Dots(rig) => Ok(*rig),
            AnyRig::Plane(_) => panic!("its kind is another"),
        }
    }

    #[test]
    fn a_simulated_rig_opens_with_camera_mirror_and_stand() {
        let folder = tempfile::tempdir().unwrap();
        let text = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n[sim.dots]\nrows = 16\n";
        let rig = load(folder.path(), text).unwrap();
        let devices = rig.open(folder.path(), 13_500.0).unwrap();
        assert_eq!((devices.camera.capabilities().height, devices.pace), (32, Pace::Pipeline));
        assert!(devices.mirror.is_some() && devices.truth.is_some() && !rig.has_real_mirror());
        assert!(devices.stand.place(Subject::Plane(1)).unwrap());
        assert!(devices.stand.place(Subject::Plane(2)).is_err());
        let refused = load(folder.path(), &text.replace("rows = 16", "scene = \"teapot\"")).err().unwrap();
        assert!(matches!(refused, RigError::Config(_)), "{refused}");
    }

    #[test]
    fn a_recording_beside_the_rig_file_is_its_camera_and_needs_no_mirror() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("frames.raw"), [7_u8; 3 * 2 * 4 * 8]).unwrap();
        let text = "kind = \"dots\"\n[camera]\ndriver = \"replay\"\n\
                    [camera.replay]\npath = \"frames.raw\"\nwidth = 8\nheight = 4\n";
        let rig = load(folder.path(), text).unwrap();
        let DotDevices { mut camera, mirror, stand, pace, .. } = rig.open(folder.path(), 1000.0).unwrap();
        assert!(mirror.is_none() && matches!(stand, Stand::Recorded) && pace == Pace::Pipeline);
        camera.arm().unwrap();
        let mut buffer = FramePool::new(1, 64).take();
        for _ in 0..3 {
            assert_eq!(camera.state(), DeviceState::Streaming);
            camera.next_frame(&mut buffer, Duration::ZERO).unwrap().unwrap();
            assert!(buffer.iter().all(|byte| *byte == 7));
        }
        assert_eq!(camera.state(), DeviceState::Ready);
    }
}
