//! Assembles products from the strips of a sweep.

use ndarray::{Array2, Array3, Axis, s};
use raysweep_transport::plane::Transport;
use raysweep_transport::plane::advice::BiasOfFamily;

use super::mask;
use super::profile::ProfileSums;
use super::spec::{ProductKind, ProductSpec};
use crate::product::Product;
use crate::stack::SweepStack;

/// Why a product could not be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("product {name}: {what}")]
pub struct NotMade {
    /// The product's name.
    pub name: String,
    /// What is missing, and what to do.
    pub what: String,
}

impl ProductSpec {
    /// Computes the product.
    ///
    /// # Errors
    /// If a required image was not taken, or saturates.
    pub fn make(&self, stack: &SweepStack, transport: &Transport) -> Result<Product, NotMade> {
        let mut assembly = Assembly::new(self.clone());
        assembly.add(0, stack, transport)?;
        assembly.finish()
    }
}

/// A product under construction. It has the same bits for any division into strips.
#[derive(Debug)]
pub struct Assembly {
    spec: ProductSpec,
    /// The product of each strip so far; empty for a profile.
    parts: Vec<Product>,
    sums: ProfileSums,
    /// What a `prior-bias` is taken from, the same for all strips.
    family: Option<BiasOfFamily>,
}

impl Assembly {
    /// Starts a product.
    pub fn new(spec: ProductSpec) -> Self {
        Self { spec, parts: Vec::new(), sums: ProfileSums::default(), family: None }
    }

    /// The product's name.
    pub fn name(&self) -> &str {
        self.spec.name()
    }

    /// Adds the camera rows starting at `first_row`, to which stack and transport belong. Strips must be added from
    /// top to bottom, each once.
    ///
    /// # Errors
    /// If a required image was not taken.
    pub fn add(
        &mut self,
        first_row: usize,
        stack: &SweepStack,
        transport: &Transport,
    ) -> Result<(), NotMade> {
        let name = self.spec.name.clone();
        let not_made = |what: String| NotMade { name: self.spec.name.clone(), what };
        let mask = mask::of(&self.spec.kind, first_row, stack, transport)
            .map_err(|error| not_made(error.to_string()))?;
        let part = match &self.spec.kind {
            ProductKind::Regular => match &stack.regular {
                Some(image) => Product::Image {
                    name,
                    about: "a captured exposure of one whole VSYNC period: every row lit once".into(),
                    is_light: true,
                    image: image.clone(),
                    mask,
                },
                None => {
                    let what = "the regular image or its dark image is not stored: resume the run";
                    return Err(not_made(what.into()));
                }
            },
            ProductKind::Epipolar(width) => width.of(stack.one_band).epipolar(name, transport, mask),
            ProductKind::NonEpipolar(width) => width.of(stack.one_band).non_epipolar(name, transport, mask),
            ProductKind::Band(band) => band.of(stack.one_band).make(name, transport, mask),
            ProductKind::Bands(bands) => {
                let timing = &stack.timing;
                let starts_us = timing.row_starts_us();
                let lit_us = starts_us[timing.projector_rows()] - starts_us[0];
                let row_time_us = lit_us / timing.projector_rows() as f64;
                bands.make(name, row_time_us, stack.one_band, transport, mask)
            }
            ProductKind::Captured(captured) => captured.make(name, stack, mask).map_err(not_made)?,
            ProductKind::CrossSection(cut) => {
                let part = cut.make(name, first_row, stack, transport).map_err(not_made)?;
                self.parts.extend(part);
                return Ok(());
            }
            ProductKind::Relight(pattern) => pattern
                .make(name, &stack.timing, first_row, transport, mask)
                .map_err(|error| not_made(error.to_string()))?,
            ProductKind::Uncertainty(of) => {
                of.make(name, first_row, stack, transport, mask).map_err(not_made)?
            }
            ProductKind::PriorBias(of) => {
                of.make_bias(name, first_row, stack, transport, mask, &mut self.family).map_err(not_made)?
            }
            ProductKind::DelayProfile(options) => {
                options.add(&mut self.sums, first_row, stack, transport);
                return Ok(());
            }
        };
        self.parts.push(part);
        Ok(())
    }

    /// The product, after all strips have been added.
    ///
    /// # Errors
    /// If a required image saturates.
    pub fn finish(self) -> Result<Product, NotMade> {
        let Self { spec: ProductSpec { name, kind }, parts, sums, .. } = self;
        if let ProductKind::DelayProfile(options) = kind {
            return options.make(name.clone(), &sums).map_err(|what| NotMade { name, what });
        }
        let mut parts = parts.into_iter();
        let first = parts.next();
        let first = first.ok_or(NotMade { name, what: "no camera row was solved: resume the run".into() })?;
        if parts.len() == 0 {
            return Ok(first);
        }
        Ok(match first {
            Product::Image { name, about, is_light, image, mask } => {
                let rest = parts.filter_map(|part| match part {
                    Product::Image { image, mask, .. } => Some((image.insert_axis(Axis(0)), mask)),
                    _ => None,
                });
                let (images, masks) = rest.unzip();
                let image =
                    one_below_the_other(image.insert_axis(Axis(0)), images).index_axis_move(Axis(0), 0);
                Product::Image { name, about, is_light, image, mask: one_mask_below_the_other(mask, masks) }
            }
            Product::Sequence { name, about, axis, at, images, mask } => {
                let rest = parts.filter_map(|part| match part {
                    Product::Sequence { images, mask, .. } => Some((images, mask)),
                    _ => None,
                });
                let (rest, masks) = rest.unzip();
                let (images, mask) =
                    (one_below_the_other(images, rest), one_mask_below_the_other(mask, masks));
                Product::Sequence { name, about, axis, at, images, mask }
            }
            Product::CrossSection(mut whole) => {
                for part in parts {
                    if let Product::CrossSection(part) = part {
                        whole.append(part);
                    }
                }
                Product::CrossSection(whole)
            }
            other @ Product::Profile(_) => other,
        })
    }
}

fn one_mask_below_the_other(first: Array2<u8>, rest: Vec<Array2<u8>>) -> Array2<u8> {
    let rest = rest.into_iter().map(|mask| mask.insert_axis(Axis(0))).collect();
    one_below_the_other(first.insert_axis(Axis(0)), rest).index_axis_move(Axis(0), 0)
}

/// Concatenates images `[k, t, s]` along their rows. The result is in C order, as if it had been computed as a whole:
/// sums over it depend, to the bit, on the memory layout.
fn one_below_the_other<T: Copy + Default>(first: Array3<T>, rest: Vec<Array3<T>>) -> Array3<T> {
    let parts: Vec<Array3<T>> = std::iter::once(first).chain(rest).collect();
    let (count, _, columns) = parts[0].dim();
    let rows = parts.iter().map(|part| part.len_of(Axis(1))).sum();
    let mut whole = Array3::from_elem((count, rows, columns), T::default());
    let mut first_row = 0;
    for part in parts {
        let end = first_row + part.len_of(Axis(1));
        whole.slice_mut(s![.., first_row..end, ..]).assign(&part);
        first_row = end;
    }
    whole
}
