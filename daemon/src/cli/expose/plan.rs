//! The plan that exposures are chosen for, and what becomes of it.

use raysweep_config::plan::{Axis, with_tables};
use raysweep_config::{Plan, Procedure};
use raysweep_proto::{CheckReport, ExpectedError};

use super::trial::{LongestAt, PlanExposures, in_hundredths};
use crate::cli::failure::CommandFailure;

/// With a larger expected error nothing is foreseen that frames are counted by, such as where the scenes that it is expected
/// of saturate.
const FORESEEN: f64 = 0.5;
/// Edges nearer to the pixel's own row than this share of the exposure divide the light about it.
const NEAR_EDGES: f64 = 0.15;
/// A plan's only exposure is shortened to no less than this share of it.
const LEAST_OF_ONE: f64 = 0.25;
/// Averaging over more frames is not proposed.
pub(super) const MAX_AVERAGE: f64 = 64.0;
/// Noise this much larger or smaller than what averaging does not remove counts as equal to it: fewer frames change what
/// else is foreseen, too, so that the balance is found step by step.
pub(super) const BALANCED: f64 = 1.1;

/// The exposures of a plan; `None` if there are none to choose.
pub(super) fn plan_exposures(procedure: &Procedure) -> Option<PlanExposures> {
    let grids: Vec<(Vec<f64>, Vec<f64>)> = match procedure {
        Procedure::Sweep(sweep) => {
            let extra = sweep.extra.iter().map(|grid| (grid.delay_us.values(), grid.exposure_us.values()));
            extra.chain([(sweep.delay_us.values(), sweep.exposure_us.values())]).collect()
        }
        Procedure::Film(film) => vec![(film.delay_us.values(), vec![film.exposure_us])],
        _ => return None,
    };
    let mut longest_at: Vec<LongestAt> = Vec::new();
    for (delays_us, exposures_us) in &grids {
        let exposure_us = exposures_us.iter().copied().reduce(f64::max)?;
        for &delay_us in delays_us {
            match longest_at.iter_mut().find(|known| known.delay_us == delay_us) {
                Some(known) => known.exposure_us = known.exposure_us.max(exposure_us),
                None => longest_at.push(LongestAt { delay_us, exposure_us }),
            }
        }
    }
    longest_at.sort_by(|a, b| a.delay_us.total_cmp(&b.delay_us));
    let longest_us = longest_at.iter().map(|longest| longest.exposure_us).reduce(f64::max)?;
    let shortest_us = grids.iter().flat_map(|(_, exposures)| exposures).copied().reduce(f64::min)?;
    let shortest_us = if shortest_us < longest_us { shortest_us } else { LEAST_OF_ONE * longest_us };
    Some(PlanExposures { shortest_us, longest_us, longest_at })
}

/// The plan without longer exposures.
pub(super) fn limited(text: &str, most_us: f64) -> Result<String, CommandFailure> {
    let limit = |axis: &Axis| each_once(axis.values().into_iter().map(|us| us.min(most_us)));
    changed(text, |procedure| match procedure {
        Procedure::Sweep(sweep) => {
            sweep.exposure_us = limit(&sweep.exposure_us);
            for grid in &mut sweep.extra {
                if let [exposure_us] = grid.exposure_us.values()[..] {
                    grid.delay_us = with_edges(&grid.delay_us, exposure_us, exposure_us.min(most_us));
                }
                grid.exposure_us = limit(&grid.exposure_us);
            }
        }
        Procedure::Film(film) => {
            let shorter_us = film.exposure_us.min(most_us);
            film.delay_us = with_edges(&film.delay_us, film.exposure_us, shorter_us);
            film.exposure_us = shorter_us;
        }
        _ => {}
    })
}

/// The delays for a shorter exposure. Where an edge lay near the pixel's own row, it stays where it was.
fn with_edges(delays: &Axis, exposure_us: f64, shorter_us: f64) -> Axis {
    let half_us = (exposure_us - shorter_us) / 2.0;
    let moved = |delay_us: f64| {
        let is_near = (delay_us.abs() - exposure_us / 2.0).abs() < NEAR_EDGES * exposure_us;
        let moved_us = if is_near { delay_us - half_us.copysign(delay_us) } else { delay_us };
        in_hundredths(moved_us)
    };
    each_once(delays.values().into_iter().map(moved))
}

/// The values without duplicates: longer exposures become one, and an edge that is moved may meet a delay that is not.
fn each_once(values: impl Iterator<Item = f64>) -> Axis {
    let mut kept = Vec::new();
    values.for_each(|us| {
        if !kept.contains(&us) {
            kept.push(us)
        }
    });
    Axis::of_values(kept)
}

/// The plan with so many frames per point that noise is as large as what averaging does not remove; `None` where it is so
/// already, nothing is averaged, or nothing is foreseen.
pub(super) fn averaged(text: &str, foreseen: &CheckReport) -> Result<Option<String>, CommandFailure> {
    let Some(ratio) = foreseen.advice.as_ref().and_then(|advice| noise_ratio(&advice.expected)) else {
        return Ok(None);
    };
    let plan = changed(text, |procedure| {
        if let Procedure::Sweep(sweep) = procedure
            && !(BALANCED.recip()..=BALANCED).contains(&ratio)
        {
            let frames = (f64::from(sweep.average) * ratio * ratio).ceil();
            sweep.average = frames.clamp(1.0, MAX_AVERAGE.max(f64::from(sweep.average))) as u32;
        }
    })?;
    Ok((plan != text).then_some(plan))
}

/// Noise over what averaging does not remove; `None` where nothing is foreseen that frames are counted by.
pub(super) fn noise_ratio(expected: &ExpectedError) -> Option<f64> {
    let ExpectedError { noise, bias, calibration, total, .. } = expected;
    (total.median < FORESEEN)
        .then(|| noise.median / bias.median.hypot(calibration.median).max(f64::MIN_POSITIVE))
}

fn changed(text: &str, change: impl FnOnce(&mut Procedure)) -> Result<String, CommandFailure> {
    let failed = |error: &dyn std::fmt::Display| CommandFailure::Exposure(error.to_string());
    let mut plan = Plan::parse(text).map_err(|error| failed(&error))?;
    let before = plan.procedure.clone();
    change(&mut plan.procedure);
    let table = match &plan.procedure {
        procedure if *procedure == before => return Ok(text.to_owned()),
        Procedure::Sweep(sweep) => sweep.to_toml(),
        Procedure::Film(film) => film.to_toml(),
        _ => return Ok(text.to_owned()),
    };
    with_tables(text, &table).map_err(|error| failed(&error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shorter_exposure_keeps_its_edges_on_the_own_row() {
        let delays = Axis::List(vec![-640.0, -311.0, 0.0, 289.0, 333.0]);
        assert_eq!(with_edges(&delays, 600.0, 430.0).values(), [-640.0, -226.0, 0.0, 204.0, 248.0]);
        assert_eq!(with_edges(&delays, 600.0, 600.0), delays);
        let meeting = Axis::List(vec![0.0, 200.0, 300.0]);
        assert_eq!(with_edges(&meeting, 600.0, 400.0).values(), [0.0, 200.0], "one delay where two meet");
    }

    #[test]
    fn longer_exposures_are_shortened_and_the_rest_of_a_plan_stays() {
        let text = "kind = \"sweep\"\nname = \"a\"\n[sweep]\nexposure_us = [100, 400, 800, 1200]\naverage = 3\n\
                    [[sweep.extra]]\ndelay_us = [0]\nexposure_us = [900, 50]\n[[stage]]\nname = \"demux\"\nalpha = 0.5\n";
        let plan = Plan::parse(&limited(text, 500.0).unwrap()).unwrap();
        let Procedure::Sweep(sweep) = &plan.procedure else { panic!("{plan:?}") };
        assert_eq!(sweep.exposure_us.values(), [100.0, 400.0, 500.0]);
        assert_eq!(sweep.extra[0].exposure_us.values(), [500.0, 50.0]);
        assert_eq!((sweep.average, plan.name.as_str(), plan.stages.len()), (3, "a", 1));
        let asked = plan_exposures(&plan.procedure).unwrap();
        assert_eq!((asked.shortest_us, asked.longest_us), (50.0, 500.0));
        let longest =
            |delay_us| asked.longest_at.iter().find(|at| at.delay_us == delay_us).unwrap().exposure_us;
        assert_eq!((longest(0.0), longest(-1500.0)), (500.0, 500.0));
        assert_eq!(limited(text, 1200.0).unwrap(), text, "nothing to change");
        let film = limited("kind = \"film\"\n[film]\nexposure_us = 700\n", 600.5).unwrap();
        let asked = plan_exposures(&Plan::parse(&film).unwrap().procedure).unwrap();
        assert_eq!((asked.shortest_us, asked.longest_us), (0.25 * 600.5, 600.5));
        assert!(plan_exposures(&Plan::parse("kind = \"darks\"\n").unwrap().procedure).is_none());
    }
}
