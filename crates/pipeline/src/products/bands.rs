//! Product `bands`: the light of one band of rows after the other, a film over the delay without its blur.

use std::ops::RangeInclusive;

use ndarray::{Array2, Array3, Axis};
use raysweep_transport::plane::Transport;
use serde::Deserialize;

use super::band::reach_of;
use super::mask::NEAR_ROWS;
use crate::product::Product;

/// Options of `bands`: the middle rows of the first and of the last band, their width, and how far they are apart.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Bands {
    /// Signed: rows above the pixel's own are negative.
    from_rows: i32,
    to_rows: i32,
    /// Odd, so that a band is symmetric about its middle row.
    #[serde(default = "one")]
    width_rows: i32,
    #[serde(default = "one")]
    step_rows: i32,
}

fn one() -> i32 {
    1
}

/// Most rows by which bands may be away from the pixel's own: no projector has more.
const MOST_ROWS: i32 = 1 << 16;

impl Bands {
    pub(super) fn check(self) -> Result<Self, (&'static str, String)> {
        let Self { from_rows, to_rows, width_rows, step_rows } = self;
        let refused = |field: &'static str, value: i32, allowed: String| {
            Err((field, format!("{field} = {value}: must be {allowed}")))
        };
        if !(-MOST_ROWS..=MOST_ROWS).contains(&from_rows) {
            return refused("from_rows", from_rows, format!("from -{MOST_ROWS} to {MOST_ROWS}"));
        }
        if !(from_rows..=MOST_ROWS).contains(&to_rows) {
            return refused("to_rows", to_rows, format!("from from_rows = {from_rows} to {MOST_ROWS}"));
        }
        if !(1..=MOST_ROWS).contains(&width_rows) || width_rows % 2 == 0 {
            let allowed = "an odd number of rows, so that as many lie above the band's middle as below";
            return refused("width_rows", width_rows, allowed.into());
        }
        if !(1..=MOST_ROWS).contains(&step_rows) {
            return refused("step_rows", step_rows, format!("from 1 to {MOST_ROWS}"));
        }
        Ok(self)
    }

    pub(super) fn default_name(self) -> String {
        let width = if self.width_rows == 1 { String::new() } else { format!("_{}", self.width_rows) };
        format!("bands_{}_to_{}{width}", self.from_rows, self.to_rows)
    }

    /// The most images that it has.
    pub(super) fn images(self) -> usize {
        self.middles().count()
    }

    /// All rows that its bands contain.
    pub(super) fn range(self) -> RangeInclusive<i32> {
        let half = self.width_rows / 2;
        self.from_rows - half..=self.to_rows + half
    }

    /// Why a sweep of this reach sees nothing of some bands.
    pub(super) fn beyond(self, first: i32, last: i32) -> Option<String> {
        let half = self.width_rows / 2;
        let last_middle = self.middles().last().unwrap_or(self.from_rows);
        (self.from_rows + half < first || last_middle - half > last).then(|| {
            format!(
                "from_rows = {} to to_rows = {} are not within the reach of rows {first} to {last}, so some images would be 0 everywhere: give rows within, or delays further from 0",
                self.from_rows, self.to_rows
            )
        })
    }

    fn middles(self) -> impl Iterator<Item = i32> {
        // Checked: positive.
        (self.from_rows..=self.to_rows).step_by(self.step_rows.unsigned_abs() as usize)
    }

    /// The bands. Those that divide rows which no setting tells apart are one, with all of these rows.
    fn ranges(self, one_band: bool) -> Vec<RangeInclusive<i32>> {
        let half = self.width_rows / 2;
        let divides = |rows: &RangeInclusive<i32>| {
            let inside = NEAR_ROWS.filter(|u| rows.contains(u)).count();
            one_band && inside > 0 && inside < NEAR_ROWS.count()
        };
        let all = self.middles().map(|middle| middle - half..=middle + half);
        let (divided, mut ranges): (Vec<_>, Vec<_>) = all.partition(divides);
        if !divided.is_empty() {
            let united = divided.iter().fold(NEAR_ROWS, |united, rows| {
                *united.start().min(rows.start())..=*united.end().max(rows.end())
            });
            let before = ranges.iter().filter(|rows| rows.start() < united.start()).count();
            ranges.insert(before, united);
        }
        ranges
    }

    pub(super) fn make(
        self,
        name: String,
        row_time_us: f64,
        one_band: bool,
        transport: &Transport,
        mask: Array2<u8>,
    ) -> Product {
        let ranges = self.ranges(one_band);
        let (_, rows, columns) = transport.t.dim();
        let mut images = Array3::zeros((ranges.len(), rows, columns));
        for (mut image, band) in images.axis_iter_mut(Axis(0)).zip(&ranges) {
            image.assign(&transport.band(band.clone()));
        }
        Product::Sequence {
            name,
            about: format!(
                "light of bands of {} projector rows over their distance u from the pixel's own, which is the delay over {row_time_us:.3} µs a row{}; {}",
                self.width_rows,
                if one_band {
                    ", of all bands that divide |u| <= 2 together, which nothing tells apart"
                } else {
                    ""
                },
                reach_of(transport)
            ),
            axis: "u, rows".into(),
            at: ranges.iter().map(|band| f64::from(band.start() + band.end()) / 2.0).collect(),
            images,
            mask,
        }
    }
}
