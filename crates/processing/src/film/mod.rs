//! Films: one light transport per cycle of a few settings.

mod process;
mod report;
mod task;

pub use self::process::process;
pub use self::report::{shortcomings, write as write_report};
pub use self::task::{FilmTask, create_transports};
