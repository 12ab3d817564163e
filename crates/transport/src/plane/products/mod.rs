//! What is made of a transport: profiles over the delay, images under other light, and the noise of both.

mod profile;
mod relight;
mod uncertainty;

pub use profile::DelayProfile;
pub use relight::{RelitBeam, relight, relight_rows};
pub use uncertainty::{Samples, Uncertainty};
