//! What a simulated dot rig consists of.

use raysweep_config::sim::DotsConfig;
use raysweep_core::{MechanicalDeg, MirrorLimits, PixelFormat, ns_from_us};

use super::beam::DotBeam;
use super::scene::DotScene;
use crate::sensor::ImageSensor;

/// Parameters from the rest of the rig file that the simulation needs.
#[derive(Debug, Clone)]
pub struct DotsSetup {
    /// Pixel packing of the frames.
    pub format: PixelFormat,
    /// Counts, above black, of a white plane at the dot's centre in an exposure of `white_exposure_us`.
    pub white_dn: f64,
    /// Exposure that `white_dn` refers to.
    pub white_exposure_us: f64,
    /// Counts without light.
    pub black_dn: f64,
    /// Angle between the beam and the mirror's normal at rest.
    pub incidence: MechanicalDeg,
    /// Limits of the mirror.
    pub limits: MirrorLimits,
}

/// The parts of the rig that are constant while it runs.
pub(super) struct Bench {
    pub config: DotsConfig,
    pub setup: DotsSetup,
    pub scene: DotScene,
    pub beam: DotBeam,
    pub sensor: ImageSensor,
    /// Camera rows and columns, including the margin.
    pub size: (usize, usize),
}

impl Bench {
    /// Light of a white plane in an exposure of `exposure_us`, relative to one of `white_exposure_us`.
    pub fn exposed(&self, exposure_us: f64) -> f64 {
        exposure_us / self.setup.white_exposure_us
    }

    /// Minimum time between two frames.
    pub fn frame_ns(frame_rate_hz: f64) -> i64 {
        ns_from_us(1e6 / frame_rate_hz).max(1)
    }
}
