//! Light transport in files: NumPy's `.npz`.
//!
//! Arrays: `T` float32 or float64 `[V, H, W]` or `[V, H, W, 3]`, and optionally `proj_uv` `[H, W, 2]`, the projector
//! coordinate (u right, v down, 0..1) of the point that each pixel sees. Other arrays are ignored.

use std::fs::File;
use std::io::{BufReader, BufWriter, Write};
use std::path::Path;

use ndarray::{Array2, Array3, ArrayD, Axis, Ix2, Ix4, IxDyn, OwnedRepr};
use ndarray_npy::{NpzReader, NpzWriter, ReadNpyError, ReadNpzError, WriteNpzError};

use super::Scene;
use super::error::SceneError;
use crate::stored_float::StoredFloat;

const TRANSPORT: &str = "T";
const PROJECTOR_UV: &str = "proj_uv";

pub(super) fn load(path: &Path) -> Result<Scene, SceneError> {
    let file = File::open(path).map_err(|source| SceneError::Open { path: path.into(), source })?;
    let unreadable = |source| SceneError::Unreadable { path: path.into(), source };
    let mut npz = NpzReader::new(BufReader::new(file)).map_err(unreadable)?;
    let names = npz.names().map_err(unreadable)?;
    if !names.iter().any(|name| name == TRANSPORT) {
        return Err(SceneError::MissingTransport { path: path.into(), found: names.join(", ") });
    }

    let array = read(&mut npz, path, TRANSPORT)?;
    let shape = array.shape().to_vec();
    let wrong_shape = || SceneError::Shape {
        path: path.into(),
        array: TRANSPORT,
        shape: shape.clone(),
        expected: "[V, H, W] or [V, H, W, 3] with no length 0".into(),
    };
    let transport = match *shape {
        [_, _, _] => array.insert_axis(Axis(3)),
        [_, _, _, 3] => array,
        _ => return Err(wrong_shape()),
    };
    let transport = transport.into_dimensionality::<Ix4>().map_err(|_shape| wrong_shape())?;
    if transport.is_empty() {
        return Err(wrong_shape());
    }

    let projector_column = if names.iter().any(|name| name == PROJECTOR_UV) {
        Some(read_projector_column(&mut npz, path, shape[1], shape[2])?)
    } else {
        None
    };
    Scene::checked(transport, projector_column, &format!("array {TRANSPORT} of {}", path.display()))
}

fn read_projector_column(
    npz: &mut NpzReader<BufReader<File>>,
    path: &Path,
    rows: usize,
    columns: usize,
) -> Result<Array2<f32>, SceneError> {
    let uv = read(npz, path, PROJECTOR_UV)?;
    let shape = uv.shape().to_vec();
    let column = match *shape {
        [h, w, 2] if (h, w) == (rows, columns) => {
            uv.index_axis_move(Axis(2), 0).into_dimensionality::<Ix2>().ok()
        }
        _ => None,
    };
    column.map(|column| column.mapv(usable_column)).ok_or_else(|| SceneError::Shape {
        path: path.into(),
        array: PROJECTOR_UV,
        shape,
        expected: format!("[{rows}, {columns}, 2], the camera rows and columns of {TRANSPORT}"),
    })
}

/// Replaces invalid columns: a pixel that sees nothing, or a point outside the frame, has no direct light.
fn usable_column(column: f32) -> f32 {
    if column.is_nan() { 0.5 } else { column.clamp(0.0, 1.0) }
}

/// Reads a float32 array, or a float64 array with conversion.
fn read(
    npz: &mut NpzReader<BufReader<File>>,
    path: &Path,
    array: &'static str,
) -> Result<ArrayD<f32>, SceneError> {
    let failed = |source| match source {
        ReadNpzError::Npy(ReadNpyError::WrongDescriptor(dtype)) => {
            SceneError::Dtype { path: path.into(), array, dtype: dtype.to_string() }
        }
        source => SceneError::Unreadable { path: path.into(), source },
    };
    let stored = npz.by_name::<OwnedRepr<StoredFloat>, IxDyn>(array).map_err(failed)?;
    Ok(stored.map(|StoredFloat(value)| *value))
}

pub(super) fn save(scene: &Scene, path: &Path) -> Result<(), SceneError> {
    let failed = |source| SceneError::Write { path: path.into(), source };
    let file = File::create(path).map_err(|source| failed(WriteNpzError::Zip(source.into())))?;
    let mut npz = NpzWriter::new(BufWriter::new(file));
    let transport = match scene.channels() {
        1 => npz.add_array(TRANSPORT, &scene.transport.index_axis(Axis(3), 0)),
        _ => npz.add_array(TRANSPORT, &scene.transport),
    };
    transport.map_err(failed)?;
    if let Some(column) = &scene.projector_column {
        let (rows, columns) = scene.size();
        // Rectified: a pixel's direct light comes from the centre of its own row.
        let uv = Array3::from_shape_fn((rows, columns, 2), |(row, x, axis)| match axis {
            0 => column[[row, x]],
            _ => (row as f32 + 0.5) / scene.rows() as f32,
        });
        npz.add_array(PROJECTOR_UV, &uv).map_err(failed)?;
    }
    let mut file = npz.finish().map_err(failed)?;
    file.flush().map_err(|source| failed(WriteNpzError::Zip(source.into())))
}
