//! How far camera rows are off projector rows.

use ndarray::{Array2, Array3, Axis, s};
use raysweep_core::Pattern;
use raysweep_transport::plane::board::images::{CodedPictures, ImagesError, Phases, locate_rows};

/// Number of pictures of sparse rows, and the distance of their rows.
const PHASES: usize = 16;
/// Rows with the same Gray code.
const ROWS_PER_BLOCK: usize = 8;
/// A pixel is lit if white raises it by more than this share of the bright pixels' rise.
const LIT: f32 = 0.2;
/// The bright pixels are those above this share of all.
const BRIGHT: f64 = 0.9;
/// Less than this is aligned, in rows.
const ALIGNED_ROWS: f64 = 0.1;

/// The pictures that tell which projector row each pixel sees: white, black, sparse rows and the rows' Gray code.
#[derive(Debug, Clone)]
pub struct AlignPictures {
    projector_rows: usize,
    patterns: Vec<Pattern>,
    /// One image of each, `[picture, t, s]`.
    images: Array3<f32>,
    taken: usize,
}

impl AlignPictures {
    /// The pictures for a projector, seen by a camera of this size (rows, columns).
    pub fn new(projector_rows: usize, size: (usize, usize)) -> Self {
        let blocks = projector_rows.div_ceil(ROWS_PER_BLOCK).max(2);
        let bits = usize::BITS - (blocks - 1).leading_zeros();
        let sparse = (0..PHASES).map(|phase| Pattern::SparseRows { phase, period: PHASES });
        let codes = (0..bits).rev().flat_map(|bit| {
            [false, true].map(|inverse| Pattern::GrayRows { bit, inverse, block: ROWS_PER_BLOCK })
        });
        let patterns: Vec<Pattern> =
            [Pattern::White, Pattern::Black].into_iter().chain(sparse).chain(codes).collect();
        let images = Array3::zeros((patterns.len(), size.0, size.1));
        Self { projector_rows, patterns, images, taken: 0 }
    }

    /// The picture to show next.
    pub fn next(&self) -> &Pattern {
        &self.patterns[self.taken]
    }

    /// Whether the next picture is white, which alone looks like the subject.
    pub fn next_is_white(&self) -> bool {
        self.taken == 0
    }

    /// Takes the image of the next picture. After the last, what all of them say of the rows; then they begin anew.
    pub fn add(&mut self, image: &Array2<u16>) -> Option<Result<SeenRows, ImagesError>> {
        self.images.index_axis_mut(Axis(0), self.taken).assign(&image.mapv(f32::from));
        self.taken = (self.taken + 1) % self.patterns.len();
        (self.taken == 0).then(|| self.rows())
    }

    /// Begins with the first picture again.
    pub fn restart(&mut self) {
        self.taken = 0;
    }

    fn rows(&self) -> Result<SeenRows, ImagesError> {
        let black = self.images.index_axis(Axis(0), 1);
        let rise = &self.images.index_axis(Axis(0), 0) - &black;
        let mut sorted: Vec<f32> = rise.iter().copied().collect();
        let at = ((sorted.len() - 1) as f64 * BRIGHT) as usize;
        let bright = *sorted.select_nth_unstable_by(at, f32::total_cmp).1;
        let lit = rise.mapv(|rise| bright > 0.0 && rise > LIT * bright);
        let sparse = &self.images.slice(s![2..2 + PHASES, .., ..]) - &black;
        let phases = Phases { images: sparse.view(), frames: 1 };
        let code = CodedPictures {
            images: self.images.slice(s![2 + PHASES.., .., ..]),
            lines_per_block: ROWS_PER_BLOCK,
        };
        let found = locate_rows(&phases, &code, lit.view(), self.projector_rows)?;
        Ok(SeenRows { place: found.place })
    }
}

/// The projector row that each pixel sees.
#[derive(Debug, Clone)]
pub struct SeenRows {
    /// Place on the scale of the projector's rows, `[t, s]`; NaN where it is not known.
    pub place: Array2<f32>,
}

/// How far camera rows are off the projector rows that the rig file says they see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alignment {
    /// Projector rows by which the middle of the image looks further down.
    pub shift_rows: f64,
    /// Angle by which camera rows run down the projector's from left to right.
    pub rotation_deg: f64,
    /// Factor on the projector rows between camera rows.
    pub magnification: f64,
    /// The largest distance of a pixel from its stated row.
    pub worst_rows: f64,
    /// Root mean square of what shift, rotation and magnification do not explain: distortion and keystone.
    pub residual_rows: f64,
}

impl SeenRows {
    /// The alignment against a camera whose row 0 should see `first_row`, and each further row `row_pitch` rows more;
    /// `None` if too little is known of the places.
    pub fn alignment(&self, first_row: usize, row_pitch: f64) -> Option<Alignment> {
        let (rows, columns) = self.place.dim();
        let middle = ((rows as f64 - 1.0) / 2.0, (columns as f64 - 1.0) / 2.0);
        let known: Vec<[f64; 3]> = self
            .place
            .indexed_iter()
            .filter(|(_, place)| place.is_finite())
            .map(|((t, s), &place)| {
                let stated = first_row as f64 + row_pitch * t as f64;
                [t as f64 - middle.0, s as f64 - middle.1, f64::from(place) - stated]
            })
            .collect();
        let count = known.len() as f64;
        let mean = |of: &dyn Fn(&[f64; 3]) -> f64| known.iter().map(of).sum::<f64>() / count;
        let [mean_t, mean_s, mean_off] = [0, 1, 2].map(|axis| mean(&|point| point[axis]));
        let product = |a: usize, b: usize| mean(&|point| point[a] * point[b]);
        let means = [mean_t, mean_s, mean_off];
        let cov = |a: usize, b: usize| product(a, b) - means[a] * means[b];
        let determinant = cov(0, 0) * cov(1, 1) - cov(0, 1).powi(2);
        // A single row or column of pixels tells no rotation or magnification.
        if !determinant.is_finite() || determinant <= 1e-9 * (cov(0, 0) + cov(1, 1)).powi(2) {
            return None;
        }
        let down = (cov(0, 2) * cov(1, 1) - cov(1, 2) * cov(0, 1)) / determinant;
        let right = (cov(1, 2) * cov(0, 0) - cov(0, 2) * cov(0, 1)) / determinant;
        let shift_rows = mean_off - down * mean_t - right * mean_s;
        let rest = |[t, s, off]: &[f64; 3]| off - shift_rows - down * t - right * s;
        Some(Alignment {
            shift_rows,
            rotation_deg: (right / row_pitch).atan().to_degrees(),
            magnification: 1.0 + down / row_pitch,
            worst_rows: known.iter().map(|point| point[2].abs()).fold(0.0, f64::max),
            residual_rows: mean(&|point| rest(point).powi(2)).sqrt(),
        })
    }
}

impl Alignment {
    /// What to turn, one sentence each, for a camera of this size (rows, columns); nothing if all is well.
    pub fn advice(&self, size: (usize, usize), first_row: usize, row_pitch: f64) -> Vec<String> {
        let &Self { shift_rows, rotation_deg, magnification, residual_rows, .. } = self;
        let mut advice = Vec::new();
        let at_sides = rotation_deg.to_radians().tan().abs() * row_pitch * size.1 as f64 / 2.0;
        if at_sides > ALIGNED_ROWS {
            let turn = if rotation_deg > 0.0 { "counter-clockwise" } else { "clockwise" };
            advice.push(format!(
                "turn the camera {turn} by {:.2} degrees, seen from behind it: its rows are off by {at_sides:.1} rows at the sides",
                rotation_deg.abs()
            ));
        }
        let at_ends = (magnification - 1.0).abs() * row_pitch * size.0 as f64 / 2.0;
        if at_ends > ALIGNED_ROWS {
            let zoom = if magnification > 1.0 { "in, or move it closer" } else { "out, or move it away" };
            advice.push(format!(
                "zoom the camera {zoom}, by {:.2} %, or set camera.row_pitch = {:.4}: its rows are off by {at_ends:.1} rows at top and bottom",
                100.0 * (magnification - 1.0).abs(),
                row_pitch * magnification
            ));
        }
        if shift_rows.abs() > ALIGNED_ROWS {
            let tilt = if shift_rows > 0.0 { "up" } else { "down" };
            let whole = (first_row as f64 + shift_rows).round();
            let set = match whole >= 0.0 && whole != first_row as f64 {
                true => format!(", or set camera.first_projector_row = {whole}"),
                false => String::new(),
            };
            let off = if shift_rows > 0.0 { "further down" } else { "further up" };
            advice.push(format!(
                "tilt the camera {tilt}{set}: it looks {:.2} projector rows {off} than the rig file says",
                shift_rows.abs()
            ));
        }
        if residual_rows > ALIGNED_ROWS {
            advice.push(format!(
                "{residual_rows:.2} rows remain that no turning removes: switch off the projector's keystone correction and scaling, and set camera and projector parallel; a calibration takes account of the rest"
            ));
        }
        advice
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_of_places_gives_shift_rotation_and_magnification() {
        let (first_row, pitch) = (100, 1.5);
        let place = |t: usize, s: usize| {
            let (down, right) = (t as f64 - 19.5, s as f64 - 29.5);
            let of_rotation = 0.3_f64.to_radians().tan() * right * pitch;
            100.0 + 1.5 * t as f64 + 2.25 + of_rotation + 0.02 * down * pitch
        };
        let mut rows = SeenRows { place: Array2::from_shape_fn((40, 60), |(t, s)| place(t, s) as f32) };
        // A part of the picture is not lit.
        rows.place.slice_mut(s![..10, 40..]).fill(f32::NAN);
        let found = rows.alignment(first_row, pitch).unwrap();
        assert!((found.shift_rows - 2.25).abs() < 1e-3 && (found.rotation_deg - 0.3).abs() < 1e-3);
        assert!((found.magnification - 1.02).abs() < 1e-4 && found.residual_rows < 1e-3, "{found:?}");
        let corner = place(39, 59) - (100.0 + 1.5 * 39.0);
        assert!((found.worst_rows - corner).abs() < 1e-3, "{found:?}");
        let advice = found.advice((40, 60), first_row, pitch).join("\n");
        for told in ["counter-clockwise by 0.30", "in, or move it closer", "row_pitch = 1.53", "row = 102"] {
            assert!(advice.contains(told), "{told} in {advice}");
        }
        let aligned = Alignment {
            shift_rows: 0.05,
            rotation_deg: 0.0,
            magnification: 1.0,
            worst_rows: 0.05,
            residual_rows: 0.02,
        };
        assert!(aligned.advice((40, 60), first_row, pitch).is_empty());
        rows.place.slice_mut(s![.., 1..]).fill(f32::NAN);
        assert_eq!(rows.alignment(first_row, pitch), None, "one column");
    }
}
