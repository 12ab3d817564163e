//! How late the light of each image is against the VSYNC edge, from a strip of the board in view.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::{Array2, ArrayView2, s};
use rayon::prelude::*;
use raysweep_transport::plane::board::Estimate;
use raysweep_transport::plane::board::times::{JitterGauge, Lateness};
use raysweep_transport::plane::{PlaneError, Setting};

use crate::scale::{CameraCurve, LightScale};
use crate::schedule::{PointRole, SweepGeometry};

/// Largest accepted misfit of what should be the board, in units of its variance: what a calibration accepts.
const MOST_CHI2: f64 = 9.0;
/// A strip that knows less than this share of the lateness's variance has no edge on its light.
const SHOWN_SHARE: f64 = 0.5;

/// The strip of a rig, and the scale of its light.
#[derive(Clone)]
pub struct StripGauge {
    gauge: Arc<JitterGauge>,
    scale: Arc<LightScale>,
    /// Standard deviation of a frame's lateness before it is measured.
    jitter_us: f64,
}

/// The light of all images in the strip.
#[derive(Clone)]
pub struct StripLight {
    strip: StripGauge,
    /// Mean counts, `[t, s]` of the strip.
    counts: BTreeMap<PointRole, (Setting, Arc<Array2<f32>>)>,
}

/// The images' lateness, and what is to be said of it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StripFindings {
    /// By how much the light of each image is late; without those of which the strip shows nothing.
    pub late_us: BTreeMap<PointRole, Estimate>,
    /// What was found.
    pub remark: Option<String>,
    /// What is wrong with the strip.
    pub warning: Option<String>,
}

impl StripGauge {
    /// The strip of a calibrated rig; `None` if it has none.
    ///
    /// # Errors
    /// If the strip does not fit the image.
    pub fn of(geometry: &SweepGeometry) -> Result<Option<Self>, PlaneError> {
        let Some((calibration, strip)) =
            geometry.calibration.as_ref().and_then(|found| Some((found, found.strip.as_ref()?)))
        else {
            return Ok(None);
        };
        let raster = &geometry.raster;
        let centre_us = raster.row_centre_us(geometry.first_row);
        let gauge = JitterGauge::new(calibration, strip, raster.period_us, centre_us)?;
        let white_dn = calibration.white_dn.slice(s![.., gauge.columns()]).mapv(f64::from);
        let zero_dn = || calibration.dark_offset_dn.slice(s![.., gauge.columns()]).to_owned();
        let curve = calibration.linearity_per_dn;
        let curve = curve.map(|per_dn| CameraCurve { per_dn, zero_dn: zero_dn() });
        let scale = LightScale::new(&white_dn, curve);
        Ok(Some(Self { gauge: Arc::new(gauge), scale: Arc::new(scale), jitter_us: strip.jitter_us }))
    }

    /// The strip's part of an image.
    pub fn of_image<'a>(&self, image: &'a ArrayView2<'a, f32>) -> ArrayView2<'a, f32> {
        image.slice(s![.., self.gauge.columns()])
    }

    /// How late the light of an image is; `None` if the strip does not show it, or does not look like the board.
    pub fn late_us(
        &self,
        setting: &Setting,
        image: ArrayView2<f32>,
        dark: ArrayView2<f32>,
    ) -> Option<Estimate> {
        let found = self.lateness(setting, image, dark)?;
        self.is_shown(setting, &found).then_some(found.late_us)
    }

    fn is_shown(&self, setting: &Setting, found: &Lateness) -> bool {
        let prior = self.jitter_us.powi(2) / setting.delays_us.len().max(1) as f64;
        found.late_us.sd.powi(2) < (1.0 - SHOWN_SHARE) * prior && found.chi2_per_sample < MOST_CHI2
    }

    fn lateness(&self, setting: &Setting, image: ArrayView2<f32>, dark: ArrayView2<f32>) -> Option<Lateness> {
        let light = self.scale.light(image, dark);
        self.gauge.lateness(setting, light.view()).ok()
    }
}

impl StripLight {
    /// No images yet.
    pub fn new(strip: StripGauge) -> Self {
        Self { strip, counts: BTreeMap::new() }
    }

    /// Takes an image, `[t, s]` of all camera rows; a later one of the same role replaces it.
    pub fn push(&mut self, role: PointRole, setting: &Setting, image: ArrayView2<f32>) {
        let strip = self.strip.of_image(&image).to_owned();
        self.counts.insert(role, (setting.clone(), Arc::new(strip)));
    }

    /// The lateness of all images of the sweep whose dark image, by `dark_of`, was taken.
    pub fn findings(&self, dark_of: impl Fn(PointRole) -> Option<PointRole> + Sync) -> StripFindings {
        let lit: Vec<PointRole> =
            self.counts.keys().filter(|role| matches!(role, PointRole::Sweep(_))).copied().collect();
        let found: Vec<(PointRole, usize, bool, Lateness)> = lit
            .par_iter()
            .filter_map(|&role| {
                let (setting, image) = self.counts.get(&role)?;
                let (_, dark) = self.counts.get(&dark_of(role)?)?;
                let found = self.strip.lateness(setting, image.view(), dark.view())?;
                Some((role, setting.delays_us.len(), self.strip.is_shown(setting, &found), found))
            })
            .collect();
        let unlike = found.iter().filter(|(.., found)| found.chi2_per_sample >= MOST_CHI2).count();
        let late_us: BTreeMap<PointRole, Estimate> = found
            .iter()
            .filter(|(_, _, shown, _)| *shown)
            .map(|(role, .., found)| (*role, found.late_us))
            .collect();
        if late_us.is_empty() && unlike == 0 {
            return StripFindings::default();
        }
        let columns = self.strip.gauge.columns();
        let warning = (unlike > late_us.len()).then(|| {
            format!(
                "columns {} to {} (calibration.strip_columns) do not look like the calibrated board in {unlike} images: their jitter is not known; put the board there, or leave strip_columns out",
                columns.start,
                columns.end - 1
            )
        });
        let rms_us = (late_us.values().map(|late_us| late_us.value * late_us.value).sum::<f64>()
            / late_us.len().max(1) as f64)
            .sqrt();
        let remark = format!(
            "{} of {} images have an edge on the strip of the board; their light is late by {rms_us:.2} us (rms), which is corrected",
            late_us.len(),
            found.len(),
        );
        StripFindings { late_us, remark: Some(remark), warning }
    }
}
