//! Light after its first reflection or refraction: simple, qualitatively correct models that are not based on
//! measurements.

use std::f64::consts::PI;

use super::model::{Coarse, Place, SceneModel};
use crate::dots::beam::BeamSpot;
use crate::dots::view::CameraView;

/// Global light transport of a scene.
pub enum Glow {
    /// No global light.
    None,
    /// One bounce between the walls.
    Bounce,
    /// Refraction by a ball, which forms a caustic.
    Caustic { centre: [f64; 2], radius: f64 },
    /// Subsurface scattering in wax: light leaves around the point of entry.
    Wax { centre: f64, radius: f64, top: f64 },
    /// Scattering along the beam and around it.
    Fog { density: Box<dyn Fn([f64; 2]) -> f64 + Send + Sync> },
}

/// Widths of the wax's glow, relative to the height of the field of view, and the fraction of light in each.
const WAX: [(f64, f64); 2] = [(0.10, 0.30), (0.30, 0.25)];
/// Distances at which fog scatters the beam's light.
const FOG_DEPTHS: [f64; 6] = [0.90, 0.92, 0.94, 0.96, 0.98, 1.00];
/// Fraction of light scattered towards the camera at each distance, for a beam through the densest fog.
const FOG_STREAK: f64 = 0.02;
/// Fraction of light that leaves after multiple scattering, and its width.
const FOG_HALO: (f64, f64) = (0.012, 0.5);

/// Light at a coarse pixel, given its index, direction and surface point.
type LightAt<'a> = Box<dyn Fn(usize, [f64; 2], &Place) -> f64 + 'a>;

impl Glow {
    /// Whether the light falls on the surface and is weighted by its albedo, rather than coming from in front of it.
    pub fn is_of_surface(&self) -> bool {
        !matches!(self, Self::Fog { .. })
    }

    /// Light without fine detail at the coarse pixels; `None` if there is none.
    pub fn coarse(
        &self,
        spot: &BeamSpot,
        model: &SceneModel,
        view: &CameraView,
        coarse: &Coarse,
    ) -> Option<Vec<f32>> {
        let light: LightAt = match self {
            Self::None | Self::Caustic { .. } => return None,
            Self::Bounce => {
                let from = model.place(spot.centre);
                let flux = spot.flux() * model.mean_albedo(spot.centre);
                let blur = spot.sigma().powi(2);
                Box::new(move |_, _, to| flux * exchange(&from, to, blur))
            }
            &Self::Wax { centre, radius, top } => {
                let within = move |[x, y]: [f64; 2]| (x - centre).abs() < radius && y > top;
                if !within(spot.centre) {
                    return None;
                }
                let (spot, height) = (*spot, 2.0 * view.half[1]);
                Box::new(move |_, m, _| if within(m) { wandered(&spot, m, height) } else { 0.0 })
            }
            Self::Fog { density } => {
                let thick = density(spot.centre);
                let blobs: Vec<([f64; 2], f64, f64)> = FOG_DEPTHS
                    .iter()
                    .map(|&depth| (view.pixel(spot.centre, depth), 1.5 * spot.sigma(), FOG_STREAK * thick))
                    .chain([(view.pixel(spot.centre, 1.0), FOG_HALO.1 * view.half[1], FOG_HALO.0 * thick)])
                    .collect();
                let px_per_tangent = view.size.1 as f64 / (2.0 * view.half[0]);
                let light = spot.light;
                let pixel_of = |node: usize| coarse.pixel(node);
                Box::new(move |node, _, _| {
                    let [row, column] = pixel_of(node);
                    blobs
                        .iter()
                        .map(|([y, x], sigma, share)| {
                            let sigma_px = sigma * px_per_tangent;
                            let square = (row - y).powi(2) + (column - x).powi(2);
                            light * share * (-0.5 * square / (sigma_px * sigma_px)).exp()
                        })
                        .sum()
                })
            }
        };
        Some(coarse.seen.iter().enumerate().map(|(node, (m, place))| light(node, *m, place) as f32).collect())
    }
}

/// Irradiance at `to` caused by unit flux from a small diffuse patch at `from`.
fn exchange(from: &Place, to: &Place, blur: f64) -> f64 {
    let way = [0, 1, 2].map(|axis| to.point[axis] - from.point[axis]);
    let square: f64 = way.iter().map(|part| part * part).sum();
    let dot = |normal: [f64; 3]| (0..3).map(|axis| normal[axis] * way[axis]).sum::<f64>();
    let (out, into) = (dot(from.normal).max(0.0), (-dot(to.normal)).max(0.0));
    // Near the edge the patch cannot be treated as a point; `blur` is its variance.
    out * into / (PI * square.max(1e-12) * (square + blur))
}

/// Light that entered the wax under a spot and leaves it at `m`.
fn wandered(spot: &BeamSpot, m: [f64; 2], height: f64) -> f64 {
    let square = (m[0] - spot.centre[0]).powi(2) + (m[1] - spot.centre[1]).powi(2);
    let gaussians = WAX.iter().map(|(width, share)| {
        let variance = (width * height).powi(2) + spot.sigma().powi(2);
        share * spot.flux() / (2.0 * PI * variance) * (-0.5 * square / variance).exp()
    });
    gaussians.sum()
}

/// The refracted spot behind a glass ball for a spot on the ball. Spots from near the rim and from closer to the centre
/// overlap, so that light concentrates in a ring.
pub fn caustic(centre: [f64; 2], radius: f64, spot: &BeamSpot) -> Option<BeamSpot> {
    let from_centre = [0, 1].map(|axis| (spot.centre[axis] - centre[axis]) / radius);
    let rho = from_centre[0].hypot(from_centre[1]);
    if rho >= 1.0 {
        return None;
    }
    let stretch = 1.6 * rho * rho - 2.4;
    Some(
        spot.refracted(
            [0, 1].map(|axis| centre[axis] + stretch * radius * from_centre[axis]),
            1.0 - rho * rho,
        ),
    )
}
