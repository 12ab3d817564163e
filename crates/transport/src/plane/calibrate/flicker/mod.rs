//! A lamp that flickers while a sweep or a film is taken: found in the dark images of a sweep or in the first cycles of a
//! film, followed by the times of the frames, and removed.

mod cycles;
mod dark;
mod exposures;
mod lamp;
mod search;
mod unexplained;

pub use cycles::CycleFlicker;
pub use dark::{DarkFlicker, DarkRows};
pub use exposures::{FrameExposures, TimedImage, averaged_share, can_be_followed, cancelling_frames};
pub use lamp::LampFlicker;
pub use unexplained::Unexplained;
