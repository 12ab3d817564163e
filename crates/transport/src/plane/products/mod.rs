//! What is made of a transport: profiles over the delay, images under other light, and how far to trust them.

mod profile;
mod relight;
mod sensitivity;
mod uncertainty;

pub use profile::DelayProfile;
pub use relight::{RelitBeam, RelitUnknowns, relight, relight_rows};
pub use uncertainty::{DarkImage, LightSums, Samples, Uncertainty};
