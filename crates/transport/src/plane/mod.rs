//! Plane-to-ray light transport from delay-exposure stacks, after Kubo et al., "Acquiring and Characterizing
//! Plane-to-Ray Indirect Light Transport" (ICCP 2018), with its Eq. 1 corrected (see [`delay_us`]).
//!
//! A raster projector lights one row at a time while a rolling shutter exposes camera rows at the same vertical speed.
//! `T(v, t, s)` is the light that camera pixel (row `t`, column `s`) receives when projector row `v` alone is lit;
//! 1.0 is the light of a white surface under its own row, collected over one row's dwell. An image taken with
//! delay `t_d` and exposure `t_e` is a weighted sum of `T` over the relative row `u = v - t`:
//!
//! ```text
//! I(s, t) = sum over u of A(u) T(t + u, s, t)
//! A(u)    = |[u tau - t_p/2, u tau + t_p/2] ∩ [t_d - t_e/2, t_d + t_e/2]| / t_p,    t_p = tau
//! ```
//!
//! This applies if the rows of projector and camera advance at one constant speed. [`RowTiming`] covers other cases,
//! and the [`Beam`] the spread of a row; it and [`Setting`] contain the quantities on the right-hand side.
//! [`RowModel`] is `A` for one camera row with its borders and the neighbouring frames, and [`Demux`] inverts it with
//! a [`Prior`]. [`Coupling`] averages similar pixels beforehand, based on a [`NoiseModel`], and [`Uncertainty`]
//! computes what noise and errors of a calibration leave in the result. [`calibrate`] estimates the model's parameters from the stack
//! itself.
//!
//! The folders import each other in one direction: `solve` imports `model`; [`calibrate`], `products` and [`advice`]
//! import both, and `noise`; `products` imports [`advice`], too, for the family of scenes that it bounds biases with.

pub mod advice;
pub mod board;
pub mod calibrate;
mod error;
mod model;
mod noise;
mod products;
pub mod separation;
mod solve;
pub mod spread;

pub use error::PlaneError;
pub use model::{
    Beam, CameraRows, FIRST_RESPONSE_ROW, MIN_WEIGHT, PixelResponse, RESPONSE_ROWS, RowModel, RowTiming,
    Setting, Shares, Slot, SlotKind, Transport, delay_us, offset_us, predict, reach, relative_rows,
};
pub use noise::{Coupled, Coupling, NoiseModel};
pub use products::{
    DarkImage, DelayProfile, LightSums, RelitBeam, RelitUnknowns, Samples, Uncertainty, relight, relight_rows,
};
#[doc(hidden)]
pub use solve::linear;
pub use solve::{Bracket, Demux, Prior, SimdLevel, objectives_bytes, reference};
