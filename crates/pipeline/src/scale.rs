//! From counts to light.

use ndarray::{Array2, ArrayView2, Zip};

/// What converts the counts of some pixels to light.
#[derive(Debug, Clone)]
pub struct LightScale {
    /// Light per count, `[t, s]`; 0 where white is not known.
    per_dn: Array2<f32>,
    /// `a` of `DN (1 + a DN)`, which is proportional to the light.
    linearity_per_dn: f32,
}

impl LightScale {
    /// The scale of pixels that have these counts under white, `[t, s]`, infinite where it is not known, on a camera
    /// whose `DN (1 + a DN)` is proportional to the light.
    pub fn new(white_dn: &Array2<f64>, linearity_per_dn: f64) -> Self {
        let per_dn = white_dn.mapv(|dn| (1.0 / dn) as f32);
        Self { per_dn, linearity_per_dn: linearity_per_dn as f32 }
    }

    /// The light of an image `[t, s]` of these pixels with its dark image: 1 = a white pixel lit by its own row.
    pub fn light(&self, image: ArrayView2<'_, f32>, dark: ArrayView2<'_, f32>) -> Array2<f32> {
        let mut light = &image - &dark;
        Zip::from(&mut light)
            .and(&self.per_dn)
            .for_each(|light, per_dn| *light = *light * (1.0 + self.linearity_per_dn * *light) * per_dn);
        light
    }
}
