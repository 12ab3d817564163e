//! A volume that is written in strips.

use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use ndarray::{ArrayView3, Axis};
use ndarray_npy::write_zeroed_npy;

use crate::durable::{self, DraftFile};
use crate::{Error, Result};

/// Writes `NAME.npy` (float32 `[u, t, s]`, C order) in strips of t. Nothing is visible before
/// [`VolumeWriter::commit`], and nothing is kept without it.
pub struct VolumeWriter {
    draft: DraftFile,
    /// Path and content of the JSON file next to the volume.
    sidecar: (PathBuf, Vec<u8>),
    shape: (usize, usize, usize),
    /// Offset of the values.
    header_bytes: u64,
    next_row: usize,
}

impl VolumeWriter {
    pub(super) fn create(
        path: &Path,
        shape: (usize, usize, usize),
        sidecar: (PathBuf, Vec<u8>),
    ) -> Result<VolumeWriter> {
        let draft = DraftFile::create(path)?;
        write_zeroed_npy::<f32, _>(draft.file(), shape).map_err(io::Error::other).map_err(draft.failed())?;
        let file_bytes = draft.file().metadata().map_err(draft.failed())?.len();
        let header_bytes = file_bytes - bytes_of(shape.0 * shape.1 * shape.2);
        Ok(VolumeWriter { draft, sidecar, shape, header_bytes, next_row: 0 })
    }

    /// Writes the next rows.
    ///
    /// # Errors
    /// [`Error::Shape`] for rows beyond the last, or of another size; [`Error::Io`].
    pub fn append(&mut self, strip: ArrayView3<f32>) -> Result<()> {
        let (depth, all_rows, columns) = self.shape;
        let (first_row, rows) = (self.next_row, strip.len_of(Axis(1)));
        if strip.dim() != (depth, rows, columns) || rows > all_rows - first_row {
            return Err(Error::Shape {
                what: format!("a strip of a volume from row {first_row} on"),
                found: strip.shape().to_vec(),
                allowed: format!("[{depth}, at most {}, {columns}]", all_rows - first_row),
            });
        }
        let mut bytes = vec![0; rows * columns * size_of::<f32>()];
        for (u, plane) in strip.outer_iter().enumerate() {
            let (places, _) = bytes.as_chunks_mut();
            places.iter_mut().zip(&plane).for_each(|(place, value)| *place = value.to_le_bytes());
            let at = self.header_bytes + bytes_of((u * all_rows + first_row) * columns);
            self.draft.file().write_all_at(&bytes, at).map_err(self.draft.failed())?;
        }
        self.next_row += rows;
        Ok(())
    }

    /// Moves the volume to its final place.
    ///
    /// # Errors
    /// [`Error::Shape`] if rows are missing; [`Error::Io`].
    pub fn commit(self) -> Result<()> {
        let (depth, rows, columns) = self.shape;
        if self.next_row < rows {
            return Err(Error::Shape {
                what: "the volume that is to be put in place".into(),
                found: vec![depth, self.next_row, columns],
                allowed: format!("{:?}", [depth, rows, columns]),
            });
        }
        self.draft.commit()?;
        let (path, content) = &self.sidecar;
        durable::write(path, content)
    }
}

fn bytes_of(values: usize) -> u64 {
    (values * size_of::<f32>()) as u64
}
