//! What plans ask for of a sweep.

use ndarray::{Array2, Array3};
use raysweep_transport::plane::DelayProfile;

/// A product, as it is written to disk.
#[derive(Debug, Clone)]
pub enum Product {
    /// An image `[t, s]` in the scene's units (1 = a white pixel).
    Image {
        /// File name without extension.
        name: String,
        /// Description in one sentence.
        about: String,
        /// Whether it shows light, and not how uncertain light is.
        is_light: bool,
        /// The pixels.
        image: Array2<f32>,
        /// What is known of each pixel, `[t, s]`: the bits of [`crate::mask`].
        mask: Array2<u8>,
    },
    /// Images `[k, t, s]` in the scene's units.
    Sequence {
        /// File name without extension.
        name: String,
        /// Description in one sentence.
        about: String,
        /// The quantity in which the images differ, with its unit.
        axis: String,
        /// The value of `axis` for each image.
        at: Vec<f64>,
        /// The pixels.
        images: Array3<f32>,
        /// What is known of each pixel in all images, `[t, s]`: the bits of [`crate::mask`].
        mask: Array2<u8>,
    },
    /// Light as a function of the delay.
    Profile(Profile),
    /// Light along a row or a column of several images.
    CrossSection(CrossSection),
}

impl Product {
    /// The name of its files, without extension.
    pub fn name(&self) -> &str {
        match self {
            Self::Image { name, .. } | Self::Sequence { name, .. } => name,
            Self::Profile(profile) => &profile.name,
            Self::CrossSection(section) => &section.name,
        }
    }
}

/// Light as a function of the delay at one exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// File name without extension.
    pub name: String,
    /// Description in one sentence.
    pub about: String,
    /// The planned exposure.
    pub exposure_us: f64,
    /// Measured light.
    pub measured: DelayProfile,
    /// Light predicted from the transport by the forward model.
    pub predicted: DelayProfile,
}

impl Profile {
    /// The table to write: names and values of its columns, one row per delay.
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

/// Light along a row or a column of several images.
#[derive(Debug, Clone, PartialEq)]
pub struct CrossSection {
    /// File name without extension.
    pub name: String,
    /// Description in one sentence.
    pub about: String,
    /// The axis along which it runs: `s` along a row, `t` down a column.
    pub along: &'static str,
    /// The images by name, with a value for each pixel.
    pub curves: Vec<(&'static str, Vec<f64>)>,
}

impl CrossSection {
    /// Appends the part below.
    pub(crate) fn append(&mut self, below: Self) {
        for ((_, all), (_, more)) in self.curves.iter_mut().zip(below.curves) {
            all.extend(more);
        }
    }

    /// The table to write: names and values of its columns, one row per pixel.
    pub fn columns(&self) -> Vec<(&'static str, Vec<f64>)> {
        let pixels = self.curves.first().map_or(0, |(_, curve)| curve.len());
        let places = (0..pixels).map(|pixel| pixel as f64).collect();
        std::iter::once((self.along, places)).chain(self.curves.iter().cloned()).collect()
    }
}
