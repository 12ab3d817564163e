//! Product `delay-profile`: the light of a pixel or a region over the delay, as it was measured and as the transport
//! predicts it.

use ndarray::Axis;
use raysweep_transport::plane::{DelayProfile, Transport};
use serde::Deserialize;

use super::SweepStack;
use crate::schedule::{Role, Schedule, SweepGeometry};
use crate::stage::Product;

/// Options of `delay-profile`, as they stand in a plan.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ProfileTable {
    /// `[t, s]`
    pixel: Option<[usize; 2]>,
    /// `[t0, t1, s0, s1]`, half open: rows `t0..t1`, columns `s0..s1`.
    region: Option<[usize; 4]>,
    /// One of the plan's; left out: the shortest.
    exposure_us: Option<f64>,
}

/// Of which pixels a profile is, and at which exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ProfileOptions {
    /// `[t0, t1, s0, s1]`, half open; a pixel is a region of one.
    region: [usize; 4],
    exposure_us: f64,
}

/// Light over the delay at one exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// File name without extension.
    pub name: String,
    /// What it shows, in a sentence.
    pub about: String,
    /// The exposure that the plan asked for.
    pub exposure_us: f64,
    /// What the camera saw.
    pub measured: DelayProfile,
    /// What the forward model makes of the transport.
    pub predicted: DelayProfile,
}

impl Profile {
    /// The table that is written: names and values of its columns, one row per delay.
    pub fn columns(&self) -> [(&'static str, Vec<f64>); 5] {
        [
            ("delay_us", self.measured.delays_us.clone()),
            ("light", self.measured.light.clone()),
            ("predicted", self.predicted.light.clone()),
            ("light_per_area_us", self.measured.normalised_per_us()),
            ("predicted_per_area_us", self.predicted.normalised_per_us()),
        ]
    }
}

/// What a profile cannot do without: two delays make an area.
const MIN_DELAYS: usize = 2;

impl ProfileTable {
    /// The options, where the plan and its camera have what they name.
    pub(super) fn check(
        self,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<ProfileOptions, (&'static str, String)> {
        let (height, width) = (geometry.height, geometry.width);
        let size = format!("the camera has {height} rows and {width} columns");
        let region = match (self.pixel, self.region) {
            (Some([t, s]), None) if t < height && s < width => [t, t + 1, s, s + 1],
            (Some(pixel), None) => return Err(("pixel", format!("pixel = {pixel:?}, [t, s]: {size}"))),
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
        let sweep = schedule.points.iter().filter(|point| matches!(point.role, Role::Sweep(_)));
        let mut exposures_us: Vec<f64> = sweep.map(|point| point.exposure_us).collect();
        exposures_us.sort_by(f64::total_cmp);
        let shortest_us = exposures_us.first().copied().unwrap_or_default();
        let exposure_us = self.exposure_us.unwrap_or(shortest_us);
        let delays = exposures_us.iter().filter(|&&us| us == exposure_us).count();
        exposures_us.dedup();
        match delays {
            MIN_DELAYS.. => Ok(ProfileOptions { region, exposure_us }),
            0 => Err(("exposure_us", format!("exposure_us = {exposure_us}: the plan has {exposures_us:?}"))),
            _ => {
                let what = format!(
                    "exposure_us = {exposure_us}: a profile takes {MIN_DELAYS} delays, the plan has {delays} at it"
                );
                Err(("exposure_us", what))
            }
        }
    }
}

impl ProfileOptions {
    /// The pixels in words that suit a file name.
    pub(super) fn default_name(self) -> String {
        let [t0, t1, s0, s1] = self.region;
        match (t1 - t0, s1 - s0) {
            (1, 1) => format!("delay_profile_t{t0}_s{s0}"),
            _ => format!("delay_profile_t{t0}_{t1}_s{s0}_{s1}"),
        }
    }

    pub(super) fn make(
        self,
        name: String,
        stack: &SweepStack,
        transport: &Transport,
    ) -> Result<Product, String> {
        let exposure_us = self.exposure_us;
        let taken: Vec<usize> =
            (0..stack.settings.len()).filter(|&n| stack.exposures_us[n] == exposure_us).collect();
        if taken.len() < MIN_DELAYS {
            return Err(format!(
                "{} images of {exposure_us} µs are there, a profile takes {MIN_DELAYS}: resume the run",
                taken.len()
            ));
        }
        let settings: Vec<_> = taken.iter().map(|&n| stack.settings[n].clone()).collect();
        let [t0, t1, s0, s1] = self.region;
        // A pixel that saturates at some delays would distort the others' profile there and only there.
        let unsaturated = |[t, s]: &[usize; 2]| {
            stack.valid.as_ref().is_none_or(|valid| taken.iter().all(|&n| valid[[n, *t, *s]]))
        };
        let all = (t0..t1).flat_map(|t| (s0..s1).map(move |s| [t, s]));
        let pixels: Vec<[usize; 2]> = all.filter(unsaturated).collect();
        if pixels.is_empty() {
            return Err(format!(
                "every pixel of it saturates at some delay at {exposure_us} µs: choose a shorter exposure_us, or other pixels"
            ));
        }
        let left_out = (t1 - t0) * (s1 - s0) - pixels.len();
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
        let images = stack.images.select(Axis(0), &taken);
        Ok(Product::Profile(Profile {
            name,
            about,
            exposure_us,
            measured: DelayProfile::measured(images.view(), &settings, &pixels),
            predicted: DelayProfile::predicted(&stack.timing, transport, &settings, &pixels),
        }))
    }
}
