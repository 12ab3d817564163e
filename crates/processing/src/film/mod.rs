//! Films: one light transport per cycle of a few settings.

mod frames;
mod process;
mod product;
mod report;
mod task;

pub use self::process::process;
pub use self::product::{FilmProducts, write_products};
pub use self::report::{note_findings, shortcomings, write as write_report};
pub use self::task::{FilmTask, create_transports, write_transport};
