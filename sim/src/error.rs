//! Why a simulated rig cannot be built.

use raysweep_core::PatternError;

use crate::scene::SceneError;

/// Why a simulated rig cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The scene cannot be read or computed.
    #[error("sim.scene: {0}")]
    Scene(#[from] SceneError),
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
    /// The pattern varies along rows, which the scenes' row transport cannot represent.
    #[error(
        "the simulated projector shows white, black, a line and row weights: a pattern that changes along rows needs a real one"
    )]
    AlongRows,
    /// A key of `[sim]` outside its range.
    #[error("sim.{key} = {value}: allowed is {allowed}")]
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
            | Self::AlongRows => "scene",
            Self::RowTable => "projector.row_table",
            Self::Beam => "projector.beam",
            Self::Range { key, .. } => key,
        }
    }
}
