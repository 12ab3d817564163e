//! What the stack of a sweep says of the rig and of the scene, before it is demultiplexed: settings that cannot be
//! trusted, the beam's width, the place of direct light, the prior.

use raysweep_transport::plane::calibrate::{
    CalibrateError, Choice, Optics, Sample, candidates, choose_prior, estimate_optics, settings_on_direct_row,
};
use raysweep_transport::plane::{Beam, Demux, PlaneError, Prior};

use crate::products::SweepStack;
use crate::schedule::{Spot, SweepGeometry};

/// Offsets of direct light below this are not worth a model of their own: they cost less than the noise.
const NEGLIGIBLE_U0_ROWS: f64 = 0.01;

/// How a sweep was demultiplexed, and why so.
#[derive(Debug, Clone, PartialEq)]
pub struct Findings {
    /// The prior.
    pub prior: Prior,
    /// The held-out error of the priors compared; none if the plan names its prior, or it could not be found.
    pub choice: Option<Choice>,
    /// Standard deviation of the beam, 0 for an ideal one.
    pub beam_sigma_rows: f64,
    /// Median place of direct light in projector rows, 0 where it lies in its own row.
    pub u0_rows: f64,
    /// Delay and exposure of the images that were left out.
    pub left_out_us: Vec<(f64, f64)>,
    /// What was found, as a key and a sentence each.
    pub remarks: Vec<(&'static str, String)>,
}

/// Chooses how to demultiplex a stack, leaves out of it what cannot be used, and says why. `planned` is the plan's
/// demultiplexer; `stated` says that the plan names its prior.
///
/// # Errors
/// When the stack makes no model.
pub fn find(
    planned: &Demux,
    stated: bool,
    geometry: &SweepGeometry,
    stack: &mut SweepStack,
) -> Result<(Demux, Findings), PlaneError> {
    let mut remarks = Vec::new();
    let left_out_us = leave_out(geometry, stack, &mut remarks)?;
    let mut findings = Findings {
        prior: planned.prior(),
        choice: None,
        beam_sigma_rows: geometry.beam_sigma_rows.unwrap_or(0.0),
        u0_rows: 0.0,
        left_out_us,
        remarks,
    };
    let mut demux = planned.with_settings(stack.settings.clone())?;
    let valid = stack.valid.as_ref().map(|valid| valid.view());
    let sample = match Sample::new(stack.timing.clone(), stack.settings.clone(), stack.images.view(), valid) {
        Ok(sample) => sample,
        Err(error) => {
            findings.remarks.push(("calibration", format!("nothing is estimated from the stack: {error}")));
            return Ok((demux, findings));
        }
    };

    let estimate = match estimate_optics(&sample, geometry.beam_sigma_rows) {
        Ok(estimate) => estimate,
        Err(error) => {
            findings.remarks.push(("beam", format!("not estimated: {error}")));
            return Ok((demux, findings));
        }
    };
    let optics = estimate.optics;
    findings.beam_sigma_rows = optics.beam_sigma_rows;
    let beam = match &estimate.beam {
        None => format!("{} rows, as the rig file says", optics.beam_sigma_rows),
        Some(Ok(found)) if found.sigma_rows == 0.0 => {
            format!("no wider than a row, from {} pixels with direct light", found.pixels)
        }
        Some(Ok(found)) => format!(
            "{:.3} ± {:.3} rows (standard deviation), estimated from {} pixels with direct light",
            found.sigma_rows, found.standard_error_rows, found.pixels
        ),
        Some(Err(error)) => format!("taken as ideal: {error}"),
    };
    findings.remarks.push(("beam", beam));
    demux = demux.with_timing(stack.timing.clone().with_beam(Beam::of_sigma(optics.beam_sigma_rows))?)?;

    let mut optics = optics;
    match &estimate.spike {
        Ok(map) => {
            let mut places: Vec<f32> = map.u0.iter().copied().collect();
            places.sort_by(f32::total_cmp);
            let at = |share: f64| f64::from(places[((places.len() - 1) as f64 * share) as usize]);
            findings.u0_rows = at(0.5);
            let (low, high) = (at(0.0), at(1.0));
            let error = map.standard_error.iter().fold(0.0_f32, |most, &error| most.max(error));
            if low.abs().max(high.abs()) < NEGLIGIBLE_U0_ROWS.max(f64::from(error)) {
                optics.spike = None;
                findings.u0_rows = 0.0;
                findings.remarks.push((
                    "direct light",
                    format!("in its own row within {error:.3} rows, from {} pixels", map.pixels),
                ));
            } else {
                demux = demux.with_spike(map.u0.clone())?;
                findings.remarks.push((
                    "direct light",
                    format!(
                        "{low:.3} to {high:.3} rows beside its own row (median {:.3}, standard error up to {error:.3}), from {} pixels: what rectification leaves",
                        findings.u0_rows, map.pixels
                    ),
                ));
            }
        }
        Err(error) => {
            findings.remarks.push(("direct light", format!("taken to lie in its own row: {error}")));
        }
    }

    let prior = match stated {
        true => format!("{}, as the plan says", name(findings.prior)),
        false => match choose(&sample, &optics, findings.prior) {
            Ok(choice) => {
                findings.prior = choice.prior();
                let reason = choice.reason();
                findings.choice = Some(choice);
                reason
            }
            Err(error) => format!("the default {}: {error}", name(findings.prior)),
        },
    };
    findings.remarks.push(("prior", prior));
    Ok((demux.with_prior(findings.prior)?, findings))
}

fn choose(sample: &Sample, optics: &Optics, default: Prior) -> Result<Choice, CalibrateError> {
    let mut compared = vec![default];
    compared.extend(candidates().into_iter().filter(|prior| *prior != default));
    choose_prior(sample, optics, &compared)
}

/// A prior with its weights.
pub fn name(prior: Prior) -> String {
    format!("{} (alpha {}, beta {})", prior.name(), prior.alpha(), prior.beta())
}

/// Leaves out settings whose edge cuts the direct row while a flying spot draws it: whether the spot has passed a pixel
/// by then depends on a projector column that nobody knows.
fn leave_out(
    geometry: &SweepGeometry,
    stack: &mut SweepStack,
    remarks: &mut Vec<(&'static str, String)>,
) -> Result<Vec<(f64, f64)>, PlaneError> {
    let Spot::Flying(_) = geometry.spot else { return Ok(Vec::new()) };
    let cut = settings_on_direct_row(&stack.timing, &stack.settings, 0.0)?;
    if cut.len() == stack.settings.len() {
        remarks.push((
            "flying spot",
            "every exposure begins or ends while the direct row is drawn, so none is left out: direct light is not to be trusted; move the delays by a row".into(),
        ));
        return Ok(Vec::new());
    }
    let at = |n: usize| (stack.settings[n].delays_us[0], stack.settings[n].exposure_us);
    let left_out: Vec<(f64, f64)> = cut.iter().map(|&n| at(n)).collect();
    stack.keep(|n| !cut.contains(&n));
    remarks.push((
        "flying spot",
        format!(
            "{} images are left out, because their exposure begins or ends while the spot draws the direct row; {} are kept",
            left_out.len(),
            stack.settings.len()
        ),
    ));
    Ok(left_out)
}
