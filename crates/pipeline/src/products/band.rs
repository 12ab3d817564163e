//! Light by the distance of its projector row: `epipolar`, `non-epipolar`, `band`.

use std::ops::RangeInclusive;

use ndarray::Array2;
use raysweep_transport::plane::Transport;
use serde::Deserialize;

use crate::product::Product;

/// The reach of a transport as text, for products that are limited by it.
pub(super) fn reach_of(transport: &Transport) -> String {
    format!("the sweep reaches u = {} to {}, beyond nothing is known", transport.u_min, transport.u_max())
}

/// Rows up to this distance are one band if no setting tells them apart.
const ONE_BAND_ROWS: u32 = 2;

/// Options of `epipolar` and `non-epipolar`: the rows that count as the pixel's own.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Width {
    /// Odd, so that the rows are symmetric about u = 0.
    width_rows: u32,
}

impl Default for Width {
    fn default() -> Self {
        Self { width_rows: 1 }
    }
}

impl Width {
    pub(super) fn check(self) -> Result<Self, (&'static str, String)> {
        match self.width_rows % 2 {
            1 => Ok(self),
            _ => {
                let what = format!(
                    "width_rows = {}: must be an odd number of rows, so that as many lie above as below",
                    self.width_rows
                );
                Err(("width_rows", what))
            }
        }
    }

    /// Why a sweep of this reach does not see the rows.
    pub(super) fn beyond(self, first: i32, last: i32) -> Option<String> {
        let reach = first.unsigned_abs().max(last.unsigned_abs());
        (self.half() > reach).then(|| {
            format!(
                "width_rows = {} is beyond the reach of {reach} rows to either side: give at most {}, or delays further from 0",
                self.width_rows,
                2 * reach + 1
            )
        })
    }

    /// The name of a product of this width if the plan gives none.
    pub(super) fn named(self, name: &str) -> String {
        match self.width_rows {
            1 => name.into(),
            width_rows => format!("{name}_{width_rows}"),
        }
    }

    /// At least the band whose division the settings do not tell.
    pub(super) fn of(self, one_band: bool) -> Self {
        let narrowest_rows = if one_band { 2 * ONE_BAND_ROWS + 1 } else { 1 };
        Self { width_rows: self.width_rows.max(narrowest_rows) }
    }

    fn half(self) -> u32 {
        self.width_rows / 2
    }

    /// Number of rows.
    pub(super) fn rows(self) -> u32 {
        self.width_rows
    }

    /// The relative rows.
    pub(super) fn range(self) -> RangeInclusive<i32> {
        let half = i32::try_from(self.half()).unwrap_or(i32::MAX);
        -half..=half
    }

    pub(super) fn epipolar(self, name: String, transport: &Transport, mask: Array2<u8>) -> Product {
        let about = match self.half() {
            0 => "light from the pixel's own projector row (u = 0)".into(),
            half => {
                format!("light from the pixel's own projector row and {half} to either side (|u| <= {half})")
            }
        };
        Product::Image { name, about, is_light: true, image: transport.epipolar(self.width_rows), mask }
    }

    pub(super) fn non_epipolar(self, name: String, transport: &Transport, mask: Array2<u8>) -> Product {
        let about = match self.half() {
            0 => "light from all other rows within the sweep's reach".into(),
            half => {
                format!("light from all rows more than {half} away within the sweep's reach (|u| > {half})")
            }
        };
        Product::Image { name, about, is_light: true, image: transport.non_epipolar(self.width_rows), mask }
    }
}

/// Options of `band`: the distance of the rows.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Band {
    /// Smallest |u|.
    from_rows: u32,
    /// Largest |u|; if omitted, the sweep's reach.
    to_rows: Option<u32>,
    /// If omitted, both sides.
    side: Option<Side>,
}

/// Position of rows relative to the pixel's own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Side {
    /// u < 0.
    Above,
    /// u > 0.
    Below,
}

impl Band {
    pub(super) fn new(from_rows: u32, to_rows: Option<u32>) -> Self {
        Self { from_rows, to_rows, side: None }
    }

    pub(super) fn check(self) -> Result<Self, (&'static str, String)> {
        match self.to_rows {
            Some(to_rows) if to_rows < self.from_rows => {
                let what = format!("to_rows = {to_rows}: must be at least from_rows = {}", self.from_rows);
                Err(("to_rows", what))
            }
            _ => Ok(self),
        }
    }

    /// The band without a part of the rows whose division the settings do not tell: all of them, or none.
    pub(super) fn of(self, one_band: bool) -> Self {
        match self {
            Self { from_rows, to_rows, side } if one_band && from_rows <= ONE_BAND_ROWS => match to_rows {
                Some(to_rows) if to_rows <= ONE_BAND_ROWS => Self::new(0, Some(ONE_BAND_ROWS)),
                _ if from_rows == 0 && side.is_none() => self,
                _ => Self { from_rows: ONE_BAND_ROWS + 1, ..self },
            },
            _ => self,
        }
    }

    /// Why a sweep of this reach sees none of the rows.
    pub(super) fn beyond(self, first: i32, last: i32) -> Option<String> {
        let (above, below) = (first.min(0).unsigned_abs(), last.max(0).unsigned_abs());
        let (reach, side) = match self.side {
            Some(Side::Above) => (above, " above"),
            Some(Side::Below) => (below, " below"),
            None => (above.max(below), ""),
        };
        (self.from_rows > reach).then(|| {
            format!(
                "from_rows = {} is beyond the reach of {reach} rows{side}, so the image is 0 everywhere: give at most {reach}, or delays further from 0",
                self.from_rows
            )
        })
    }

    pub(super) fn default_name(self) -> String {
        let side = match self.side {
            Some(Side::Above) => "_above",
            Some(Side::Below) => "_below",
            None => "",
        };
        match self.to_rows {
            Some(to_rows) => format!("band_{}_to_{to_rows}{side}", self.from_rows),
            None => format!("band_from_{}{side}", self.from_rows),
        }
    }

    /// The rows, as text.
    pub(super) fn says(self) -> String {
        if self.to_rows == Some(0) {
            return "light from the pixel's own projector row (u = 0)".into();
        }
        let rows = match self.to_rows {
            Some(to_rows) => format!("{} to {to_rows} rows", self.from_rows),
            None => format!("{} or more rows", self.from_rows),
        };
        let side = match self.side {
            Some(Side::Above) => "above the pixel's own",
            Some(Side::Below) => "below the pixel's own",
            None => "away from the pixel's own",
        };
        format!("light that left the projector {rows} {side}")
    }

    pub(super) fn make(self, name: String, transport: &Transport, mask: Array2<u8>) -> Product {
        let mut about = self.says();
        let known = transport.u_min.unsigned_abs().min(transport.u_max().unsigned_abs());
        if self.to_rows.is_none_or(|to_rows| to_rows > known) {
            about.push_str(&format!("; {}", reach_of(transport)));
        }
        Product::Image { name, about, is_light: true, image: self.image(transport), mask }
    }

    /// The relative rows, without duplicates.
    pub(super) fn ranges(self) -> Vec<RangeInclusive<i32>> {
        // Every reach is shorter than i32::MAX rows.
        let rows = |rows: u32| i32::try_from(rows).unwrap_or(i32::MAX);
        let (from, to) = (rows(self.from_rows), self.to_rows.map_or(i32::MAX, rows));
        match self.side {
            Some(Side::Above) => vec![-to..=-from],
            Some(Side::Below) => vec![from..=to],
            // Both sides contain the pixel's own row, which must count once.
            None if from == 0 => vec![-to..=to],
            None => vec![-to..=-from, from..=to],
        }
    }

    /// [`Self::ranges`], where rows as far as the sweep reaches end at `i32::MIN` and `i32::MAX`.
    pub(super) fn open_ranges(self) -> Vec<RangeInclusive<i32>> {
        let start = |u: i32| if u == -i32::MAX { i32::MIN } else { u };
        self.ranges().into_iter().map(|rows| start(*rows.start())..=*rows.end()).collect()
    }

    fn image(self, transport: &Transport) -> Array2<f32> {
        let bands = self.ranges().into_iter().map(|rows| transport.band(rows));
        bands.reduce(|sum, band| sum + band).unwrap_or_default()
    }
}
