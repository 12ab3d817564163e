use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use super::robust::{reweighted, spread_of};
use crate::dots::DotsError;
use crate::dots::error::check_range;
use crate::dots::sensor::median;

/// Least distance between the images of a dot on the two planes, in standard deviations of a dot's distance from its
/// epipolar line. On a single plane both are noise, and the ratio is about 1.
pub const LEAST_PARALLAX: f64 = 4.0;

/// Fewest dots that show a robust fit which of them are outliers.
const FEWEST_DOTS: usize = 8;

/// Epipoles, each from two dots, among which the robust fit begins.
const CANDIDATES: usize = 512;

/// The epipolar geometry of mirror and camera: `m' F c = 0` for every point lit by a dot, at any depth. A dot's
/// direction `m` is given by its place on the first calibration plane, in the camera's pixels, so that `F = [e]x`
/// with the epipole `e`: neither the mirror's angles nor its tracking need to be known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fundamental {
    matrix: Matrix3<f64>,
}

/// An epipolar geometry with what is known of its quality.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpipolarFit {
    /// The geometry.
    pub fundamental: Fundamental,
    /// Dots that both planes show.
    pub dots: usize,
    /// Those among them that the fit leaves out, because they lie far from their lines.
    pub outliers: usize,
    /// Standard deviation of the distance of the other dots from their lines on the second plane, in pixels.
    pub sd_px: f64,
    /// Median distance between a dot's places on the two planes, in pixels.
    pub parallax_px: f64,
}

/// A dot's places on the two planes, homogeneous and normalised, and the line through them.
struct Pair {
    first: Vector3<f64>,
    second: Vector3<f64>,
    line: Vector3<f64>,
}

impl Pair {
    /// Distance of the dot on the second plane from the line that joins its place on the first to the epipole.
    fn distance(&self, epipole: &Vector3<f64>) -> f64 {
        let line = epipole.cross(&self.first);
        let length = line.x.hypot(line.y);
        if length > 0.0 { line.dot(&self.second) / length } else { 0.0 }
    }
}

impl Fundamental {
    /// Finds the epipole, the only two unknowns, from the places of the dots on the two planes, in pixels (column,
    /// row): the lines through the two places of each dot meet in it. Dots far from their lines are left out (Tukey's
    /// biweight, from the best of many epipoles of two dots each).
    ///
    /// # Errors
    /// [`DotsError::TooFew`] below eight dots on both planes, [`DotsError::OutOfRange`] for places that are not finite,
    /// [`DotsError::Planar`] if the planes do not differ in depth by more than the noise.
    pub fn from_planes(
        first: &[Option<[f64; 2]>],
        second: &[Option<[f64; 2]>],
    ) -> Result<EpipolarFit, DotsError> {
        let both: Vec<([f64; 2], [f64; 2])> =
            first.iter().zip(second).filter_map(|(first, second)| Some(((*first)?, (*second)?))).collect();
        if both.len() < FEWEST_DOTS {
            let what = "dots seen on both calibration planes, for the epipolar geometry: scan more dots, or see that the planes fill the field";
            return Err(DotsError::TooFew { what, given: both.len(), needed: FEWEST_DOTS });
        }
        for value in both.iter().flat_map(|(first, second)| [first, second]).flatten() {
            check_range(
                "place of a dot",
                *value,
                value.is_finite(),
                "finite: leave out dots that were not seen",
            )?;
        }
        let to_unit = normalising(both.iter().flat_map(|&(first, second)| [first, second]));
        let scale_px = 1.0 / to_unit[(0, 0)];
        let pairs: Vec<Pair> = both
            .iter()
            .map(|&(first, second)| {
                let [first, second] = [first, second].map(|[x, y]| to_unit * Vector3::new(x, y, 1.0));
                Pair { first, second, line: first.cross(&second) }
            })
            .collect();
        let begin = best_candidate(&pairs);
        let (epipole, weights) = reweighted(
            begin,
            |epipole, distances| {
                distances.clear();
                distances.extend(pairs.iter().map(|pair| pair.distance(epipole)));
            },
            |epipole, weights| fitted(&pairs, epipole, weights),
        );
        let kept = pairs.iter().zip(&weights).filter(|(_, weight)| **weight > 0.0);
        let distances: Vec<f64> = kept.map(|(pair, _)| pair.distance(&epipole)).collect();
        let squares: f64 = distances.iter().map(|distance| distance * distance).sum();
        let sd_px = scale_px * (squares / distances.len().saturating_sub(2).max(1) as f64).sqrt();
        let mut shifts: Vec<f64> =
            both.iter().map(|(first, second)| (first[0] - second[0]).hypot(first[1] - second[1])).collect();
        let parallax_px = median(&mut shifts);
        if parallax_px <= LEAST_PARALLAX * sd_px {
            return Err(DotsError::Planar { parallax_px, sd_px });
        }
        let matrix = to_unit.transpose() * epipole.cross_matrix() * to_unit;
        Ok(EpipolarFit {
            fundamental: Self { matrix: matrix / matrix.norm() },
            dots: both.len(),
            outliers: both.len() - distances.len(),
            sd_px,
            parallax_px,
        })
    }

    /// From its nine entries, row by row, for example from a file.
    pub fn from_rows(rows: [[f64; 3]; 3]) -> Self {
        Self { matrix: Matrix3::from_fn(|row, column| rows[row][column]) }
    }

    /// Its nine entries, row by row.
    pub fn rows(&self) -> [[f64; 3]; 3] {
        std::array::from_fn(|row| std::array::from_fn(|column| self.matrix[(row, column)]))
    }

    /// The line `(l1, l2, l3)` in the camera's image that contains everything lit directly by the dot.
    pub fn epipolar_line(&self, place: [f64; 2]) -> [f64; 3] {
        let line = self.matrix.transpose() * Vector3::new(place[0], place[1], 1.0);
        [line[0], line[1], line[2]]
    }

    /// The intersection of all these lines, which is the mirror's image in the camera, as homogeneous coordinates of
    /// length 1.
    pub fn epipole(&self) -> [f64; 3] {
        let svd = self.matrix.svd(false, true);
        let last = svd.v_t.map_or_else(Vector3::zeros, |v_t| v_t.row(2).transpose());
        [last[0], last[1], last[2]]
    }
}

/// The epipole with the smallest median distance, among those of pairs of dots that lie apart in the scan.
fn best_candidate(pairs: &[Pair]) -> Vector3<f64> {
    let count = pairs.len();
    let step = count.div_ceil(CANDIDATES);
    let mut best = (f64::INFINITY, Vector3::z());
    let mut distances = Vec::with_capacity(count);
    for dot in (0..count).step_by(step) {
        // A third of the scan away, so that their lines differ.
        let crossing = pairs[dot].line.cross(&pairs[(dot + count / 3 + 1) % count].line);
        if crossing.norm() < f64::MIN_POSITIVE {
            continue;
        }
        let epipole = crossing.normalize();
        distances.clear();
        distances.extend(pairs.iter().map(|pair| pair.distance(&epipole)));
        let spread = spread_of(&mut distances);
        if spread < best.0 {
            best = (spread, epipole);
        }
    }
    best.1
}

/// The epipole nearest to all weighted lines, with distances measured as from `earlier`.
fn fitted(pairs: &[Pair], earlier: &Vector3<f64>, weights: &[f64]) -> Vector3<f64> {
    let mut system = Matrix3::zeros();
    for (pair, weight) in pairs.iter().zip(weights) {
        let line = earlier.cross(&pair.first);
        let square = line.x * line.x + line.y * line.y;
        if square > 0.0 {
            system += pair.line * pair.line.transpose() * (*weight / square);
        }
    }
    let eigen = SymmetricEigen::new(system);
    let least = eigen.eigenvalues.imin();
    eigen.eigenvectors.column(least).into_owned()
}

/// Moves the points' centroid to 0 and scales their mean distance from it to the square root of 2.
pub(super) fn normalising(points: impl Iterator<Item = [f64; 2]> + Clone) -> Matrix3<f64> {
    let count = points.clone().count() as f64;
    let (x, y) =
        points.clone().fold((0.0, 0.0), |(x, y), point| (x + point[0] / count, y + point[1] / count));
    let distance: f64 = points.map(|point| (point[0] - x).hypot(point[1] - y) / count).sum();
    let scale = std::f64::consts::SQRT_2 / distance.max(f64::MIN_POSITIVE);
    Matrix3::new(scale, 0.0, -scale * x, 0.0, scale, -scale * y, 0.0, 0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use rand_distr::{Distribution, Normal, Uniform};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::SeedableRng;

    use super::*;

    /// Dots of a mirror beside a camera with 1024 pixels, on a plane at this distance, with noisy places. The plane is
    /// tilted, as no lab's is perpendicular.
    fn plane(distance: f64, noise_px: f64, seed: u64) -> Vec<Option<[f64; 2]>> {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let noise = Normal::new(0.0, noise_px).unwrap();
        let grid = (0..16).flat_map(|down| (0..16).map(move |right| [right, down]));
        grid.map(|dot| {
            let [x, y] = dot.map(|step| (f64::from(step) - 7.5) * 0.01);
            let z = distance / (1.0 + 0.2 * x - 0.1 * y);
            Some(seen([x * z, y * z, z]).map(|pixel| pixel + noise.sample(&mut random)))
        })
        .collect()
    }

    /// A point in the mirror's coordinates, projected to the camera's pixels: 15 units to the side, turned by 0.15.
    fn seen([x, y, z]: [f64; 3]) -> [f64; 2] {
        let (sin, cos) = 0.15_f64.sin_cos();
        let (x, z) = (x - 15.0, z);
        let (x, y, z) = (cos * x + sin * z, y - 3.0, cos * z - sin * x);
        [512.0 + 5000.0 * x / z, 512.0 + 5000.0 * y / z]
    }

    fn distance_px(fundamental: &Fundamental, place: [f64; 2], [x, y]: [f64; 2]) -> f64 {
        let [l1, l2, l3] = fundamental.epipolar_line(place);
        (l1 * x + l2 * y + l3).abs() / l1.hypot(l2)
    }

    /// Largest distance of points at other depths from the lines of the dots' true places.
    fn worst_px(fundamental: &Fundamental) -> f64 {
        let first = plane(95.0, 0.0, 1);
        let distances = [90.0, 100.0, 120.0].into_iter().flat_map(|depth| {
            let points = plane(depth, 0.0, 1);
            let of_first = first.clone();
            of_first.into_iter().flatten().zip(points.into_iter().flatten()).collect::<Vec<_>>()
        });
        distances.map(|(place, point)| distance_px(fundamental, place, point)).fold(0.0, f64::max)
    }

    #[test]
    fn two_planes_give_the_lines_of_points_between_and_the_epipole() {
        let fit = Fundamental::from_planes(&plane(95.0, 0.1, 3), &plane(110.0, 0.1, 4)).unwrap();
        assert!(worst_px(&fit.fundamental) < 0.3, "{}", worst_px(&fit.fundamental));
        assert_eq!((fit.dots, fit.outliers), (256, 0));
        // The distance from a line has the noise of the second place, and nearly that of the first.
        assert!((0.12..0.16).contains(&fit.sd_px), "{}", fit.sd_px);
        let [x, y, w] = fit.fundamental.epipole();
        let expected = seen([0.0, 0.0, 0.0]);
        let error = (x / w - expected[0]).hypot(y / w - expected[1]) / expected[0].hypot(expected[1]);
        assert!(error < 0.05, "{:?} {expected:?}", [x / w, y / w]);
    }

    #[test]
    fn dots_of_noise_alone_do_not_move_the_lines() {
        let (mut first, mut second) = (plane(95.0, 0.1, 3), plane(110.0, 0.1, 4));
        let mut random = Xoshiro256PlusPlus::seed_from_u64(5);
        let anywhere = Uniform::new(0.0, 1024.0).unwrap();
        let mut noise = || Some([anywhere.sample(&mut random), anywhere.sample(&mut random)]);
        for dot in (0..256).step_by(4) {
            (first[dot], second[dot]) = (noise(), noise());
        }
        second[2] = None;
        let fit = Fundamental::from_planes(&first, &second).unwrap();
        assert!(worst_px(&fit.fundamental) < 0.4, "{}", worst_px(&fit.fundamental));
        assert_eq!(fit.dots, 255);
        assert!((55..=66).contains(&fit.outliers), "{}", fit.outliers);
    }

    #[test]
    fn noise_does_not_pass_for_depth_nor_depth_for_noise() {
        for noise_px in [0.02, 0.1, 0.5] {
            let refused = Fundamental::from_planes(&plane(100.0, noise_px, 3), &plane(100.0, noise_px, 4));
            assert!(matches!(refused, Err(DotsError::Planar { .. })), "{noise_px}: {refused:?}");
            assert!(Fundamental::from_planes(&plane(95.0, noise_px, 3), &plane(110.0, noise_px, 4)).is_ok());
        }
        let same = plane(100.0, 0.0, 3);
        assert!(matches!(Fundamental::from_planes(&same, &same), Err(DotsError::Planar { .. })));
        assert!(matches!(
            Fundamental::from_planes(&same[..7], &plane(110.0, 0.0, 4)[..7]),
            Err(DotsError::TooFew { given: 7, .. })
        ));
    }
}
