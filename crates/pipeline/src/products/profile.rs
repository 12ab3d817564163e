//! Product `delay-profile`: the light of a pixel or a region as a function of the delay, as measured and as predicted
//! from the transport.

use ndarray::Axis;
use raysweep_transport::plane::{DelayProfile, Setting, Transport};
use serde::Deserialize;

use super::planned::Planned;
use crate::product::{Product, Profile};
use crate::schedule::{Schedule, SweepGeometry};
use crate::stack::SweepStack;

/// Options of `delay-profile`, as given in a plan.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ProfileTable {
    /// `[t, s]`
    pixel: Option<[usize; 2]>,
    /// `[t0, t1, s0, s1]`, half open: rows `t0..t1`, columns `s0..s1`.
    region: Option<[usize; 4]>,
    /// One of the plan's exposures; if omitted, the shortest.
    exposure_us: Option<f64>,
}

/// The pixels and the exposure of a profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ProfileOptions {
    /// `[t0, t1, s0, s1]`, half open; a pixel is a region of one.
    region: [usize; 4],
    planned: Planned,
}

/// Sums over the pixels of a profile, accumulated over the camera rows from top to bottom.
#[derive(Debug, Default)]
pub(super) struct ProfileSums {
    /// Delays and exposure of the images with the profile's exposure.
    settings: Vec<Setting>,
    /// Sum of the pixels' light in each of these images.
    measured: Vec<f64>,
    predicted: Vec<f64>,
    pixels: usize,
}

/// Smallest number of delays of a profile: its area needs two.
const MIN_DELAYS: usize = 2;

impl ProfileTable {
    /// The options, if they are valid for the plan and its camera.
    pub(super) fn check(
        self,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<ProfileOptions, (&'static str, String)> {
        let (height, width) = (geometry.height, geometry.width);
        let size = format!("the camera has {height} rows and {width} columns");
        let region = match (self.pixel, self.region) {
            (Some([t, s]), None) if t < height && s < width => [t, t + 1, s, s + 1],
            (Some(pixel), None) => {
                return Err(("pixel", format!("pixel = {pixel:?} is outside of the image: {size}")));
            }
            (None, Some([t0, t1, s0, s1])) if t0 < t1 && t1 <= height && s0 < s1 && s1 <= width => {
                [t0, t1, s0, s1]
            }
            (None, Some(region)) => {
                let what = format!(
                    "region = {region:?}: give [t0, t1, s0, s1] with t0 < t1 and s0 < s1, t1 and s1 not included; {size}"
                );
                return Err(("region", what));
            }
            _ => return Err(("pixel", "give either pixel = [t, s] or region = [t0, t1, s0, s1]".into())),
        };
        let planned = Planned::new(schedule, self.exposure_us)?;
        let Planned { exposure_us, delays, .. } = planned;
        match delays {
            MIN_DELAYS.. => Ok(ProfileOptions { region, planned }),
            _ => {
                let what = format!(
                    "exposure_us = {exposure_us}: a profile needs at least {MIN_DELAYS} delays, but the plan has {delays} at this exposure"
                );
                Err(("exposure_us", what))
            }
        }
    }
}

impl ProfileOptions {
    /// The pixels as text suitable for a file name.
    pub(super) fn default_name(self) -> String {
        let [t0, t1, s0, s1] = self.region;
        match (t1 - t0, s1 - s0) {
            (1, 1) => format!("delay_profile_t{t0}_s{s0}"),
            _ => format!("delay_profile_t{t0}_{t1}_s{s0}_{s1}"),
        }
    }

    /// Adds the pixels in the camera rows starting at `first_row`, to which stack and transport belong.
    pub(super) fn add(
        self,
        sums: &mut ProfileSums,
        first_row: usize,
        stack: &SweepStack,
        transport: &Transport,
    ) {
        let taken = self.planned.images_of(stack);
        if sums.settings.is_empty() {
            sums.settings = taken.iter().map(|&n| stack.settings[n].clone()).collect();
            sums.measured = vec![0.0; taken.len()];
            sums.predicted = vec![0.0; taken.len()];
        }
        let [t0, t1, s0, s1] = self.region;
        let end = first_row + stack.images.len_of(Axis(1));
        // A pixel that saturates at some delays would distort the profile at these delays only.
        let unsaturated = |pixel @ [t, s]: &[usize; 2]| {
            !transport.lower_bounds.contains_key(pixel)
                && stack.valid.as_ref().is_none_or(|valid| taken.iter().all(|&n| valid[[n, *t, *s]]))
        };
        let rows = t0.max(first_row)..t1.min(end);
        let all = rows.flat_map(|t| (s0..s1).map(move |s| [t - first_row, s]));
        let pixels: Vec<[usize; 2]> = all.filter(unsaturated).collect();
        if pixels.is_empty() {
            return;
        }
        sums.pixels += pixels.len();
        let images = stack.images.select(Axis(0), &taken);
        DelayProfile::add_measured(&mut sums.measured, images.view(), &pixels);
        DelayProfile::add_predicted(
            &mut sums.predicted,
            &stack.timing,
            first_row,
            transport,
            &sums.settings,
            &pixels,
        );
    }

    pub(super) fn make(self, name: String, sums: &ProfileSums) -> Result<Product, String> {
        let exposure_us = self.planned.exposure_us;
        let taken = sums.settings.len();
        if taken < MIN_DELAYS {
            return Err(format!(
                "{taken} images at {exposure_us} µs are stored, but a profile needs at least {MIN_DELAYS}: resume the run"
            ));
        }
        if sums.pixels == 0 {
            return Err(format!(
                "each of its pixels saturates at some delay at {exposure_us} µs: choose a shorter exposure_us, or other pixels"
            ));
        }
        let [t0, t1, s0, s1] = self.region;
        let left_out = (t1 - t0) * (s1 - s0) - sums.pixels;
        let mut about = match (t1 - t0, s1 - s0) {
            (1, 1) => {
                format!("light of pixel t {t0}, s {s0} over the delay at an exposure of {exposure_us} µs")
            }
            _ => format!(
                "mean light of rows {t0}..{t1}, columns {s0}..{s1} over the delay at an exposure of {exposure_us} µs"
            ),
        };
        if left_out > 0 {
            about.push_str(&format!("; {left_out} pixels that saturate are left out"));
        }
        let mean = |light: &[f64]| DelayProfile::mean(&sums.settings, light, sums.pixels);
        Ok(Product::Profile(Profile {
            name,
            about,
            exposure_us,
            measured: mean(&sums.measured),
            predicted: mean(&sums.predicted),
        }))
    }
}
