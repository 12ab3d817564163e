//! When each projector row is lit, from images of the white board.
//!
//! Each image is one frame, as a share of one pass of white. In frames with a global shutter, the edges of the exposure
//! appear as borders between dark and light: [`CoarseSweep`] reads the sweep from their places to within 10 us, without any
//! model. Rolling frames of about three row times then find when the light of each camera row arrives. [`RowTimes`]
//! fits a model of all frames: a smooth table of row starts, the camera's row time, the offset between the shutter
//! modes, what exposures have more than their nominal length, and how late the light of each frame is.
//!
//! The order of calls is: [`Columns::new`] from the map of places and the responses; frames of [`sweep_settings`], each
//! reduced by [`Columns::average`]; [`CoarseSweep::from_borders`]; a pass of frames of [`arrival_settings`] as foreseen;
//! [`RollingSweep::from_arrivals`]; more frames of [`arrival_settings`], and of [`check_settings`];
//! [`RowTimes::fit`], which takes all of these frames. Where it refuses them as a misfit, rows may not be lit evenly:
//! [`RowTimes::find_spot`] tries how a flying spot would draw them.
//!
//! While a scene is measured, [`JitterGauge`] finds how late the light of each image is from a strip of the board that
//! stays in view.

mod coarse;
mod columns;
mod error;
mod fit;
mod model;
mod result;
mod settings;
mod spot;
mod strip;
mod table;

pub use coarse::{CoarseSweep, RollingSweep};
pub use columns::Columns;
pub use error::TimesError;
pub use result::{Dropped, FrameJitter, Residual, RowTimes};
pub use settings::{
    BoardFrame, BoardSetting, ExposureMode, Nominal, arrival_settings, check_settings, sweep_settings,
};
pub use strip::{JitterGauge, Lateness};
