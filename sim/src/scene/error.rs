//! Errors of scenes.

use std::path::PathBuf;

use ndarray_npy::{ReadNpzError, WriteNpzError};
use raysweep_core::io_text;

use super::names::{BUILTIN_NAMES, MOVING_NAMES};
use super::size::{MAX_ENTRIES, MIN_SIDE, Window};

/// Why a scene cannot be loaded, computed, saved or rendered.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// There is no built-in scene of this name.
    #[error("scene \"{name}\": no such built-in scene; choose one of {}, one that moves ({}), or name a file that ends in .npz", BUILTIN_NAMES.join(", "), MOVING_NAMES.join(", "))]
    UnknownName {
        /// The requested name.
        name: String,
    },
    /// A built-in scene does not support this size.
    #[error(
        "scene size {rows} rows x {columns} columns, {channels} channel(s): rows and columns start \
         at {MIN_SIDE}, and rows x rows x columns x channels may reach {MAX_ENTRIES}; choose a size \
         within"
    )]
    Size {
        /// Requested rows.
        rows: usize,
        /// Requested columns.
        columns: usize,
        /// 1 for mono, 3 for RGB.
        channels: usize,
    },
    /// A moving scene is computed in several positions, which together would be too large.
    #[error(
        "scene size {rows} rows x {columns} columns: a moving scene is kept in {keys} positions, and \
         {keys} x rows x rows x columns may reach {MAX_ENTRIES}; choose a smaller size or a scene at rest"
    )]
    MovingSize {
        /// Requested rows.
        rows: usize,
        /// Requested columns.
        columns: usize,
        /// Number of positions.
        keys: usize,
    },
    /// The file cannot be opened.
    #[error("scene file {}: {}; check the path, and that the program's user may read it", path.display(), io_text(source))]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not a valid `.npz`.
    #[error(
        "scene file {}: not a readable .npz ({source}); it may be cut short or damaged, so copy it \
         again", path.display()
    )]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The read error.
        source: ReadNpzError,
    },
    /// The file has no array named `T`.
    #[error(
        "scene file {}: no array T among [{found}]; save the transport [V, H, W] or [V, H, W, 3] as \
         T", path.display()
    )]
    MissingTransport {
        /// The file.
        path: PathBuf,
        /// Names of the arrays in the file.
        found: String,
    },
    /// An array has an unsupported element type.
    #[error("scene file {}: array {array} has type {dtype}; save it as float32 or float64", path.display())]
    Dtype {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        array: &'static str,
        /// NumPy's description of the element type.
        dtype: String,
    },
    /// An array has an unexpected shape.
    #[error("scene file {}: array {array} has shape {shape:?}; expected {expected}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        array: &'static str,
        /// Actual shape.
        shape: Vec<usize>,
        /// Expected shape.
        expected: String,
    },
    /// The file cannot be written.
    #[error(
        "scene file {}: cannot be written ({source}); check the folder and the free space",
        path.display()
    )]
    Write {
        /// The file.
        path: PathBuf,
        /// The write error.
        source: WriteNpzError,
    },
    /// The shapes of transport and projector columns do not match.
    #[error(
        "transport of shape {transport:?} with projector columns {projector_column:?}: expected \
         [V, H, W, 1 or 3] with no length 0, and [H, W]"
    )]
    Layout {
        /// Shape of the transport.
        transport: (usize, usize, usize, usize),
        /// Shape of the projector columns, if given.
        projector_column: Option<(usize, usize)>,
    },
    /// Transport contains a negative or non-finite value.
    #[error(
        "{origin}: value {value} at [v, t, s, channel] = {index:?}; transport must be finite and not negative"
    )]
    Value {
        /// Origin of the array.
        origin: String,
        /// Index of the first invalid value.
        index: (usize, usize, usize, usize),
        /// The invalid value.
        value: f32,
    },
    /// A pattern does not fit the projector.
    #[error(
        "pattern of {rows} rows x {columns} columns: expected {expected} rows (the scene's projector \
         rows), at least one column, and finite values"
    )]
    Pattern {
        /// Rows of the pattern.
        rows: usize,
        /// Columns of the pattern.
        columns: usize,
        /// Projector rows of the scene.
        expected: usize,
    },
    /// The pattern varies along a row, but the scene is defined by row transport only.
    #[error(
        "pattern of {columns} columns that change along a row: this scene is given by its rows \
         (T[V, H, W]), whose columns are summed; use patterns that are constant along each row, or a \
         built-in scene"
    )]
    RowsOnly {
        /// Columns of the pattern.
        columns: usize,
    },
    /// The window extends beyond the image.
    #[error("window {window:?}: expected a part, not empty, of the image of {height} rows x {width} columns")]
    Window {
        /// The requested window.
        window: Window,
        /// Camera rows.
        height: usize,
        /// Camera columns.
        width: usize,
    },
}
