//! Figures and warnings of a sweep, accumulated over its camera rows from top to bottom.

use std::ops::RangeInclusive;

use ndarray::Array2;
use raysweep_transport::plane::Transport;

use crate::findings::Findings;

/// Name of the figure that checks consistency: the light of the regular image, predicted by the model over captured
/// by the camera.
pub const PREDICTED_SHARE: &str = "predicted / captured regular light";

/// What there is to say about a sweep's transport.
#[derive(Debug, Clone)]
pub struct SweepSummary {
    /// How it was demultiplexed.
    pub findings: Findings,
    /// Numbers for the report: name, with the unit, and value.
    pub figures: Vec<(&'static str, f64)>,
    /// Problems that make the products worse than they look.
    pub warnings: Vec<String>,
}

/// Largest relative error with which the transport should predict the regular image.
const CLOSE_SHARE: f64 = 0.02;
/// Beyond this range of predicted over captured light, the transport does not describe the scene at all.
const EXPLAINED_SHARE: RangeInclusive<f64> = 0.8..=1.25;
/// Below this share, the light may have been gone for a part of the run.
const DARK_SHARE: f64 = 0.5;
/// A larger share of saturated pixels causes a warning: highlights are normal, saturated areas are not.
const SATURATED_SHARE: f64 = 0.01;

/// Counts over the camera rows so far; the same, to the bit, however the rows are divided.
#[derive(Default)]
pub(super) struct Tally {
    images: usize,
    /// Pixels whose white level is known.
    pixels: usize,
    unmeasured: usize,
    saturated: usize,
    /// Pixels that are known only as lower bounds.
    bounds: usize,
    /// `None` if the regular image was not taken.
    regular: Option<Regular>,
}

#[derive(Default)]
struct Regular {
    saturated: usize,
    /// Light where the regular image is not saturated.
    captured: f64,
    /// The same light as predicted by the transport.
    predicted: f64,
}

impl Tally {
    /// Adds rows whose transport was computed from `images` images; `measured` is where the white level is known.
    pub(super) fn add_sweep(&mut self, images: usize, measured: &Array2<bool>, transport: &Transport) {
        self.images = images;
        self.pixels += count(measured);
        self.unmeasured += measured.len() - count(measured);
        self.saturated += count(&(&transport.saturated & measured));
        self.bounds += transport.lower_bounds.keys().filter(|pixel| measured[**pixel]).count();
    }

    /// Adds the light of the regular image in these rows.
    pub(super) fn add_regular(
        &mut self,
        unsaturated: &Array2<bool>,
        measured: &Array2<bool>,
        light: &Array2<f32>,
        transport: &Transport,
    ) {
        let regular = self.regular.get_or_insert_default();
        let mut valid = unsaturated & measured;
        regular.saturated += count(measured) - count(&valid);
        // A bound is not what is there.
        transport.lower_bounds.keys().for_each(|pixel| valid[*pixel] = false);
        let valid = &valid;
        let add = |sum: &mut f64, image: &Array2<f32>| {
            let pixels = image.iter().zip(valid).filter(|&(_, &valid)| valid);
            pixels.for_each(|(&light, _)| *sum += f64::from(light));
        };
        add(&mut regular.captured, light);
        add(&mut regular.predicted, &transport.total());
    }

    /// Figures and warnings, and the findings.
    pub(super) fn summary(self, findings: Findings) -> SweepSummary {
        let mut figures = vec![
            ("images demultiplexed, captures included", self.images as f64),
            ("saturated pixels", self.saturated as f64),
        ];
        if self.saturated > 0 {
            figures.push(("pixels known only as lower bounds", self.bounds as f64));
        }
        if self.unmeasured > 0 {
            figures.push(("pixels that the calibration did not measure", self.unmeasured as f64));
        }
        let mut warnings: Vec<String> =
            too_many_saturated("the sweep", self.saturated, self.pixels).into_iter().collect();
        if let Some(regular) = self.regular {
            regular.check(self.pixels, &mut figures, &mut warnings);
        }
        warnings.extend(findings.warnings.iter().cloned());
        SweepSummary { findings, figures, warnings }
    }
}

impl Regular {
    /// How well the transport predicts the light of the regular image where the image is not saturated.
    fn check(self, pixels: usize, figures: &mut Vec<(&'static str, f64)>, warnings: &mut Vec<String>) {
        let what = "the regular image (a whole VSYNC period long)";
        if let Some(warning) = too_many_saturated(what, self.saturated, pixels) {
            warnings.push(warning);
        } else if self.captured > 0.0 {
            let share = self.predicted / self.captured;
            figures.push((PREDICTED_SHARE, share));
            if !EXPLAINED_SHARE.contains(&share) {
                let light = match share < DARK_SHARE {
                    true => "the projector went out or the lens was capped for a part of the run, or ",
                    false => "",
                };
                warnings.push(format!(
                    "THE TRANSPORT DOES NOT EXPLAIN WHAT THE CAMERA SAW: IT PREDICTS {:.1} % OF THE LIGHT OF THE REGULAR IMAGE, WHERE {:.0} TO {:.0} % ARE ALLOWED. Do not use it: {light}the delays are wrong (projector.first_row_us, camera.trigger_latency_us), or the row time, white_dn or the dark images, or the scene or the light changed during the run",
                    share * 100.0,
                    EXPLAINED_SHARE.start() * 100.0,
                    EXPLAINED_SHARE.end() * 100.0
                ));
            } else if (share - 1.0).abs() > CLOSE_SHARE {
                warnings.push(format!(
                    "the transport predicts {:.1} % of the light of the regular image: light from beyond the sweep's reach, or a wrong row time, white_dn or dark image",
                    share * 100.0
                ));
            }
        }
    }
}

fn count(pixels: &Array2<bool>) -> usize {
    pixels.iter().filter(|&&pixel| pixel).count()
}

fn too_many_saturated(what: &str, saturated: usize, pixels: usize) -> Option<String> {
    let share = saturated as f64 / pixels as f64;
    (share > SATURATED_SHARE).then(|| {
        format!(
            "{:.1} % of the pixels of {what} are saturated: use less gain, a smaller aperture or less ambient light",
            share * 100.0
        )
    })
}
