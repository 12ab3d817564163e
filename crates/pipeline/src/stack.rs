//! The images of a sweep, ready to be demultiplexed.

use ndarray::{Array2, Array3, Axis};
use raysweep_transport::plane::board::CalibrationCovariance;
use raysweep_transport::plane::{DarkImage, NoiseModel, Prior, RowTiming, Setting};

/// The images from which a transport was computed.
#[derive(Debug, Clone)]
pub struct SweepStack {
    /// The timing of projector and camera rows.
    pub timing: RowTiming,
    /// The prior used for the transport.
    pub prior: Prior,
    /// The planned delay of each image of a sweep; of a film, the measured one.
    pub delays_us: Vec<f64>,
    /// The planned exposure of each image.
    pub exposures_us: Vec<f64>,
    /// Delays and exposure of each image.
    pub settings: Vec<Setting>,
    /// Number of frames averaged in the dark image that was subtracted from each image. Images with the same planned
    /// exposure share one.
    pub dark_frames: Vec<usize>,
    /// Standard deviation of the delay of each image, as far as it is known: what VSYNC stamps do not show of its
    /// frames' light.
    pub delay_sds_us: Vec<f64>,
    /// Errors of the calibration that the timing contains; `None` without one.
    pub calibration: Option<CalibrationCovariance>,
    /// `[settings, t, s]` of all camera rows, or those of a [`crate::Strip`]; dark image subtracted, 1 = a white pixel
    /// lit by its own projector row.
    pub images: Array3<f32>,
    /// Which samples are not saturated, of the same shape; `None` if all.
    pub valid: Option<Array3<bool>>,
    /// The image with one whole VSYNC period of exposure, `[t, s]`, if it was taken.
    pub regular: Option<Array2<f32>>,
    /// Where that image does not saturate, `[t, s]`; `None` if nowhere, or if the image was not taken.
    pub regular_valid: Option<Array2<bool>>,
    /// Which pixels a stage replaced in some image, `[t, s]`; `None` if none.
    pub filled: Option<Array2<bool>>,
    /// The noise of a single frame without that of its dark image, if it could be fitted.
    pub noise: Option<NoiseModel>,
    /// Share of the noise variance that remains after spatial coupling, `[t, s]`; `None` if not coupled.
    pub variance_ratio: Option<Array2<f32>>,
    /// Assumed position of direct light, in rows from the pixel's own, `[t, s]`; `None` if in its own row.
    pub u0_rows: Option<Array2<f32>>,
    /// Whether the rows `|u| <= 2` are one band, because the settings do not tell where in it direct light lies.
    pub one_band: bool,
}

impl SweepStack {
    /// Images with these settings, of which nothing else is known: delays and exposures as planned, dark images of one frame,
    /// exact delays.
    pub(crate) fn new(timing: RowTiming, prior: Prior, settings: Vec<Setting>, images: Array3<f32>) -> Self {
        Self {
            timing,
            prior,
            delays_us: settings.iter().map(Setting::mean_delay_us).collect(),
            exposures_us: settings.iter().map(|setting| setting.exposure_us).collect(),
            dark_frames: vec![1; settings.len()],
            delay_sds_us: vec![0.0; settings.len()],
            settings,
            calibration: None,
            images,
            valid: None,
            regular: None,
            regular_valid: None,
            filled: None,
            noise: None,
            variance_ratio: None,
            u0_rows: None,
            one_band: false,
        }
    }

    /// A stack with only these camera rows.
    pub(crate) fn of_rows(&self, rows: &[usize]) -> Self {
        let images = self.images.select(Axis(1), rows);
        Self {
            delays_us: self.delays_us.clone(),
            exposures_us: self.exposures_us.clone(),
            dark_frames: self.dark_frames.clone(),
            delay_sds_us: self.delay_sds_us.clone(),
            valid: self.valid.as_ref().map(|valid| valid.select(Axis(1), rows)),
            ..Self::new(self.timing.clone(), self.prior, self.settings.clone(), images)
        }
    }

    /// The dark images that were subtracted.
    pub(crate) fn darks(&self) -> Vec<DarkImage> {
        let mut darks: Vec<(f64, DarkImage)> = Vec::new();
        for (n, (&exposure_us, &frames)) in self.exposures_us.iter().zip(&self.dark_frames).enumerate() {
            match darks.iter_mut().find(|(of_us, _)| *of_us == exposure_us) {
                Some((_, dark)) => dark.settings.push(n),
                None => darks.push((exposure_us, DarkImage { settings: vec![n], frames })),
            }
        }
        darks.into_iter().map(|(_, dark)| dark).collect()
    }

    /// Keeps the images for whose index `kept` returns true.
    pub(crate) fn keep(&mut self, kept: impl Fn(usize) -> bool) {
        let kept: Vec<usize> = (0..self.settings.len()).filter(|&n| kept(n)).collect();
        if kept.len() == self.settings.len() {
            return;
        }
        self.delays_us = kept.iter().map(|&n| self.delays_us[n]).collect();
        self.exposures_us = kept.iter().map(|&n| self.exposures_us[n]).collect();
        self.dark_frames = kept.iter().map(|&n| self.dark_frames[n]).collect();
        self.delay_sds_us = kept.iter().map(|&n| self.delay_sds_us[n]).collect();
        self.settings = kept.iter().map(|&n| self.settings[n].clone()).collect();
        self.images = self.images.select(Axis(0), &kept);
        self.valid = self.valid.as_ref().map(|valid| valid.select(Axis(0), &kept));
    }
}
