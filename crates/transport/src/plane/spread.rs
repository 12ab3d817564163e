//! How far light spreads: width and asymmetry of a profile, and the decay length of a turbid medium.
//!
//! The line source is that of Farrell, Patterson and Wilson, "A diffusion theory model of spatially resolved, steady-state
//! diffuse reflectance" (1992), integrated along the illuminated row, because a pixel of the plane rig receives light
//! from all of it:
//!
//! ```text
//! R(x) = A mu [ z0 K1(mu r1) / r1 + (z0 + 2 zb) K1(mu r2) / r2 ]
//! r1^2 = x^2 + z0^2,  r2^2 = x^2 + (z0 + 2 zb)^2,  z0 = l,  zb = 2/3 l (1 + rd) / (1 - rd)
//! ```
//!
//! with the transport mean free path l, the effective attenuation mu, and the internal reflection rd of the surface
//! (Groenhuis et al., 1983). Diffusion holds only beyond two mean free paths, so nearer light is not used.

use ndarray::ArrayView1;

/// Light nearer than this many mean free paths has been scattered too few times.
const NEAREST_FREE_PATHS: f64 = 2.0;
/// Fewer distances do not determine amplitude, mean free path and decay.
const LEAST_DISTANCES: usize = 5;
/// Light fainter than this share of the nearest that is used is mostly noise.
const FAINT: f64 = 0.01;
/// Mean free paths that are tried, as shares of the largest distance.
const FREE_PATHS: usize = 12;
/// Steps of the search for the attenuation.
const SEARCH_STEPS: usize = 24;

/// A profile over the distance from the illuminated row.
#[derive(Debug, Clone, Copy)]
pub struct SpreadProfile<'a> {
    /// Light at u = `u_min`, `u_min + 1`, ...
    pub light: ArrayView1<'a, f32>,
    /// The first row, relative to the pixel's own.
    pub u_min: i64,
}

/// The decay of a medium.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decay {
    /// Distance over which light in the medium falls to 1/e, 1 / mu_eff, in mm.
    pub length_mm: f64,
    /// Transport mean free path, in mm: only its order of magnitude is determined.
    pub free_path_mm: f64,
}

impl SpreadProfile<'_> {
    fn at(&self, u: i64) -> Option<f64> {
        let index = usize::try_from(u - self.u_min).ok()?;
        self.light.get(index).map(|light| f64::from(*light)).filter(|light| light.is_finite())
    }

    /// Rows to both sides that the profile has.
    fn reach(&self) -> i64 {
        let last = self.u_min + self.light.len() as i64 - 1;
        last.min(-self.u_min).max(0)
    }

    /// Width of the band around the pixel's own row from which half of the light comes, in rows; `None` without light.
    pub fn effective_width_rows(&self) -> Option<f64> {
        let reach = self.reach();
        let both = |k: i64| -> Option<f64> {
            let (below, above) = (self.at(k)?, self.at(-k)?);
            Some(if k == 0 { below } else { below + above })
        };
        // As far as both sides are known.
        let light: Vec<f64> = (0..=reach).map_while(both).collect();
        let half = 0.5 * light.iter().sum::<f64>();
        if half.is_nan() || half <= 0.0 {
            return None;
        }
        let mut within = 0.0;
        for (k, light) in light.iter().enumerate() {
            if within + light >= half {
                let share = (half - within) / light;
                // Rows k on both sides, from k - 1/2 to k + 1/2; row 0 is there once.
                return Some(if k == 0 { share } else { 2.0 * (k as f64 - 0.5 + share) });
            }
            within += light;
        }
        None
    }

    /// Light from lower rows minus light from upper rows, as a share of both; `None` if there is none.
    pub fn asymmetry(&self) -> Option<f64> {
        let sides = (1..=self.reach()).map_while(|k| Some((self.at(k)?, self.at(-k)?)));
        let (below, above) = sides.fold((0.0, 0.0), |sums, sides| (sums.0 + sides.0, sums.1 + sides.1));
        (below + above > 0.0).then(|| (below - above) / (below + above))
    }

    /// The decay of a turbid medium, if light spreads in it as diffusion says. `refractive_index` is the medium's, below
    /// air.
    pub fn decay(&self, mm_per_row: f64, refractive_index: f64) -> Option<Decay> {
        let mut light: Vec<(f64, f64)> = (1..=self.reach())
            .filter_map(|k| Some((k as f64 * mm_per_row, 0.5 * (self.at(k)? + self.at(-k)?))))
            .collect();
        let brightest = light.first()?.1;
        let dark = light.iter().position(|(_, light)| *light <= FAINT * brightest).unwrap_or(light.len());
        light.truncate(dark);
        let farthest_mm = light.last()?.0;
        let surface = Surface::of(refractive_index);
        let nearest_mm = 0.25 * mm_per_row;
        let mut best: Option<(f64, Decay)> = None;
        for step in 0..FREE_PATHS {
            let share = step as f64 / (FREE_PATHS - 1) as f64;
            let free_path_mm = nearest_mm * (farthest_mm / (4.0 * nearest_mm)).max(1.0).powf(share);
            let used: Vec<_> =
                light.iter().copied().filter(|(x, _)| *x >= NEAREST_FREE_PATHS * free_path_mm).collect();
            if used.len() < LEAST_DISTANCES {
                continue;
            }
            let (misfit, length_mm) = surface.fit(&used, free_path_mm, farthest_mm);
            if best.is_none_or(|(least, _)| misfit < least) {
                best = Some((misfit, Decay { length_mm, free_path_mm }));
            }
        }
        best.map(|(_, decay)| decay)
    }
}

/// The boundary between a medium and air.
struct Surface {
    /// Extrapolated boundary, in mean free paths.
    boundary: f64,
}

impl Surface {
    fn of(index: f64) -> Self {
        let reflected = -1.440 / (index * index) + 0.710 / index + 0.668 + 0.0636 * index;
        Self { boundary: 2.0 / 3.0 * (1.0 + reflected) / (1.0 - reflected) }
    }

    /// The line source's light at `x_mm`, up to its amplitude.
    fn reflectance(&self, x_mm: f64, free_path_mm: f64, attenuation_per_mm: f64) -> f64 {
        let source = |depth_mm: f64| {
            let r_mm = x_mm.hypot(depth_mm);
            attenuation_per_mm * depth_mm * bessel_k1(attenuation_per_mm * r_mm) / r_mm
        };
        source(free_path_mm) + source(free_path_mm * (1.0 + 2.0 * self.boundary))
    }

    /// Mean squared deviation of logarithms, and the decay length with the least one, by golden section.
    fn fit(&self, light: &[(f64, f64)], free_path_mm: f64, farthest_mm: f64) -> (f64, f64) {
        let misfit = |log_length: f64| {
            let attenuation_per_mm = (-log_length).exp();
            let differences: Vec<f64> = light
                .iter()
                .map(|&(x_mm, light)| {
                    light.ln() - self.reflectance(x_mm, free_path_mm, attenuation_per_mm).ln()
                })
                .collect();
            let mean = differences.iter().sum::<f64>() / differences.len() as f64;
            differences.iter().map(|difference| (difference - mean).powi(2)).sum::<f64>()
                / (differences.len() - 2) as f64
        };
        let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
        let (mut low, mut high) = ((0.02 * farthest_mm).ln(), (20.0 * farthest_mm).ln());
        for _ in 0..SEARCH_STEPS {
            let span = golden * (high - low);
            let (left, right) = (high - span, low + span);
            if misfit(left) < misfit(right) {
                high = right;
            } else {
                low = left;
            }
        }
        let middle = 0.5 * (low + high);
        (misfit(middle), middle.exp())
    }
}

/// The modified Bessel function of the second kind and order 1: Abramowitz and Stegun 9.8.3, 9.8.7 and 9.8.8, to 1e-6.
fn bessel_k1(x: f64) -> f64 {
    let polynomial =
        |coefficients: [f64; 7], t: f64| coefficients.iter().rev().fold(0.0, |sum, c| sum * t + c);
    if x > 2.0 {
        let far = [
            1.253_314_14,
            0.234_986_19,
            -0.036_556_2,
            0.015_042_68,
            -0.007_803_53,
            0.003_256_14,
            -0.000_682_45,
        ];
        return (-x).exp() / x.sqrt() * polynomial(far, 2.0 / x);
    }
    let i1 = [0.5, 0.878_905_94, 0.514_988_69, 0.150_849_34, 0.026_587_33, 0.003_015_32, 0.000_324_11];
    let i1 = x * polynomial(i1, (x / 3.75).powi(2));
    let near = [1.0, 0.154_431_44, -0.672_785_79, -0.181_568_97, -0.019_194_02, -0.001_104_04, -0.000_046_86];
    (0.5 * x).ln() * i1 + polynomial(near, (0.5 * x).powi(2)) / x
}

#[cfg(test)]
mod tests {
    use ndarray::Array1;

    use super::*;

    #[test]
    fn bessel_functions_are_those_of_the_tables() {
        // Abramowitz and Stegun, table 9.8.
        for (x, known) in
            [(0.1, 9.853_844_780_870_606), (1.0, 0.601_907_230_197_234_6), (5.0, 0.004_044_613_445_452_164)]
        {
            let found = bessel_k1(x);
            assert!((found / known - 1.0).abs() < 1e-6, "{x}: {found} {known}");
        }
    }

    #[test]
    fn half_of_the_light_comes_from_the_effective_width() {
        let of = |light: &[f32]| {
            let light = Array1::from(light.to_vec());
            SpreadProfile { light: light.view(), u_min: -((light.len() / 2) as i64) }.effective_width_rows()
        };
        assert_eq!(of(&[0.0, 0.0, 1.0, 0.0, 0.0]), Some(0.5));
        // A flat profile of 5 rows: half of the light is in 2.5 of them.
        assert_eq!(of(&[1.0; 5]), Some(2.5));
        assert_eq!(of(&[1.0, 0.0, 0.0, 0.0, 1.0]), Some(4.0));
        assert_eq!(of(&[0.0; 5]), None);
        // What is not known on one side is left out on both.
        assert_eq!(of(&[f32::NAN, 1.0, 1.0, 1.0, 9.0]), Some(1.5));
        assert_eq!(of(&[]), None);
    }

    #[test]
    fn asymmetry_is_the_side_that_more_light_comes_from() {
        let light = Array1::from(vec![0.0_f32, 1.0, 5.0, 3.0, 0.0]);
        let profile = SpreadProfile { light: light.view(), u_min: -2 };
        assert_eq!(profile.asymmetry(), Some(0.5));
    }
}
