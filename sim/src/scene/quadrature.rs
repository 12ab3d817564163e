//! Quadrature rules for patches and for cells between which light diffuses.

/// Gauss-Legendre nodes and weights on 0..1.
pub(super) const GAUSS_2: [(f64, f64); 2] = [(0.211_324_865_405_187_1, 0.5), (0.788_675_134_594_812_9, 0.5)];
const GAUSS_4: [(f64, f64); 4] = [
    (0.069_431_844_202_973_71, 0.173_927_422_568_726_93),
    (0.330_009_478_207_571_87, 0.326_072_577_431_273_07),
    (0.669_990_521_792_428_1, 0.326_072_577_431_273_07),
    (0.930_568_155_797_026_3, 0.173_927_422_568_726_93),
];
pub(super) const GAUSS_8: [(f64, f64); 8] = [
    (0.019_855_071_751_231_856, 0.050_614_268_145_188_13),
    (0.101_666_761_293_186_64, 0.111_190_517_226_687_24),
    (0.237_233_795_041_835_5, 0.156_853_322_938_943_64),
    (0.408_282_678_752_175_1, 0.181_341_891_689_181),
    (0.591_717_321_247_825, 0.181_341_891_689_181),
    (0.762_766_204_958_164_5, 0.156_853_322_938_943_64),
    (0.898_333_238_706_813_4, 0.111_190_517_226_687_24),
    (0.980_144_928_248_768_1, 0.050_614_268_145_188_13),
];
const MIDPOINT: [(f64, f64); 1] = [(0.0, 1.0)];

/// Distances, in cells, below which four and two points are needed: the dipole's profile is as narrow as a cell, steep
/// near its centre and flat far away.
const NEAR_CELLS: f64 = 4.0;
const MIDDLE_CELLS: f64 = 20.0;

/// Nodes and weights (sum 1) for the mean over the offset between two points, each uniform in its own cell of length 1:
/// the offset has a triangular density on -1..1.
pub(super) fn offset_rule(distance_cells: f64) -> &'static [(f64, f64)] {
    const NEAR: [(f64, f64); 8] = triangle(&GAUSS_4);
    const MIDDLE: [(f64, f64); 4] = triangle(&GAUSS_2);
    match distance_cells {
        d if d < NEAR_CELLS => &NEAR,
        d if d < MIDDLE_CELLS => &MIDDLE,
        _ => &MIDPOINT,
    }
}

/// Nodes and weights (sum 1) for the mean over one cell, -1/2..1/2.
pub(super) fn cell_rule(distance_cells: f64) -> &'static [(f64, f64)] {
    const NEAR: [(f64, f64); 4] = centred(&GAUSS_4);
    const MIDDLE: [(f64, f64); 2] = centred(&GAUSS_2);
    match distance_cells {
        d if d < NEAR_CELLS => &NEAR,
        d if d < MIDDLE_CELLS => &MIDDLE,
        _ => &MIDPOINT,
    }
}

const fn triangle<const N: usize, const M: usize>(half: &[(f64, f64); N]) -> [(f64, f64); M] {
    let mut rule = [(0.0, 0.0); M];
    let mut k = 0;
    while k < N {
        let (node, weight) = half[k];
        rule[2 * k] = (node, weight * (1.0 - node));
        rule[2 * k + 1] = (-node, weight * (1.0 - node));
        k += 1;
    }
    rule
}

const fn centred<const N: usize>(rule: &[(f64, f64); N]) -> [(f64, f64); N] {
    let mut rule = *rule;
    let mut k = 0;
    while k < N {
        rule[k].0 -= 0.5;
        k += 1;
    }
    rule
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gauss_is_exact_to_its_degree() {
        let moment = |rule: &[(f64, f64)], k: i32| rule.iter().map(|(x, w)| w * x.powi(k)).sum::<f64>();
        for rule in [&GAUSS_2[..], &GAUSS_4, &GAUSS_8] {
            for k in 0..2 * rule.len() as i32 {
                assert!((moment(rule, k) - 1.0 / f64::from(k + 1)).abs() < 1e-14, "{} {k}", rule.len());
            }
        }
    }

    #[test]
    fn rules_have_the_moments_of_triangle_and_box() {
        for distance in [1.0, 10.0, 100.0] {
            let rule = offset_rule(distance);
            let moment = |k: i32| rule.iter().map(|(x, w)| w * x.powi(k)).sum::<f64>();
            assert!((moment(0) - 1.0).abs() < 1e-12 && moment(1).abs() < 1e-12);
            if rule.len() > 1 {
                assert!((moment(2) - 1.0 / 6.0).abs() < 1e-12);
            }
            let rule = cell_rule(distance);
            let moment = |k: i32| rule.iter().map(|(x, w)| w * x.powi(k)).sum::<f64>();
            assert!((moment(0) - 1.0).abs() < 1e-12 && moment(1).abs() < 1e-12);
            if rule.len() > 1 {
                assert!((moment(2) - 1.0 / 12.0).abs() < 1e-12);
            }
        }
    }
}
