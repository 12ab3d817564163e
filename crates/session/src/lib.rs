//! A session on disk: one folder that can be read without raysweep.
//!
//! | path | what |
//! | --- | --- |
//! | `plan.toml`, `rig.toml` | as used, verbatim |
//! | `ledger.jsonl` | what was acquired: one JSON object per line, append-only ([`ledger`]) |
//! | `stack.zarr` | the summed frames, Zarr v3 ([`stack`]) |
//! | `transport.zarr` | the light transport, Zarr v3 ([`transport`]) |
//! | `film.zarr`, `transport_film.zarr` | of a film: the frames and the light transport of each cycle, Zarr v3 ([`film`]) |
//! | `dots.zarr` | of a flying dot: the sparse columns of each batch, Zarr v3 ([`dots`]) |
//! | `products/` | images as EXR and NPY, volumes as NPY, each with a JSON sidecar ([`products`]) |
//! | `report.html` | one self-contained page ([`report`]) |
//! | `manifest.json` | versions, settings, counts and checksums ([`manifest`]) |
//!
//! The ledger is the source of truth: data without a line in the ledger do not count. So the order of a write
//! is data, fsync, rename, fsync of the folder ([`durable`]), then the ledger's line, fsync.

mod damage;
pub mod dots;
pub mod durable;
mod error;
mod exr_file;
pub mod film;
mod folder;
pub mod input;
pub mod integrity;
pub mod ledger;
mod listing;
pub mod manifest;
pub mod pattern;
pub mod products;
pub mod report;
pub mod stack;
pub mod transport;
mod trash;
mod zarr;

pub use error::{Error, Result};
pub use folder::Session;
pub use listing::{Listing, SessionSummary, list};
pub use trash::TRASH;

/// Camera rows per strip: the unit in which [`stack`] and [`transport`] are stored, and so the cheapest unit
/// for reading and writing data that do not fit in memory.
pub const STRIP_ROWS: usize = zarr::CHUNK_PX;
