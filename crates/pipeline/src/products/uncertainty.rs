//! How far to trust a band's light: `uncertainty`, the standard deviation, and `prior-bias`, what the prior may add.

use ndarray::{Array2, Array3, Axis};
use raysweep_transport::plane::{NoiseModel, PlaneError, Samples, Transport, Uncertainty};

use super::band::Band;
use crate::product::Product;
use crate::stack::SweepStack;

/// The standard deviation for the camera rows starting at `first_row`, to which stack and transport belong.
pub(super) fn make(
    name: String,
    band: Band,
    first_row: usize,
    stack: &SweepStack,
    transport: &Transport,
    mask: Array2<u8>,
) -> Result<Product, String> {
    let noise = stack.noise.ok_or("the stack's noise could not be fitted; the report says why")?;
    let image = image(stack, noise, |model, samples| {
        model.of_bands_in_rows(first_row, transport, samples, &[band.ranges()])
    })?;
    let of = match stack.calibration {
        Some(_) => "noise, dark images and calibration",
        None => "noise and dark images",
    };
    let about = format!(
        "standard deviation, through {of}, of {}; the prior's bias is not in it: see prior-bias",
        band.says()
    );
    Ok(Product::Image { name, about, image, mask })
}

/// The size of the prior's bias for the same rows.
pub(super) fn make_bias(
    name: String,
    band: Band,
    first_row: usize,
    stack: &SweepStack,
    transport: &Transport,
    mask: Array2<u8>,
) -> Result<Product, String> {
    let none = NoiseModel { read_variance: 0.0, gain: 0.0 };
    let image = image(stack, none, |model, samples| {
        model.prior_bias_in_rows(first_row, transport, samples, &[band.ranges()])
    })?;
    let about = format!("size of the bias that the prior may give to {}", band.says());
    Ok(Product::Image { name, about, image, mask })
}

/// The image that `make` computes from a stack.
fn image(
    stack: &SweepStack,
    noise: NoiseModel,
    make: impl FnOnce(&Uncertainty<'_>, &Samples<'_>) -> Result<Array3<f32>, PlaneError>,
) -> Result<Array2<f32>, String> {
    let frames: Vec<usize> = stack.settings.iter().map(|setting| setting.delays_us.len()).collect();
    let ratios = frames.iter().zip(&stack.dark_frames).map(|(&frames, &dark)| frames as f64 / dark as f64);
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
        // The stack from which the noise was fitted contains that of the dark images.
        noise: noise.without_darks(ratios.sum::<f64>() / frames.len() as f64),
        frames: &frames,
        darks: &stack.darks(),
        calibration: stack.calibration.as_ref(),
    };
    let image = make(&model, &samples).map_err(|error| error.to_string())?;
    Ok(image.index_axis_move(Axis(0), 0))
}
