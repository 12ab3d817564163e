//! Built-in scenes: a surface as a function of the beam's direction, its print, and its global light transport.

use rayon::prelude::*;
use raysweep_core::Mosaic;

use super::glow::{self, Glow};
use super::still::{Still, seen};
use crate::dots::beam::BeamSpot;
use crate::dots::view::CameraView;
use crate::scene::texture::{noise, printed_page};

/// Iterations for finding the point that a pixel sees; each reduces the error by a factor of at least five.
const TRACE_STEPS: usize = 12;
/// Half the step for finite differences of the surface, as a tangent.
const STEP_TANGENT: f64 = 1e-4;
/// Size of a scene's print in pixels.
const PAGE_ROWS: usize = 192;
const PAGE_COLUMNS: usize = 320;

/// Distance of the surface in a direction.
pub type Depth = Box<dyn Fn([f64; 2]) -> f64 + Send + Sync>;
/// Linear RGB albedo in a direction.
pub type Albedo = Box<dyn Fn([f64; 2]) -> [f32; 3] + Send + Sync>;

/// A surface and its light transport, independent of the camera.
pub struct SceneModel {
    depth: Depth,
    albedo: Albedo,
    glow: Glow,
}

impl SceneModel {
    /// A white Lambertian plane.
    pub fn plane(depth: f64) -> Self {
        Self { depth: Box::new(move |_| depth), albedo: Box::new(|_| [1.0; 3]), glow: Glow::None }
    }

    /// One of [`super::BUILTIN_NAMES`], at a position of its swing.
    pub fn builtin(name: &str, half: [f64; 2], swing: f64, seed: u64) -> Self {
        match name {
            "glass" => Self::glass(half, swing, seed),
            "candle" => Self::candle(half, swing, seed),
            "fog" => Self::fog(half, swing, seed),
            _ => Self::v_groove(half, swing, seed),
        }
    }

    /// Two printed walls that meet in a vertical concave edge, which moves sideways.
    fn v_groove(half: [f64; 2], swing: f64, seed: u64) -> Self {
        let edge = 0.3 * half[0] * swing;
        Self {
            depth: Box::new(move |[x, _]| 1.06 - 0.8 * (x - edge).abs()),
            albedo: page(half, [edge, 0.0], seed),
            glow: Glow::Bounce,
        }
    }

    /// A glass ball in front of a printed page: it deflects the beam and focuses it into a caustic.
    fn glass(half: [f64; 2], swing: f64, seed: u64) -> Self {
        let (centre, radius) = ([0.35 * half[0] * swing, 0.1 * half[1]], 0.5 * half[1]);
        let within = move |[x, y]: [f64; 2]| (x - centre[0]).hypot(y - centre[1]) < radius;
        let page = page(half, [0.0, 0.0], seed);
        Self {
            depth: Box::new(|_| 1.05),
            // Only a faint reflection of the ball itself is visible.
            albedo: Box::new(move |m| if within(m) { [0.05, 0.05, 0.06] } else { page(m) }),
            glow: Glow::Caustic { centre, radius },
        }
    }

    /// A wax candle in front of a wall, with subsurface scattering.
    fn candle(half: [f64; 2], swing: f64, seed: u64) -> Self {
        let (centre, radius, top) = (0.3 * half[0] * swing, 0.45 * half[1], -0.7 * half[1]);
        let within = move |[x, y]: [f64; 2]| (x - centre).abs() < radius && y > top;
        let page = page(half, [0.0, 0.0], seed);
        Self {
            depth: Box::new(move |m| {
                let round = (radius * radius - (m[0] - centre).powi(2)).max(0.0).sqrt();
                if within(m) { 1.0 - 0.5 * round } else { 1.05 }
            }),
            albedo: Box::new(move |m| if within(m) { [0.45, 0.40, 0.30] } else { page(m) }),
            glow: Glow::Wax { centre, radius, top },
        }
    }

    /// A drifting slab of fog in front of a printed page.
    fn fog(half: [f64; 2], swing: f64, seed: u64) -> Self {
        let density = move |m: [f64; 2]| {
            0.55 + 0.45 * noise(seed, 3.0 * (m[0] / half[0] + swing), 3.0 * m[1] / half[0])
        };
        let page = page(half, [0.0, 0.0], seed);
        Self {
            depth: Box::new(|_| 1.05),
            // The fog attenuates both the beam on its way to the page and the light returned by the page.
            albedo: Box::new(move |m| page(m).map(|part| part * (-1.2 * density(m)).exp() as f32)),
            glow: Glow::Fog { density: Box::new(density) },
        }
    }
}

fn page(half: [f64; 2], middle: [f64; 2], seed: u64) -> Albedo {
    let page = printed_page(PAGE_ROWS, PAGE_COLUMNS, seed);
    Box::new(move |m| {
        let place = |axis: usize, length: usize| {
            let part = 0.5 + (m[axis] - middle[axis]) / (2.6 * half[axis]);
            ((part * length as f64).max(0.0) as usize).min(length - 1)
        };
        let (row, column) = (place(1, PAGE_ROWS), place(0, PAGE_COLUMNS));
        [0, 1, 2].map(|c| page[[row, column, c]])
    })
}

/// A point on a surface.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Position, in units of the scene's distance.
    pub point: [f64; 3],
    /// Unit normal towards the projector.
    pub normal: [f64; 3],
}

/// A surface as seen by the camera.
pub struct Surface {
    model: SceneModel,
    view: CameraView,
    /// Direction from the projector to the point that each pixel sees.
    directions: Vec<[f64; 2]>,
    /// Albedo of each pixel, as seen through its colour filter.
    albedo: Vec<f32>,
    /// Irradiance factor of each pixel: 1 where the surface faces the projector at the scene's distance.
    facing: Vec<f32>,
    coarse: Coarse,
}

/// Samples of the surface every [`Coarse::STEP`] pixels, sufficient for light without fine detail.
pub struct Coarse {
    columns: usize,
    /// Direction and surface point of each sample.
    pub seen: Vec<([f64; 2], Place)>,
}

impl Coarse {
    const STEP: usize = 4;

    fn new(model: &SceneModel, view: CameraView) -> Self {
        let (rows, columns) = view.size;
        let [rows, columns] = [rows, columns].map(|length| length.div_ceil(Self::STEP) + 1);
        let seen = (0..rows * columns).into_par_iter().map(|node| {
            let (row, column) = (node / columns * Self::STEP, node % columns * Self::STEP);
            let direction = model.seen(view, row, column);
            (direction, model.place(direction))
        });
        Self { columns, seen: seen.collect() }
    }

    /// Row and column of the centre of a sample's pixel.
    pub fn pixel(&self, node: usize) -> [f64; 2] {
        [node / self.columns, node % self.columns].map(|place| (place * Self::STEP) as f64 + 0.5)
    }

    /// Interpolates the samples' values at a pixel.
    fn at(&self, values: &[f32], row: usize, column: usize) -> f32 {
        let (node, below) = (row / Self::STEP, (row % Self::STEP) as f32 / Self::STEP as f32);
        let (column, right) = (column / Self::STEP, (column % Self::STEP) as f32 / Self::STEP as f32);
        let first = node * self.columns + column;
        let between = |at: usize| values[at] + right * (values[at + 1] - values[at]);
        between(first) + below * (between(first + self.columns) - between(first))
    }
}

impl SceneModel {
    /// Direction from the projector to the point that a pixel sees.
    fn seen(&self, view: CameraView, row: usize, column: usize) -> [f64; 2] {
        let mut depth = 1.0;
        for _ in 0..TRACE_STEPS {
            depth = (self.depth)(view.direction(row, column, depth));
        }
        view.direction(row, column, depth)
    }

    /// Surface point and normal in a direction.
    pub fn place(&self, direction: [f64; 2]) -> Place {
        let point = |[x, y]: [f64; 2]| {
            let depth = (self.depth)([x, y]);
            [x * depth, y * depth, depth]
        };
        let [x, y] = direction;
        let difference = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
        let along = difference(point([x + STEP_TANGENT, y]), point([x - STEP_TANGENT, y]));
        let down = difference(point([x, y + STEP_TANGENT]), point([x, y - STEP_TANGENT]));
        let normal = [
            down[1] * along[2] - down[2] * along[1],
            down[2] * along[0] - down[0] * along[2],
            down[0] * along[1] - down[1] * along[0],
        ];
        let length = normal.iter().map(|part| part * part).sum::<f64>().sqrt();
        Place { point: point(direction), normal: normal.map(|part| part / length) }
    }

    /// Albedo in a direction, averaged over the colours.
    pub fn mean_albedo(&self, direction: [f64; 2]) -> f64 {
        f64::from((self.albedo)(direction).iter().sum::<f32>()) / 3.0
    }
}

impl Surface {
    /// Computes what each pixel sees.
    pub fn trace(model: SceneModel, view: CameraView, mosaic: Mosaic) -> Self {
        let (rows, columns) = view.size;
        let pixels: Vec<([f64; 2], f32, f32)> = (0..rows * columns)
            .into_par_iter()
            .map(|pixel| {
                let (row, column) = (pixel / columns, pixel % columns);
                let direction = model.seen(view, row, column);
                let Place { point, normal } = model.place(direction);
                let square: f64 = point.iter().map(|part| part * part).sum();
                let cosine = -(0..3).map(|axis| normal[axis] * point[axis]).sum::<f64>() / square.sqrt();
                let albedo = seen(mosaic, row, column, (model.albedo)(direction));
                (direction, albedo, (cosine.max(0.0) / square) as f32)
            })
            .collect();
        let coarse = Coarse::new(&model, view);
        Self {
            directions: pixels.iter().map(|pixel| pixel.0).collect(),
            albedo: pixels.iter().map(|pixel| pixel.1).collect(),
            facing: pixels.iter().map(|pixel| pixel.2).collect(),
            model,
            view,
            coarse,
        }
    }
}

impl Still for Surface {
    fn add_direct(&self, spot: &BeamSpot, image: &mut [f32]) {
        let columns = self.view.size.1;
        image.par_chunks_mut(columns).enumerate().for_each(|(row, image)| {
            let first = row * columns;
            for (column, value) in image.iter_mut().enumerate() {
                let irradiance = spot.at(self.directions[first + column]) as f32;
                *value += irradiance * self.albedo[first + column] * self.facing[first + column];
            }
        });
    }

    fn add_global(&self, spot: &BeamSpot, image: &mut [f32]) {
        if let Glow::Caustic { centre, radius } = self.model.glow {
            glow::caustic(centre, radius, spot).iter().for_each(|spot| self.add_direct(spot, image));
            return;
        }
        let Some(values) = self.model.glow.coarse(spot, &self.model, &self.view, &self.coarse) else {
            return;
        };
        let columns = self.view.size.1;
        let of_surface = self.model.glow.is_of_surface();
        image.par_chunks_mut(columns).enumerate().for_each(|(row, image)| {
            for (column, value) in image.iter_mut().enumerate() {
                let albedo = if of_surface { self.albedo[row * columns + column] } else { 1.0 };
                *value += albedo * self.coarse.at(&values, row, column);
            }
        });
    }
}
