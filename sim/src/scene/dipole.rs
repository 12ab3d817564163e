//! Diffusion of light inside a translucent medium: the dipole of Jensen, Marschner, Levoy and
//! Hanrahan, "A practical model for subsurface light transport", SIGGRAPH 2001.
//!
//! Neglected: the single-scattering term, and any deviation from a flat, semi-infinite, uniform medium (for curved and
//! bounded bodies, the straight distance between entry and exit is used).

use std::f64::consts::PI;

/// Optical properties per RGB band.
#[derive(Debug)]
pub(super) struct Material {
    pub(super) name: &'static str,
    /// Reduced scattering coefficient, 1/mm.
    scattering_per_mm: [f64; 3],
    /// Absorption coefficient, 1/mm.
    absorption_per_mm: [f64; 3],
    /// Relative index of refraction.
    pub(super) refraction: f64,
}

impl Material {
    pub(super) fn dipole(&self, band: usize) -> Dipole {
        Dipole::new(self.scattering_per_mm[band], self.absorption_per_mm[band], self.refraction)
    }
}

const fn material(
    name: &'static str,
    scattering_per_mm: [f64; 3],
    absorption_per_mm: [f64; 3],
    refraction: f64,
) -> Material {
    Material { name, scattering_per_mm, absorption_per_mm, refraction }
}

/// Measured media from Jensen et al. 2001, figure 5 (the paper's table of measured parameters).
pub(super) const MEASURED: [Material; 5] = [
    material("marble", [2.19, 2.62, 3.00], [0.0021, 0.0041, 0.0071], 1.5),
    material("skim milk", [0.70, 1.22, 1.90], [0.0014, 0.0025, 0.0142], 1.3),
    material("skin1", [0.74, 0.88, 1.01], [0.032, 0.17, 0.48], 1.3),
    material("whole milk", [2.55, 3.21, 3.77], [0.0011, 0.0024, 0.014], 1.3),
    material("ketchup", [0.18, 0.07, 0.03], [0.061, 0.97, 1.45], 1.3),
];

/// Candle wax \[A\]: a medium between skim milk and marble, for lack of a published table.
pub(super) const WAX: Material = material("wax", [1.30, 1.20, 1.10], [0.0008, 0.0020, 0.0090], 1.44);

/// A real source below the surface and its negative image source above it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Dipole {
    reduced_albedo: f64,
    /// Effective transport coefficient, 1/mm.
    transport_per_mm: f64,
    real_depth_mm: f64,
    image_height_mm: f64,
}

impl Dipole {
    fn new(scattering_per_mm: f64, absorption_per_mm: f64, refraction: f64) -> Self {
        let extinction_per_mm = scattering_per_mm + absorption_per_mm;
        let reflected = -1.440 / (refraction * refraction) + 0.710 / refraction + 0.668 + 0.0636 * refraction;
        let boundary = (1.0 + reflected) / (1.0 - reflected);
        let real_depth_mm = 1.0 / extinction_per_mm;
        Self {
            reduced_albedo: scattering_per_mm / extinction_per_mm,
            transport_per_mm: (3.0 * absorption_per_mm * extinction_per_mm).sqrt(),
            real_depth_mm,
            image_height_mm: real_depth_mm * (1.0 + 4.0 / 3.0 * boundary),
        }
    }

    /// Diffuse reflectance R_d at the distance `r_mm` from the point where light enters: exitance per incident power,
    /// 1/mm² (equation 4).
    pub(super) fn reflectance_per_mm2(&self, r_mm: f64) -> f64 {
        let pole = |z: f64| {
            let d = (r_mm * r_mm + z * z).sqrt();
            z * (self.transport_per_mm * d + 1.0) * (-self.transport_per_mm * d).exp() / (d * d * d)
        };
        self.reduced_albedo / (4.0 * PI) * (pole(self.real_depth_mm) + pole(self.image_height_mm))
    }
}

/// Unpolarised Fresnel transmittance into a dielectric at the given cosine of the angle of incidence.
pub(super) fn fresnel_transmittance(cos: f64, refraction: f64) -> f64 {
    let cos = cos.clamp(0.0, 1.0);
    let inside = (1.0 - (1.0 - cos * cos) / (refraction * refraction)).sqrt();
    let s = (cos - refraction * inside) / (cos + refraction * inside);
    let p = (refraction * cos - inside) / (refraction * cos + inside);
    1.0 - 0.5 * (s * s + p * p)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Closed form of the integral of R_d over the plane (Jensen and Buhler 2002, equation 3).
    fn total_reflectance(dipole: &Dipole, refraction: f64) -> f64 {
        let reflected = -1.440 / (refraction * refraction) + 0.710 / refraction + 0.668 + 0.0636 * refraction;
        let boundary = (1.0 + reflected) / (1.0 - reflected);
        let root = (3.0 * (1.0 - dipole.reduced_albedo)).sqrt();
        0.5 * dipole.reduced_albedo * (1.0 + (-4.0 / 3.0 * boundary * root).exp()) * (-root).exp()
    }

    #[test]
    fn profile_integrates_to_the_diffuse_albedo() {
        for material in MEASURED.iter().chain([&WAX]) {
            for band in 0..3 {
                let dipole = material.dipole(band);
                let steps = 200_000;
                // The substitution r = exp(q) spreads the samples over the decades of r.
                let (from, to) = (1e-5_f64.ln(), 2000.0_f64.ln());
                let step = (to - from) / f64::from(steps);
                let sum: f64 = (0..steps)
                    .map(|k| (from + (f64::from(k) + 0.5) * step).exp())
                    .map(|r| dipole.reflectance_per_mm2(r) * 2.0 * PI * r * r * step)
                    .sum();
                let expected = total_reflectance(&dipole, material.refraction);
                assert!((sum - expected).abs() < 1e-5, "{} {band}: {sum} {expected}", material.name);
            }
        }
    }

    /// The paper lists the diffuse reflectance of each medium next to its coefficients.
    #[test]
    fn albedo_agrees_with_the_published_reflectance() {
        let published = [
            [0.83, 0.79, 0.75],
            [0.81, 0.81, 0.69],
            [0.44, 0.22, 0.13],
            [0.91, 0.88, 0.76],
            [0.16, 0.01, 0.00],
        ];
        for (material, published) in MEASURED.iter().zip(published) {
            for (band, published) in published.into_iter().enumerate() {
                let albedo = total_reflectance(&material.dipole(band), material.refraction);
                let name = material.name;
                assert!((albedo - published).abs() < 0.011, "{name} {band}: {albedo} {published}");
            }
        }
    }

    /// Marble, green, computed by hand: sigma_t' = 2.6241, alpha' = 0.998438, sigma_tr = 0.179657,
    /// z_r = 0.381083, F_dr = 0.596733, A = 3.959500, z_v = 2.392947.
    #[test]
    fn marble_by_hand() {
        let dipole = MEASURED[0].dipole(1);
        assert!((dipole.transport_per_mm - 0.179657).abs() < 1e-6);
        assert!((dipole.real_depth_mm - 0.381083).abs() < 1e-6);
        assert!((dipole.image_height_mm - 2.392947).abs() < 1e-4);
        // r = 0: alpha' / (4 pi) * ((0.179657 + 1/z_r) exp(-0.068464)/z_r + the same for z_v)
        let real = (0.179657 + 2.624100) * 0.933827 * 2.624100;
        let image = (0.179657 + 0.417895) * 0.650522 * 0.417895;
        let expected = 0.998438 / (4.0 * PI) * (real + image);
        assert!((dipole.reflectance_per_mm2(0.0) - expected).abs() < 1e-4 * expected);
    }

    #[test]
    fn fresnel_at_normal_and_grazing_incidence() {
        assert!((fresnel_transmittance(1.0, 1.5) - 0.96).abs() < 1e-12);
        assert!(fresnel_transmittance(0.0, 1.5).abs() < 1e-12);
        // Brewster's angle, where p-polarised light is not reflected: 1 - s²/2 with s = (n² - 1)/(n² + 1).
        let brewster = (1.0_f64 / (1.0 + 1.5 * 1.5)).sqrt();
        let expected = 1.0 - 0.5 * (1.25_f64 / 3.25).powi(2);
        assert!((fresnel_transmittance(brewster, 1.5) - expected).abs() < 1e-12);
    }
}
