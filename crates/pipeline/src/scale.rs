//! From counts to light.

use ndarray::{Array2, ArrayView2, Zip};

/// The curve of a camera: `DN (1 + a DN)` is proportional to the light, DN counting from an exposure of 0.
#[derive(Debug, Clone)]
pub(crate) struct CameraCurve {
    /// `a`.
    pub per_dn: f64,
    /// Counts at an exposure of 0, `[t, s]`.
    pub zero_dn: Array2<f32>,
}

/// What converts the counts of some pixels to light.
#[derive(Debug, Clone)]
pub struct LightScale {
    /// Light per count, `[t, s]`; 0 where white is infinite, NaN where it is NaN.
    per_dn: Array2<f32>,
    curve: Option<CameraCurve>,
}

impl LightScale {
    /// The scale of pixels that have these counts under white, `[t, s]`, infinite where no light is to be found, on a
    /// camera with this curve.
    pub(crate) fn new(white_dn: &Array2<f64>, curve: Option<CameraCurve>) -> Self {
        Self { per_dn: white_dn.mapv(|dn| (1.0 / dn) as f32), curve }
    }

    /// The light of an image `[t, s]` of these pixels with its dark image: 1 = a white pixel lit by its own row.
    pub fn light(&self, image: ArrayView2<'_, f32>, dark: ArrayView2<'_, f32>) -> Array2<f32> {
        let mut light = &image - &dark;
        if let Some(CameraCurve { per_dn, zero_dn }) = &self.curve {
            // Of S(image - zero) - S(dark - zero) with S(x) = x (1 + a x): the dark image has light of the room.
            let a = *per_dn as f32;
            Zip::from(&mut light)
                .and(&image)
                .and(&dark)
                .and(zero_dn)
                .for_each(|light, image, dark, zero| *light *= 1.0 + a * (image + dark - 2.0 * zero));
        }
        light * &self.per_dn
    }
}

#[cfg(test)]
mod tests {
    use ndarray::arr2;

    use super::*;

    #[test]
    fn light_is_the_difference_of_straightened_counts_over_white() {
        let (image, dark) = (arr2(&[[1064.0, 564.0, 64.0, 1064.0]]), arr2(&[[264.0, 64.0, 64.0, 64.0]]));
        let white_dn = arr2(&[[1000.0, 1000.0, 1000.0, f64::INFINITY]]);
        let light = |curve| LightScale::new(&white_dn, curve).light(image.view(), dark.view());
        assert_eq!(light(None), arr2(&[[0.8, 0.5, 0.0, 0.0]]));
        let curve = CameraCurve { per_dn: 1e-4, zero_dn: Array2::from_elem((1, 4), 64.0) };
        // 1000 counts of light are 1000 (1 + 0.1), 200 are 200 (1 + 0.02), 500 are 500 (1 + 0.05).
        let expected = arr2(&[[1.1 - 0.204, 0.525, 0.0, 0.0_f32]]);
        let found = light(Some(curve));
        assert!(found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found}");
    }
}
