//! The stored images under pictures, in units of light.

use ndarray::Array2;
use raysweep_pipeline::{LightScale, PointRole};
use raysweep_session::ledger::State;
use raysweep_session::stack::{ArrayName, Stack, crc32};

use super::PatternsTask;
use crate::plane::place;

/// The images of a session.
pub(crate) struct PictureImages<'a> {
    pub task: &'a PatternsTask,
    pub state: &'a State,
    pub stack: &'a Stack,
    scale: LightScale,
}

/// An image of light `[t, s]`, 1 for a white pixel lit by its own row.
pub(crate) struct LitImage {
    pub light: Array2<f32>,
    /// Where a frame saturated, if any did.
    pub clipped: Option<Array2<u32>>,
    pub frames: u32,
}

impl<'a> PictureImages<'a> {
    pub fn new(task: &'a PatternsTask, state: &'a State, stack: &'a Stack) -> Self {
        let rows: Vec<usize> = (0..task.task.geometry.height).collect();
        Self { task, state, stack, scale: task.task.geometry.scale_of(&rows) }
    }

    /// The image of a picture in a setting.
    ///
    /// # Errors
    /// What keeps it from being used.
    pub fn image(&self, picture: usize, setting: usize) -> Result<LitImage, String> {
        let index = self.task.index(picture, setting);
        let (mean, frames) = self.mean(ArrayName::Sum, index)?;
        let (dark, _) = self.dark(setting)?;
        let entry = self.state.point(ArrayName::Sum, index);
        let clipped = match entry.and_then(|entry| entry.clipped_crc32) {
            Some(crc) => Some(self.read(ArrayName::Clipped, index, crc)?),
            None => None,
        };
        Ok(LitImage { light: self.scale.light(mean.view(), dark.view()), clipped, frames })
    }

    /// The dark image of a setting's exposure, and its frames.
    ///
    /// # Errors
    /// What keeps it from being used.
    pub fn dark(&self, setting: usize) -> Result<(Array2<f32>, u32), String> {
        let exposure_us = self.task.settings()[setting].exposure_us;
        match self.task.task.schedule.dark_of(exposure_us) {
            Some(role @ PointRole::Dark(_)) => {
                let (array, index) = place(role);
                self.mean(array, index)
            }
            _ => Err(format!("there is no dark image of {exposure_us} us")),
        }
    }

    /// The mean of a point's frames, in counts.
    fn mean(&self, array: ArrayName, index: usize) -> Result<(Array2<f32>, u32), String> {
        let again = "`raysweep resume` acquires it";
        let entry = self
            .state
            .point(array, index)
            .filter(|entry| entry.frames > 0)
            .ok_or_else(|| format!("{} {index} is missing: {again}", array.as_str()))?;
        let sum = self.read(array, index, entry.crc32)?;
        Ok((sum.mapv(|sum| sum as f32 / entry.frames as f32), entry.frames))
    }

    fn read(&self, array: ArrayName, index: usize, crc: u32) -> Result<Array2<u32>, String> {
        let damaged = |why: String| {
            format!("{} {index} is damaged ({why}): `raysweep resume` acquires it again", array.as_str())
        };
        let image = self.stack.read_point(array, index).map_err(|error| damaged(error.to_string()))?;
        if crc32(image.view()) != crc {
            return Err(damaged("its checksum differs from the ledger's".into()));
        }
        Ok(image)
    }
}
