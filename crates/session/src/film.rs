//! `film.zarr` and `transport_film.zarr`: the frames of a film and the transports computed from them, Zarr v3
//! groups.
//!
//! | array | type | axes | what |
//! | --- | --- | --- | --- |
//! | `film.zarr/film` | uint16 | `[cycle, setting, t, s]` | raw frames in camera counts (DN), settings in the plan's order |
//! | `transport_film.zarr/transport` | float32 | `[cycle, u, t, s]` | light transport of each cycle, as in [`crate::transport`] |
//! | `transport_film.zarr/mask` | uint8 | `[cycle, u, t, s]` | what is known of each value, as in [`crate::transport`] |
//!
//! One shard is one cycle, so that a cycle costs one fsync of a file and one of a folder for each array. A cycle without
//! a line in the ledger is not stored, whatever `film` contains; in `transport`, a cycle that was not estimated is NaN,
//! whatever its mask.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ndarray::{Array3, Array4, ArrayView3, s};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use zarrs::array::{
    Array, ArrayBuilder, CodecOptions, DataType, Element, ElementOwned, FillValue, data_type,
};

use crate::stack::StackShape;
use crate::zarr::{self, CHUNK_PX, DurableStore};
use crate::{Error, Result};

/// A time series of volumes: one array of four axes, one shard per cycle.
pub struct CycleArray<T> {
    path: PathBuf,
    array: Array<DurableStore>,
    /// Shape of a cycle, `[depth, t, s]`.
    shape: [usize; 3],
    element: std::marker::PhantomData<T>,
}

/// `film.zarr/film` `[cycle, setting, t, s]`.
pub type Film = CycleArray<u16>;

/// `transport_film.zarr`: the transport of each cycle, and its mask.
pub struct TransportFilm {
    transport: CycleArray<f32>,
    /// `None` in sessions of versions that wrote none.
    mask: Option<CycleArray<u8>>,
}

/// The transport of a cycle, `[u, t, s]`, and what is known of each of its values.
#[derive(Debug, Clone, PartialEq)]
pub struct CycleTransport {
    /// Light.
    pub t: Array3<f32>,
    /// Bits; 0 if nothing is stored.
    pub mask: Array3<u8>,
}

/// Layout of a cycle array in its group.
struct Layout {
    name: &'static str,
    axes: [&'static str; 4],
    /// Number of settings or relative rows in an inner chunk.
    chunk_depth: usize,
    data_type: DataType,
    fill: FillValue,
}

impl Film {
    /// Creates an empty film at `dir`.
    ///
    /// # Errors
    /// [`Error::Zarr`] if the file system refuses.
    pub fn create(dir: &Path, shape: &StackShape) -> Result<Self> {
        let (cycles, settings) = shape.cycles()?;
        let cycle = [settings, shape.rows, shape.columns];
        let attributes = Map::from_iter([("units".to_owned(), Value::from("DN"))]);
        Self::create_array(dir, cycles, cycle, film_layout(), attributes)
    }

    /// Opens the film at `dir`.
    ///
    /// # Errors
    /// [`Error::Zarr`] if it cannot be read, [`Error::Shape`] if it has another shape.
    pub fn open(dir: &Path, shape: &StackShape) -> Result<Self> {
        let (cycles, settings) = shape.cycles()?;
        let opened = Self::open_array(dir, &film_layout())?;
        let expected = [cycles, settings, shape.rows, shape.columns];
        let found = zarr::shape_of(&opened.array);
        if found != expected {
            let what = opened.path.display().to_string();
            return Err(Error::Shape { what, found, allowed: format!("{expected:?}") });
        }
        Ok(opened)
    }
}

impl TransportFilm {
    /// Creates an empty series of `cycles` transports `[u, t, s]` at `dir`, replacing any existing one. `attributes`
    /// become those of the array: `u_min`, `row_time_us`, the prior and how it was computed; `bits` names the bits of
    /// the masks.
    ///
    /// # Errors
    /// [`Error::Zarr`] or [`Error::Io`] if the file system refuses.
    pub fn create(
        dir: &Path,
        cycles: usize,
        cycle: [usize; 3],
        attributes: &Map<String, Value>,
        bits: &Value,
    ) -> Result<Self> {
        if dir.exists() {
            std::fs::remove_dir_all(dir).map_err(Error::io("remove", dir))?;
        }
        let [depth, ..] = cycle;
        let of_mask = Map::from_iter([("bits".to_owned(), bits.clone())]);
        Ok(Self {
            transport: CycleArray::create_array(
                dir,
                cycles,
                cycle,
                transport_layout(depth),
                attributes.clone(),
            )?,
            mask: Some(CycleArray::create_array(dir, cycles, cycle, mask_layout(depth), of_mask)?),
        })
    }

    /// Opens the series at `dir`.
    ///
    /// # Errors
    /// [`Error::Zarr`] if it is missing or damaged; [`Error::Shape`] if the masks are not as large as the transports.
    pub fn open(dir: &Path) -> Result<Self> {
        let transport = CycleArray::open_array(dir, &transport_layout(1))?;
        let layout = mask_layout(1);
        let has_mask = dir.join(layout.name).exists();
        let mask = has_mask.then(|| CycleArray::open_array(dir, &layout)).transpose()?;
        let opened = Self { transport, mask };
        match &opened.mask {
            Some(mask) if zarr::shape_of(&mask.array) != zarr::shape_of(&opened.transport.array) => {
                Err(Error::Shape {
                    what: mask.path.display().to_string(),
                    found: zarr::shape_of(&mask.array),
                    allowed: format!("{:?}, as the transport has", zarr::shape_of(&opened.transport.array)),
                })
            }
            _ => Ok(opened),
        }
    }

    /// The attributes that it was created with.
    pub fn attributes(&self) -> &Map<String, Value> {
        self.transport.array.attributes()
    }

    /// Number of cycles that it can hold.
    pub fn cycles(&self) -> usize {
        self.transport.cycles()
    }

    /// Writes a cycle, replacing any existing one; when this returns, it is durable.
    ///
    /// # Errors
    /// As [`CycleArray::write`].
    pub fn write(&self, cycle: usize, transport: ArrayView3<f32>, mask: ArrayView3<u8>) -> Result<()> {
        // The cycle is there when its transport is.
        self.mask.as_ref().map_or(Ok(()), |masks| masks.write(cycle, mask))?;
        self.transport.write(cycle, transport)
    }

    /// Reads a cycle; `None` if it was never written.
    ///
    /// # Errors
    /// As [`CycleArray::read`].
    pub fn read(&self, cycle: usize) -> Result<Option<CycleTransport>> {
        let Some(t) = self.transport.read(cycle)? else { return Ok(None) };
        let mask = self.mask.as_ref().map_or(Ok(None), |masks| masks.read(cycle))?;
        Ok(Some(CycleTransport { mask: mask.unwrap_or_else(|| Array3::zeros(t.dim())), t }))
    }

    /// Whether a cycle was written, without decoding it.
    ///
    /// # Errors
    /// As [`CycleArray::contains`].
    pub fn contains(&self, cycle: usize) -> Result<bool> {
        self.transport.contains(cycle)
    }
}

fn film_layout() -> Layout {
    let axes = ["cycle", "setting", "t", "s"];
    Layout { name: "film", axes, chunk_depth: 1, data_type: data_type::uint16(), fill: 0u16.into() }
}

fn transport_layout(depth: usize) -> Layout {
    let axes = ["cycle", "u", "t", "s"];
    let fill = f32::NAN.into();
    Layout { name: "transport", axes, chunk_depth: depth, data_type: data_type::float32(), fill }
}

fn mask_layout(depth: usize) -> Layout {
    let axes = ["cycle", "u", "t", "s"];
    Layout { name: "mask", axes, chunk_depth: depth, data_type: data_type::uint8(), fill: 0u8.into() }
}

impl<T: Element + ElementOwned + Clone + Default> CycleArray<T> {
    fn create_array(
        dir: &Path,
        cycles: usize,
        cycle: [usize; 3],
        layout: Layout,
        attributes: Map<String, Value>,
    ) -> Result<Self> {
        let store = DurableStore::new(dir)?;
        zarr::create_group(&store, Map::new())?;
        let [depth, rows, columns] = cycle;
        let chunk = [1, layout.chunk_depth, rows.min(CHUNK_PX), columns.min(CHUNK_PX)];
        // A shard must consist of whole inner chunks, so it may extend beyond the frame; the excess is 0.
        let shard = [1, depth, rows.next_multiple_of(chunk[2]), columns.next_multiple_of(chunk[3])];
        let to_u64 = |axes: [usize; 4]| axes.map(|len| len as u64).to_vec();
        let mut builder = ArrayBuilder::new(
            to_u64([cycles, depth, rows, columns]),
            to_u64(shard),
            layout.data_type,
            layout.fill,
        );
        zarr::with_codecs(&mut builder)
            .subchunk_shape(to_u64(chunk))
            .dimension_names(Some(layout.axes))
            .attributes(attributes);
        let array = zarr::create_array(&store, layout.name, &builder)?;
        Ok(Self { path: dir.join(layout.name), array, shape: cycle, element: std::marker::PhantomData })
    }

    fn open_array(dir: &Path, layout: &Layout) -> Result<Self> {
        let store: Arc<DurableStore> = DurableStore::new(dir)?;
        let array = zarr::open_array(&store, layout.name, 4)?;
        let path = dir.join(layout.name);
        match zarr::shape_of(&array)[..] {
            [_, depth, rows, columns] => {
                Ok(Self { path, array, shape: [depth, rows, columns], element: std::marker::PhantomData })
            }
            _ => Err(Error::Shape {
                what: path.display().to_string(),
                found: zarr::shape_of(&array),
                allowed: "four axes".into(),
            }),
        }
    }

    /// Number of cycles that it can hold.
    pub fn cycles(&self) -> usize {
        zarr::shape_of(&self.array)[0]
    }

    /// Writes a cycle, replacing any existing one; when this returns, it is durable.
    ///
    /// # Errors
    /// [`Error::Index`], [`Error::Shape`], or [`Error::Zarr`] if the file system refuses.
    pub fn write(&self, cycle: usize, data: ArrayView3<T>) -> Result<()> {
        self.check(cycle)?;
        if data.shape() != self.shape {
            return Err(Error::Shape {
                what: format!("a cycle of {}", self.path.display()),
                found: data.shape().to_vec(),
                allowed: format!("{:?}", self.shape),
            });
        }
        let place = [cycle as u64, 0, 0, 0];
        let shard = self.array.chunk_shape_usize(&place).map_err(Error::zarr("write", &self.path))?;
        let [depth, rows, columns] = self.shape;
        let mut padded = Array4::from_elem((1, shard[1], shard[2], shard[3]), T::default());
        padded.slice_mut(s![0, ..depth, ..rows, ..columns]).assign(&data);
        self.array.store_chunk_opt(&place, padded, &options()).map_err(Error::zarr("write", &self.path))
    }

    /// Reads a cycle; `None` if it was never written.
    ///
    /// # Errors
    /// [`Error::Index`], or [`Error::Zarr`] for damaged data.
    pub fn read(&self, cycle: usize) -> Result<Option<Array3<T>>> {
        self.check(cycle)?;
        let shard = self
            .array
            .retrieve_chunk_if_exists_opt::<Array4<T>>(&[cycle as u64, 0, 0, 0], &options())
            .map_err(Error::zarr("read", &self.path))?;
        let [depth, rows, columns] = self.shape;
        Ok(shard.map(|shard| {
            let cycle = shard.slice_move(s![0, ..depth, ..rows, ..columns]);
            cycle.as_standard_layout().into_owned()
        }))
    }

    /// Whether a cycle was written, without decoding it.
    ///
    /// # Errors
    /// [`Error::Index`], or [`Error::Zarr`] if the file system refuses.
    pub fn contains(&self, cycle: usize) -> Result<bool> {
        self.check(cycle)?;
        let stored = self.array.retrieve_encoded_chunk(&[cycle as u64, 0, 0, 0]);
        Ok(stored.map_err(Error::zarr("read", &self.path))?.is_some())
    }

    fn check(&self, cycle: usize) -> Result<()> {
        let len = self.cycles();
        if cycle < len { Ok(()) } else { Err(Error::Index { array: "cycle", index: cycle, len }) }
    }
}

/// One thread only: the next frames arrive while a film is written, and need the other threads.
fn options() -> CodecOptions {
    zarr::codec_options().with_concurrent_target(1)
}

/// CRC-32 (as in zip and PNG) of a cycle's frames as little-endian uint16 in C order.
pub fn crc32(data: ArrayView3<u16>) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    let mut row_bytes = Vec::with_capacity(data.len_of(ndarray::Axis(2)) * 2);
    for row in data.rows() {
        row_bytes.clear();
        row_bytes.extend(row.iter().flat_map(|value| value.to_le_bytes()));
        hasher.update(&row_bytes);
    }
    hasher.finalize()
}

/// A stored cycle of a film, as recorded in the ledger.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CycleEntry {
    /// Its index in `film.zarr`.
    pub cycle: usize,
    /// Start of the first exposure of its frames, in seconds after the film's first.
    pub start_s: f64,
    /// The exposure time that the camera applied, in us.
    pub exposure_us: f64,
    /// The true delay of each setting's frame in us, from its exposure start and its VSYNC edge.
    pub delays_us: Vec<f64>,
    /// Start of the exposure of camera row 0 in each setting's frame, in ns on the clock of frames and edges; empty in
    /// sessions from before it was stored.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub starts_ns: Vec<i64>,
    /// What became of its triggers.
    pub counts: raysweep_core::Counts,
    /// CRC-32 of the stored frames, see [`crc32`].
    pub crc32: u32,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stack::Contents;

    fn shape(rows: usize, columns: usize) -> StackShape {
        StackShape { contents: Contents::Film { cycles: 4, settings: 3, exposures: 1 }, rows, columns }
    }

    fn frames(rows: usize, columns: usize, seed: usize) -> Array3<u16> {
        Array3::from_shape_fn((3, rows, columns), |(k, t, s)| (seed * 7919 + k * 997 + t * 31 + s) as u16)
    }

    #[test]
    fn cycles_read_back_at_sizes_that_are_no_multiple_of_a_chunk() {
        let dir = tempfile::tempdir().unwrap();
        for (rows, columns) in [(1, 1), (3, 5), (64, 64), (65, 130)] {
            let path = dir.path().join(format!("{rows}.zarr"));
            let film = Film::create(&path, &shape(rows, columns)).unwrap();
            film.write(2, frames(rows, columns, 1).view()).unwrap();
            let film = Film::open(&path, &shape(rows, columns)).unwrap();
            assert_eq!(film.read(2).unwrap(), Some(frames(rows, columns, 1)));
            assert_eq!(film.read(1).unwrap(), None);
        }
    }

    #[test]
    fn the_same_cycle_gives_the_same_bytes_in_an_opened_film() {
        let dir = tempfile::tempdir().unwrap();
        let bytes = |film: Film| {
            film.write(0, frames(70, 66, 5).view()).unwrap();
            std::fs::read(dir.path().join("film/c.0.0.0.0")).unwrap()
        };
        let first = bytes(Film::create(dir.path(), &shape(70, 66)).unwrap());
        assert!(bytes(Film::open(dir.path(), &shape(70, 66)).unwrap()) == first);
    }

    #[test]
    fn transports_that_were_not_estimated_are_not_there_and_making_anew_forgets_the_old() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("transport_film.zarr");
        let attributes = Map::from_iter([("u_min".to_owned(), Value::from(-3))]);
        let transport = Array3::from_shape_fn((7, 9, 70), |(u, t, s)| (u * 900 + t * 70 + s) as f32 / 7.0);
        let mask = transport.mapv(|light| light as u8);
        let bits = Value::from("bits");
        let film = TransportFilm::create(&path, 2, [7, 9, 70], &attributes, &bits).unwrap();
        film.write(1, transport.view(), mask.view()).unwrap();
        let opened = TransportFilm::open(&path).unwrap();
        assert_eq!((opened.cycles(), opened.attributes()), (2, &attributes));
        assert_eq!(opened.mask.as_ref().unwrap().array.attributes()["bits"], bits);
        assert_eq!(opened.read(1).unwrap(), Some(CycleTransport { t: transport, mask }));
        assert_eq!(opened.read(0).unwrap(), None);
        TransportFilm::create(&path, 2, [7, 9, 70], &attributes, &bits).unwrap();
        assert_eq!(opened.read(1).unwrap(), None);

        let other = dir.path().join("other.zarr");
        TransportFilm::create(&other, 2, [7, 9, 71], &attributes, &bits).unwrap();
        std::fs::remove_dir_all(path.join("mask")).unwrap();
        assert!(TransportFilm::open(&path).unwrap().read(1).unwrap().is_none(), "as in earlier versions");
        std::fs::rename(other.join("mask"), path.join("mask")).unwrap();
        assert!(matches!(TransportFilm::open(&path), Err(Error::Shape { .. })));
    }

    #[test]
    fn what_does_not_fit_is_refused_and_damage_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let film = Film::create(dir.path(), &shape(8, 8)).unwrap();
        assert!(matches!(film.write(4, frames(8, 8, 0).view()), Err(Error::Index { len: 4, .. })));
        assert!(matches!(film.write(0, frames(8, 9, 0).view()), Err(Error::Shape { .. })));
        assert!(matches!(Film::open(dir.path(), &shape(8, 9)), Err(Error::Shape { .. })));
        film.write(0, frames(8, 8, 0).view()).unwrap();
        let path = dir.path().join("film/c.0.0.0.0");
        let mut bytes = std::fs::read(&path).unwrap();
        bytes.truncate(bytes.len() / 2);
        std::fs::write(&path, bytes).unwrap();
        assert!(matches!(film.read(0), Err(Error::Zarr { .. })));
    }
}
