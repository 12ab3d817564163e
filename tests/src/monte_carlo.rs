//! Light transport of turbid media in open containers, photon by photon, after Wang, Jacques and Zheng, "MCML: Monte
//! Carlo modeling of light transport in multi-layered tissues" (1995). It shares nothing with the models that this
//! project fits: no diffusion, no dipole, walls and corners included.

use std::f64::consts::TAU;

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};

/// What a container is filled with.
#[derive(Debug, Clone, Copy)]
pub struct Medium {
    /// Inverse mean distance between scattering events.
    pub scattering_per_mm: f64,
    /// Inverse mean distance to absorption.
    pub absorption_per_mm: f64,
    /// Mean cosine of the Henyey-Greenstein phase function.
    pub anisotropy: f64,
    /// Refractive index; above the medium is air.
    pub index: f64,
}

impl Medium {
    /// A medium of known reduced scattering, which is what tables give.
    pub fn of_reduced(scattering_per_mm: f64, absorption_per_mm: f64) -> Self {
        let anisotropy = 0.8;
        let scattering_per_mm = scattering_per_mm / (1.0 - anisotropy);
        Self { scattering_per_mm, absorption_per_mm, anisotropy, index: 1.33 }
    }
}

/// A box that is open above, from (0, 0, 0) to `size_mm` in x, y and z; z points into the medium.
#[derive(Debug, Clone, Copy)]
pub struct Container {
    /// In x, y and z.
    pub size_mm: [f64; 3],
    /// Albedo of its walls and its floor, which reflect diffusely.
    pub wall_albedo: f64,
}

/// Light that left the medium through its surface.
#[derive(Debug, Clone, Copy)]
pub struct Exit {
    /// Where, x and y.
    pub at_mm: [f64; 2],
    /// Share of the light that entered.
    pub light: f64,
}

/// A photon packet is followed until this share is left, then it survives one time in ten.
const FAINT: f64 = 1e-3;

struct Dice(Xoshiro256PlusPlus);

impl Dice {
    /// Uniform in (0, 1].
    fn roll(&mut self) -> f64 {
        ((self.0.next_u64() >> 11) + 1) as f64 / (1_u64 << 53) as f64
    }
}

/// Follows photon packets that enter at places uniform over the surface, from `direction` in air (x and y of a unit
/// vector), and tells where each entered and what left. The same seed gives the same packets.
pub fn follow(
    medium: Medium,
    container: Container,
    direction: [f64; 2],
    packets: u64,
    seed: u64,
    mut left: impl FnMut([f64; 2], Exit),
) {
    let mut dice = Dice(Xoshiro256PlusPlus::seed_from_u64(seed));
    for _ in 0..packets {
        let entry_mm = [0, 1].map(|axis| dice.roll() * container.size_mm[axis]);
        packet(&mut dice, medium, container, direction, entry_mm, |exit| left(entry_mm, exit));
    }
}

fn packet(
    dice: &mut Dice,
    medium: Medium,
    container: Container,
    direction: [f64; 2],
    entry_mm: [f64; 2],
    mut left: impl FnMut(Exit),
) {
    let extinction = medium.scattering_per_mm + medium.absorption_per_mm;
    let albedo = medium.scattering_per_mm / extinction;
    // Refraction keeps the direction along the surface, divided by the index.
    let mut heading = pointing([direction[0] / medium.index, direction[1] / medium.index]);
    let mut place = [entry_mm[0], entry_mm[1], 0.0];
    let mut light = 1.0;
    let mut free_mm = -dice.roll().ln() / extinction;
    loop {
        let (wall_mm, axis) = (0..3)
            .map(|axis| {
                let end = if heading[axis] > 0.0 { container.size_mm[axis] } else { 0.0 };
                let far = (end - place[axis]) / heading[axis];
                (if heading[axis] == 0.0 { f64::INFINITY } else { far.max(0.0) }, axis)
            })
            .fold((f64::INFINITY, 2), |nearest, wall| if wall.0 < nearest.0 { wall } else { nearest });
        let step_mm = free_mm.min(wall_mm);
        for (place, heading) in place.iter_mut().zip(heading) {
            *place += heading * step_mm;
        }
        if free_mm < wall_mm {
            light *= albedo;
            heading = scattered(dice, heading, medium.anisotropy);
            free_mm = -dice.roll().ln() / extinction;
        } else {
            free_mm -= wall_mm;
            if axis == 2 && heading[2] < 0.0 {
                place[2] = 0.0;
                if dice.roll() > reflected(-heading[2], medium.index) {
                    left(Exit { at_mm: [place[0], place[1]], light });
                    return;
                }
                heading[2] = -heading[2];
            } else {
                light *= container.wall_albedo;
                let inward = -heading[axis].signum();
                place[axis] = if inward > 0.0 { 0.0 } else { container.size_mm[axis] };
                let (radius, turn) = (dice.roll().sqrt(), TAU * dice.roll());
                let others = [(axis + 1) % 3, (axis + 2) % 3];
                heading[others[0]] = radius * turn.cos();
                heading[others[1]] = radius * turn.sin();
                heading[axis] = inward * (1.0 - radius * radius).sqrt();
            }
        }
        if light < FAINT {
            if dice.roll() > 0.1 {
                return;
            }
            light *= 10.0;
        }
    }
}

fn pointing([x, y]: [f64; 2]) -> [f64; 3] {
    [x, y, (1.0 - x * x - y * y).sqrt()]
}

/// Share of unpolarised light that stays inside at the surface (Fresnel).
fn reflected(cosine_inside: f64, index: f64) -> f64 {
    let sine_outside_squared = index * index * (1.0 - cosine_inside * cosine_inside);
    if sine_outside_squared >= 1.0 {
        return 1.0;
    }
    let outside = (1.0 - sine_outside_squared).sqrt();
    let across = (index * cosine_inside - outside) / (index * cosine_inside + outside);
    let along = (cosine_inside - index * outside) / (cosine_inside + index * outside);
    0.5 * (across * across + along * along)
}

fn scattered(dice: &mut Dice, [x, y, z]: [f64; 3], anisotropy: f64) -> [f64; 3] {
    let roll = dice.roll();
    let cosine = if anisotropy.abs() < 1e-6 {
        2.0 * roll - 1.0
    } else {
        let g = anisotropy;
        let part = (1.0 - g * g) / (1.0 - g + 2.0 * g * roll);
        (1.0 + g * g - part * part) / (2.0 * g)
    };
    let sine = (1.0 - cosine * cosine).max(0.0).sqrt();
    let (sin_turn, cos_turn) = (TAU * dice.roll()).sin_cos();
    let level = (1.0 - z * z).max(0.0).sqrt();
    if level < 1e-5 {
        return [sine * cos_turn, sine * sin_turn, cosine * z.signum()];
    }
    let turned = [
        sine * (x * z * cos_turn - y * sin_turn) / level + x * cosine,
        sine * (y * z * cos_turn + x * sin_turn) / level + y * cosine,
        -sine * cos_turn * level + z * cosine,
    ];
    // Rounding errors of many events would add up.
    let length = turned.iter().map(|part| part * part).sum::<f64>().sqrt();
    turned.map(|part| part / length)
}

#[cfg(test)]
mod tests {
    use super::*;

    const BLACK: f64 = 0.0;

    fn reflectance(medium: Medium, container: Container, packets: u64) -> f64 {
        let mut all = 0.0;
        follow(medium, container, [0.0, 0.0], packets, 7, |_, exit| all += exit.light);
        all / packets as f64
    }

    #[test]
    fn a_slab_reflects_what_van_de_hulst_tabulates() {
        let medium = Medium { scattering_per_mm: 9.0, absorption_per_mm: 1.0, anisotropy: 0.75, index: 1.0 };
        let wide = Container { size_mm: [1e4, 1e4, 0.2], wall_albedo: BLACK };
        let found = reflectance(medium, wide, 400_000);
        assert!((found - 0.09739).abs() < 0.0015, "{found}");
    }

    #[test]
    fn a_deep_medium_with_a_surface_reflects_what_giovanelli_found() {
        let medium = Medium { scattering_per_mm: 9.0, absorption_per_mm: 1.0, anisotropy: 0.0, index: 1.5 };
        let deep = Container { size_mm: [1e4, 1e4, 1e3], wall_albedo: BLACK };
        // His number includes the 4 % of the light that the surface mirrors.
        let found = 0.04 + 0.96 * reflectance(medium, deep, 200_000);
        assert!((found - 0.26).abs() < 0.003, "{found}");
    }

    #[test]
    fn without_absorption_all_light_comes_back() {
        let medium = Medium { scattering_per_mm: 5.0, absorption_per_mm: 0.0, anisotropy: 0.5, index: 1.33 };
        let white = Container { size_mm: [4.0, 3.0, 2.0], wall_albedo: 1.0 };
        let found = reflectance(medium, white, 5_000);
        assert!((found - 1.0).abs() < 1e-9, "{found}");
    }
}
