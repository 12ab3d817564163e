use nalgebra::{Dyn, Matrix3, OMatrix, U9, Vector3};

use super::Centroids;
use super::fundamental::normalising;
use super::robust::reweighted;
use crate::dots::sensor::median;

/// Fewest dots from which the places of others follow.
const FEWEST_DOTS: usize = 12;

/// Largest standard deviation of the seen dots from their expected places, as a share of the distance between
/// neighbours, with which unseen dots are placed. Beyond it the mirror does not follow its path.
const MOST_SPREAD: f64 = 0.25;

/// How the dots that the plane does not show were placed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extension {
    /// Number of dots that were placed.
    pub dots: usize,
    /// Standard deviation of the seen dots from the places expected of them, in pixels.
    pub sd_px: f64,
}

impl Centroids {
    /// Places the dots that miss the plane, or fall beside the frame, where they would be if the plane went on: a plane
    /// maps the mirror's directions to pixels by a homography, which is fitted to the dots that were seen.
    /// `directions` are those of the path, as tangents; `None` for frames that show no dot of the scene. `Err` with
    /// the standard deviation in pixels, and nothing placed, if the seen dots do not follow the path.
    ///
    /// # Errors
    /// The standard deviation; infinite if too few dots were seen.
    pub fn extended(&self, directions: &[Option<[f64; 2]>]) -> Result<(Self, Extension), f64> {
        let seen: Vec<([f64; 2], [f64; 2])> = directions
            .iter()
            .zip(&self.xy)
            .filter_map(|(direction, xy)| Some(((*direction)?, (*xy)?)))
            .collect();
        if seen.len() < FEWEST_DOTS {
            return Err(f64::INFINITY);
        }
        let of_mirror = normalising(seen.iter().map(|(direction, _)| *direction));
        let of_camera = normalising(seen.iter().map(|(_, xy)| *xy));
        let scale_px = 1.0 / of_camera[(0, 0)];
        let unit: Vec<(Vector3<f64>, Vector3<f64>)> = seen
            .iter()
            .map(|(direction, xy)| {
                (
                    of_mirror * Vector3::new(direction[0], direction[1], 1.0),
                    of_camera * Vector3::new(xy[0], xy[1], 1.0),
                )
            })
            .collect();
        let begin = homography(&unit, &vec![1.0; unit.len()]);
        let (found, weights) = reweighted(
            begin,
            |found, distances| {
                distances.clear();
                distances.extend(unit.iter().map(|(from, to)| distance(found, from, to)));
            },
            |_, weights| homography(&unit, weights),
        );
        let kept = unit.iter().zip(&weights).filter(|(_, weight)| **weight > 0.0);
        let squares: Vec<f64> = kept.map(|((from, to), _)| distance(&found, from, to).powi(2)).collect();
        let sd_px = scale_px * (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
        let mut pitches: Vec<f64> = self
            .xy
            .windows(2)
            .filter_map(|pair| Some((pair[0]?, pair[1]?)))
            .map(|(one, other)| (one[0] - other[0]).hypot(one[1] - other[1]))
            .collect();
        let follows = !pitches.is_empty()
            && sd_px <= MOST_SPREAD * median(&mut pitches)
            && 2 * squares.len() > seen.len();
        if !follows {
            return Err(sd_px);
        }
        let back = of_camera.try_inverse().unwrap_or_else(Matrix3::identity) * found * of_mirror;
        let mut all = self.clone();
        let mut dots = 0;
        for (xy, direction) in all.xy.iter_mut().zip(directions) {
            if let (None, Some([x, y])) = (&xy, direction) {
                let place = back * Vector3::new(*x, *y, 1.0);
                *xy = Some([place.x / place.z, place.y / place.z]);
                dots += 1;
            }
        }
        Ok((all, Extension { dots, sd_px }))
    }
}

/// Distance of a point from where the homography expects it.
fn distance(homography: &Matrix3<f64>, from: &Vector3<f64>, to: &Vector3<f64>) -> f64 {
    let place = homography * from;
    (place.x / place.z - to.x).hypot(place.y / place.z - to.y)
}

/// The homography of weighted, normalised points (direct linear transform).
fn homography(points: &[(Vector3<f64>, Vector3<f64>)], weights: &[f64]) -> Matrix3<f64> {
    let mut system = OMatrix::<f64, Dyn, U9>::zeros(2 * points.len());
    for (at, ((from, to), weight)) in points.iter().zip(weights).enumerate() {
        let weight = weight.sqrt();
        for axis in 0..3 {
            system[(2 * at, axis)] = weight * from[axis];
            system[(2 * at, 6 + axis)] = -weight * to.x * from[axis];
            system[(2 * at + 1, 3 + axis)] = weight * from[axis];
            system[(2 * at + 1, 6 + axis)] = -weight * to.y * from[axis];
        }
    }
    let normal = system.transpose() * &system;
    let eigen = normal.symmetric_eigen();
    let least = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    Matrix3::from_fn(|row, column| least[3 * row + column])
}

#[cfg(test)]
mod tests {
    use rand_distr::{Distribution, Normal};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::SeedableRng;

    use super::*;
    use crate::dots::FrameShape;

    /// Directions of a grid of 20 x 20, and where a camera sees them: rays from the mirror meet a tilted plane, which a
    /// pinhole beside the mirror sees.
    fn scan() -> Vec<([f64; 2], [f64; 2])> {
        let grid = (0..400)
            .map(|dot| [f64::from(dot % 20) - 9.5, f64::from(dot / 20) - 9.5].map(|step| 0.008 * step));
        let project = |[x, y]: [f64; 2]| {
            let z = 100.0 / (1.0 + 0.3 * x - 0.2 * y);
            let (x, y) = (x * z - 20.0, y * z + 4.0);
            [150.0 + 900.0 * (x + 0.2 * z) / (z - 0.2 * x), 100.0 + 900.0 * y / (z - 0.2 * x)]
        };
        grid.map(|direction| (direction, project(direction))).collect()
    }

    #[test]
    fn dots_beside_the_plane_are_placed_by_the_path_and_wrong_ones_do_not_matter() {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
        let noise = Normal::new(0.0, 0.1).unwrap();
        let directions: Vec<_> = scan().into_iter().map(|(direction, _)| Some(direction)).collect();
        let truth: Vec<[f64; 2]> = scan().into_iter().map(|(_, xy)| xy).collect();
        let shape = FrameShape::new(256, 320, 1).unwrap();
        let mut seen = Centroids::at(
            shape,
            truth.iter().map(|xy| Some(xy.map(|at| at + noise.sample(&mut random)))).collect(),
        );
        // The plane's left quarter is missing, and some dots are reflected elsewhere.
        (0..400).filter(|dot| dot % 20 < 5).for_each(|dot| seen.xy[dot] = None);
        [47, 130, 255, 333].into_iter().for_each(|dot| seen.xy[dot] = Some([10.0, 200.0]));
        let (all, extension) = seen.extended(&directions).unwrap();
        assert_eq!(extension.dots, 100);
        assert!((0.1..0.2).contains(&extension.sd_px), "{extension:?}");
        for (dot, xy) in all.xy.iter().enumerate() {
            let ([x, y], [x0, y0]) = (xy.unwrap(), truth[dot]);
            match seen.xy[dot] {
                Some(measured) => assert_eq!([x, y], measured, "what was measured stays"),
                None => assert!((x - x0).hypot(y - y0) < 0.2, "{dot}: {x} {y}, {x0} {y0}"),
            }
        }
    }

    #[test]
    fn nothing_is_placed_if_the_mirror_does_not_follow_its_path() {
        let shape = FrameShape::new(256, 320, 1).unwrap();
        let directions: Vec<_> = scan().into_iter().map(|(direction, _)| Some(direction)).collect();
        // Every other row is a dot and a half late, as of a raster without a known response.
        let late =
            |(dot, xy): (usize, [f64; 2])| [xy[0] + if dot / 20 % 2 == 0 { 11.0 } else { -11.0 }, xy[1]];
        let places = scan().into_iter().map(|(_, xy)| xy).enumerate().map(late);
        let mut seen = Centroids::at(shape, places.map(Some).collect());
        seen.xy[7] = None;
        let sd_px = seen.extended(&directions).unwrap_err();
        assert!((9.0..12.0).contains(&sd_px), "{sd_px}");
        seen.xy.iter_mut().skip(11).for_each(|xy| *xy = None);
        assert_eq!(seen.extended(&directions).unwrap_err(), f64::INFINITY);
    }
}
