//! What a sweep's stack tells about the rig and the scene, before it is demultiplexed: unreliable settings, the
//! beam's width, the position of direct light, the prior, the noise.

use std::collections::BTreeSet;
use std::ops::Range;

use ndarray::{Array3, Axis, s};
use raysweep_transport::plane::board::{CalibrationCovariance, CalibrationParameter};
use raysweep_transport::plane::calibrate::{
    BeamEstimate, CalibrateError, Choice, Optics, OpticsEstimate, Sample, candidates, choose_prior,
    estimate_optics,
};
use raysweep_transport::plane::{
    Beam, Coupled, Coupling, Demux, NoiseModel, PlaneError, Prior, RowTiming, Setting, Transport,
};

use crate::bracket::BracketImage;
use crate::calibrated;
use crate::demux::DemuxOptions;
use crate::flicker::RoomFindings;
use crate::schedule::{Spot, SweepGeometry};
use crate::spot::SpotCut;
use crate::stack::SweepStack;

/// Smaller offsets of direct light are ignored, because modelling them requires several models per row.
const NEGLIGIBLE_U0_ROWS: f32 = 0.02;

/// How a sweep was demultiplexed, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Findings {
    /// The prior.
    pub prior: Prior,
    /// The held-out errors of the priors compared; `None` if the plan names its prior, or the comparison failed.
    pub choice: Option<Choice>,
    /// Standard deviation of the beam in rows, 0 for an ideal one; `None` if a calibration measured it pixel by pixel.
    pub beam_sigma_rows: Option<f64>,
    /// By how much later than calibrated the light was taken to arrive; `None` without a calibration.
    pub late_us: Option<f64>,
    /// Median position of direct light in projector rows, 0 if it lies in its own row, or where it was calibrated.
    pub u0_rows: f64,
    /// Whether the rows `|u| <= 2` are one band, because no setting tells where in it direct light lies.
    pub one_band: bool,
    /// Delay and exposure of the images that were left out.
    pub left_out_us: Vec<(f64, f64)>,
    /// Findings, each as a key and a sentence.
    pub remarks: Vec<(&'static str, String)>,
    /// Problems that make the result worse than it looks.
    pub warnings: Vec<String>,
}

/// How a sweep is to be demultiplexed, and why. The choice is based on a few camera rows, so that a sweep solved in
/// parts gives the same result as one solved as a whole.
pub struct Choices {
    /// Solves the images; without a flying spot, which is added for those that it cuts.
    demux: Demux,
    geometry: SweepGeometry,
    /// By how much later than modelled light arrives.
    late_us: f64,
    /// What is not known of the calibration, after the run has refined it.
    calibration: Option<CalibrationCovariance>,
    noise: Option<NoiseModel>,
    /// The same without that of the dark images.
    noise_without_darks: Option<NoiseModel>,
    coupling: Option<Coupling>,
    /// The reasons for the choices.
    pub findings: Findings,
}

/// The camera rows that [`choose`] uses, for an image with `camera_rows` rows: those of a sample, with the neighbours
/// that they are coupled to.
pub fn rows_to_choose_by(camera_rows: usize) -> Vec<usize> {
    let halo_rows = Coupling::default().radius_px;
    let with_halo = |t: usize| t.saturating_sub(halo_rows)..(t + halo_rows + 1).min(camera_rows);
    let rows: BTreeSet<usize> = Sample::rows_of(camera_rows).flat_map(with_halo).collect();
    rows.into_iter().collect()
}

/// Chooses how to demultiplex a sweep from some of its rows, those of [`rows_to_choose_by`]. `planned` is the plan's
/// demultiplexer; `stack` contains only the camera rows `rows`.
///
/// # Errors
/// If the stack does not give a valid model.
pub fn choose(
    planned: &Demux,
    options: &DemuxOptions,
    geometry: &SweepGeometry,
    rows: &[usize],
    mut stack: SweepStack,
) -> Result<Choices, PlaneError> {
    let mut findings = Findings::planned(planned.prior(), geometry);
    let cut = SpotCut::of(geometry, &stack.timing, &stack.settings)?;
    findings.add_spot(geometry, &cut, &stack.settings);
    let settings = stack.settings.clone();
    stack.keep(|n| cut.is_steady(n));
    let calibration = geometry.calibration.as_ref().map(|calibration| {
        let known_us = calibration.covariance.sd(CalibrationParameter::Latency);
        let late_sd_us = findings.check_calibration(&mut stack, rows, known_us);
        late_sd_us.map_or(calibration.covariance, |sd_us| calibration.covariance.with_latency_sd(sd_us))
    });
    let late_us = findings.late_us.unwrap_or(0.0);
    let planned = planned.with_settings(stack.settings.clone())?;
    let sample_of = |images: &Array3<f32>| {
        let valid = stack.valid.as_ref().map(|valid| valid.view());
        Sample::of_rows(stack.timing.clone(), stack.settings.clone(), rows, images.view(), valid)
    };
    let ratios = frames_of(&stack).into_iter().zip(&stack.dark_frames);
    let frames_per_dark_frame =
        ratios.map(|(frames, &dark)| frames as f64 / dark as f64).sum::<f64>() / stack.settings.len() as f64;
    let ((noise, coupling, coupled), optics) = rayon::join(
        || {
            let noise = fit_noise(&stack, frames_per_dark_frame, &mut findings);
            let coupling = noise.filter(|_| options.coupling).map(|_| Coupling::default());
            let coupled = noise.zip(coupling).map(|(noise, coupling)| couple(&coupling, &noise, &stack));
            (noise, coupling, coupled)
        },
        // From the images before coupling.
        || {
            let estimate = || estimate_optics(&sample_of(&stack.images)?, geometry.beam_sigma_rows);
            geometry.calibration.is_none().then(estimate)
        },
    );
    let coupled = coupled.transpose()?;
    if let Some(Coupled { variance_ratio, .. }) = &coupled {
        findings.remarks.push((
            "spatial coupling",
            format!(
                "like neighbours averaged before demultiplexing: the variance of noise falls to {:.0} % on average",
                100.0 * variance_ratio.mean().unwrap_or(1.0)
            ),
        ));
    }
    // From the images that will be solved.
    let sample = || sample_of(coupled.as_ref().map_or(&stack.images, |coupled| &coupled.stack));
    let demux = match optics {
        None => choose_among_priors(&planned, options, &Optics::default(), &sample, &mut findings)?,
        Some(optics) => {
            let calibrated = optics.and_then(|optics| {
                calibrate(&planned, options, &stack.timing, optics, &sample, &mut findings)
            });
            match calibrated {
                Ok(demux) => demux,
                Err(error) => {
                    let said = format!("nothing is estimated from the stack: {error}");
                    findings.remarks.push(("calibration", said));
                    planned
                }
            }
        }
    };
    // A spot that cannot be modelled is told here.
    cut.modelled_by(demux.with_settings(settings)?)?;
    let noise_without_darks = noise.map(|noise| noise.without_darks(frames_per_dark_frame));
    let geometry = geometry.clone();
    Ok(Choices { demux, geometry, late_us, calibration, noise, noise_without_darks, coupling, findings })
}

impl Findings {
    /// What is known before any image is looked at.
    fn planned(prior: Prior, geometry: &SweepGeometry) -> Self {
        Self {
            prior,
            choice: None,
            beam_sigma_rows: match geometry.calibration {
                Some(_) => None,
                None => geometry.beam_sigma_rows.or(Some(0.0)),
            },
            late_us: None,
            u0_rows: 0.0,
            one_band: false,
            left_out_us: Vec::new(),
            remarks: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// Adds what was found of the room's light.
    pub(crate) fn add_room(&mut self, RoomFindings { remark, warning }: RoomFindings) {
        self.remarks.extend(remark);
        self.warnings.extend(warning);
    }

    /// Adds what is done about a flying spot in the images of these settings.
    fn add_spot(&mut self, geometry: &SweepGeometry, cut: &SpotCut, settings: &[Setting]) {
        let Spot::Flying(_) = geometry.spot else { return };
        let said = match cut {
            SpotCut::Nowhere => "no exposure begins or ends while it draws the direct row".into(),
            SpotCut::Everywhere => "every exposure begins or ends while it draws the direct row, so none is left out and direct light is not to be trusted: move the delays by a few rows".into(),
            SpotCut::Modelled { cut, .. } => format!(
                "modelled in the {} images whose exposure begins or ends while it draws the direct row",
                cut.len()
            ),
            SpotCut::LeftOut { cut } => {
                let at = |&n: &usize| (settings[n].delays_us[0], settings[n].exposure_us);
                self.left_out_us = cut.iter().map(at).collect();
                let unknown = match geometry.calibration {
                    Some(_) => "",
                    None => ", and the rig file does not say when it passes a pixel (projector.scan, camera.projector_columns, projector.beam_sigma_rows = 0)",
                };
                format!(
                    "{} images are left out, because their exposure begins or ends while it draws the direct row{unknown}; {} are kept",
                    cut.len(),
                    settings.len() - cut.len()
                )
            }
        };
        self.remarks.push(("flying spot", said));
    }

    /// Checks the calibration, whose latency has the standard deviation `known_us`, by a stack that contains only the
    /// camera rows `rows`, and corrects the delays of its
    /// images for the latency found. Returns the standard deviation of that latency.
    fn check_calibration(&mut self, stack: &mut SweepStack, rows: &[usize], known_us: f64) -> Option<f64> {
        let valid = stack.valid.as_ref().map(|valid| valid.view());
        let images = calibrated::Images { rows, images: stack.images.view(), valid };
        let drift = calibrated::CalibrationDrift::of(&stack.timing, &stack.settings, &images, known_us);
        stack.settings.iter_mut().for_each(|setting| *setting = setting.earlier(drift.late_us));
        self.late_us = Some(drift.late_us);
        self.u0_rows = drift.u0_rows.unwrap_or(0.0);
        self.remarks.extend(drift.remarks);
        self.warnings.extend(drift.warnings);
        drift.late_sd_us
    }
}

impl Choices {
    /// What rig file and plan say, before any image is looked at.
    pub(crate) fn planned(demux: Demux, geometry: &SweepGeometry) -> Self {
        Self {
            findings: Findings::planned(demux.prior(), geometry),
            demux,
            geometry: geometry.clone(),
            late_us: 0.0,
            calibration: geometry.calibration.as_ref().map(|calibration| calibration.covariance),
            noise: None,
            noise_without_darks: None,
            coupling: None,
        }
    }

    /// The same with an image under less light for pixels that saturate, whose level is found from the rows of
    /// [`rows_to_choose_by`]: `stack` contains only the camera rows `rows`.
    ///
    /// # Errors
    /// If the stack does not give a valid model.
    pub(crate) fn with_bracket(
        mut self,
        mut image: BracketImage,
        rows: &[usize],
        mut stack: SweepStack,
    ) -> Result<Self, PlaneError> {
        let cut = SpotCut::of(&self.geometry, &stack.timing, &stack.settings)?;
        stack.keep(|n| cut.keeps(n));
        stack.settings.iter_mut().for_each(|setting| *setting = setting.earlier(self.late_us));
        image.setting = image.setting.earlier(self.late_us);
        let demux = cut.modelled_by(self.demux.clone())?;
        let said = match image.levelled(&demux, rows, &stack)? {
            Some(bracket) => {
                let said = format!(
                    "taken under {:.2} % of the sweep's light, as found from both",
                    100.0 * bracket.light
                );
                self.demux = self.demux.with_bracket(bracket)?;
                said
            }
            None => {
                let what = "not used: too few pixels are lit in it and do not saturate to find its level";
                self.findings.warnings.push(format!("the bracket is {what}; raise sweep.bracket.light"));
                what.into()
            }
        };
        self.findings.remarks.push(("bracket", said));
        Ok(self)
    }

    /// The noise of a single frame without that of its dark image, if it could be fitted.
    pub(crate) fn noise_without_darks(&self) -> Option<NoiseModel> {
        self.noise_without_darks
    }

    /// The timing of the model.
    pub(crate) fn timing(&self) -> &RowTiming {
        self.demux.timing()
    }

    /// Number of additional rows that the stack must contain on either side of those solved, where the image has
    /// them.
    pub fn halo_rows(&self) -> usize {
        self.coupling.map_or(0, |coupling| coupling.radius_px)
    }

    /// Solves camera rows `rows`. `stack` contains the rows starting at `held_from`, with at least
    /// [`Self::halo_rows`] more than those solved; the returned stack is reduced to `rows` and the images in use.
    ///
    /// # Errors
    /// If the stack does not give a valid model, or `go_on` returned false.
    pub fn solve(
        &self,
        rows: Range<usize>,
        held_from: usize,
        stack: &mut SweepStack,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, PlaneError> {
        let (demux, coupled) = self.prepare(&rows, held_from, stack, go_on)?;
        let images = coupled.as_ref().unwrap_or(&stack.images);
        let valid = stack.valid.as_ref().map(|valid| valid.view());
        let rows: Vec<usize> = rows.collect();
        demux.solve_rows(&rows, images.view(), valid, go_on)
    }

    /// Makes of a stack that from which camera rows `rows` are solved, as [`Self::solve`] does, and returns what solves
    /// it, and its images after coupling, if they are coupled.
    pub(crate) fn prepare(
        &self,
        rows: &Range<usize>,
        held_from: usize,
        stack: &mut SweepStack,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<(Demux, Option<Array3<f32>>), PlaneError> {
        let cut = SpotCut::of(&self.geometry, &stack.timing, &stack.settings)?;
        let kept = (0..stack.settings.len()).filter(|&n| cut.keeps(n));
        // Neighbours see a spot at other times, so images that depend on it are not coupled.
        let steady: Vec<usize> =
            kept.enumerate().filter(|&(_, n)| cut.is_steady(n)).map(|(place, _)| place).collect();
        stack.keep(|n| cut.keeps(n));
        stack.settings.iter_mut().for_each(|setting| *setting = setting.earlier(self.late_us));
        let inner = rows.start - held_from..rows.end - held_from;
        let mut coupled = None;
        if !go_on() {
            return Err(PlaneError::Stopped);
        }
        if let Some((noise, coupling)) = self.noise.zip(self.coupling) {
            let Coupled { stack: images, variance_ratio } = if steady.len() == stack.settings.len() {
                couple(&coupling, &noise, stack)?
            } else {
                let mut of_steady = stack.clone();
                of_steady.keep(|n| steady.contains(&n));
                let mut coupled = couple(&coupling, &noise, &of_steady)?;
                let mut all = stack.images.clone();
                for (&n, image) in steady.iter().zip(coupled.stack.outer_iter()) {
                    all.index_axis_mut(Axis(0), n).assign(&image);
                }
                coupled.stack = all;
                coupled
            };
            stack.variance_ratio = Some(variance_ratio.slice_move(s![inner.clone(), ..]));
            coupled = Some(images.slice_move(s![.., inner.clone(), ..]));
        }
        if inner.len() < stack.images.len_of(Axis(1)) {
            stack.images = stack.images.slice(s![.., inner.clone(), ..]).to_owned();
            stack.valid = stack.valid.as_ref().map(|valid| valid.slice(s![.., inner, ..]).to_owned());
        }
        stack.timing = self.demux.timing().clone();
        stack.prior = self.demux.prior();
        stack.noise = self.noise_without_darks;
        stack.calibration = self.calibration;
        stack.one_band = self.findings.one_band;
        stack.u0_rows = self.demux.u0_rows().map(|u0_rows| u0_rows.slice(s![rows.clone(), ..]).to_owned());
        let demux = cut.modelled_by(self.demux.with_settings(stack.settings.clone())?)?;
        Ok((demux, coupled))
    }
}

fn frames_of(stack: &SweepStack) -> Vec<usize> {
    stack.settings.iter().map(|setting| setting.delays_us.len()).collect()
}

fn fit_noise(stack: &SweepStack, frames_per_dark_frame: f64, findings: &mut Findings) -> Option<NoiseModel> {
    let valid = stack.valid.as_ref().map(|valid| valid.view());
    match NoiseModel::fit(stack.images.view(), valid, &frames_of(stack)) {
        Ok(noise) => {
            let of_frame = noise.without_darks(frames_per_dark_frame);
            let sd = |light| of_frame.variance(light, 1).sqrt();
            let said = format!("{:.4} in the dark, {:.4} at the light of one white row", sd(0.0), sd(1.0));
            findings.remarks.push(("noise of a frame", said));
            Some(noise)
        }
        Err(error) => {
            findings.remarks.push(("noise", format!("not fitted, and pixels not coupled: {error}")));
            None
        }
    }
}

fn couple(coupling: &Coupling, noise: &NoiseModel, stack: &SweepStack) -> Result<Coupled, PlaneError> {
    let valid = stack.valid.as_ref().map(|valid| valid.view());
    coupling.apply(stack.images.view(), valid, noise, &frames_of(stack))
}

/// Adopts the estimated optics, and chooses the prior.
fn calibrate(
    planned: &Demux,
    options: &DemuxOptions,
    timing: &RowTiming,
    OpticsEstimate { mut optics, beam, spike }: OpticsEstimate,
    sample: &dyn Fn() -> Result<Sample, CalibrateError>,
    findings: &mut Findings,
) -> Result<Demux, CalibrateError> {
    if beam.is_some() && optics.beam_sigma_rows > 0.0 {
        findings.warnings.push(format!(
            "the beam's width, {:.2} rows, was estimated from this scene, and light that spreads by about a row under the surface looks the same: measure it once on a matt white surface and state it as projector.beam_sigma_rows in the rig file",
            optics.beam_sigma_rows
        ));
    }
    findings.remarks.push(("beam", say_beam(beam.as_ref(), optics.beam_sigma_rows)));
    let sigma_rows = optics.beam_sigma_rows;
    let beam = Beam::of_sigma(sigma_rows);
    let mut demux = planned.with_timing(timing.clone().with_beam(beam)?)?;
    findings.beam_sigma_rows = Some(sigma_rows);

    let said = match &spike {
        // A measured response states the place, and needs no edge.
        Err(CalibrateError::NoEdge) if timing.measured_response().is_none() => {
            findings.one_band = true;
            "given as one band with the rows |u| <= 2, and not as u = 0 alone: no exposure begins or ends within 1.5 rows of the pixel's own row, so nothing tells how the band is divided; add settings with t_d ± t_e/2 there, or calibrate the rig".into()
        }
        Err(error) => format!("taken to lie in its own row: {error}"),
        Ok(map) => {
            let mut places: Vec<f32> = map.u0.iter().copied().collect();
            places.sort_by(f32::total_cmp);
            let (low, median, high) = (places[0], places[places.len() / 2], places[places.len() - 1]);
            let error = map.standard_error.iter().fold(0.0_f32, |most, &error| most.max(error));
            if low.abs().max(high.abs()) < (2.0 * error).max(NEGLIGIBLE_U0_ROWS) {
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
    Ok(choose_among_priors(&demux, options, &optics, sample, findings)?)
}

/// Chooses the prior for a sample of the images that will be solved, unless the plan states it.
fn choose_among_priors(
    demux: &Demux,
    options: &DemuxOptions,
    optics: &Optics,
    sample: &dyn Fn() -> Result<Sample, CalibrateError>,
    findings: &mut Findings,
) -> Result<Demux, PlaneError> {
    let prior = match options.states_prior() {
        true => format!("{}, as the plan says", name(findings.prior)),
        false => {
            let default = findings.prior;
            let others = candidates().into_iter().filter(|prior| *prior != default);
            let compared: Vec<Prior> = std::iter::once(default).chain(others).collect();
            // More noise requires more smoothness, but coupling has removed most of the noise.
            match sample().and_then(|sample| choose_prior(&sample, optics, &compared)) {
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
    demux.with_prior(findings.prior)
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

/// A prior with its weights, as text.
pub fn name(prior: Prior) -> String {
    format!("{} (alpha {}, beta {})", prior.name(), prior.alpha(), prior.beta())
}
