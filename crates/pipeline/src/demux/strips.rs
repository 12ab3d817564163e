//! The fold of a sweep that is larger than the memory: it keeps how images were taken, and reads their rows again.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use ndarray::Axis;
use rayon::prelude::*;
use raysweep_transport::plane::{PlaneError, Setting};

use super::tally::Tally;
use super::{DemuxFold, Taken, refused};
use crate::findings::rows_to_choose_by;
use crate::schedule::Role;
use crate::stage::{FoldError, Product};
use crate::strips::{ImageRows, InStrips};

impl DemuxFold {
    pub(super) fn solve_in_strips(
        &mut self,
        strips: InStrips<'_>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Vec<Product>, FoldError> {
        let InStrips { images, strip_rows, take } = strips;
        let not_kept = self.not_kept.take().unwrap_or_default();
        let height = self.geometry.height;
        let choices = self.choose(self.stack(self.read_to_choose_by(&not_kept, images, go_on)?)?)?;
        let mut tally = Tally::default();
        for first_row in (0..height).step_by(strip_rows) {
            let rows = first_row..height.min(first_row + strip_rows);
            let halo_rows = choices.halo_rows();
            let around = first_row.saturating_sub(halo_rows)..height.min(rows.end + halo_rows);
            let held = self.hold(around.start, read_rows(&not_kept, images, &around)?)?;
            take(&choices.findings, self.strip(&choices, rows, held, &mut tally, go_on)?)?;
        }
        Ok(tally.products(choices.findings))
    }

    /// The rows of [`rows_to_choose_by`] of all images. They lie all over an image, so that it is read whole: one at a time,
    /// because many together may be larger than the memory.
    fn read_to_choose_by(
        &self,
        not_kept: &BTreeMap<Role, (u32, Setting)>,
        images: &dyn ImageRows,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<BTreeMap<Role, Arc<Taken>>, FoldError> {
        let height = self.geometry.height;
        let rows = rows_to_choose_by(height);
        let of_rows = |(role, (point, setting)): (&Role, &(u32, Setting))| {
            if !go_on() {
                return Err(refused(PlaneError::Stopped));
            }
            let image = images.read(*point, 0..height).map_err(not_read)?.select(Axis(0), &rows);
            Ok((*role, Arc::new(Taken { setting: setting.clone(), image })))
        };
        not_kept.iter().map(of_rows).collect()
    }
}

/// The images of some camera rows.
fn read_rows(
    not_kept: &BTreeMap<Role, (u32, Setting)>,
    images: &dyn ImageRows,
    rows: &Range<usize>,
) -> Result<BTreeMap<Role, Arc<Taken>>, FoldError> {
    not_kept
        .par_iter()
        .map(|(role, (point, setting))| {
            let image = images.read(*point, rows.clone()).map_err(not_read)?;
            Ok((*role, Arc::new(Taken { setting: setting.clone(), image })))
        })
        .collect()
}

fn not_read(what: String) -> FoldError {
    FoldError { fold: "demux".into(), what }
}
