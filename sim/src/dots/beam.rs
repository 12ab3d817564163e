//! Profile of the spot: an elliptical Gaussian that varies over the field of view.

use raysweep_config::sim::SimDot;

/// Ratio of a Gaussian's standard deviation to its full width at half maximum.
const SIGMA_OVER_FWHM: f64 = 0.424_661;
/// Distance from the centre, in standard deviations, beyond which the light is taken as zero.
const REACH_SIGMAS: f64 = 4.5;

/// The beam over the whole field of view. Directions are tangents of the beam's angles, x and y.
#[derive(Debug, Clone)]
pub struct DotBeam {
    sigma: f64,
    uneven: f64,
    half: [f64; 2],
}

/// The spot of the beam in one direction.
#[derive(Debug, Clone, Copy)]
pub struct BeamSpot {
    /// Direction of its centre.
    pub centre: [f64; 2],
    /// Irradiance at its centre; 1 is the full beam.
    pub light: f64,
    /// Standard deviations along its long and short axis.
    sigmas: [f64; 2],
    /// Direction of the long axis.
    long: [f64; 2],
}

impl DotBeam {
    /// The beam over a field of view of `2 half`, as tangents.
    pub fn new(dot: &SimDot, half: [f64; 2]) -> Self {
        let sigma = SIGMA_OVER_FWHM * dot.fwhm_deg.to_radians().tan();
        Self { sigma, uneven: dot.uneven, half }
    }

    /// The spot around `centre`: round in the middle of the field, elongated radially towards the corners.
    pub fn spot(&self, centre: [f64; 2], light: f64) -> BeamSpot {
        let [x, y] = [centre[0] / self.half[0], centre[1] / self.half[1]];
        let square = x * x + y * y;
        let stretch = self.uneven * (square / 2.0).min(1.0);
        let sigmas = [self.sigma * (1.0 + stretch), self.sigma / (1.0 + stretch)];
        let radius = square.sqrt();
        let long = if radius > 0.0 { [x / radius, y / radius] } else { [1.0, 0.0] };
        BeamSpot { centre, light, sigmas, long }
    }
}

impl BeamSpot {
    /// Irradiance in a direction.
    pub fn at(&self, direction: [f64; 2]) -> f64 {
        let [x, y] = [direction[0] - self.centre[0], direction[1] - self.centre[1]];
        let reach = REACH_SIGMAS * self.sigmas[0];
        // Also true for NaN, which marks points that the beam cannot reach.
        if !(x.abs() <= reach && y.abs() <= reach) {
            return 0.0;
        }
        let along = (x * self.long[0] + y * self.long[1]) / self.sigmas[0];
        let across = (y * self.long[0] - x * self.long[1]) / self.sigmas[1];
        self.light * (-0.5 * (along * along + across * across)).exp()
    }

    /// Total light: irradiance integrated over solid angle.
    pub fn flux(&self) -> f64 {
        self.light * std::f64::consts::TAU * self.sigmas[0] * self.sigmas[1]
    }

    /// The same spot at another position, with a fraction of its light.
    pub fn refracted(&self, centre: [f64; 2], share: f64) -> Self {
        Self { centre, light: share * self.light, ..*self }
    }

    /// Standard deviation of a round spot of the same area.
    pub fn sigma(&self) -> f64 {
        (self.sigmas[0] * self.sigmas[1]).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_spot_is_as_wide_as_stated_and_uneven_towards_the_corners() {
        let dot = SimDot::default();
        let half = [0.081, 0.046];
        let beam = DotBeam::new(&dot, half);
        let middle = beam.spot([0.0, 0.0], 1.0);
        let half_width = (dot.fwhm_deg / 2.0).to_radians().tan();
        for direction in [[half_width, 0.0], [0.0, -half_width]] {
            assert!((middle.at(direction) - 0.5).abs() < 1e-4, "{}", middle.at(direction));
        }
        let corner = beam.spot(half, 1.0);
        let along = corner.at([half[0] + 0.003 * 0.5_f64.sqrt(), half[1] + 0.003 * 0.5_f64.sqrt()]);
        let across = corner.at([half[0] + 0.003 * 0.5_f64.sqrt(), half[1] - 0.003 * 0.5_f64.sqrt()]);
        assert!(along > 1.2 * across, "{along} {across}");
        assert_eq!(middle.at([f64::NAN, 0.0]), 0.0);
    }
}
