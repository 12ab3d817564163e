//! The forward model: which light of which projector row a camera row collects with a setting.

mod beam;
mod forward;
mod response;
mod setting;
mod spot;
mod timing;
mod transport;

pub use beam::Beam;
pub(super) use beam::WIDEST_RESPONSE_SIGMA_ROWS;
pub(super) use forward::drawn;
pub use forward::{MIN_WEIGHT, RowModel, Slot, SlotKind, predict, reach, relative_rows};
pub use response::{FIRST_RESPONSE_ROW, PixelResponse, RESPONSE_ROWS, Shares};
pub(super) use response::{PLACE_STEPS, ResponseClass, collected, collected_rows};
pub use setting::{Setting, delay_us, offset_us};
pub use spot::{FlyingSpot, Scan, settings_on_direct_row, spike_weights};
pub use timing::{CameraRows, RowTiming};
pub use transport::Transport;
