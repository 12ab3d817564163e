use super::random::Random;

/// Number of scenes in the family, and of pixels in each of them.
pub(super) const SCENES: usize = 24;
pub(super) const PIXELS_PER_SCENE: usize = 9;

/// Light of one pixel by relative row, 1.0 for a white surface under its own row.
///
/// It is the sum of what single surfaces and bodies are known to do:
///
/// - direct light at `u = 0`;
/// - light that spreads under the surface: exponentials over the distance, as multiple scattering gives (Farrell et
///   al., "A diffusion theory model of spatially resolved, steady-state diffuse reflectance", Medical Physics 1992),
///   one short and one long, a little stronger to one side;
/// - interreflection of surfaces that meet or face each other: the form factor of a strip at a distance, a lobe
///   `(1 + (u - centre)^2 / width^2)^(-3/2)`;
/// - a floor from everything else, the same from all rows.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FamilyPixel {
    direct: f64,
    spread: [Exponential; 2],
    lobes: [Lobe; 2],
    floor: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Exponential {
    /// Light of all rows.
    light: f64,
    length_rows: f64,
    /// Share of the light by which the side `u > 0` has more than its half.
    skew: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Lobe {
    /// Light of all rows.
    light: f64,
    centre_rows: f64,
    width_rows: f64,
}

impl FamilyPixel {
    /// Light from relative row `u`.
    pub fn light(&self, u: i32) -> f64 {
        let rows = f64::from(u);
        let direct = if u == 0 { self.direct } else { 0.0 };
        let spread = self.spread.iter().map(|spread| {
            // The integral of the exponential over the row.
            let side =
                |from: f64, to: f64| (-from / spread.length_rows).exp() - (-to / spread.length_rows).exp();
            let (near, far) = ((rows.abs() - 0.5).max(0.0), rows.abs() + 0.5);
            match u {
                0 => spread.light * side(0.0, 0.5),
                _ => spread.light * (0.5 + 0.5 * spread.skew * rows.signum()) * side(near, far),
            }
        });
        let lobes = self.lobes.iter().map(|lobe| {
            let distance = (rows - lobe.centre_rows) / lobe.width_rows;
            lobe.light / (2.0 * lobe.width_rows) * (1.0 + distance * distance).powf(-1.5)
        });
        direct + spread.sum::<f64>() + lobes.sum::<f64>() + self.floor
    }
}

/// The transports over which errors are predicted: pixels of [`SCENES`] scenes, the same at every call.
///
/// A scene is a printed or painted opaque surface with bodies on it. Scenes differ in brightness and contrast, in the
/// share of pixels that show a translucent body (none to all), in how much of its light spreads inside and how far, and
/// in how strongly surfaces light each other. The ranges are those of everyday matter under a projector of some hundred rows; none is fitted to a
/// rendered scene.
pub(super) fn family() -> Vec<Vec<FamilyPixel>> {
    (0..SCENES).map(scene).collect()
}

fn scene(index: usize) -> Vec<FamilyPixel> {
    // Shares of translucent pixels are spread evenly over the scenes, and one scene in four has none.
    let translucent = (index as f64 / (SCENES - 1) as f64 * 4.0 / 3.0 - 1.0 / 3.0).max(0.0);
    let mut random = Random::new(index as u64);
    let (length_rows, reflectance) = (random.log_uniform(1.0, 5.0), random.log_uniform(0.03, 0.3));
    let brightness = random.log_uniform(0.3, 1.0);
    let darkest = random.uniform(0.4, 0.8);
    let body_spread = random.uniform(0.4, 1.2).min(1.0);
    (0..PIXELS_PER_SCENE)
        .map(|pixel| {
            let is_translucent = (pixel as f64 + 0.5) / (PIXELS_PER_SCENE as f64) < translucent;
            let albedo = brightness * random.log_uniform(darkest, 0.9);
            let spread = if is_translucent { body_spread } else { 0.0 };
            let near = random.uniform(0.5, 0.8);
            let exponential = |share: f64, rows: f64, skew: f64| Exponential {
                light: albedo * spread * share,
                length_rows: length_rows * rows,
                skew,
            };
            let spread_lights = [
                exponential(near, random.uniform(0.5, 1.2), random.uniform(-0.2, 0.2)),
                exponential(1.0 - near, random.uniform(2.0, 5.0), random.uniform(-0.2, 0.2)),
            ];
            let mut lobe = || Lobe {
                light: albedo * reflectance * random.log_uniform(0.2, 2.0),
                centre_rows: random.uniform(-60.0, 60.0),
                width_rows: random.log_uniform(4.0, 40.0),
            };
            let lobes = [lobe(), lobe()];
            let floor = albedo * random.log_uniform(1e-5, 5e-4);
            FamilyPixel { direct: albedo * (1.0 - spread), spread: spread_lights, lobes, floor }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_family_is_the_same_at_every_call() {
        let family = family();
        assert_eq!(family, super::family());
        assert!(family.iter().all(|scene| scene.len() == PIXELS_PER_SCENE) && family.len() == SCENES);
    }

    #[test]
    fn light_is_divided_among_the_rows_and_none_is_lost() {
        for profile in family().concat() {
            let rows: f64 = (-20_000..=20_000).map(|u| profile.light(u) - profile.floor).sum();
            let lights = profile.spread.iter().map(|spread| spread.light);
            let expected = profile.direct
                + lights.sum::<f64>()
                + profile.lobes.iter().map(|lobe| lobe.light).sum::<f64>();
            assert!((rows / expected - 1.0).abs() < 1e-3, "{rows} is not {expected}");
        }
    }
}
