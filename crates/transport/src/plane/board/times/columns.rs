use std::ops::Range;

use ndarray::{Array2, ArrayView1, ArrayView2, ArrayView3, s};

use super::super::super::PlaneError;
use super::super::super::error::check_shape;
use super::super::super::model::{FIRST_RESPONSE_ROW, FlyingSpot, RESPONSE_ROWS, Scan};
use super::super::images::{PICTURES, Responses, column_pairs};

/// Largest number of groups into which the columns of the image are averaged. More groups hardly help: they differ
/// only in the fraction of a row at which their pixels lie.
const GROUPS: usize = 12;
/// Least part of the projector's width that a group of columns is taken to see: a spot is not a point.
const LEAST_WIDTH: f64 = 1.0 / 32.0;

/// The last of the pictures of a response.
const BLACK: usize = PICTURES - 1;

/// What each camera row sees of each drawn row, averaged over groups of neighbouring columns.
///
/// The light of a mean of pixels is the mean of their responses times the light that each row has sent. So averaging
/// adds no error, and a fit takes as long for an image of 1280 columns as for one of 12.
#[derive(Debug, Clone, PartialEq)]
pub struct Columns {
    lit: Array2<bool>,
    /// Image columns of each group.
    groups: Vec<Range<usize>>,
    /// `[row * groups + group]`.
    cells: Vec<Cell>,
    /// The drawn rows of each cell's response and their end, `[row * groups + group][rows + 1]`.
    drawn: Vec<DrawnRow>,
    /// `rows + 1`.
    drawn_rows: usize,
    /// Mean variance of a single pixel of a cell in each picture of its response, in squares of its light,
    /// `[row * groups + group, 17]`.
    picture_variances: Array2<f64>,
    /// For each camera row, the drawn rows that any of its cells sees.
    reach: Vec<(f64, f64)>,
}

/// The lit pixels of one camera row in one group of columns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cell {
    /// Number of lit pixels; cells without any are never compared.
    pub pixels: usize,
    /// Mean place of the pixels in projector rows.
    pub place: f64,
    /// The first drawn row of the response.
    first_row: i64,
    /// Number of drawn rows in the response.
    rows: usize,
    /// The fraction of a row's dwell in which it lights the cell.
    dwell: f64,
    /// Standard deviation of a row's light sent while it passes the cell, as a share of it.
    step_sd: f64,
}

/// A row of a cell's response.
#[derive(Debug, Clone, Copy, PartialEq)]
struct DrawnRow {
    /// What earlier rows have sent.
    before: f64,
    /// The fraction of its dwell that has passed when half of its light has been sent.
    middle: f64,
}

/// Shares of a cell's light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LightSent {
    /// What has been sent.
    pub sent: f64,
    /// What would be sent in the time of a row if light went on as at this moment.
    pub sending: f64,
    /// Standard deviation of what has been sent: a spot lights one pixel after the other.
    pub sd: f64,
}

impl Columns {
    /// From each pixel's `place` in projector rows, NaN where it is unlit, and its `response` `[16, t, s]`:
    /// the share of its light that drawn row `round(place) + d` sends, for `d` from -7 to 8. Rows are lit evenly, or by
    /// a spot, whose columns are those of the lit pixels. The responses have no errors, unless
    /// [`Self::with_errors_of`] says so.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if the arrays do not fit together; [`PlaneError::OutOfRange`] for a response of a lit
    /// pixel whose sum is not 1 to within 1 %, or for an image without lit pixels.
    pub fn new(
        place: ArrayView2<f32>,
        response: ArrayView3<f32>,
        spot: Option<&FlyingSpot>,
    ) -> Result<Self, PlaneError> {
        let (rows, columns) = place.dim();
        if let Some(spot) = spot {
            spot.check((rows, columns))?;
            let is_unknown =
                |((t, s), place): ((usize, usize), &f32)| place.is_finite() && spot.column(t, s).is_nan();
            if place.indexed_iter().any(is_unknown) {
                let allowed = "known in every lit pixel: give pixels without a column no place either";
                return Err(PlaneError::OutOfRange { field: "columns", value: f64::NAN, allowed });
            }
        }
        check_shape("response", "[16, t, s]", response.shape(), &[RESPONSE_ROWS, rows, columns])?;
        let lit = place.mapv(f32::is_finite);
        if !lit.iter().any(|&lit| lit) {
            return Err(PlaneError::OutOfRange {
                field: "place",
                value: f64::NAN,
                allowed: "a projector row in at least one pixel: fill the view with the board",
            });
        }
        let count = GROUPS.min(columns);
        let groups: Vec<_> =
            (0..count).map(|group| group * columns / count..(group + 1) * columns / count).collect();
        let mut cells = Vec::with_capacity(rows * count);
        let mut responses: Vec<Vec<f64>> = Vec::with_capacity(rows * count);
        let mut passes: Vec<Vec<f64>> = Vec::with_capacity(rows * count);
        for row in 0..rows {
            for group in &groups {
                let pixels: Vec<usize> = group.clone().filter(|&column| lit[[row, column]]).collect();
                let own_row = |column: usize| place[[row, column]].round() as i64;
                let first = pixels.iter().map(|&column| own_row(column)).min().unwrap_or(0);
                let last = pixels.iter().map(|&column| own_row(column)).max().unwrap_or(0);
                let mut sum = vec![0.0; (last - first) as usize + RESPONSE_ROWS];
                let mut passed = sum.clone();
                let (mut leftmost, mut rightmost) = (f64::MAX, f64::MIN);
                for &column in &pixels {
                    let shift = (own_row(column) - first) as usize;
                    let shares = pixel_response(response.slice(s![.., row, column]))?;
                    let passes = spot.map_or(0.5, |spot| spot.column(row, column));
                    (leftmost, rightmost) = (leftmost.min(passes), rightmost.max(passes));
                    sum[shift..].iter_mut().zip(shares).for_each(|(sum, share)| *sum += share);
                    passed[shift..].iter_mut().zip(shares).for_each(|(sum, share)| *sum += share * passes);
                }
                // A spot passes the pixels that see more of a row than the others at a time of its own.
                let backwards = |v: i64| {
                    v.rem_euclid(2) == 1 && spot.is_some_and(|spot| spot.scan == Scan::Bidirectional)
                };
                let whole = (leftmost + rightmost) / 2.0;
                for ((passed, sum), v) in
                    passed.iter_mut().zip(&sum).zip(first + i64::from(FIRST_RESPONSE_ROW)..)
                {
                    let middle = *passed / sum;
                    let middle = if (leftmost..=rightmost).contains(&middle) { middle } else { whole };
                    *passed = if backwards(v) { 1.0 - middle } else { middle };
                }
                let places = pixels.iter().map(|&column| f64::from(place[[row, column]]));
                cells.push(Cell {
                    pixels: pixels.len(),
                    place: places.sum::<f64>() / pixels.len() as f64,
                    first_row: first + i64::from(FIRST_RESPONSE_ROW),
                    rows: sum.len(),
                    // From the border of the first pixel to that of the last.
                    dwell: spot.map_or(1.0, |_| {
                        let between = pixels.len() as f64 - 1.0;
                        ((rightmost - leftmost) * (1.0 + between.max(1.0).recip())).max(LEAST_WIDTH)
                    }),
                    // That of a uniform distribution over one pixel.
                    step_sd: spot.map_or(0.0, |_| 12.0_f64.sqrt().recip() / pixels.len().max(1) as f64),
                });
                passes.push(passed);
                responses.push(sum.iter().map(|sum| sum / pixels.len().max(1) as f64).collect());
            }
        }
        let longest = responses.iter().map(Vec::len).max().unwrap_or(0);
        let mut drawn = Vec::with_capacity(cells.len() * (longest + 1));
        for (response, passes) in responses.iter().zip(&passes) {
            let mut before = 0.0;
            for row in 0..=longest {
                drawn.push(DrawnRow { before, middle: passes.get(row).copied().unwrap_or(0.5) });
                before += response.get(row).unwrap_or(&0.0);
            }
        }
        let mut reach = vec![(f64::MAX, f64::MIN); rows];
        for (index, (cell, response)) in cells.iter().zip(&responses).enumerate() {
            let (first, end) = &mut reach[index / count];
            for (row, _) in (cell.first_row..).zip(response).filter(|(_, share)| **share != 0.0) {
                *first = first.min(row as f64);
                *end = end.max(row as f64 + 1.0);
            }
        }
        Ok(Self {
            picture_variances: Array2::zeros((cells.len(), PICTURES)),
            lit,
            groups,
            cells,
            drawn,
            drawn_rows: longest + 1,
            reach,
        })
    }

    /// The same with the noise of the pictures from which these responses were averaged.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if they have another shape; [`PlaneError::OutOfRange`] for a lit pixel without a noise.
    pub fn with_errors_of(mut self, responses: &Responses) -> Result<Self, PlaneError> {
        let picture_sd = &responses.picture_sd;
        let (rows, columns) = self.lit.dim();
        check_shape("picture_sd", "[17, t, s]", picture_sd.shape(), &[PICTURES, rows, columns])?;
        let count = self.groups.len();
        for (index, cell) in self.cells.iter().enumerate() {
            let (row, mut variances) = (index / count, self.picture_variances.row_mut(index));
            for column in self.groups[index % count].clone().filter(|&column| self.lit[[row, column]]) {
                for (variance, &sd) in variances.iter_mut().zip(picture_sd.slice(s![.., row, column])) {
                    *variance += f64::from(sd).powi(2) / cell.pixels as f64;
                }
            }
            if let Some(&value) = variances.iter().find(|variance| !variance.is_finite()) {
                let allowed = "finite: give pixels without a noise no place either";
                return Err(PlaneError::OutOfRange { field: "picture_sd of a lit pixel", value, allowed });
            }
        }
        Ok(self)
    }

    /// The same under a spot that takes this part of a row's time, or more, to pass a group of columns; `None` if rows are
    /// lit evenly.
    pub(super) fn blurred(&self, dwell: f64) -> Option<Self> {
        let is_even = self.cells.iter().all(|cell| cell.step_sd == 0.0);
        let mut cells = self.cells.clone();
        cells.iter_mut().for_each(|cell| cell.dwell = cell.dwell.max(dwell));
        (!is_even).then(|| Self { cells, ..self.clone() })
    }

    /// The mean of an image over the lit pixels of each group, `[rows, groups]`; 0 where a group has none.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if the image does not have the shape of the places; [`PlaneError::OutOfRange`] for a
    /// lit pixel without a value.
    pub fn average(&self, image: ArrayView2<f32>) -> Result<Array2<f32>, PlaneError> {
        let (rows, columns) = self.lit.dim();
        check_shape("image", "[row, column]", image.shape(), &[rows, columns])?;
        let mut means = Array2::zeros((rows, self.groups.len()));
        for ((row, group), mean) in means.indexed_iter_mut() {
            let pixels = self.groups[group].clone().filter(|&column| self.lit[[row, column]]);
            let sum: f64 = pixels.map(|column| f64::from(image[[row, column]])).sum();
            if !sum.is_finite() {
                return Err(PlaneError::OutOfRange {
                    field: "light of a lit pixel",
                    value: sum,
                    allowed: "finite: give pixels without a value no place either",
                });
            }
            *mean = (sum / self.cell(row, group).pixels.max(1) as f64) as f32;
        }
        Ok(means)
    }

    /// Number of camera rows.
    pub fn rows(&self) -> usize {
        self.lit.nrows()
    }

    /// Number of groups of columns, at most 12.
    pub fn groups(&self) -> usize {
        self.groups.len()
    }

    /// The projector rows nearest to the places of the image.
    pub fn seen_rows(&self) -> Range<usize> {
        let places = || self.cells.iter().filter(|cell| cell.pixels > 0).map(|cell| cell.place);
        let (first, last) = (places().fold(f64::MAX, f64::min), places().fold(0.0, f64::max));
        first.round().max(0.0) as usize..last.round() as usize + 1
    }

    pub(super) fn cell(&self, row: usize, group: usize) -> &Cell {
        &self.cells[row * self.groups.len() + group]
    }

    /// Whether drawing at this row, or fraction of it, lights a camera row.
    #[inline]
    pub(super) fn reached(&self, row: usize, drawn: f64) -> bool {
        let (first, end) = self.reach[row];
        drawn > first && drawn < end
    }

    /// Mean place of a camera row's lit pixels, if it has any.
    pub(super) fn row_place(&self, row: usize) -> Option<f64> {
        let cells = || (0..self.groups()).map(|group| self.cell(row, group)).filter(|cell| cell.pixels > 0);
        let pixels: usize = cells().map(|cell| cell.pixels).sum();
        let sum: f64 = cells().map(|cell| cell.place * cell.pixels as f64).sum();
        (pixels > 0).then(|| sum / pixels as f64)
    }

    /// Mean of an averaged image over a camera row's lit pixels.
    pub(super) fn row_mean(&self, light: &Array2<f32>, row: usize) -> f64 {
        let (sum, pixels) = (0..self.groups()).fold((0.0, 0), |(sum, pixels), group| {
            let cell = self.cell(row, group);
            (sum + f64::from(light[[row, group]]) * cell.pixels as f64, pixels + cell.pixels)
        });
        sum / pixels as f64
    }

    /// The light of a cell when `drawn` rows (with a fraction) have been drawn.
    #[inline]
    pub(super) fn light_before(&self, row: usize, group: usize, drawn: f64) -> LightSent {
        let index = row * self.groups.len() + group;
        let cell = &self.cells[index];
        let steady = |sent: f64| LightSent { sent, sending: 0.0, sd: 0.0 };
        let from_first = drawn - cell.first_row as f64;
        if from_first <= 0.0 {
            return steady(0.0);
        }
        let (whole, drawn) = (from_first as usize, self.drawn_of(index));
        if whole >= cell.rows {
            return steady(drawn[cell.rows].before);
        }
        let (before, after) = (drawn[whole].before, drawn[whole + 1].before);
        let share = after - before;
        match self.part_sent(index, whole, from_first) {
            ..=0.0 => steady(before),
            1.0.. => steady(after),
            part => LightSent {
                sent: before + part * share,
                sending: share / cell.dwell,
                sd: share * cell.step_sd,
            },
        }
    }
}

impl Columns {
    /// The part of its light that a drawn row, of index `row` in the cell's response, has sent; below 0 before it begins,
    /// beyond 1 after its end.
    #[inline]
    fn part_sent(&self, index: usize, row: usize, from_first: f64) -> f64 {
        (from_first - row as f64 - self.drawn_of(index)[row].middle) / self.cells[index].dwell + 0.5
    }

    #[inline]
    fn drawn_of(&self, index: usize) -> &[DrawnRow] {
        &self.drawn[index * self.drawn_rows..][..self.drawn_rows]
    }

    /// What the light of a cell would have more, when `drawn` rows (with a fraction) have been drawn, if each of the
    /// pictures of its response were brighter by all of the cell's light. The sum of its shares stays 1.
    pub(super) fn errors_before(&self, row: usize, group: usize, drawn: f64) -> [f64; PICTURES] {
        let index = row * self.groups.len() + group;
        let cell = &self.cells[index];
        let first = cell.place.round() as i64 + i64::from(FIRST_RESPONSE_ROW) - cell.first_row;
        let sent = self.light_before(row, group, drawn).sent;
        let mut errors = [0.0; PICTURES];
        for (error, drawn_row) in errors.iter_mut().zip(first..).take(RESPONSE_ROWS) {
            let part = match usize::try_from(drawn_row) {
                Ok(drawn_row) if drawn_row < cell.rows => {
                    self.part_sent(index, drawn_row, drawn - cell.first_row as f64).clamp(0.0, 1.0)
                }
                _ => 0.0,
            };
            *error = part - sent;
        }
        // Rows that do not exist have no picture.
        let pictures = errors.iter().zip(self.picture_variances.row(index));
        errors[BLACK] =
            -pictures.filter(|(_, variance)| **variance > 0.0).map(|(error, _)| error).sum::<f64>();
        errors
    }

    /// The share that each pixel of a camera row has in the mean response of each group, `[group, column]`: responses are
    /// averaged over neighbouring columns before they are averaged over a group.
    pub(super) fn column_shares(&self, row: usize) -> Array2<f64> {
        let lit = self.lit.row(row);
        let mut shares = Array2::zeros((self.groups.len(), lit.len()));
        for (group, mut shares) in shares.outer_iter_mut().enumerate() {
            for column in self.groups[group].clone().filter(|&column| lit[column]) {
                let pairs =
                    column_pairs(column, lit.len()).filter(|pair| pair.iter().all(|&column| lit[column]));
                let near: Vec<usize> = std::iter::once(column).chain(pairs.flatten()).collect();
                let share = 1.0 / (near.len() * self.cell(row, group).pixels) as f64;
                near.into_iter().for_each(|column| shares[column] += share);
            }
        }
        shares
    }

    /// Image columns of a group.
    pub(super) fn columns_of(&self, group: usize) -> Range<usize> {
        self.groups[group].clone()
    }

    /// Mean variance of a single pixel of a cell in one of the pictures of its response, in squares of its light.
    pub(super) fn picture_variance(&self, row: usize, group: usize, picture: usize) -> f64 {
        self.picture_variances[[row * self.groups.len() + group, picture]]
    }
}

/// The response of one pixel, checked.
fn pixel_response(response: ArrayView1<f32>) -> Result<[f64; RESPONSE_ROWS], PlaneError> {
    let mut shares = [0.0; RESPONSE_ROWS];
    shares.iter_mut().zip(response).for_each(|(share, &given)| *share = f64::from(given));
    let sum: f64 = shares.iter().sum();
    match (sum - 1.0).abs() < 0.01 {
        true => Ok(shares),
        false => Err(PlaneError::OutOfRange {
            field: "sum of a lit pixel's response",
            value: sum,
            allowed: "1: divide each response by its sum, and mark pixels without one as unlit",
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::Estimate;
    use super::super::super::images::{Phases, RowPlaces, SensorNoise, WhiteMap};
    use super::*;

    const ROWS: usize = 25;
    /// A camera row that has all 21 rows over which responses are averaged.
    const ROW: usize = 12;
    const WHITE_DN: f32 = 1000.0;

    /// Responses of a board that is unlit in some columns, one pixel of which sees `more` of its light from its own row.
    fn responses(columns: usize, unlit: &[usize], (bright, more): (usize, f32)) -> Responses {
        let is_lit = |s: usize| !unlit.contains(&s);
        let place = Array2::from_shape_fn((ROWS, columns), |(t, s)| match is_lit(s) {
            true => 100.0 + t as f32,
            false => f32::NAN,
        });
        let mut images = ndarray::Array3::zeros((16, ROWS, columns));
        for (t, s) in ndarray::indices((ROWS, columns)).into_iter().filter(|&(_, s)| is_lit(s)) {
            for (d, share) in [(0, 0.25), (1, 0.5), (2, 0.25)] {
                images[[(99 + t + d) % 16, t, s]] = share * WHITE_DN;
            }
        }
        images[[(100 + ROW) % 16, ROW, bright]] += more * WHITE_DN;
        let white = WhiteMap {
            white_dn: Array2::from_elem((ROWS, columns), WHITE_DN),
            sd_dn: Array2::zeros((ROWS, columns)),
            noise: SensorNoise { electrons_per_dn: 1.0, read_noise_e: 1.0 },
            black_frames: 1,
            level_dn: Estimate { value: f64::from(WHITE_DN), sd: 0.0 },
            coverage: 1.0,
            saturated: 0.0,
        };
        let places = RowPlaces { place, rms: 0.0, misread: 0.0 };
        Responses::new(&Phases { images: images.view(), frames: 1 }, &white, &places, 720).unwrap()
    }

    #[test]
    fn shares_of_columns_are_those_with_which_responses_are_averaged() {
        const MORE: f32 = 0.1;
        let own = (-FIRST_RESPONSE_ROW) as usize;
        for (columns, unlit) in
            [(1, &[][..]), (2, &[]), (13, &[]), (13, &[0, 1, 6]), (40, &[]), (40, &[3, 11, 12, 39])]
        {
            let plain = responses(columns, unlit, (0, 0.0));
            let groups = Columns::new(plain.place.view(), plain.response.view(), None).unwrap();
            let shares = groups.column_shares(ROW);
            for bright in (0..columns).filter(|s| !unlit.contains(s)) {
                let changed = responses(columns, unlit, (bright, MORE));
                for group in (0..groups.groups()).filter(|&group| groups.cell(ROW, group).pixels > 0) {
                    let lit = groups.columns_of(group).filter(|s| !unlit.contains(s));
                    let sum: f32 =
                        lit.map(|s| changed.response[[own, ROW, s]] - plain.response[[own, ROW, s]]).sum();
                    // The mean over 21 rows; half of what one row's share gains is lost when they are made to sum to 1.
                    let share = f64::from(sum / MORE * 21.0 / 0.5) / groups.cell(ROW, group).pixels as f64;
                    let stated = shares[[group, bright]];
                    assert!(
                        (share - stated).abs() < 0.01 * stated + 1e-3,
                        "{columns} {unlit:?} {group} {bright}: {share} {stated}"
                    );
                }
            }
            let lit = shares.rows().into_iter().map(|shares| shares.sum()).filter(|sum| *sum > 0.0);
            assert!(lit.into_iter().all(|sum| (sum - 1.0).abs() < 1e-12), "{columns} {unlit:?}");
        }
    }
}
