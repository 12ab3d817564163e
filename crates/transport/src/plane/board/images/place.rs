use ndarray::{Array2, ArrayView2, ArrayView3, Axis, s};
use rayon::prelude::*;

use super::smooth::{SmoothMap, SmoothPoint};
use super::{ImagesError, check_frames, check_range, check_shape};

/// Number of pictures in which every 16th line is lit.
pub(super) const PHASES: usize = 16;
/// The centre of gravity includes this many lines on either side of the brightest.
const REACH: usize = 3;
/// Largest accepted difference of places from a smooth map.
const MOST_RMS: f64 = 0.1;
/// Points beyond this many lines from the smooth map are misread and not counted in its difference.
const MISREAD_LINES: f64 = 2.0;
/// Largest accepted difference of the middles of blocks from a smooth map, in blocks: 0.29 where all is well.
const MOST_BLOCK_RMS: f64 = 0.5;
/// Largest number of points for the smooth map.
const MAX_POINTS: usize = 60_000;
/// Fewest points for the smooth map.
const MIN_POINTS: usize = 200;

/// Images of the 16 pictures in which every 16th row (or column) of the projector is lit: picture `m` has rows `m`,
/// `m + 16`, and so on.
#[derive(Debug, Clone, Copy)]
pub struct Phases<'a> {
    /// Mean image of each picture, black picture subtracted, `[16, t, s]`.
    pub images: ArrayView3<'a, f32>,
    /// Number of frames in each mean.
    pub frames: usize,
}

/// Images of the Gray code of `floor(line / lines_per_block)`.
#[derive(Debug, Clone, Copy)]
pub struct CodedPictures<'a> {
    /// Each picture and then its inverse, the highest bit first, `[2 bits, t, s]`.
    pub images: ArrayView3<'a, f32>,
    /// Lines with the same code: at most 16.
    pub lines_per_block: usize,
}

/// Which line of the projector each pixel sees.
#[derive(Debug, Clone, PartialEq)]
pub struct RowPlaces {
    /// Position on the scale of the projector's lines by the smooth map, `[t, s]`; NaN where the pixel is not lit or
    /// lies outside the projector's picture.
    pub place: Array2<f32>,
    /// Root mean square of the difference of single pixels from the smooth map, misread pixels excluded.
    pub rms: f64,
    /// Share of the pixels whose code was misread.
    pub misread: f64,
}

/// Places in projector rows: brightest picture and Gray code give the row, the centre of gravity of 7 rows about it
/// the pixel's own place, and a robust polynomial over the image the result. Only pixels in `lit` take part.
///
/// # Errors
/// [`ImagesError::NotSmooth`] if the pixels' own places differ from the polynomial by more than 0.1 row;
/// [`ImagesError::TooFew`] lit pixels; [`ImagesError::Shape`]; [`ImagesError::OutOfRange`] for a code that does not
/// reach all rows or has blocks of more than 16.
pub fn locate_rows(
    phases: &Phases,
    code: &CodedPictures,
    lit: ArrayView2<bool>,
    projector_rows: usize,
) -> Result<RowPlaces, ImagesError> {
    locate(phases, code, lit, projector_rows, "row")
}

/// The projector column that each pixel sees, `[t, s]` in 0..=1 over the projector's width, from a Gray code over
/// columns alone: a smooth map through the middles of the blocks that pixels in `lit` see, good to a fifth of a block.
/// NaN where unlit.
///
/// # Errors
/// [`ImagesError::NotSmooth`] if pixels see blocks that differ from the map by more than half a block (rms);
/// [`ImagesError::TooFew`] lit pixels; [`ImagesError::Shape`]; [`ImagesError::OutOfRange`] for a code that does not
/// reach all columns.
pub fn locate_columns(
    code: &CodedPictures,
    lit: ArrayView2<bool>,
    projector_columns: usize,
) -> Result<Array2<f32>, ImagesError> {
    check_code(code, lit.dim(), projector_columns)?;
    let block_columns = code.lines_per_block as f64;
    let points: Vec<SmoothPoint> = lit
        .indexed_iter()
        .filter(|(_, lit)| **lit)
        .map(|((t, s), _)| SmoothPoint { t, s, value: (block(code, t, s) as f64 + 0.5) * block_columns })
        .collect();
    let map = smooth(lit.dim(), &points)?;
    let residuals = points.iter().map(|point| (point.value - map.at(point.t, point.s)) / block_columns);
    // A misread block counts, but no more than one that is two off.
    let squares: f64 = residuals.map(|residual| residual.abs().min(2.0).powi(2)).sum();
    let rms = (squares / points.len() as f64).sqrt();
    if rms > MOST_BLOCK_RMS {
        return Err(ImagesError::NotSmooth { lines: "block of columns", rms, limit: MOST_BLOCK_RMS });
    }
    let mut columns = map.image();
    columns.zip_mut_with(&lit, |column, lit| {
        let share = *column / projector_columns as f32;
        *column = if *lit { share.clamp(0.0, 1.0) } else { f32::NAN };
    });
    Ok(columns)
}

fn locate(
    phases: &Phases,
    code: &CodedPictures,
    lit: ArrayView2<bool>,
    lines: usize,
    name: &'static str,
) -> Result<RowPlaces, ImagesError> {
    check(phases, code, lit, lines)?;
    let shape = lit.dim();
    let mut points: Vec<SmoothPoint> = (0..shape.0)
        .into_par_iter()
        .flat_map_iter(|t| {
            (0..shape.1).filter(move |&s| lit[[t, s]]).filter_map(move |s| {
                let value = own_place(phases, code, lines, t, s)?;
                Some(SmoothPoint { t, s, value })
            })
        })
        .collect();
    // Where the code changes, it may be read one block off, and the place is then wrong by 16 lines.
    let first = smooth(shape, &points)?;
    let mut misread = 0;
    for point in &mut points {
        let turns = ((point.value - first.at(point.t, point.s)) / PHASES as f64).round();
        point.value -= turns * PHASES as f64;
        misread += usize::from(turns != 0.0);
    }
    let map = smooth(shape, &points)?;
    let mut squares = Vec::with_capacity(points.len());
    for point in &points {
        let residual = point.value - map.at(point.t, point.s);
        match residual.abs() < MISREAD_LINES {
            true => squares.push(residual * residual),
            false => misread += 1,
        }
    }
    let rms = (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
    let misread = misread as f64 / points.len() as f64;
    if squares.is_empty() || rms > MOST_RMS {
        return Err(ImagesError::NotSmooth { lines: name, rms, limit: MOST_RMS });
    }
    let mut place = map.image();
    let inside = -0.5..lines as f32 - 0.5;
    ndarray::Zip::from(&mut place).and(&lit).for_each(|place, &lit| {
        if !lit || !inside.contains(place) {
            *place = f32::NAN;
        }
    });
    Ok(RowPlaces { place, rms, misread })
}

/// The smooth map through points.
fn smooth(shape: (usize, usize), points: &[SmoothPoint]) -> Result<SmoothMap, ImagesError> {
    let too_few = |given| ImagesError::TooFew {
        what: "lit pixels whose line can be read",
        given,
        needed: MIN_POINTS,
        cure: "fill the view with the board, and check that the pictures are shown in their order",
    };
    if points.len() < MIN_POINTS {
        return Err(too_few(points.len()));
    }
    // An odd step, so that the points do not lie in a few columns only.
    let step = (points.len() / MAX_POINTS) | 1;
    let few: Vec<SmoothPoint> = points.iter().copied().step_by(step).collect();
    SmoothMap::fit(shape, &few).ok_or_else(|| too_few(few.len()))
}

fn check(
    phases: &Phases,
    code: &CodedPictures,
    lit: ArrayView2<bool>,
    lines: usize,
) -> Result<(), ImagesError> {
    let (rows, columns) = lit.dim();
    check_frames(phases.frames, 1)?;
    check_shape("phases", "[pictures, t, s]", phases.images.shape(), &[PHASES, rows, columns])?;
    check_code(code, lit.dim(), lines)
}

fn check_code(
    code: &CodedPictures,
    (rows, columns): (usize, usize),
    lines: usize,
) -> Result<(), ImagesError> {
    let pictures = code.images.len_of(Axis(0));
    check_shape("code", "[pictures and inverses, t, s]", code.images.shape(), &[pictures, rows, columns])?;
    let block = code.lines_per_block;
    let accepted = (1..=PHASES).contains(&block);
    check_range(
        "lines_per_block",
        block as f64,
        accepted,
        "1 to 16: the pictures of every 16th line tell the rest",
    )?;
    let blocks = lines.div_ceil(block);
    let enough = pictures.is_multiple_of(2) && pictures < 64 && 1 << (pictures / 2) >= blocks;
    let allowed = "a picture and its inverse for each bit of the number of blocks: take 7 bits, 14 pictures";
    check_range("number of coded pictures", pictures as f64, enough, allowed)
}

/// A pixel's own place: the centre of gravity about its brightest line. `None` if the line does not exist, or lies so
/// close to the border of the picture that part of the light is missing.
fn own_place(phases: &Phases, code: &CodedPictures, lines: usize, t: usize, column: usize) -> Option<f64> {
    let light = phases.images.slice(s![.., t, column]);
    let brightest = (0..PHASES).max_by(|&a, &b| light[a].total_cmp(&light[b]))?;
    let size = code.lines_per_block as f64;
    let centre = block(code, t, column) as f64 * size + (size - 1.0) / 2.0;
    let line = brightest as f64 + PHASES as f64 * ((centre - brightest as f64) / PHASES as f64).round();
    let complete = (REACH + 1) as f64..=lines as f64 - (REACH + 2) as f64;
    if !complete.contains(&line) {
        return None;
    }
    let [mut sum, mut moment] = [0.0; 2];
    for step in 0..=2 * REACH {
        let counts = f64::from(light[(brightest + PHASES + step - REACH) % PHASES]);
        sum += counts;
        moment += counts * (step as f64 - REACH as f64);
    }
    (sum > 0.0).then(|| line + moment / sum)
}

/// The number of the block of lines that a pixel sees.
fn block(code: &CodedPictures, t: usize, column: usize) -> usize {
    let of_code = code.images.slice(s![.., t, column]);
    (0..of_code.len() / 2).fold(0, |block, bit| {
        let lit = usize::from(of_code[2 * bit] > of_code[2 * bit + 1]);
        2 * block + (lit ^ (block & 1))
    })
}
