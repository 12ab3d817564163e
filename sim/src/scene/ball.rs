//! `mirror-ball`: a ball of plane mirrors over a printed page.
//!
//! Traced paths: the page's direct light, with the ball's shadow; projector -> facet -> page, bright spots that arrive
//! at rows other than the page's own; camera -> facet -> page, the page (and the spots on it) seen in the mirrors. The
//! ball is the convex polyhedron bounded by its facets' planes, so no mirrored ray meets a second facet. Neglected:
//! diffuse light on the path page -> ball -> page, and the surroundings, which are black.

use std::f64::consts::PI;

use ndarray::{Array3, ArrayViewMut3, ArrayViewMut4};
use rayon::prelude::*;

use super::object::{Direct, Indirect, Object};
use super::projector::{PatternPart, ProjectorFrame, projector_cos, to_projector};
use super::size::SceneSize;
use super::texture::{Dice, printed_page};
use super::vector::{Vector, dot, minus, plus, reflect};

const TO_CAMERA: Vector = [0.0, 0.0, 1.0];
/// Reflectance of a facet \[A\].
const MIRROR: f64 = 0.85;
/// Dust on the facets \[A\]: a matte component, and a glossy lobe that shows the facets oriented halfway between
/// camera and projector.
const DUST_ALBEDO: f64 = 0.05;
const GLOSS: f64 = 0.7;
const GLOSS_EXPONENT: i32 = 60;
/// Angle between neighbouring facets, and their largest misalignment.
const FACET_ANGLE: f64 = PI / 12.0;
const FACET_TILT: f64 = 0.03;
/// Samples along each side of a pixel.
const SAMPLES: usize = 4;

/// Light of one pixel other than the direct light of its own row.
#[derive(Debug, Clone)]
struct Ray {
    row: usize,
    /// Projector cell that the light comes from; see [`Rays::cells`].
    cell: usize,
    /// Weight per RGB band.
    weight: [f32; 3],
}

#[derive(Debug)]
struct Rays {
    /// The rays of each pixel, at index `row * columns + column`.
    pixels: Vec<Vec<Ray>>,
    columns: usize,
    bands: Vec<usize>,
    /// Number of equal cells that a projector row is divided into.
    cells: usize,
}

struct Ball {
    centre: Vector,
    radius: f64,
    /// Unit normals; every facet's plane is tangent to the sphere.
    facets: Vec<Vector>,
}

struct Stage {
    ball: Ball,
    page: Array3<f32>,
    frame: ProjectorFrame,
    size: SceneSize,
    cells: usize,
}

pub(super) fn build(size: SceneSize, bands: &[usize], seed: u64) -> Object {
    build_swung(size, bands, seed, 0.0)
}

/// The ball as the bob of a pendulum at `swing`, -1 to 1: it moves sideways by up to 0.8 radii to either side and
/// rises by up to a tenth of a radius.
pub(super) fn build_swung(size: SceneSize, bands: &[usize], seed: u64, swing: f64) -> Object {
    let SceneSize { rows, columns } = size;
    let mut dice = Dice::new(seed);
    let radius = 0.23 * rows.min(columns) as f64;
    let rest = [columns as f64 * dice.between(0.5, 0.56), rows as f64 * dice.between(0.47, 0.53)];
    let bob = [rest[0] + 0.8 * radius * swing, rest[1] - 0.1 * radius * swing * swing];
    let ball = Ball::new([bob[0], bob[1], 1.5 * radius], radius, &mut dice);
    let frame = ProjectorFrame::covering(columns, ball.centre[2] + radius);
    let stage = Stage { ball, page: printed_page(rows, columns, seed), frame, size, cells: 2 * columns };
    let mut direct = Direct::new(size, bands.len(), |row, x| {
        let origin = [x, row as f64 + 0.5, 0.0];
        let depth = stage.ball.hit_from_above(origin).map_or(0.0, |(_, point)| point[2]);
        stage.frame.column(x, depth)
    });

    let pixels: Vec<(Vec<Ray>, [f32; 3])> =
        (0..rows * columns).into_par_iter().map(|k| stage.pixel(k / columns, k % columns)).collect();
    for ((row, column, channel), value) in direct.value.indexed_iter_mut() {
        *value = pixels[row * columns + column].1[bands[channel]];
    }
    let pixels = pixels.into_iter().map(|(rays, _)| rays).collect();
    let rays = Rays { pixels, columns, bands: bands.to_vec(), cells: stage.cells };
    Object { direct, indirect: Box::new(rays) }
}

impl Ball {
    fn new(centre: Vector, radius: f64, dice: &mut Dice) -> Self {
        let bands = (PI / FACET_ANGLE).round() as usize;
        let mut facets = Vec::new();
        for band in 0..bands {
            let latitude = ((band as f64 + 0.5) / bands as f64 - 0.5) * PI;
            let count = (2.0 * PI * latitude.cos() / FACET_ANGLE).round().max(3.0) as usize;
            let first = dice.between(0.0, 1.0);
            for k in 0..count {
                let longitude = 2.0 * PI * (k as f64 + first) / count as f64;
                let latitude = latitude + dice.between(-FACET_TILT, FACET_TILT);
                let longitude = longitude + dice.between(-FACET_TILT, FACET_TILT);
                facets.push([
                    latitude.cos() * longitude.sin(),
                    latitude.sin(),
                    latitude.cos() * longitude.cos(),
                ]);
            }
        }
        Self { centre, radius, facets }
    }

    /// Facet and point at which a ray from outside enters the ball.
    fn hit(&self, origin: Vector, direction: Vector) -> Option<(usize, Vector)> {
        let from_centre = minus(origin, self.centre);
        let along = dot(from_centre, direction);
        // Facets extend beyond the sphere by less than a factor of 1 / cos(facet angle).
        let reach = self.radius / FACET_ANGLE.cos();
        if dot(from_centre, from_centre) - along * along > reach * reach || along > 0.0 {
            return None;
        }
        let (mut entry, mut exit, mut facet) = (0.0, f64::INFINITY, None);
        for (k, &normal) in self.facets.iter().enumerate() {
            let slope = dot(normal, direction);
            let gap = self.radius - dot(normal, from_centre);
            if slope < 0.0 && gap / slope > entry {
                (entry, facet) = (gap / slope, Some(k));
            } else if slope > 0.0 {
                exit = exit.min(gap / slope);
            } else if slope == 0.0 && gap < 0.0 {
                return None;
            }
        }
        facet.filter(|_| entry < exit).map(|facet| (facet, plus(origin, direction, entry)))
    }

    /// Facet and point that the camera sees at (x, y).
    fn hit_from_above(&self, origin: Vector) -> Option<(usize, Vector)> {
        self.hit([origin[0], origin[1], self.centre[2] + 2.0 * self.radius], [0.0, 0.0, -1.0])
    }
}

impl Stage {
    /// Indirect rays and direct light (RGB) of a pixel.
    fn pixel(&self, row: usize, column: usize) -> (Vec<Ray>, [f32; 3]) {
        let mut rays = Vec::new();
        let mut direct = [0.0; 3];
        let share = 1.0 / (SAMPLES * SAMPLES) as f64;
        let inside = |k: usize| (k as f64 + 0.5) / SAMPLES as f64;
        for k in 0..SAMPLES * SAMPLES {
            let point = [column as f64 + inside(k % SAMPLES), row as f64 + inside(k / SAMPLES), 0.0];
            match self.ball.hit_from_above(point) {
                None => {
                    let albedo = self.albedo(point).unwrap_or([0.0; 3]).map(|a| a * share);
                    if self.sees_projector(point) {
                        add(&mut direct, albedo);
                    }
                    self.spots(point, albedo, &mut rays);
                }
                Some((facet, point)) => {
                    add(&mut direct, [share * self.dust(facet); 3]);
                    let view = reflect([0.0, 0.0, -1.0], self.ball.facets[facet]);
                    self.mirrored(point, view, MIRROR * share, &mut rays);
                }
            }
        }
        (merge(rays), direct.map(|d| d as f32))
    }

    /// Direct light that dust on a facet scatters to the camera.
    fn dust(&self, facet: usize) -> f64 {
        let (normal, light) = (self.ball.facets[facet], to_projector());
        let cos = dot(normal, light).max(0.0);
        let half = plus(light, TO_CAMERA, 1.0);
        let gloss = (dot(normal, half) / dot(half, half).sqrt()).max(0.0).powi(GLOSS_EXPONENT);
        (DUST_ALBEDO + GLOSS * gloss) * cos / projector_cos()
    }

    /// Adds the light of the page as seen from `point` on the ball along `view`.
    fn mirrored(&self, point: Vector, view: Vector, weight: f64, rays: &mut Vec<Ray>) {
        if view[2] >= 0.0 {
            return;
        }
        let on_page = plus(point, view, -point[2] / view[2]);
        let Some(albedo) = self.albedo(on_page) else { return };
        let albedo = albedo.map(|a| a * weight);
        if self.sees_projector(on_page) {
            self.push(on_page, albedo, rays);
        }
        self.spots(on_page, albedo, rays);
    }

    /// Adds the light that facets reflect onto the page at `point`. For each facet, a ray is traced from the point back
    /// along the beam that this facet reflects; it counts if it hits that facet.
    fn spots(&self, point: Vector, albedo: [f64; 3], rays: &mut Vec<Ray>) {
        let beam = to_projector().map(|component| -component);
        for (facet, &normal) in self.ball.facets.iter().enumerate() {
            if dot(normal, beam) >= 0.0 {
                continue;
            }
            let mirrored = reflect(beam, normal);
            if mirrored[2] >= 0.0 {
                continue;
            }
            if let Some((first, at)) = self.ball.hit(point, mirrored.map(|component| -component))
                && first == facet
            {
                let irradiance = MIRROR * -mirrored[2] / projector_cos();
                self.push(at, albedo.map(|a| a * irradiance), rays);
            }
        }
    }

    /// Adds the projector's light at `point`, if the point lies in one of its rows.
    fn push(&self, point: Vector, weight: [f64; 3], rays: &mut Vec<Ray>) {
        if (0.0..self.size.rows as f64).contains(&point[1]) {
            let column = f64::from(self.frame.column(point[0], point[2])) * self.cells as f64;
            let cell = (column as usize).min(self.cells - 1);
            rays.push(Ray { row: point[1] as usize, cell, weight: weight.map(|w| w as f32) });
        }
    }

    fn sees_projector(&self, point: Vector) -> bool {
        self.ball.hit(point, to_projector()).is_none()
    }

    /// Albedo of the page, which ends at the border of the camera's image.
    fn albedo(&self, point: Vector) -> Option<[f64; 3]> {
        let [x, y, _] = point;
        let inside = x >= 0.0 && x < self.size.columns as f64 && y >= 0.0 && y < self.size.rows as f64;
        inside.then(|| [0, 1, 2].map(|band| f64::from(self.page[[y as usize, x as usize, band]])))
    }
}

/// Merges rays that come from the same projector cell.
fn merge(mut rays: Vec<Ray>) -> Vec<Ray> {
    rays.sort_by_key(|ray| (ray.row, ray.cell));
    rays.dedup_by(|next, kept| {
        let same = (next.row, next.cell) == (kept.row, kept.cell);
        if same {
            for band in 0..3 {
                kept.weight[band] += next.weight[band];
            }
        }
        same
    });
    rays.shrink_to_fit();
    rays
}

fn add(sum: &mut [f64; 3], value: [f64; 3]) {
    for band in 0..3 {
        sum[band] += value[band];
    }
}

impl Rays {
    fn pixel(&self, row: usize, column: usize) -> &[Ray] {
        &self.pixels[row * self.columns + column]
    }
}

impl Indirect for Rays {
    fn add_transport(&self, mut transport: ArrayViewMut4<f32>) {
        let (_, rows, columns, _) = transport.dim();
        for row in 0..rows {
            for column in 0..columns {
                for ray in self.pixel(row, column) {
                    for (channel, &band) in self.bands.iter().enumerate() {
                        transport[[ray.row, row, column, channel]] += ray.weight[band];
                    }
                }
            }
        }
    }

    fn add_image(&self, pattern: &PatternPart, mut image: ArrayViewMut3<f32>) {
        let edge = |cell: usize| cell as f32 / self.cells as f32;
        let (rows, columns, _) = image.dim();
        for row in 0..rows {
            for column in 0..columns {
                for ray in self.pixel(row, column) {
                    let lit = pattern.mean(ray.row, (edge(ray.cell), edge(ray.cell + 1)));
                    for (channel, &band) in self.bands.iter().enumerate() {
                        image[[row, column, channel]] += lit * ray.weight[band];
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ball() -> Ball {
        Ball::new([0.0, 0.0, 40.0], 30.0, &mut Dice::new(4))
    }

    #[test]
    fn rays_enter_where_the_surface_is() {
        let ball = ball();
        for k in 0..400 {
            let origin = [f64::from(k % 20) * 3.3 - 31.0, f64::from(k / 20) * 3.3 - 31.0, 200.0];
            let Some((facet, point)) = ball.hit(origin, [0.0, 0.0, -1.0]) else { continue };
            let heights = |k: usize| dot(ball.facets[k], minus(point, ball.centre)) - ball.radius;
            assert!(heights(facet).abs() < 1e-9);
            assert!((0..ball.facets.len()).all(|k| heights(k) < 1e-9));
        }
        assert!(ball.hit([0.0, 0.0, 200.0], [0.0, 0.0, 1.0]).is_none());
        assert!(ball.hit([40.0, 0.0, 200.0], [0.0, 0.0, -1.0]).is_none());
    }

    /// A facet preserves the flux it takes from the beam: its cross-section, counted with rays along the beam, equals
    /// the spot's area on the page times the cosine of the reflected beam, counted on the page.
    #[test]
    fn spots_keep_the_flux() {
        let ball = ball();
        let beam = to_projector().map(|component| -component);
        let step = 0.25;
        let mut compared = 0;
        for (facet, &normal) in ball.facets.iter().enumerate() {
            let mirrored = reflect(beam, normal);
            if dot(normal, beam) > -0.3 || mirrored[2] > -0.3 {
                continue;
            }
            let count = |hits: &dyn Fn(Vector) -> bool, half: i32| {
                let places = (-half..half).flat_map(|i| (-half..half).map(move |j| (i, j)));
                places.filter(|&(i, j)| hits([step * f64::from(i), step * f64::from(j), 0.0])).count() as f64
            };
            // The beam meets the page's plane at the projector's angle, hence the cosine.
            let taken = |at| ball.hit(plus(at, beam, -200.0), beam).is_some_and(|(k, _)| k == facet);
            let given = |at| ball.hit(at, mirrored.map(|c| -c)).is_some_and(|(k, _)| k == facet);
            let cross_section = count(&taken, 240) * projector_cos();
            let spot = count(&given, 1000) * -mirrored[2];
            assert!((spot / cross_section - 1.0).abs() < 0.08, "{facet}: {spot} {cross_section}");
            compared += 1;
        }
        assert!(compared >= 5, "{compared}");
    }
}
