//! Scenes from files: one image for each of N dots.
//!
//! `.npz`: `T` `[N, H, W]` or `[N, H, W, 3]` of 16, 32 or 64 bit floats, and `uv` `[N, 2]`, the dots' centres in
//! the field of view, 0..1 from left to right and from top to bottom. `.npy`: `T` alone, with dots on a square grid,
//! row by row from the top. Images are interpolated between dots.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayD, Axis, Ix2, IxDyn, OwnedRepr};
use ndarray_npy::{NpzReader, ReadNpyExt};
use raysweep_core::Mosaic;

use super::error::DotSceneError;
use super::still::{Still, seen};
use crate::dots::beam::BeamSpot;
use crate::dots::view::CameraView;
use crate::stored_float::StoredFloat;

/// Number of surrounding dots that are interpolated if the dots do not form a grid.
const NEIGHBOURS: usize = 4;

/// A scene defined by its dots.
pub struct FileScene {
    /// `[dots, pixels]`, as seen by the sensor's pixels.
    images: Array2<f32>,
    uv: Vec<[f64; 2]>,
    /// Columns and rows of the dots' grid in row order, if they form one.
    grid: Option<[usize; 2]>,
    view: CameraView,
}

impl FileScene {
    /// Loads a scene from a file.
    pub fn load(path: &Path, half: [f64; 2], mosaic: Mosaic) -> Result<Self, DotSceneError> {
        let mut arrays = Arrays::open(path)?;
        let (transport, uv) = match &arrays {
            Arrays::One(_) => (arrays.read("T")?, None),
            Arrays::Named { names, .. } => {
                if !["T", "uv"].iter().all(|wanted| names.iter().any(|name| name == wanted)) {
                    return Err(DotSceneError::Layout {
                        path: path.into(),
                        found: format!("it holds [{}]", names.join(", ")),
                        expected: "T [N, H, W] or [N, H, W, 3] and uv [N, 2]".into(),
                    });
                }
                (arrays.read("T")?, Some(arrays.read("uv")?))
            }
        };
        Self::new(path, transport, uv, half, mosaic)
    }

    /// Loads planes under the dots of this scene from a file: each array of images in it is one, in their order.
    pub fn load_planes(&self, path: &Path, mosaic: Mosaic) -> Result<Vec<Self>, DotSceneError> {
        let mut arrays = Arrays::open(path)?;
        let names = match &arrays {
            Arrays::One(_) => vec!["T".to_owned()],
            Arrays::Named { names, .. } => names.clone(),
        };
        let uv = Array2::from_shape_fn((self.uv.len(), 2), |(dot, axis)| self.uv[dot][axis] as f32);
        let (rows, columns) = self.size();
        let expected = || format!("[{}, {rows}, {columns}], as the scene's dots and images", self.uv.len());
        let mut planes = Vec::new();
        for name in &names {
            let images = arrays.read(name)?;
            // Centres, radii and the like.
            if images.ndim() < 3 {
                continue;
            }
            if images.shape().get(..3) != Some(&[self.uv.len(), rows, columns]) {
                return Err(DotSceneError::Layout {
                    path: path.into(),
                    found: format!("{name} has the shape {:?}", images.shape()),
                    expected: expected(),
                });
            }
            planes.push(Self::new(path, images, Some(uv.clone().into_dyn()), self.view.half, mosaic)?);
        }
        Ok(planes)
    }

    fn new(
        path: &Path,
        transport: ArrayD<f32>,
        uv: Option<ArrayD<f32>>,
        half: [f64; 2],
        mosaic: Mosaic,
    ) -> Result<Self, DotSceneError> {
        let shape = transport.shape().to_vec();
        let layout = |found: String, expected: &str| DotSceneError::Layout {
            path: path.into(),
            found,
            expected: expected.into(),
        };
        let (&[dots, rows, columns] | &[dots, rows, columns, 3]) = shape.as_slice() else {
            return Err(layout(format!("T has the shape {shape:?}"), "[N, H, W] or [N, H, W, 3]"));
        };
        if transport.is_empty() {
            return Err(layout(format!("T has the shape {shape:?}"), "no length 0"));
        }
        let pixels = rows * columns;
        let channels = transport.len() / dots / pixels;
        for (dot, image) in transport.axis_iter(Axis(0)).enumerate() {
            let bad = image.iter().enumerate().find(|&(_, &value)| !(value.is_finite() && value >= 0.0));
            if let Some((index, &value)) = bad {
                return Err(DotSceneError::Value { path: path.into(), dot, index, value });
            }
        }
        let uv: Vec<[f64; 2]> = match uv {
            Some(uv) => {
                let shape = uv.shape().to_vec();
                let expected = format!("[{dots}, 2]: one centre for each dot of T");
                let uv = uv.into_dimensionality::<Ix2>().ok().filter(|uv| uv.dim() == (dots, 2));
                let uv = uv.ok_or_else(|| layout(format!("uv has the shape {shape:?}"), &expected))?;
                uv.rows().into_iter().map(|uv| [uv[0], uv[1]].map(f64::from)).collect()
            }
            None => {
                let side = dots.isqrt();
                if side * side != dots {
                    let expected = "a square number of them, or an .npz with uv";
                    return Err(layout(format!("T has {dots} dots"), expected));
                }
                let middle = |index: usize| (index as f64 + 0.5) / side as f64;
                (0..dots).map(|dot| [middle(dot % side), middle(dot / side)]).collect()
            }
        };
        if let Some(dot) = uv.iter().position(|uv| !uv.iter().all(|part| (-1.0..=2.0).contains(part))) {
            return Err(layout(format!("uv[{dot}] = {:?}", uv[dot]), "0 to 1 in the field of view"));
        }
        let values = transport.as_standard_layout();
        let values = values.as_slice().unwrap_or_default();
        let images = Array2::from_shape_fn((dots, pixels), |(dot, pixel)| {
            let first = (dot * pixels + pixel) * channels;
            match values[first..first + channels] {
                [red, green, blue] => seen(mosaic, pixel / columns, pixel % columns, [red, green, blue]),
                _ => values[first],
            }
        });
        let grid = grid_of(&uv);
        Ok(Self { images, uv, grid, view: CameraView { size: (rows, columns), half } })
    }

    /// Rows and columns of the images.
    pub fn size(&self) -> (usize, usize) {
        self.view.size
    }

    /// Dots to interpolate for a spot, with their weights; empty outside the field of view.
    fn neighbours(&self, uv: [f64; 2]) -> Vec<(usize, f64)> {
        if let Some([columns, rows]) = self.grid {
            let (first, last) = (self.uv[0], self.uv[self.uv.len() - 1]);
            let mut between = [(0, 0.0); 2];
            for (axis, count) in [(0, columns), (1, rows)] {
                let pitch = (last[axis] - first[axis]) / (count - 1) as f64;
                let place = (uv[axis] - first[axis]) / pitch;
                if !(-1.0..=count as f64).contains(&place) {
                    return Vec::new();
                }
                let place = place.clamp(0.0, (count - 1) as f64);
                let below = (place as usize).min(count - 2);
                between[axis] = (below, place - below as f64);
            }
            let [(column, right), (row, down)] = between;
            let dot = |row: usize, column: usize| row * columns + column;
            return vec![
                (dot(row, column), (1.0 - right) * (1.0 - down)),
                (dot(row, column + 1), right * (1.0 - down)),
                (dot(row + 1, column), (1.0 - right) * down),
                (dot(row + 1, column + 1), right * down),
            ];
        }
        let mut nearest: Vec<(usize, f64)> = Vec::with_capacity(NEIGHBOURS + 1);
        for (dot, centre) in self.uv.iter().enumerate() {
            let square = (uv[0] - centre[0]).powi(2) + (uv[1] - centre[1]).powi(2);
            let place = nearest.partition_point(|&(_, other)| other <= square);
            nearest.insert(place, (dot, square));
            nearest.truncate(NEIGHBOURS);
        }
        let pitch_square = 1.0 / self.uv.len() as f64;
        match nearest.first() {
            Some(&(dot, square)) if square < 1e-6 * pitch_square => vec![(dot, 1.0)],
            Some(&(_, square)) if square > pitch_square => Vec::new(),
            _ => {
                let total: f64 = nearest.iter().map(|(_, square)| square.recip()).sum();
                nearest.into_iter().map(|(dot, square)| (dot, square.recip() / total)).collect()
            }
        }
    }
}

impl Still for FileScene {
    fn add_direct(&self, spot: &BeamSpot, image: &mut [f32]) {
        for (dot, weight) in self.neighbours(self.view.uv(spot.centre)) {
            let weight = (weight * spot.light) as f32;
            if weight > 0.0 {
                image.iter_mut().zip(self.images.row(dot)).for_each(|(sum, value)| *sum += weight * value);
            }
        }
    }

    fn add_global(&self, _: &BeamSpot, _: &mut [f32]) {}
}

/// Columns and rows of the dots' grid in row order, if they form one.
fn grid_of(uv: &[[f64; 2]]) -> Option<[usize; 2]> {
    let columns = uv.windows(2).position(|pair| pair[1][0] <= pair[0][0])? + 1;
    let rows = uv.len() / columns;
    if rows * columns != uv.len() || rows < 2 || columns < 2 {
        return None;
    }
    let (first, last) = (uv[0], uv[uv.len() - 1]);
    let counts = [columns, rows];
    let pitch = [0, 1].map(|axis| (last[axis] - first[axis]) / (counts[axis] - 1) as f64);
    let on_grid = uv.iter().enumerate().all(|(dot, uv)| {
        let place = [dot % columns, dot / columns];
        (0..2).all(|axis| {
            (uv[axis] - first[axis] - place[axis] as f64 * pitch[axis]).abs() < 1e-3 * pitch[axis].abs()
        })
    });
    on_grid.then_some(counts)
}

/// The arrays of a file.
enum Arrays {
    /// An `.npy`.
    One(PathBuf),
    /// An `.npz`.
    Named { path: PathBuf, npz: Box<NpzReader<BufReader<File>>>, names: Vec<String> },
}

impl Arrays {
    fn open(path: &Path) -> Result<Self, DotSceneError> {
        if path.extension().is_some_and(|extension| extension == "npy") {
            return Ok(Self::One(path.into()));
        }
        let mut npz = NpzReader::new(reader(path)?).map_err(|error| unreadable(path, error))?;
        let names = npz.names().map_err(|error| unreadable(path, error))?;
        Ok(Self::Named { path: path.into(), npz: Box::new(npz), names })
    }

    /// Reads an array of floats; 16 and 64 bit floats are converted. The name does not matter to an `.npy`.
    fn read(&mut self, name: &str) -> Result<ArrayD<f32>, DotSceneError> {
        let floats = |values: ArrayD<StoredFloat>| values.map(|StoredFloat(value)| *value);
        match self {
            Self::One(path) => {
                ArrayD::read_npy(reader(path)?).map(floats).map_err(|error| unreadable(path, error))
            }
            Self::Named { path, npz, .. } => npz
                .by_name::<OwnedRepr<StoredFloat>, IxDyn>(name)
                .map(floats)
                .map_err(|error| unreadable(path, error)),
        }
    }
}

fn reader(path: &Path) -> Result<BufReader<File>, DotSceneError> {
    File::open(path).map(BufReader::new).map_err(|error| unreadable(path, error))
}

fn unreadable(path: &Path, reason: impl std::fmt::Display) -> DotSceneError {
    DotSceneError::Unreadable { path: path.into(), reason: reason.to_string() }
}
