//! A session on disk: one folder that can be read without raysweep.
//!
//! | path | what |
//! | --- | --- |
//! | `plan.toml`, `rig.toml` | as used, verbatim |
//! | `ledger.jsonl` | what was acquired: one JSON object a line, append-only ([`ledger`]) |
//! | `stack.zarr` | the summed frames, Zarr v3 ([`stack`]) |
//! | `transport.zarr` | the light transport, Zarr v3 ([`transport`]) |
//! | `film.zarr`, `transport_film.zarr` | of a film: the frames and the light transport of each cycle, Zarr v3 ([`film`]) |
//! | `dots.zarr` | of a flying dot: the sparse columns of each batch, Zarr v3 ([`dots`]) |
//! | `products/` | images as EXR and NPY, volumes as NPY, each with a JSON sidecar ([`products`]) |
//! | `report.html` | one self-contained page ([`report`]) |
//! | `manifest.json` | versions, settings, counts and checksums ([`manifest`]) |
//!
//! The ledger is what knows, and nothing else does: data without its line does not exist. So the order of a write is
//! data, fsync, rename, fsync of the folder ([`durable`]), and only then the ledger's line, fsync.

pub mod dots;
pub mod durable;
mod error;
mod exr_file;
pub mod film;
mod folder;
pub mod ledger;
pub mod manifest;
pub mod pattern;
pub mod products;
pub mod report;
pub mod stack;
pub mod transport;
mod zarr;

pub use error::{Error, Result};
pub use folder::{Listing, Session, SessionSummary, list};

/// Camera rows of a strip: the unit in which [`stack`] and [`transport`] are stored, and so the cheapest in which what is
/// larger than the memory is read and written.
pub const STRIP_ROWS: usize = zarr::CHUNK_PX;
