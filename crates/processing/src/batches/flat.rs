//! Passes the flat field between a run, its session, and later runs.

use std::path::{Path, PathBuf};

use ndarray::{Array2, Axis};
use raysweep_session::dots::FlatArrays;
use raysweep_session::integrity::{DamagedPart, changed_inputs};
use raysweep_session::ledger::Entry;
use raysweep_session::{Error, Result, Session};
use raysweep_transport::dots::{Correction, FlatField};

use super::task::DotTask;

/// Stores the gains that are applied to the run's columns; returns the entry that binds them in the ledger.
///
/// # Errors
/// When the session cannot be written.
pub fn keep(session: &Session, correction: &Correction) -> Result<Entry> {
    let size = (correction.shape().height(), correction.shape().width());
    let mut repaired = Array2::from_elem(size, false);
    correction
        .hot()
        .iter()
        .for_each(|&pixel| repaired[[pixel as usize / size.1, pixel as usize % size.1]] = true);
    let gain = Array2::from_shape_fn(size, |(t, s)| correction.gain()[t * size.1 + s]);
    session.dots()?.write_flat(&FlatArrays { gain, repaired })?;
    session.bind(|file| file.starts_with(FOLDER))
}

/// Where the flat field is in a session.
const FOLDER: &str = "dots.zarr/flat/";

fn is_flat_field(part: &DamagedPart) -> bool {
    matches!(part, DamagedPart::Input { file } if file.starts_with(FOLDER))
}

impl DotTask {
    /// Loads the flat field of the earlier session that the plan names, if any: one in `data`, or in a folder that the
    /// rig file allows.
    ///
    /// # Errors
    /// When that session is elsewhere, or has no flat field, or one of another size.
    pub fn earlier_flat_field(&self, data: &Path) -> Result<Option<FlatField>> {
        let Some(dir) = &self.correct.flat_field else { return Ok(None) };
        let size = [self.shape.height(), self.shape.width()];
        let folders: Vec<PathBuf> = [data.to_owned()].into_iter().chain(self.folders.clone()).collect();
        let session = Session::open_below(&folders, dir)?;
        let changed = changed_inputs(&session, &session.state()?)?;
        if let Some(damage) = changed.iter().find(|damage| is_flat_field(&damage.part)) {
            let what = session.dir().display().to_string();
            return Err(Error::Codec { action: "use the flat field of", what, why: damage.to_string() });
        }
        let FlatArrays { gain, repaired } = FlatArrays::read(&session.dots_path(), size)?;
        let dead =
            repaired.indexed_iter().filter(|(_, repaired)| **repaired).map(|(pixel, _)| pixel).collect();
        Ok(Some(FlatField { gain: gain.insert_axis(Axis(2)), dead }))
    }
}
