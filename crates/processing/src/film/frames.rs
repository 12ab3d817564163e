//! The stored frames of a film, after all stages.

use std::iter;
use std::sync::Arc;

use ndarray::{Array2, Axis, Zip};
use raysweep_core::{Counts, SettingsId};
use raysweep_pipeline::{FilmImage, Point, Stages, Unit, run_stages};
use raysweep_session::film::{CycleEntry, Film, crc32};
use raysweep_session::ledger::State;
use raysweep_session::stack::ArrayName;
use raysweep_session::{Result, Session, stack};

use super::task::FilmTask;
use crate::plane::unit_of;

/// Said of a film without a dark image.
pub(super) const NO_DARK: &str =
    "the dark image is missing or damaged: no transport and no product can be made without it";

/// The cycles of a stored film.
pub(super) struct StoredFrames<'a> {
    film: Film,
    task: &'a FilmTask,
    stages: &'a Stages,
    /// The image without light.
    pub dark: FilmImage,
}

/// One cycle.
pub(super) struct StoredCycle {
    /// The frames in the settings' order, after all stages.
    pub frames: Vec<FilmImage>,
    /// Which pixels a stage replaced in some frame, `[t, s]`.
    pub filled: Array2<bool>,
}

impl<'a> StoredFrames<'a> {
    /// Opens a film; `None` if its dark image is missing or damaged.
    ///
    /// # Errors
    /// When the session cannot be read.
    pub fn open(
        session: &Session,
        state: &State,
        task: &'a FilmTask,
        stages: &'a Stages,
    ) -> Result<Option<Self>> {
        let Some(entry) = state.point(ArrayName::Dark, 0) else { return Ok(None) };
        let sum = session.stack()?.read_point(ArrayName::Dark, 0)?;
        if stack::crc32(sum.view()) != entry.crc32 {
            return Ok(None);
        }
        let unit = unit_of(0, entry, sum, None);
        let Ok(dark) = run_stages(stages, &unit) else { return Ok(None) };
        Ok(Some(Self { film: session.film()?, task, stages, dark: FilmImage::of(&unit, dark) }))
    }

    /// Reads a cycle, or says what is wrong with it.
    pub fn read(&self, entry: &CycleEntry) -> std::result::Result<StoredCycle, String> {
        let cycle = entry.cycle;
        let raw = match self.film.read(cycle) {
            Ok(Some(raw)) if crc32(raw.view()) == entry.crc32 => raw,
            Ok(_) => return Err(format!("cycle {cycle} is damaged: its checksum differs from the ledger's")),
            Err(error) => return Err(format!("cycle {cycle} is damaged ({error})")),
        };
        let settings = raw.len_of(Axis(0));
        if entry.delays_us.len() != settings || ![0, settings].contains(&entry.starts_ns.len()) {
            return Err(format!(
                "cycle {cycle} is damaged: the ledger has {} delays and {} times of its {settings} frames",
                entry.delays_us.len(),
                entry.starts_ns.len()
            ));
        }
        let mut filled = Array2::from_elem(self.dark.counts.dim(), false);
        let starts_ns = entry.starts_ns.iter().map(|&start_ns| vec![start_ns]);
        let times = entry.delays_us.iter().zip(starts_ns.chain(iter::repeat(Vec::new())));
        let settings = raw.axis_iter(Axis(0)).zip(self.task.task.settings()).zip(times);
        let frames = settings.map(|((raw, point), (&delay_us, starts_ns))| {
            let unit = unit(point, entry, (delay_us, starts_ns), raw.mapv(u32::from));
            let image = run_stages(self.stages, &unit).map_err(|error| format!("cycle {cycle}: {error}"))?;
            Zip::from(&mut filled)
                .and(&raw)
                .and(&image)
                .for_each(|filled, &raw, &image| *filled |= f32::from(raw) != image);
            Ok(FilmImage::of(&unit, image))
        });
        let frames = frames.collect::<std::result::Result<_, String>>()?;
        Ok(StoredCycle { frames, filled })
    }
}

fn unit(
    (ordinal, point): (u32, &Point),
    entry: &CycleEntry,
    (delay_us, starts_ns): (f64, Vec<i64>),
    sum: Array2<u32>,
) -> Unit {
    Unit {
        id: SettingsId { point: ordinal, attempt: entry.cycle as u32 },
        frames: 1,
        delay_us: point.delay_us,
        exposure_us: entry.exposure_us,
        delays_us: vec![delay_us],
        run: 0,
        starts_ns,
        sum: Arc::new(sum),
        clipped: None,
        counts: Counts::default(),
    }
}
