//! What can go wrong with a scene.

use std::path::PathBuf;

use ndarray_npy::{ReadNpzError, WriteNpzError};

use super::{BUILTIN_NAMES, MAX_ENTRIES, MIN_SIDE, MOVING_NAMES, Window};

/// Why a scene could not be had, or could not answer.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// No built-in scene of this name.
    #[error("scene \"{name}\": no such built-in scene; choose one of {}, one that moves ({}), or name a file that ends in .npz", BUILTIN_NAMES.join(", "), MOVING_NAMES.join(", "))]
    UnknownName {
        /// The name asked for.
        name: String,
    },
    /// A built-in scene cannot have this size.
    #[error(
        "scene size {rows} rows x {columns} columns, {channels} channel(s): rows and columns start \
         at {MIN_SIDE}, and rows x rows x columns x channels may reach {MAX_ENTRIES}; choose a size \
         within"
    )]
    Size {
        /// Rows asked for.
        rows: usize,
        /// Columns asked for.
        columns: usize,
        /// 1 for mono, 3 for RGB.
        channels: usize,
    },
    /// A moving scene is computed in several positions, which would be too large together.
    #[error(
        "scene size {rows} rows x {columns} columns: a moving scene is kept in {keys} positions, and \
         {keys} x rows x rows x columns may reach {MAX_ENTRIES}; choose a smaller size or a scene at rest"
    )]
    MovingSize {
        /// Rows asked for.
        rows: usize,
        /// Columns asked for.
        columns: usize,
        /// Positions.
        keys: usize,
    },
    /// The file cannot be opened.
    #[error("scene file {}: cannot be opened; check the path and its permissions", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file is not an intact `.npz`.
    #[error(
        "scene file {}: not a readable .npz ({source}); it may be cut short or damaged, so copy it \
         again", path.display()
    )]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        source: ReadNpzError,
    },
    /// The file has no array `T`.
    #[error(
        "scene file {}: no array T among [{found}]; save the transport [V, H, W] or [V, H, W, 3] as \
         T", path.display()
    )]
    MissingTransport {
        /// The file.
        path: PathBuf,
        /// Names of the arrays that are there.
        found: String,
    },
    /// An array has another element type.
    #[error("scene file {}: array {array} has type {dtype}; save it as float32 or float64", path.display())]
    Dtype {
        /// The file.
        path: PathBuf,
        /// The array.
        array: &'static str,
        /// NumPy's description of the type found.
        dtype: String,
    },
    /// An array has another shape.
    #[error("scene file {}: array {array} has shape {shape:?}; expected {expected}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// The array.
        array: &'static str,
        /// Shape found.
        shape: Vec<usize>,
        /// Shape wanted.
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
        /// What went wrong.
        source: WriteNpzError,
    },
    /// Transport and projector columns do not fit together.
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
    /// Light is finite and not negative.
    #[error(
        "{origin}: value {value} at [v, t, s, channel] = {index:?}; transport must be finite and not negative"
    )]
    Value {
        /// Where the array came from.
        origin: String,
        /// Place of the first such value.
        index: (usize, usize, usize, usize),
        /// The value.
        value: f32,
    },
    /// A pattern must fit the projector.
    #[error(
        "pattern of {rows} rows x {columns} columns: expected {expected} rows (the scene's projector \
         rows), at least one column, and finite values"
    )]
    Pattern {
        /// Rows given.
        rows: usize,
        /// Columns given.
        columns: usize,
        /// Rows of the scene.
        expected: usize,
    },
    /// The scene was given by its rows and cannot tell columns apart.
    #[error(
        "pattern of {columns} columns that change along a row: this scene is given by its rows \
         (T[V, H, W]), whose columns are summed; use patterns that are constant along each row, or a \
         built-in scene"
    )]
    RowsOnly {
        /// Columns of the pattern.
        columns: usize,
    },
    /// The window leaves the image.
    #[error("window {window:?}: expected a part, not empty, of the image of {height} rows x {width} columns")]
    Window {
        /// The window given.
        window: Window,
        /// Camera rows.
        height: usize,
        /// Camera columns.
        width: usize,
    },
}
