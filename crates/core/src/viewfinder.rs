//! What a viewfinder shows.

use serde::{Deserialize, Serialize};

/// What the projector shows during a viewfinder; on a dot rig, all pictures but `black` are the dot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FinderPicture {
    /// Every row fully lit: for exposure.
    #[default]
    White,
    /// No light: for the room's light.
    Black,
    /// A checkerboard: for focus.
    Grid,
    /// Every 16th row: for focus along the rows.
    Rows,
    /// A cross through the middle: for pointing.
    Cross,
    /// One after another the pictures that tell which projector row each pixel sees: for aligning.
    Align,
}

impl FinderPicture {
    /// All pictures.
    pub const ALL: [Self; 6] = [Self::White, Self::Black, Self::Grid, Self::Rows, Self::Cross, Self::Align];

    /// Its name in plans and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::White => "white",
            Self::Black => "black",
            Self::Grid => "grid",
            Self::Rows => "rows",
            Self::Cross => "cross",
            Self::Align => "align",
        }
    }
}
