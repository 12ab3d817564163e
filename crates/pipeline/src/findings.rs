//! What the stack of a sweep says of the rig and of the scene, before it is demultiplexed: settings that cannot be
//! trusted, the beam's width, the place of direct light, the prior, the noise.

use ndarray::{Array3, Axis};
use raysweep_transport::plane::calibrate::{
    BeamEstimate, CalibrateError, Choice, FlyingSpot, OpticsEstimate, Sample, candidates, choose_prior,
    estimate_optics, settings_on_direct_row,
};
use raysweep_transport::plane::{Beam, Coupled, Coupling, Demux, NoiseModel, PlaneError, Prior};

use crate::demux::DemuxOptions;
use crate::products::SweepStack;
use crate::schedule::{Spot, SweepGeometry};

/// Offsets of direct light below this are not worth a model of their own: they cost less than the noise.
const NEGLIGIBLE_U0_ROWS: f32 = 0.01;

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
    /// What makes the result worse than it looks.
    pub warnings: Vec<String>,
}

/// A stack made ready for the solver.
pub struct Prepared {
    /// Solves it.
    pub demux: Demux,
    /// The stack after spatial coupling, `[settings, t, s]`; none: as it was taken.
    pub coupled: Option<Array3<f32>>,
    /// Why so.
    pub findings: Findings,
}

/// Chooses how to demultiplex a stack, and leaves out of it what cannot be used. `planned` is the plan's demultiplexer.
///
/// # Errors
/// When the stack makes no model.
pub fn prepare(
    planned: &Demux,
    options: &DemuxOptions,
    geometry: &SweepGeometry,
    stack: &mut SweepStack,
) -> Result<Prepared, PlaneError> {
    let mut findings = Findings {
        prior: planned.prior(),
        choice: None,
        beam_sigma_rows: geometry.beam_sigma_rows.unwrap_or(0.0),
        u0_rows: 0.0,
        left_out_us: Vec::new(),
        remarks: Vec::new(),
        warnings: Vec::new(),
    };
    let spot = leave_out(geometry, stack, &mut findings)?;
    let planned = planned.with_settings(stack.settings.clone())?;
    let mut coupled = couple(options, stack, &mut findings)?;
    let mut demux = match calibrate(&planned, options, geometry, stack, coupled.as_ref(), &mut findings) {
        Ok(demux) => demux,
        Err(error) => {
            findings.remarks.push(("calibration", format!("nothing is estimated from the stack: {error}")));
            planned
        }
    };
    if let Some((spot, mut whole, cut)) = spot {
        // Neighbours see other moments of the spot, so images that depend on it are solved as they were taken.
        if let Some(steady) = coupled.take() {
            let mut all = whole.images.clone();
            let kept = (0..whole.settings.len()).filter(|n| !cut.contains(n));
            kept.zip(steady.outer_iter())
                .for_each(|(n, image)| all.index_axis_mut(Axis(0), n).assign(&image));
            coupled = Some(all);
        }
        (whole.noise, whole.variance_ratio) = (stack.noise, stack.variance_ratio.take());
        *stack = whole;
        demux = demux.with_settings(stack.settings.clone())?.with_spot(spot)?;
    }
    stack.timing = demux.timing().clone();
    stack.prior = demux.prior();
    Ok(Prepared { demux, coupled, findings })
}

/// Estimates the optics from the images as they were taken, and chooses the prior for those that are solved.
fn calibrate(
    planned: &Demux,
    options: &DemuxOptions,
    geometry: &SweepGeometry,
    stack: &SweepStack,
    coupled: Option<&Array3<f32>>,
    findings: &mut Findings,
) -> Result<Demux, CalibrateError> {
    let valid = stack.valid.as_ref().map(|valid| valid.view());
    let sample_of = |images: &Array3<f32>| {
        Sample::new(stack.timing.clone(), stack.settings.clone(), images.view(), valid)
    };
    let sample = sample_of(&stack.images)?;
    let OpticsEstimate { mut optics, beam, spike } = estimate_optics(&sample, geometry.beam_sigma_rows)?;
    if beam.is_some() && optics.beam_sigma_rows > 0.0 {
        findings.warnings.push(format!(
            "the beam's width, {:.2} rows, was estimated from this scene, and light that spreads by about a row under the surface looks the same: measure it once on a matt white surface and state it as projector.beam_sigma_rows in the rig file",
            optics.beam_sigma_rows
        ));
    }
    findings.remarks.push(("beam", say_beam(beam.as_ref(), optics.beam_sigma_rows)));
    let sigma_rows = optics.beam_sigma_rows;
    let beam = Beam::of_sigma(sigma_rows);
    let mut demux = planned.with_timing(stack.timing.clone().with_beam(beam)?)?;
    findings.beam_sigma_rows = sigma_rows;

    let said = match &spike {
        Err(error) => format!("taken to lie in its own row: {error}"),
        Ok(map) => {
            let mut places: Vec<f32> = map.u0.iter().copied().collect();
            places.sort_by(f32::total_cmp);
            let (low, median, high) = (places[0], places[places.len() / 2], places[places.len() - 1]);
            let error = map.standard_error.iter().fold(0.0_f32, |most, &error| most.max(error));
            if low.abs().max(high.abs()) < error.max(NEGLIGIBLE_U0_ROWS) {
                optics.spike = None;
                format!("in its own row within {error:.3} rows, from {} pixels", map.pixels)
            } else {
                demux = demux.with_spike(map.u0.clone())?;
                findings.u0_rows = median.into();
                format!(
                    "{low:.3} to {high:.3} rows beside its own row (median {median:.3}, standard error up to {error:.3}), from {} pixels: what rectification leaves",
                    map.pixels
                )
            }
        }
    };
    findings.remarks.push(("direct light", said));

    let prior = match options.states_prior() {
        true => format!("{}, as the plan says", name(findings.prior)),
        false => {
            let default = findings.prior;
            let others = candidates().into_iter().filter(|prior| *prior != default);
            let compared: Vec<Prior> = std::iter::once(default).chain(others).collect();
            // Noise asks for smoothness, and coupling has taken most of it.
            let solved = coupled.map_or(Ok(sample), sample_of);
            match solved.and_then(|solved| choose_prior(&solved, &optics, &compared)) {
                Ok(choice) => {
                    findings.prior = choice.prior();
                    let reason = choice.reason();
                    findings.choice = Some(choice);
                    reason
                }
                Err(error) => format!("the default {}: {error}", name(default)),
            }
        }
    };
    findings.remarks.push(("prior", prior));
    Ok(demux.with_prior(findings.prior)?)
}

fn say_beam(estimate: Option<&Result<BeamEstimate, CalibrateError>>, sigma_rows: f64) -> String {
    match estimate {
        None => format!("{sigma_rows} rows, as the rig file says"),
        Some(Ok(found)) if found.sigma_rows == 0.0 => {
            format!("no wider than a row, from {} pixels with direct light", found.pixels)
        }
        Some(Ok(found)) => format!(
            "{:.3} ± {:.3} rows (standard deviation), estimated from {} pixels with direct light",
            found.sigma_rows, found.standard_error_rows, found.pixels
        ),
        Some(Err(error)) => format!("taken as ideal: {error}"),
    }
}

/// Fits the noise and averages like pixels, if the plan wants that.
fn couple(
    options: &DemuxOptions,
    stack: &mut SweepStack,
    findings: &mut Findings,
) -> Result<Option<Array3<f32>>, PlaneError> {
    let frames: Vec<usize> = stack.settings.iter().map(|setting| setting.delays_us.len()).collect();
    let valid = stack.valid.as_ref().map(|valid| valid.view());
    let noise = match NoiseModel::fit(stack.images.view(), valid, &frames) {
        Ok(noise) => noise,
        Err(error) => {
            findings.remarks.push(("noise", format!("not fitted, and pixels not coupled: {error}")));
            return Ok(None);
        }
    };
    findings.remarks.push((
        "noise of a frame",
        format!(
            "{:.4} in the dark, {:.4} at the light of one white row",
            noise.variance(0.0, 1).sqrt(),
            noise.variance(1.0, 1).sqrt()
        ),
    ));
    stack.noise = Some(noise);
    if !options.coupling {
        return Ok(None);
    }
    let Coupled { stack: images, variance_ratio } =
        Coupling::default().apply(stack.images.view(), valid, &noise, &frames)?;
    findings.remarks.push((
        "spatial coupling",
        format!(
            "like neighbours averaged before demultiplexing: the variance of noise falls to {:.0} % on average",
            100.0 * variance_ratio.mean().unwrap_or(1.0)
        ),
    ));
    stack.variance_ratio = Some(variance_ratio);
    Ok(Some(images))
}

/// A prior with its weights.
pub fn name(prior: Prior) -> String {
    format!("{} (alpha {}, beta {})", prior.name(), prior.alpha(), prior.beta())
}

/// Leaves out of `stack` the images whose edge cuts the direct row while a flying spot draws it. If the rig knows when the
/// spot passes each pixel's column, and the beam lets that be modelled, they are left out of the calibration only: then
/// the spot's way, the whole stack and the images' indices come back.
fn leave_out(
    geometry: &SweepGeometry,
    stack: &mut SweepStack,
    findings: &mut Findings,
) -> Result<Option<(FlyingSpot, SweepStack, Vec<usize>)>, PlaneError> {
    let Spot::Flying(_) = geometry.spot else { return Ok(None) };
    let cut = settings_on_direct_row(&stack.timing, &stack.settings, 0.0)?;
    let mut say = |what: String| findings.remarks.push(("flying spot", what));
    if cut.is_empty() {
        say("no exposure begins or ends while it draws the direct row".into());
        return Ok(None);
    }
    if cut.len() == stack.settings.len() {
        say("every exposure begins or ends while it draws the direct row, so none is left out and direct light is not to be trusted: move the delays by a row".into());
        return Ok(None);
    }
    if let Some(spot) = geometry.flying_spot().filter(|_| geometry.beam_sigma_rows == Some(0.0)) {
        say(format!(
            "modelled in the {} images whose exposure begins or ends while it draws the direct row",
            cut.len()
        ));
        let whole = stack.clone();
        stack.keep(|n| !cut.contains(&n));
        return Ok(Some((spot, whole, cut)));
    }
    say(format!(
        "{} images are left out, because their exposure begins or ends while it draws the direct row, and the rig file does not say when it passes a pixel (projector.scan, camera.projector_columns, projector.beam_sigma_rows = 0); {} are kept",
        cut.len(),
        stack.settings.len() - cut.len()
    ));
    let at = |&n: &usize| (stack.settings[n].delays_us[0], stack.settings[n].exposure_us);
    findings.left_out_us = cut.iter().map(at).collect();
    stack.keep(|n| !cut.contains(&n));
    Ok(None)
}
