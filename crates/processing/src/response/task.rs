//! A plan of chirps on a dot rig.

use raysweep_config::{ConfigError, DotRigFile, Places, Plan, ResponsePlan};
use raysweep_core::{CameraSettings, MirrorPath, PixelFormat, Shutter};
use raysweep_session::stack::Contents;
use raysweep_transport::dots::{FrameShape, Region};

use super::path;
use crate::saturation::saturation_dn;

/// Names of a mirror's axes in files and messages.
pub const AXES: [&str; 2] = ["x", "y"];

/// A plan of chirps on a dot rig.
pub struct ResponseTask {
    /// The plan's name.
    pub name: String,
    /// The plan's own table.
    pub response: ResponsePlan,
    /// Size of the frames.
    pub shape: FrameShape,
    /// Pixel format of the frames.
    pub format: PixelFormat,
    /// Region to search for the dot.
    pub region: Region,
    /// Mirror paths; the chirp of x comes first.
    pub paths: [MirrorPath; 2],
    places: Places,
}

impl ResponseTask {
    /// A plan on a rig with a camera of this size (rows, columns).
    ///
    /// # Errors
    /// With the position in the plan's text, for what this rig cannot do.
    pub fn new(
        plan: &Plan,
        response: ResponsePlan,
        rig: &DotRigFile,
        format: PixelFormat,
        size: (usize, usize),
    ) -> Result<Self, ConfigError> {
        let shape = FrameShape::new(size.0, size.1, 1).map_err(|error| {
            let message = format!("the camera's frames: {error}; read out another region of its sensor");
            plan.places.error(&["kind"], message)
        })?;
        let region = match response.region {
            Some([top, bottom, left, right]) => Region { rows: top..bottom, columns: left..right },
            None => Region::whole(shape),
        };
        region.check(shape).map_err(|error| {
            plan.places.error(&["response", "region"], format!("response.region: {error}"))
        })?;
        let paths = path::paths(&response, &rig.limits())
            .map_err(|(key, message)| plan.places.error(&["response", key], message))?;
        let (name, places) = (plan.name.clone(), plan.places.clone());
        Ok(Self { name, response, shape, format, region, paths, places })
    }

    /// What its session stores.
    pub fn contents(&self) -> Contents {
        Contents::Axes { axes: AXES.len() }
    }

    /// An error about a value of the plan.
    pub fn refuse(&self, path: &[&str], message: impl Into<String>) -> ConfigError {
        self.places.error(path, message)
    }

    /// Camera settings for the records.
    pub fn camera_settings(&self) -> CameraSettings {
        let exposure_us = self.response.exposure_us;
        CameraSettings { shutter: Shutter::Global, exposure_us, trigger_delay_us: 0.0 }
    }

    /// Counts from which on a pixel is overexposed.
    pub fn saturation_dn(&self) -> u16 {
        saturation_dn(self.format) as u16
    }

    /// Number of frames in the record of one axis.
    pub fn frames(&self) -> usize {
        path::frames(&self.response, &self.paths[0])
    }

    /// The commanded angle of each frame, in degrees.
    pub fn commanded_deg(&self, axis: usize) -> Vec<f64> {
        path::commanded_deg(&self.response, &self.paths[axis], axis)
    }
}
