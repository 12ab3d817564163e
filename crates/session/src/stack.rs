//! `stack.zarr`: the summed frames, a Zarr v3 group.
//!
//! | array | type | axes | what |
//! | --- | --- | --- | --- |
//! | `sum` | uint32 | `[point, t, s]` | the sweep; point = exposure_index * delays + delay_index |
//! | `dark` | uint32 | `[exposure, t, s]` | projector off, one per exposure |
//! | `regular` | uint32 | `[1, t, s]` | all rows lit by a long exposure |
//! | `clipped` | uint32 | `[point, t, s]` | in how many of the frames of a point of `sum` the pixel saturated |
//!
//! Where pictures vary, a point of `sum` is an image under one of them, point = pattern * settings + setting.
//!
//! A point of `clipped` is written only if some pixel saturated; then its ledger line has `clipped_crc32`. Sessions from
//! before these frames were counted do not have the array.
//!
//! The stack of a film has only `dark`: its frames are in `film.zarr`, see [`crate::film`].
//!
//! t is the camera row (the top one is 0), s the camera column. Values are camera counts (DN), summed over
//! the frames listed in the ledger. One shard is one point, with inner chunks of 64 x 64 pixels. A point
//! without a line in the ledger is not stored, whatever the array contains.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ndarray::{Array2, Array3, ArrayView2, Axis, Ix2, s};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use zarrs::array::{Array, ArrayBuilder, data_type};
use zarrs::storage::ReadableStorageTraits;

use crate::zarr::{self, CHUNK_PX, DurableStore};
use crate::{Error, Result};

/// An array of the stack.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ArrayName {
    /// The sweep.
    Sum,
    /// Projector off, one per exposure.
    Dark,
    /// All rows lit by a long exposure.
    Regular,
    /// In how many frames of the sweep's points a pixel saturated.
    Clipped,
}

impl ArrayName {
    /// All arrays.
    pub const ALL: [ArrayName; 4] = [ArrayName::Sum, ArrayName::Dark, ArrayName::Regular, ArrayName::Clipped];

    /// The name in the Zarr group and in the ledger.
    pub fn as_str(self) -> &'static str {
        match self {
            ArrayName::Sum => "sum",
            ArrayName::Dark => "dark",
            ArrayName::Regular => "regular",
            ArrayName::Clipped => "clipped",
        }
    }

    fn first_axis(self) -> &'static str {
        match self {
            ArrayName::Sum | ArrayName::Clipped => "point",
            ArrayName::Dark => "exposure",
            ArrayName::Regular => "frame",
        }
    }
}

/// What a session stores, and how much of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "StoredShape", try_from = "StoredShape")]
pub struct StackShape {
    /// What a point of the plan is, and how many there are.
    pub contents: Contents,
    /// Camera rows, axis t.
    pub rows: usize,
    /// Camera columns, axis s.
    pub columns: usize,
}

/// What the points of a plan are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Contents {
    /// Images under delays and exposures, in `stack.zarr` with their dark images and the regular image.
    Sweep {
        /// Number of images.
        points: usize,
        /// Number of exposures, each with a dark image.
        exposures: usize,
    },
    /// Cycles of settings, with frames in `film.zarr` and dark images in `stack.zarr`.
    Film {
        /// Number of cycles.
        cycles: usize,
        /// Settings per cycle.
        settings: usize,
        /// Number of exposures, each with a dark image.
        exposures: usize,
    },
    /// Batches of a flying dot, with columns in `dots.zarr`; there is no stack.
    Batches {
        /// Number of batches.
        batches: usize,
        /// Frames per batch.
        dots: usize,
    },
    /// Axes of a mirror, with records in `products`; there is no stack.
    Axes {
        /// Number of axes.
        axes: usize,
    },
    /// Dark images alone, in `stack.zarr`.
    Darks {
        /// Number of images.
        images: usize,
    },
    /// Images of a white board, in `stack.zarr` with those of the capped lens.
    Board {
        /// Number of images of the board.
        images: usize,
        /// Number of images of the capped lens.
        capped: usize,
    },
    /// Images under pictures of the projector, in `stack.zarr` with their dark images and the regular image under white.
    Patterns {
        /// Number of pictures.
        patterns: usize,
        /// Number of images under each picture.
        settings: usize,
        /// Number of exposures, each with a dark image.
        exposures: usize,
    },
    /// Nothing: the session only says that there was light, and when.
    Nothing,
}

impl Contents {
    /// Why no later run can add to them; `None` if one can.
    pub fn past(self) -> Option<&'static str> {
        match self {
            Self::Film { .. } => Some(
                "a film cannot be resumed, because it records one moment: `raysweep process` makes the transports of its stored cycles; run the plan again for another film",
            ),
            Self::Batches { .. } => Some(
                "batches cannot be resumed, because they record one moment: `raysweep process` makes the products of the stored ones; run the plan again for more",
            ),
            Self::Axes { .. } => Some("a run of kind \"response\" cannot be resumed: run the plan again"),
            Self::Nothing => {
                Some("a viewfinder stores nothing, so there is nothing to resume: start another one")
            }
            Self::Sweep { .. } | Self::Patterns { .. } | Self::Darks { .. } | Self::Board { .. } => None,
        }
    }
}

/// A shape as ledgers have it. Those written before there was `contents` tell it by what is 0.
#[derive(Serialize, Deserialize)]
struct StoredShape {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    contents: Option<Kind>,
    points: usize,
    exposures: usize,
    rows: usize,
    columns: usize,
    #[serde(default, skip_serializing_if = "is_zero")]
    settings: usize,
    #[serde(default, skip_serializing_if = "is_zero")]
    dots: usize,
}

#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Sweep,
    Film,
    Batches,
    Axes,
    Darks,
    Board,
    Patterns,
    Nothing,
}

/// Most camera rows or columns.
const MAX_SIDE_PX: usize = 1 << 16;
/// Most points, and settings, dots or exposures of one.
const MAX_POINTS: usize = 1 << 24;

fn is_zero(count: &usize) -> bool {
    *count == 0
}

impl From<StackShape> for StoredShape {
    fn from(StackShape { contents, rows, columns }: StackShape) -> Self {
        let (kind, points, exposures, settings, dots) = match contents {
            Contents::Sweep { points, exposures } => (Kind::Sweep, points, exposures, 0, 0),
            Contents::Film { cycles, settings, exposures } => (Kind::Film, cycles, exposures, settings, 0),
            Contents::Batches { batches, dots } => (Kind::Batches, batches, 0, 0, dots),
            Contents::Axes { axes } => (Kind::Axes, axes, 0, 0, 0),
            Contents::Darks { images } => (Kind::Darks, images, images, 0, 0),
            Contents::Board { images, capped } => (Kind::Board, images, capped, 0, 0),
            Contents::Patterns { patterns, settings, exposures } => {
                (Kind::Patterns, patterns, exposures, settings, 0)
            }
            Contents::Nothing => (Kind::Nothing, 0, 0, 0, 0),
        };
        Self { contents: Some(kind), points, exposures, rows, columns, settings, dots }
    }
}

impl TryFrom<StoredShape> for StackShape {
    type Error = String;

    fn try_from(stored: StoredShape) -> std::result::Result<Self, String> {
        let StoredShape { contents, points, exposures, rows, columns, settings, dots } = stored;
        let kind = contents.unwrap_or(match (exposures, settings, dots) {
            (_, 1.., _) => Kind::Film,
            (_, _, 1..) => Kind::Batches,
            (0, ..) => Kind::Axes,
            _ => Kind::Sweep,
        });
        let contents = match kind {
            Kind::Sweep => Contents::Sweep { points, exposures },
            Kind::Film => Contents::Film { cycles: points, settings, exposures },
            Kind::Batches => Contents::Batches { batches: points, dots },
            Kind::Axes => Contents::Axes { axes: points },
            Kind::Darks => Contents::Darks { images: points },
            Kind::Board => Contents::Board { images: points, capped: exposures },
            Kind::Patterns => Contents::Patterns { patterns: points, settings, exposures },
            Kind::Nothing => Contents::Nothing,
        };
        let shape = Self { contents, rows, columns };
        shape.check().map(|()| shape).map_err(|error| error.to_string())
    }
}

impl StackShape {
    /// Planned points: images of a sweep or under pictures, cycles of a film, batches of a flying dot, axes of a mirror, or dark images.
    pub fn points(&self) -> usize {
        match self.contents {
            Contents::Sweep { points, .. } => points,
            Contents::Film { cycles, .. } => cycles,
            Contents::Batches { batches, .. } => batches,
            Contents::Axes { axes } => axes,
            Contents::Darks { images } | Contents::Board { images, .. } => images,
            Contents::Patterns { patterns, settings, .. } => patterns.saturating_mul(settings),
            Contents::Nothing => 0,
        }
    }

    /// Number of points of an array.
    pub fn len(&self, array: ArrayName) -> usize {
        match (array, self.contents) {
            (ArrayName::Sum, Contents::Sweep { points, .. } | Contents::Board { images: points, .. }) => {
                points
            }
            (ArrayName::Clipped, Contents::Sweep { points, .. }) => points,
            (ArrayName::Sum | ArrayName::Clipped, Contents::Patterns { .. }) => self.points(),
            (ArrayName::Regular, Contents::Sweep { .. } | Contents::Patterns { .. }) => 1,
            (
                ArrayName::Dark,
                Contents::Sweep { exposures, .. }
                | Contents::Film { exposures, .. }
                | Contents::Patterns { exposures, .. },
            ) => exposures,
            (ArrayName::Dark, Contents::Darks { images } | Contents::Board { capped: images, .. }) => images,
            _ => 0,
        }
    }

    /// The arrays that exist for this kind of session; none: there is no stack.
    pub(crate) fn arrays(&self) -> &'static [ArrayName] {
        match self.contents {
            Contents::Sweep { .. } | Contents::Patterns { .. } => &ArrayName::ALL,
            Contents::Film { .. } | Contents::Darks { .. } => &[ArrayName::Dark],
            Contents::Board { .. } => &[ArrayName::Dark, ArrayName::Sum],
            Contents::Batches { .. } | Contents::Axes { .. } | Contents::Nothing => &[],
        }
    }

    /// Cycles of a film, and settings per cycle.
    pub(crate) fn cycles(&self) -> Result<(usize, usize)> {
        match self.contents {
            Contents::Film { cycles, settings, .. } => Ok((cycles, settings)),
            _ => Err(Error::Shape {
                what: "the film of a session without cycles".into(),
                found: vec![self.points()],
                allowed: "a film".into(),
            }),
        }
    }

    /// Frames per batch of a flying dot; 0 for other kinds.
    pub(crate) fn dots(&self) -> usize {
        match self.contents {
            Contents::Batches { dots, .. } => dots,
            _ => 0,
        }
    }

    pub(crate) fn check(&self) -> Result<()> {
        let (axes, counts): (_, Vec<usize>) = match self.contents {
            Contents::Sweep { points, exposures } => ("points, exposures", vec![points, exposures]),
            Contents::Film { cycles, settings, exposures } => {
                ("cycles, settings, exposures", vec![cycles, settings, exposures])
            }
            Contents::Batches { batches, dots } => ("batches, dots", vec![batches, dots]),
            Contents::Axes { axes } => ("axes", vec![axes]),
            Contents::Darks { images } => ("images", vec![images]),
            Contents::Board { images, capped } => ("images, capped", vec![images, capped]),
            Contents::Patterns { patterns, settings, exposures } => (
                "patterns, settings, exposures, images",
                vec![patterns, settings, exposures, patterns.saturating_mul(settings)],
            ),
            Contents::Nothing => ("nothing", Vec::new()),
        };
        let found: Vec<usize> = counts.into_iter().chain([self.rows, self.columns]).collect();
        let is_side = |pixels| pixels <= MAX_SIDE_PX;
        if found.iter().any(|len| !(1..=MAX_POINTS).contains(len))
            || !is_side(self.rows)
            || !is_side(self.columns)
        {
            return Err(Error::Shape {
                what: format!("the stack [{axes}, rows, columns]"),
                found,
                allowed: format!("1 to {MAX_POINTS} along each axis, 1 to {MAX_SIDE_PX} rows and columns"),
            });
        }
        Ok(())
    }

    fn chunk(&self) -> [usize; 3] {
        [1, self.rows.min(CHUNK_PX), self.columns.min(CHUNK_PX)]
    }

    /// A shard must consist of whole inner chunks, so it may extend beyond the frame; the excess is 0.
    fn shard(&self) -> [usize; 3] {
        let [_, rows, columns] = self.chunk();
        [1, self.rows.next_multiple_of(rows), self.columns.next_multiple_of(columns)]
    }
}

/// The stack of a session.
pub struct Stack {
    dir: PathBuf,
    shape: StackShape,
    arrays: BTreeMap<ArrayName, Array<DurableStore>>,
}

impl Stack {
    /// Creates an empty stack at `dir`; `kind` is the plan's kind.
    ///
    /// # Errors
    /// [`Error::Shape`] for an axis of length 0, [`Error::Zarr`] if the file system refuses.
    pub fn create(dir: &Path, shape: &StackShape, kind: &str) -> Result<Stack> {
        shape.check()?;
        let store = DurableStore::new(dir)?;
        let attributes = json!({
            "kind": kind,
            "axes": { "point": "exposure_index * delays + delay_index", "t": "camera row, top first", "s": "camera column" },
            "units": "camera counts (DN), summed over frames; ledger.jsonl says how many frames and at which delays",
        });
        zarr::create_group(&store, into_map(attributes))?;
        let create = |&name: &ArrayName| Ok((name, create_array(&store, name, shape)?));
        let arrays = shape.arrays().iter().map(create).collect::<Result<_>>()?;
        Ok(Stack { dir: dir.to_owned(), shape: *shape, arrays })
    }

    /// Opens the stack at `dir`, which must have this shape.
    ///
    /// # Errors
    /// [`Error::Zarr`] if it cannot be read, [`Error::Shape`] if its shape differs.
    pub fn open(dir: &Path, shape: &StackShape) -> Result<Stack> {
        shape.check()?;
        let store = DurableStore::new(dir)?;
        let mut arrays = BTreeMap::new();
        for &name in shape.arrays() {
            if name == ArrayName::Clipped && !dir.join(name.as_str()).exists() {
                continue;
            }
            let array = zarr::open_array(&store, name.as_str(), 3)?;
            let expected = [shape.len(name), shape.rows, shape.columns];
            let found = zarr::shape_of(&array);
            if found != expected {
                let what = dir.join(name.as_str()).display().to_string();
                return Err(Error::Shape { what, found, allowed: format!("{expected:?}") });
            }
            let shard = array.chunk_shape_usize(&[0, 0, 0]).map_err(Error::zarr("open", dir))?;
            if shard != shape.shard() {
                let what = format!("a shard of {}", dir.join(name.as_str()).display());
                return Err(Error::Shape { what, found: shard, allowed: format!("{:?}", shape.shard()) });
            }
            arrays.insert(name, array);
        }
        Ok(Stack { dir: dir.to_owned(), shape: *shape, arrays })
    }

    /// The shapes of the arrays.
    pub fn shape(&self) -> &StackShape {
        &self.shape
    }

    /// Whether the stack has this array: kinds of sessions differ, and old ones have no `clipped`.
    pub fn has(&self, array: ArrayName) -> bool {
        self.arrays.contains_key(&array)
    }

    /// Writes one point `[t, s]`, replacing any existing one; when this returns, it is durable. Returns the
    /// data's CRC-32 for the ledger's line.
    ///
    /// # Errors
    /// [`Error::Index`], [`Error::Shape`], or [`Error::Zarr`] if the file system refuses.
    pub fn write(&self, array: ArrayName, index: usize, data: ArrayView2<u32>) -> Result<u32> {
        let stored = self.array(array, index)?;
        if data.dim() != (self.shape.rows, self.shape.columns) {
            return Err(Error::Shape {
                what: format!("a point of array `{}`", array.as_str()),
                found: data.shape().to_vec(),
                allowed: format!("{:?}", [self.shape.rows, self.shape.columns]),
            });
        }
        zarr::write_chunk(stored, [index as u64, 0, 0], self.shape.shard(), data.insert_axis(Axis(0)))?;
        Ok(crc32(data))
    }

    /// Reads one point `[t, s]`. Whether the data are valid must be checked against the ledger (compare
    /// [`crc32`]).
    ///
    /// # Errors
    /// [`Error::NotStored`] if nothing was written, [`Error::Index`], or [`Error::Zarr`] for damaged data.
    pub fn read_point(&self, array: ArrayName, index: usize) -> Result<Array2<u32>> {
        let shard = self
            .array(array, index)?
            .retrieve_chunk_if_exists_opt::<Array3<u32>>(&[index as u64, 0, 0], &zarr::codec_options())
            .map_err(Error::zarr("read", &self.dir.join(array.as_str())))?;
        let Some(shard) = shard else {
            return Err(Error::NotStored { path: self.dir.clone(), array: array.as_str(), index });
        };
        let frame = shard.slice_move(s![0, ..self.shape.rows, ..self.shape.columns]);
        debug_assert_eq!(frame.raw_dim(), Ix2(self.shape.rows, self.shape.columns));
        Ok(frame.as_standard_layout().into_owned())
    }

    /// Reads some rows of a point, `[rows, s]`, and only those inner chunks of its shard that contain them:
    /// 64 rows starting at a multiple of 64 cost least. Verifies the checksums of the shard's index and of
    /// these chunks. The ledger's checksum covers the whole point; to verify it, read the point once with
    /// [`Stack::read_point`].
    ///
    /// # Errors
    /// [`Error::NotStored`] if nothing was written, [`Error::Index`], [`Error::Shape`] for rows that the
    /// camera does not have, or [`Error::Zarr`] for damaged data.
    pub fn read_rows(&self, array: ArrayName, index: usize, rows: Range<usize>) -> Result<Array2<u32>> {
        let zarr = self.array(array, index)?;
        let stored = zarr.storage().size_key(&zarr.chunk_key(&[index as u64, 0, 0]));
        // Zarr itself treats a missing chunk as zeros.
        if stored.map_err(Error::zarr("read", &self.dir.join(array.as_str())))?.is_none() {
            return Err(Error::NotStored { path: self.dir.clone(), array: array.as_str(), index });
        }
        let part = zarr::read_part(zarr, [index..index + 1, rows, 0..self.shape.columns])?;
        Ok(part.index_axis_move(Axis(0), 0))
    }

    /// Reads a whole array `[point, t, s]`; points that were never written are 0.
    ///
    /// # Errors
    /// [`Error::Index`] for an array that a film does not have, [`Error::Zarr`] for damaged data.
    pub fn read(&self, array: ArrayName) -> Result<Array3<u32>> {
        zarr::read_all(self.array(array, 0)?)
    }

    fn array(&self, array: ArrayName, index: usize) -> Result<&Array<DurableStore>> {
        let len = self.shape.len(array);
        let found = self.arrays.get(&array).filter(|_| index < len);
        found.ok_or(Error::Index { array: array.as_str(), index, len })
    }
}

/// CRC-32 (as in zip and PNG) of an image as little-endian uint32 in C order.
pub fn crc32(data: ArrayView2<u32>) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    let mut row_bytes = Vec::with_capacity(data.ncols() * 4);
    for row in data.rows() {
        row_bytes.clear();
        row_bytes.extend(row.iter().flat_map(|value| value.to_le_bytes()));
        hasher.update(&row_bytes);
    }
    hasher.finalize()
}

fn create_array(
    store: &Arc<DurableStore>,
    name: ArrayName,
    shape: &StackShape,
) -> Result<Array<DurableStore>> {
    let to_u64 = |axes: [usize; 3]| axes.map(|len| len as u64).to_vec();
    let array_shape = [shape.len(name), shape.rows, shape.columns];
    let first_axis = match shape.contents {
        Contents::Darks { .. } => "image",
        _ => name.first_axis(),
    };
    let units = if name == ArrayName::Clipped { "frames" } else { "DN" };
    let mut builder =
        ArrayBuilder::new(to_u64(array_shape), to_u64(shape.shard()), data_type::uint32(), 0u32);
    zarr::with_codecs(&mut builder)
        .subchunk_shape(to_u64(shape.chunk()))
        .dimension_names(Some([first_axis, "t", "s"]))
        .attributes(into_map(json!({ "units": units })));
    zarr::create_array(store, name.as_str(), &builder)
}

fn into_map(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

#[cfg(test)]
mod tests;
