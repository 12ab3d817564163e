//! `uncertainty`: the standard deviation of a band's light due to noise.

use ndarray::{Array2, Axis};
use raysweep_transport::plane::{Samples, Transport, Uncertainty};

use super::band::Band;
use crate::product::Product;
use crate::stack::SweepStack;

/// Computes it for the camera rows starting at `first_row`, to which stack and transport belong.
pub(super) fn make(
    name: String,
    band: Band,
    first_row: usize,
    stack: &SweepStack,
    transport: &Transport,
    mask: Array2<u8>,
) -> Result<Product, String> {
    let noise = stack.noise.ok_or("the stack's noise could not be fitted; the report says why")?;
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
    };
    let sd = model
        .of_bands_in_rows(first_row, transport, &samples, &[band.ranges()])
        .map_err(|error| error.to_string())?;
    let about =
        format!("standard deviation, through noise alone, of {}; the prior's bias is not in it", band.says());
    Ok(Product::Image { name, about, image: sd.index_axis_move(Axis(0), 0), mask })
}
