//! Products of a transport alone, as a film's cycle gives it: images that need no stack.

use ndarray::Array2;
use raysweep_transport::plane::{RowTiming, Transport};

use super::assembly::NotMade;
use super::spec::{ProductKind, ProductSpec};
use crate::product::Product;

impl ProductSpec {
    /// Why it cannot be made from the transport of a film's cycle, if it cannot.
    pub fn not_of_a_film(&self) -> Option<String> {
        let what = match &self.kind {
            ProductKind::Epipolar(_) | ProductKind::NonEpipolar(_) | ProductKind::Band(_) => return None,
            ProductKind::Relight(relight) if !relight.is_sequence() => return None,
            ProductKind::Relight(_) => {
                "line gives a sequence of images, and a film has one for each cycle: use rows or stripes"
            }
            ProductKind::Regular
            | ProductKind::DelayProfile(_)
            | ProductKind::Uncertainty(_)
            | ProductKind::PriorBias(_) => {
                "needs the images of a sweep: a film's products are epipolar, non-epipolar, band and relight"
            }
        };
        Some(format!("product {}: {what}", self.name))
    }

    /// Its image of one transport, `[t, s]`, and what it shows, in one sentence. `one_band`: whether the rows
    /// `|u| <= 2` cannot be told apart.
    ///
    /// # Errors
    /// If it is not one of a film, or the transport does not fit the timing.
    pub fn frame(
        &self,
        timing: &RowTiming,
        transport: &Transport,
        one_band: bool,
    ) -> Result<(Array2<f32>, String), NotMade> {
        let not_made = |what: String| NotMade { name: self.name.clone(), what };
        let (name, mask) = (self.name.clone(), Array2::zeros((0, 0)));
        let product = match &self.kind {
            ProductKind::Epipolar(width) => width.of(one_band).epipolar(name, transport, mask),
            ProductKind::NonEpipolar(width) => width.of(one_band).non_epipolar(name, transport, mask),
            ProductKind::Band(band) => band.of(one_band).make(name, transport, mask),
            ProductKind::Relight(relight) => {
                relight.make(name, timing, 0, transport, mask).map_err(|error| not_made(error.to_string()))?
            }
            ProductKind::Regular
            | ProductKind::DelayProfile(_)
            | ProductKind::Uncertainty(_)
            | ProductKind::PriorBias(_) => return Err(not_made("it is not a product of films".into())),
        };
        match product {
            Product::Image { image, about, .. } => Ok((image, about)),
            Product::Sequence { .. } | Product::Profile(_) => {
                Err(not_made("it is more than one image".into()))
            }
        }
    }
}
