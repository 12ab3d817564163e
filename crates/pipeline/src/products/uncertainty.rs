//! How far to trust the light of a band or of a relit image: `uncertainty`, the standard deviation, and `prior-bias`,
//! a bound on what the prior adds.

use std::ops::RangeInclusive;

use ndarray::{Array2, Array3, Axis};
use raysweep_transport::plane::advice::BiasOfFamily;
use raysweep_transport::plane::{LightSums, NoiseModel, PlaneError, Samples, Transport, Uncertainty};

use super::band::Band;
use super::relight::Relight;
use crate::product::Product;
use crate::stack::SweepStack;

const NO_NOISE: &str = "the stack's noise could not be fitted; the report says why";

/// The light whose trust is told: that of a band, or of an image under some rows.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum LightOf {
    Band(Band),
    Relit(Relight),
}

impl LightOf {
    pub(super) fn default_name(&self) -> String {
        match self {
            Self::Band(band) => band.default_name(),
            Self::Relit(_) => "relight".into(),
        }
    }

    /// The relative rows whose light it tells apart.
    pub(super) fn rows(&self) -> Vec<RangeInclusive<i32>> {
        match self {
            Self::Band(band) => band.open_ranges(),
            Self::Relit(_) => vec![i32::MIN..=i32::MAX],
        }
    }

    /// Why a sweep of this reach sees none of it.
    pub(super) fn beyond(&self, first: i32, last: i32) -> Option<String> {
        match self {
            Self::Band(band) => band.beyond(first, last),
            Self::Relit(_) => None,
        }
    }

    /// The standard deviation for the camera rows starting at `first_row`, to which stack and transport belong.
    pub(super) fn make(
        &self,
        name: String,
        first_row: usize,
        stack: &SweepStack,
        transport: &Transport,
        mask: Array2<u8>,
    ) -> Result<Product, String> {
        let noise = stack.noise.ok_or(NO_NOISE)?;
        let (says, image) = self.image(stack, noise, |model, samples, sums| {
            model.of_sums_in_rows(first_row, transport, samples, sums)
        })?;
        let of = match stack.calibration {
            Some(_) => "noise, dark images, jitter and calibration",
            None => "noise and dark images",
        };
        let about = format!(
            "standard deviation, through {of}, of {says}; without the prior's bias, which the product prior-bias bounds"
        );
        Ok(Product::Image { name, about, is_light: false, image, mask })
    }

    /// The bound on the prior's bias for the same rows. `family` is that of the first strip.
    pub(super) fn make_bias(
        &self,
        name: String,
        first_row: usize,
        stack: &SweepStack,
        transport: &Transport,
        mask: Array2<u8>,
        family: &mut Option<BiasOfFamily>,
    ) -> Result<Product, String> {
        let noise = stack.noise.ok_or(NO_NOISE)?;
        let (says, image) = self.image(stack, noise, |model, samples, sums| {
            let family = match family {
                Some(family) => family,
                None => family.insert(model.bias_of_family()?),
            };
            model.prior_bias_in_rows(first_row, transport, samples, sums, family)
        })?;
        let about = format!("bound on the bias that the prior gives to {says}, meant for 95 % of the pixels");
        Ok(Product::Image { name, about, is_light: false, image, mask })
    }

    /// What the light is, and the image that `make` computes of it.
    fn image(
        &self,
        stack: &SweepStack,
        noise: NoiseModel,
        make: impl FnOnce(&Uncertainty<'_>, &Samples<'_>, &LightSums<'_>) -> Result<Array3<f32>, PlaneError>,
    ) -> Result<(String, Array2<f32>), String> {
        let make = |sums: &LightSums<'_>| image(stack, noise, |model, samples| make(model, samples, sums));
        match self {
            Self::Band(band) => {
                let band = band.of(stack.one_band);
                Ok((band.says(), make(&LightSums::Bands(&[band.ranges()]))?))
            }
            Self::Relit(relight) => {
                let (says, weights) = relight
                    .weights(stack.timing.projector_rows())
                    .map_err(|_line| "a sequence has no uncertainty")?;
                let says = format!("the scene {says}");
                Ok((says, make(&LightSums::Relit { weights: weights.view(), beam: relight.beam() })?))
            }
        }
    }
}

/// The image that `make` computes from a stack.
fn image(
    stack: &SweepStack,
    noise: NoiseModel,
    make: impl FnOnce(&Uncertainty<'_>, &Samples<'_>) -> Result<Array3<f32>, PlaneError>,
) -> Result<Array2<f32>, String> {
    let frames: Vec<usize> = stack.settings.iter().map(|setting| setting.delays_us.len()).collect();
    let samples = Samples {
        stack: stack.images.view(),
        valid: stack.valid.as_ref().map(|valid| valid.view()),
        variance_ratio: stack.variance_ratio.as_ref().map(|ratio| ratio.view()),
        u0_rows: stack.u0_rows.as_ref().map(|u0_rows| u0_rows.view()),
    };
    let model = Uncertainty {
        timing: &stack.timing,
        settings: &stack.settings,
        prior: stack.prior,
        noise,
        frames: &frames,
        delay_sds_us: &stack.delay_sds_us,
        darks: &stack.darks(),
        calibration: stack.calibration.as_ref(),
    };
    let image = make(&model, &samples).map_err(|error| error.to_string())?;
    Ok(image.index_axis_move(Axis(0), 0))
}
