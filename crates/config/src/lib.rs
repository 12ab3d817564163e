//! Rig and plan files: plain types, read from TOML. Unknown keys are refused, and every mistake is reported with its
//! position in the text.
//!
//! Drivers, simulator and processing take what they need from these types; nothing here opens a device or computes.

mod document;
mod error;
pub mod plan;
pub mod rig;
pub mod sim;
mod whole;

pub use document::{Fault, Places};
pub use error::{ConfigError, ConfigMistake};
pub use plan::{
    Axis, BatchesPlan, FilmPlan, GridPlan, PathPlan, Plan, PlanePlan, Procedure, ProductTable, ResponsePlan,
    Shape, StageTable, SweepPlan,
};
pub use rig::{AnyRigFile, DotRigFile, RigFile};
