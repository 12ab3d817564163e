//! For data larger than memory: reads images from the stack again, and writes and sums up the transport strip by
//! strip.

use std::ops::Range;

use ndarray::{Array2, s};
use raysweep_pipeline::{ImageRows, PointRows, Stages, run_stages};
use raysweep_session::ledger::State;
use raysweep_session::stack::{ArrayName, Stack};
use raysweep_transport::plane::Transport;

use crate::plane::{PlaneTask, place, unit_of};

/// The images of a session, as they were given to its demultiplexer.
pub struct StoredImages<'a> {
    /// The plan on its rig.
    pub task: &'a PlaneTask,
    /// State of the session.
    pub state: &'a State,
    /// Stored data. Each point was checked against the ledger when it was stored or read for a resumed run.
    pub stack: &'a Stack,
    /// Stages that process each image.
    pub stages: &'a Stages,
}

impl ImageRows for StoredImages<'_> {
    fn read(&self, point: u32, rows: Range<usize>) -> Result<PointRows, String> {
        let height = self.task.geometry.height;
        let planned = self.task.schedule.points.get(point as usize);
        let (array, index) = place(planned.ok_or_else(|| format!("the plan has no point {point}"))?.role);
        let stored = self.state.point(array, index);
        let entry =
            stored.ok_or_else(|| format!("{} {index} is not stored: resume the run", array.as_str()))?;
        let halo_rows = self.stages.iter().map(|stage| stage.halo_rows()).sum::<Option<usize>>();
        let around = halo_rows.map_or(0..height, |halo_rows| {
            rows.start.saturating_sub(halo_rows)..height.min(rows.end + halo_rows)
        });
        let read =
            |array| self.stack.read_rows(array, index, around.clone()).map_err(|error| error.to_string());
        let clipped = entry.clipped_crc32.map(|_| read(ArrayName::Clipped)).transpose()?;
        let unit = unit_of(point, entry, read(array)?, clipped);
        let image = run_stages(self.stages, &unit).map_err(|error| error.to_string())?;
        let inner = s![rows.start - around.start..rows.end - around.start, ..];
        let clipped = unit.clipped.map(|frames| frames.slice(inner).mapv(|frames| frames > 0));
        Ok(PointRows { image: image.slice(inner).to_owned(), clipped })
    }
}

/// Sums of a transport over relative rows, `[t, s]` each: enough for the report without the transport itself.
#[derive(Debug, Clone, PartialEq)]
pub struct Overview {
    /// Relative row of index 0 of its profiles.
    pub u_min: i32,
    /// Light from u = 0.
    pub epipolar: Array2<f32>,
    /// Light from all other rows.
    pub non_epipolar: Array2<f32>,
    /// Light from |u| <= 4.
    pub near: Array2<f32>,
    /// Light from |u| <= 20.
    pub middle: Array2<f32>,
    /// All light.
    pub total: Array2<f32>,
}

impl Overview {
    /// Sums of a whole transport, or of some rows of one.
    pub fn of(transport: &Transport) -> Self {
        Self {
            u_min: transport.u_min,
            epipolar: transport.epipolar(1),
            non_epipolar: transport.non_epipolar(1),
            near: transport.band(-4..=4),
            middle: transport.band(-20..=20),
            total: transport.total(),
        }
    }

    /// Empty sums for `height` rows, to be filled with [`Self::put`].
    pub fn empty(height: usize, transport: &Transport) -> Self {
        let image = Array2::zeros((height, transport.saturated.ncols()));
        Self {
            u_min: transport.u_min,
            epipolar: image.clone(),
            non_epipolar: image.clone(),
            near: image.clone(),
            middle: image.clone(),
            total: image,
        }
    }

    /// Fills in the rows from `first_row` on with the sums of `transport`.
    pub fn put(&mut self, first_row: usize, transport: &Transport) {
        let rows = Self::of(transport);
        for (whole, part) in [
            (&mut self.epipolar, rows.epipolar),
            (&mut self.non_epipolar, rows.non_epipolar),
            (&mut self.near, rows.near),
            (&mut self.middle, rows.middle),
            (&mut self.total, rows.total),
        ] {
            whole.slice_mut(s![first_row..first_row + part.nrows(), ..]).assign(&part);
        }
    }
}
