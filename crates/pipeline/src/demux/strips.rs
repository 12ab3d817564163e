//! The fold of a sweep that is larger than the memory: it keeps how images were taken, and reads their rows again.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;
use raysweep_transport::plane::Setting;

use super::tally::Tally;
use super::{DemuxFold, Taken};
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
        let mut tally = Tally::default();
        for first_row in (0..height).step_by(strip_rows) {
            let rows = first_row..height.min(first_row + strip_rows);
            let taken = read_rows(&not_kept, images, &rows)?;
            take(self.strip(rows, taken, &mut tally, go_on)?)?;
        }
        Ok(tally.products())
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
            let image =
                images.read(*point, rows.clone()).map_err(|what| FoldError { fold: "demux".into(), what })?;
            Ok((*role, Arc::new(Taken { setting: setting.clone(), image })))
        })
        .collect()
}
