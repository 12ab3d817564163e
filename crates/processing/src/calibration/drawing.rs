//! How the projector draws its rows, as `calibration.toml` has it.

use raysweep_transport::plane::calibrate::{FlyingSpot, Scan};
use serde::{Deserialize, Serialize};

use super::median::median;

/// How the projector draws its rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedDrawing {
    /// How it draws a row.
    pub rows: Scanning,
    /// Projector columns at which the left and right edges of the image see the board, in 0..=1 over the projector's
    /// width; measured if a spot flies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub columns: Option<[f64; 2]>,
}

/// How a projector draws a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Scanning {
    /// The whole row is lit at once, evenly over its time.
    Uniform,
    /// By a spot that flies along every row from the first column to the last.
    OneWay,
    /// By a spot that flies along odd rows from the last column to the first.
    Bidirectional,
}

impl CalibratedDrawing {
    /// That of a spot, or of rows that are lit evenly.
    pub(super) fn of(spot: Option<&FlyingSpot>) -> Self {
        let Some(FlyingSpot { scan, columns }) = spot else {
            return Self { rows: Scanning::Uniform, columns: None };
        };
        let edges = columns.rows().into_iter().filter_map(|row| {
            let mut seen = row.iter().copied().filter(|column| column.is_finite());
            let first = seen.next()?;
            Some([first, seen.next_back().unwrap_or(first)])
        });
        let edges: Vec<[f32; 2]> = edges.collect();
        let rows = match scan {
            Scan::OneWay => Scanning::OneWay,
            Scan::Bidirectional => Scanning::Bidirectional,
        };
        Self { rows, columns: Some([0, 1].map(|edge| median(edges.iter().map(|edges| edges[edge])))) }
    }

    /// The direction of the spot, if one draws the rows.
    pub(super) fn scan(&self) -> Option<Scan> {
        match self.rows {
            Scanning::Uniform => None,
            Scanning::OneWay => Some(Scan::OneWay),
            Scanning::Bidirectional => Some(Scan::Bidirectional),
        }
    }

    /// In words.
    pub fn text(&self) -> String {
        let rows = match self.rows {
            Scanning::Uniform => "lit evenly over their time",
            Scanning::OneWay => "drawn by a flying spot, all in one direction",
            Scanning::Bidirectional => "drawn by a flying spot, odd rows backwards",
        };
        let seen = self.columns.map(|[left, right]| {
            format!("; the board is seen at columns {left:.3} to {right:.3} of the width")
        });
        format!("{rows}{}", seen.unwrap_or_default())
    }
}
