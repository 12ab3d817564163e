//! Why a simulated rig cannot be built.

use raysweep_core::PatternError;

use crate::scene::SceneError;

/// Why a simulated rig cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The scene cannot be read or computed.
    #[error("sim.scene: {0}")]
    Scene(#[from] SceneError),
    /// A built-in scene has more rows than the projector.
    #[error("sim.scene_rows = {rows}: must be at most projector.rows = {most}")]
    TooManyRows {
        /// Rows of the scene.
        rows: usize,
        /// Rows of the projector.
        most: usize,
    },
    /// The scene has more rows than the projector below its first row.
    #[error(
        "sim.scene has {scene_rows} rows, which do not fit below row {first_row} of the projector's {projector_rows}: raise projector.rows, lower camera.first_projector_row or take a smaller scene"
    )]
    SceneRows {
        /// Scene rows.
        scene_rows: usize,
        /// Projector row of the scene's first row.
        first_row: usize,
        /// Projector rows.
        projector_rows: usize,
    },
    /// The camera rows span more projector rows than there are.
    #[error(
        "the camera rows of sim.scene look along {camera_rows} projector rows, which do not fit below row {first_row} of the projector's {projector_rows}: raise projector.rows, lower camera.row_pitch or set camera.first_projector_row"
    )]
    CameraRows {
        /// Projector rows spanned by the scene's camera rows.
        camera_rows: usize,
        /// Projector row of the first camera row.
        first_row: usize,
        /// Projector rows.
        projector_rows: usize,
    },
    /// Row times do not increase from row to row.
    #[error(
        "sim.projector.row_table: rows would be drawn in a different order; take a smaller percent or amplitude_us"
    )]
    RowTable,
    /// The beam has no extent or is too wide.
    #[error(
        "sim.projector.beam: sigma_rows must lie in 0..=100 (not 0), up_rows + down_rows in 0..=500 (not 0)"
    )]
    Beam,
    /// The pattern does not fit the projector.
    #[error(transparent)]
    Pattern(#[from] PatternError),
    /// The beam's kernel has no light, or no order.
    #[error(
        "sim.projector.beam: a kernel needs rising rows within -500..=500, and for each row a weight from 0 to 1e6, not all of them 0; the same holds for to"
    )]
    Kernel,
    /// Rows end after the period.
    #[error(
        "sim.{key}: the last row would end {end_us:.1} us after the edge, and vsync.period_us = {period_us}: a frame's rows must be drawn before the next edge; lower truth.row_time_us or truth.first_row_us"
    )]
    TruthPeriod {
        /// Key below `[sim]`.
        key: &'static str,
        /// End of the last row after the edge.
        end_us: f64,
        /// VSYNC period.
        period_us: f64,
    },
    /// Pixels look beyond the projector.
    #[error(
        "sim.{key}: the scene would lie from projector row {from_row:.2} to {to_row:.2} of 0 to {projector_rows}: move it less, take a smaller scene or raise projector.rows"
    )]
    TruthRows {
        /// Key below `[sim]`.
        key: &'static str,
        /// Where the scene begins.
        from_row: f64,
        /// Where it ends.
        to_row: f64,
        /// Projector rows.
        projector_rows: usize,
    },
    /// The board's strip is not within the image.
    #[error(
        "sim.board.strip_columns = [{first}, {end}]: must be [first column, column after the last] of the {columns} columns, with at least one between them"
    )]
    Strip {
        /// First column.
        first: usize,
        /// Column after the last.
        end: usize,
        /// Columns of the image.
        columns: usize,
    },
    /// The pattern varies along rows, which the scene's row transport cannot represent.
    #[error(
        "this scene is known by its rows alone, and cannot be lit by a pattern that varies along them: take a built-in scene or a pattern of rows, or put the board before the camera"
    )]
    AlongRows,
    /// A picture from a file.
    #[error("the simulated projector shows no pictures from files: take another pattern")]
    Picture,
    /// A key of `[sim]` outside its range.
    #[error("sim.{key} = {value}: must be {allowed}")]
    Range {
        /// Key below `[sim]`.
        key: &'static str,
        /// Given value.
        value: f64,
        /// Allowed values.
        allowed: &'static str,
    },
}

impl SimError {
    /// The key below `[sim]` that causes the error.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Scene(_)
            | Self::SceneRows { .. }
            | Self::CameraRows { .. }
            | Self::Pattern(_)
            | Self::AlongRows
            | Self::Picture => "scene",
            Self::TooManyRows { .. } => "scene_rows",
            Self::RowTable => "projector.row_table",
            Self::Beam | Self::Kernel => "projector.beam",
            Self::Strip { .. } => "board.strip_columns",
            Self::TruthPeriod { key, .. } | Self::TruthRows { key, .. } | Self::Range { key, .. } => key,
        }
    }
}
