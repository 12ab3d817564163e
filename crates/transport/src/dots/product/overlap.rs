use ndarray::Array3;

use super::relight::floodlit;
use crate::dots::DotsError;
use crate::dots::calibrate::PointSpreads;
use crate::dots::error::check_shape;

/// Least coverage that is divided by: below it no dot shone there, and division would only amplify noise.
const LEAST_COVERAGE: f32 = 0.1;

/// The total coverage of each pixel by the dots, `[height, width, 1]`: the sum of their spreads. The number of dots,
/// which the paper tried first, leaves ripple from the dots' edges.
pub fn coverage(spreads: &PointSpreads) -> Array3<f32> {
    floodlit(&spreads.columns)
}

/// Divides direct light `[height, width, channels]` by the coverage, so that pixels under one dot and under several
/// are equally bright.
///
/// # Errors
/// [`DotsError::Shape`] if the coverage has another size.
pub fn compensate(direct: &Array3<f32>, coverage: &Array3<f32>) -> Result<Array3<f32>, DotsError> {
    let (height, width, _) = direct.dim();
    check_shape("coverage", "[height, width, 1]", coverage.shape(), &[height, width, 1])?;
    Ok(direct / &coverage.mapv(|covered| covered.max(LEAST_COVERAGE)))
}
