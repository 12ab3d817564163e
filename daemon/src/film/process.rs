//! Offline: the transports of a film made again from its stored frames.

use std::sync::Arc;

use ndarray::{Array2, Axis};
use raysweep_core::{Counts, SettingsId};
use raysweep_pipeline::{Unit, run_stages};
use raysweep_session::Session;
use raysweep_session::film::{CycleEntry, crc32};
use raysweep_session::ledger::State;
use raysweep_session::stack::ArrayName;
use raysweep_transport::plane::Setting;

use crate::config::ConfigError;
use crate::processing::{Processing, Task, unit_of};

/// Makes the transports of all stored cycles again; returns what could not be made, and why.
///
/// # Errors
/// When the disk refuses.
pub fn process(
    session: &Session,
    task: &Task,
    state: &State,
    processing: &Processing,
) -> raysweep_session::Result<Vec<String>> {
    let solver = match task.film_solver() {
        Ok(solver) => solver,
        Err(ConfigError { message, .. }) => return Ok(vec![message]),
    };
    let Some(dark) = dark_image(session, state, processing)? else {
        return Ok(vec!["the dark image is missing or damaged: no transport can be made without it".into()]);
    };
    let film = session.film()?;
    let transports = super::create_transports(session, task, solver.reach_rows())?;
    let mut problems = Vec::new();
    // As during the film: each from the one before, so that the bits are the same where none was left out.
    let mut last = None;
    for entry in state.cycles() {
        let frames = match film.read(entry.cycle) {
            Ok(Some(frames)) if crc32(frames.view()) == entry.crc32 => frames,
            Ok(_) => {
                problems.push(format!("cycle {} is damaged: its checksum is not the ledger's", entry.cycle));
                continue;
            }
            Err(error) => {
                problems.push(format!("cycle {} is damaged ({error})", entry.cycle));
                continue;
            }
        };
        let images = frames.axis_iter(Axis(0)).zip(task.settings()).zip(&entry.delays_us).map(
            |((frame, (ordinal, _)), &delay_us)| {
                let unit = frame_unit(ordinal, entry, delay_us, frame.mapv(u32::from));
                let setting = Setting::new(delay_us, entry.exposure_us);
                run_stages(&processing.stages, &unit).map(|image| (setting, Arc::new(image)))
            },
        );
        let solved =
            images.collect::<Result<Vec<_>, _>>().map_err(|error| error.to_string()).and_then(|images| {
                solver.solve(&images, &dark, last.as_ref(), &|| true).map_err(|error| error.to_string())
            });
        match solved {
            Ok(transport) => {
                transports.write(entry.cycle, transport.t.view())?;
                last = Some(transport);
            }
            Err(error) => problems.push(format!("cycle {}: {error}", entry.cycle)),
        }
    }
    Ok(problems)
}

fn frame_unit(ordinal: u32, entry: &CycleEntry, delay_us: f64, sum: Array2<u32>) -> Unit {
    Unit {
        id: SettingsId { point: ordinal, attempt: entry.cycle as u32 },
        frames: 1,
        exposure_us: entry.exposure_us,
        delays_us: vec![delay_us],
        last_exposure_ns: None,
        sum: Arc::new(sum),
        counts: Counts::default(),
    }
}

/// The stored dark image after all stages, if it is sound.
fn dark_image(
    session: &Session,
    state: &State,
    processing: &Processing,
) -> raysweep_session::Result<Option<Array2<f32>>> {
    let Some(entry) = state.point(ArrayName::Dark, 0) else { return Ok(None) };
    let sum = session.stack()?.read_point(ArrayName::Dark, 0)?;
    if raysweep_session::stack::crc32(sum.view()) != entry.crc32 {
        return Ok(None);
    }
    Ok(run_stages(&processing.stages, &unit_of(0, entry, sum)).ok())
}
