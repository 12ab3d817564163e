use nalgebra::{Dyn, Matrix3, OMatrix, U9, Vector3};

use crate::dots::DotsError;
use crate::dots::error::check_range;

/// Smallest accepted ratio of the seventh singular value of the eight-point system to the first. Correspondences on
/// one plane determine six of the nine entries and leave only noise here (3e-4); two planes of the working volume
/// give about 0.05.
pub const LEAST_RATIO: f64 = 4e-3;

/// A dot as seen by the mirror and by the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// Intersection of its ray with the plane at unit distance from the mirror; see [`mirror_plane`].
    pub mirror: [f64; 2],
    /// Its centroid in the camera's pixels, (column, row).
    pub camera: [f64; 2],
}

/// The epipolar geometry of mirror and camera: `m' F c = 0` for every point lit by a dot, at any depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fundamental {
    matrix: Matrix3<f64>,
}

/// The intersection of a ray with the plane at unit distance in front of the mirror: the tangents of its horizontal
/// and vertical angles from the mirror's resting direction. (The paper's products of sines and cosines are not a
/// projection onto a plane.)
pub fn mirror_plane(horizontal_rad: f64, vertical_rad: f64) -> [f64; 2] {
    [horizontal_rad.tan(), vertical_rad.tan()]
}

impl Fundamental {
    /// Computes it by the normalised eight-point algorithm (Hartley 1997) from dots at two or more depths, or with
    /// calibrated mirror angles.
    ///
    /// # Errors
    /// [`DotsError::TooFew`] below eight correspondences, [`DotsError::OutOfRange`] for values that are not finite,
    /// [`DotsError::Planar`] if they lie on one plane and do not determine the matrix.
    pub fn from_correspondences(correspondences: &[Correspondence]) -> Result<Self, DotsError> {
        const NEEDED: usize = 8;
        let given = correspondences.len();
        if given < NEEDED {
            return Err(DotsError::TooFew {
                what: "correspondences for F: scan more dots",
                given,
                needed: NEEDED,
            });
        }
        for value in correspondences.iter().flat_map(|pair| [pair.mirror, pair.camera]).flatten() {
            check_range(
                "correspondence",
                value,
                value.is_finite(),
                "finite: leave out dots that were not seen",
            )?;
        }
        let of_mirror = normalising(correspondences.iter().map(|pair| pair.mirror));
        let of_camera = normalising(correspondences.iter().map(|pair| pair.camera));
        // At least nine rows, so that the last right singular vector exists.
        let mut system = OMatrix::<f64, Dyn, U9>::zeros(given.max(9));
        for (mut row, pair) in system.row_iter_mut().zip(correspondences) {
            let mirror = of_mirror * Vector3::new(pair.mirror[0], pair.mirror[1], 1.0);
            let camera = of_camera * Vector3::new(pair.camera[0], pair.camera[1], 1.0);
            (0..9).for_each(|at| row[at] = mirror[at / 3] * camera[at % 3]);
        }
        let svd = system.svd(false, true);
        let ratio = svd.singular_values[6] / svd.singular_values[0];
        let planar = DotsError::Planar { ratio, needed: LEAST_RATIO };
        let right = svd.v_t.filter(|_| ratio >= LEAST_RATIO).ok_or(planar)?;
        let full = Matrix3::from_fn(|row, column| right[(8, 3 * row + column)]);

        // All epipolar lines of one image meet in a point, so the smallest singular value is 0.
        let mut svd = full.svd(true, true);
        svd.singular_values[2] = 0.0;
        let of_rank_2 = svd.recompose().unwrap_or(full);
        let matrix = of_mirror.transpose() * of_rank_2 * of_camera;
        Ok(Self { matrix: matrix / matrix.norm() })
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
    pub fn epipolar_line(&self, mirror: [f64; 2]) -> [f64; 3] {
        let line = self.matrix.transpose() * Vector3::new(mirror[0], mirror[1], 1.0);
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

/// Moves the points' centroid to 0 and scales their mean distance from it to the square root of 2.
fn normalising(points: impl Iterator<Item = [f64; 2]> + Clone) -> Matrix3<f64> {
    let count = points.clone().count() as f64;
    let (x, y) =
        points.clone().fold((0.0, 0.0), |(x, y), point| (x + point[0] / count, y + point[1] / count));
    let distance: f64 = points.map(|point| (point[0] - x).hypot(point[1] - y) / count).sum();
    let scale = std::f64::consts::SQRT_2 / distance.max(f64::MIN_POSITIVE);
    Matrix3::new(scale, 0.0, -scale * x, 0.0, scale, -scale * y, 0.0, 0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use rand_distr::{Distribution, Normal};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::SeedableRng;

    use super::*;

    /// Dots of a mirror beside a camera with 1024 pixels, on planes at these distances, with noisy centroids.
    fn scan(distances: &[f64], noise_px: f64) -> Vec<Correspondence> {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(3);
        let noise = Normal::new(0.0, noise_px).unwrap();
        let mut pairs = Vec::new();
        for &distance in distances {
            for (down, right) in (0..16).flat_map(|down| (0..16).map(move |right| (down, right))) {
                let mirror = mirror_plane((right as f64 - 7.5) * 0.01, (down as f64 - 7.5) * 0.01);
                let camera = seen([mirror[0] * distance, mirror[1] * distance, distance]);
                let camera = camera.map(|pixel| pixel + noise.sample(&mut random));
                pairs.push(Correspondence { mirror, camera });
            }
        }
        pairs
    }

    /// A point in the mirror's coordinates, projected to the camera's pixels: 15 units to the side, turned by 0.15.
    fn seen([x, y, z]: [f64; 3]) -> [f64; 2] {
        let (sin, cos) = 0.15_f64.sin_cos();
        let (x, z) = (x - 15.0, z);
        let (x, y, z) = (cos * x + sin * z, y - 3.0, cos * z - sin * x);
        [512.0 + 5000.0 * x / z, 512.0 + 5000.0 * y / z]
    }

    fn distance_px(fundamental: &Fundamental, mirror: [f64; 2], [x, y]: [f64; 2]) -> f64 {
        let [l1, l2, l3] = fundamental.epipolar_line(mirror);
        (l1 * x + l2 * y + l3).abs() / l1.hypot(l2)
    }

    #[test]
    fn two_planes_give_the_lines_of_points_between_and_the_epipole() {
        let fundamental = Fundamental::from_correspondences(&scan(&[95.0, 110.0], 0.1)).unwrap();
        for pair in scan(&[90.0, 100.0, 120.0], 0.0) {
            assert!(distance_px(&fundamental, pair.mirror, pair.camera) < 0.3);
        }
        let [x, y, w] = fundamental.epipole();
        let expected = seen([0.0, 0.0, 0.0]);
        let error = (x / w - expected[0]).hypot(y / w - expected[1]) / expected[0].hypot(expected[1]);
        assert!(error < 0.05, "{:?} {expected:?}", [x / w, y / w]);
    }

    #[test]
    fn one_plane_is_refused_with_its_ratio() {
        for noise_px in [0.0, 0.1, 0.5] {
            let refused = Fundamental::from_correspondences(&scan(&[100.0], noise_px));
            assert!(matches!(refused, Err(DotsError::Planar { .. })), "{noise_px}: {refused:?}");
        }
    }

    #[test]
    fn noise_does_not_pass_for_depth_nor_depth_for_noise() {
        // Distance of both cases from the limit.
        for (distances, noise_px) in [(&[100.0][..], 0.5), (&[95.0, 110.0][..], 0.5)] {
            let pairs = scan(distances, noise_px);
            assert_eq!(Fundamental::from_correspondences(&pairs).is_ok(), distances.len() == 2);
        }
        assert!(matches!(
            Fundamental::from_correspondences(&scan(&[95.0, 110.0], 0.0)[..7]),
            Err(DotsError::TooFew { given: 7, .. })
        ));
    }
}
