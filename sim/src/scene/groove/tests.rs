use super::*;

const TILTS: [f64; 2] = [0.75, 0.85];

fn size() -> SceneSize {
    SceneSize { rows: 40, columns: 48 }
}

/// A uniformly coloured groove whose edge lies at row 18.
fn plain(albedo: f32) -> Bounces {
    let SceneSize { rows, columns } = size();
    let mut direct = Direct::new(size(), 1, |_, x| x as f32 / columns as f32);
    for ((row, ..), value) in direct.value.indexed_iter_mut() {
        *value = albedo * TILTS[usize::from(row >= 18)].cos() as f32;
    }
    Bounces::new(18, TILTS, Array3::from_elem((rows, columns, 1), albedo), direct)
}

fn walls() -> [Wall; 2] {
    [Wall::new(18, TILTS[0]), Wall::new(22, TILTS[1])]
}

/// Each row of form factors sums to the form factor of the whole opposite wall, which is one rectangle. For the lower
/// wall, the table is derived from the upper wall's quadrature by reciprocity while the whole is integrated the other
/// way round, which makes the check independent.
#[test]
fn form_factors_close() {
    let groove = plain(0.8);
    let (walls, columns) = (walls(), groove.patch_columns);
    let width = size().columns as f64 / columns as f64;
    let opening = PI - TILTS[0] - TILTS[1];
    for receiver in [0, 1] {
        let other = &walls[1 - receiver];
        let whole = 0.0..other.extent(other.len() - 1).end;
        for (patch, row) in groove.onto[receiver].outer_iter().enumerate() {
            let sum = f64::from(row.sum());
            let extent = walls[receiver].extent(patch / columns);
            let along = (patch % columns) as f64 * width..(patch % columns + 1) as f64 * width;
            let area = (extent.end - extent.start) * width;
            let expected =
                exchange(opening, (&extent, &along), (&whole, &(0.0..size().columns as f64))) / area;
            assert!(
                sum <= 1.0 && (sum - expected).abs() < 2e-3,
                "wall {receiver}, {patch}: {sum} {expected}"
            );
        }
    }
}

#[test]
fn form_factors_are_reciprocal() {
    let groove = plain(0.8);
    let [upper, lower] = &groove.onto;
    for ((i, j), factor) in upper.indexed_iter() {
        let forth = factor / groove.inverse_areas[0][i];
        let back = lower[[j, i]] / groove.inverse_areas[1][j];
        assert!((forth - back).abs() <= 1e-5 * forth, "{i} {j}: {forth} {back}");
    }
}

/// White furnace: if the surroundings emit radiance 1 through the opening, walls of albedo 1 have exitance 1
/// everywhere.
#[test]
fn white_furnace() {
    let mut groove = plain(0.8);
    groove.patch_albedo.iter_mut().for_each(|albedo| albedo.fill(1.0));
    groove.bounces = 60;
    let from_walls = [0, 1].map(|w| groove.onto[w].sum_axis(Axis(1)));
    let first = [0, 1].map(|w| from_walls[w].mapv(|seen| 1.0 - seen).insert_axis(Axis(0)));
    let irradiance = groove.irradiance(0, &first);
    for wall in [0, 1] {
        for (irradiance, seen) in irradiance[wall].iter().zip(&from_walls[wall]) {
            assert!((irradiance - seen).abs() < 1e-4, "{irradiance} {seen}");
        }
    }
}

#[test]
fn series_has_converged() {
    let groove = plain(0.85);
    let mut longer = plain(0.85);
    longer.bounces *= 2;
    let first = groove.dark(1).map(|dark| dark + 1.0);
    for (short, long) in groove.irradiance(0, &first).iter().zip(&longer.irradiance(0, &first)) {
        assert!(short.iter().zip(long).all(|(short, long)| (short - long).abs() <= 3e-6 * long));
    }
}

#[test]
fn spreading_over_patches_keeps_the_flux() {
    let groove = plain(0.6);
    for row in [0, 5, 17, 18, 39] {
        let mut first = groove.dark(1);
        let wall = groove.wall_of(row);
        groove.reflect(row, 0, |_| 1.0, &mut first[wall].row_mut(0));
        let flux: f32 = first[wall].row(0).iter().zip(&groove.inverse_areas[wall]).map(|(e, a)| e / a).sum();
        // A row lights one row height of the image, whatever the tilt.
        let expected = 0.6 * size().columns as f32;
        assert!((flux / expected - 1.0).abs() < 1e-5, "row {row}: {flux} {expected}");
    }
}

/// Traces particles from the lit row through all their bounces. 1,000,000 particles: the standard error of a band of
/// four rows is below 1 %; the tolerance is 4 %.
#[test]
fn particles_agree() {
    let (albedo, rows, columns) = (0.7_f32, size().rows, size().columns as f64);
    let groove = plain(albedo);
    let walls = walls();
    let mut dice = Dice::new(5);
    for lit_row in [6, 16] {
        let particles = 1_000_000;
        let mut landed = vec![0.0; rows];
        for _ in 0..particles {
            let tilt = TILTS[0].cos();
            let mut at =
                (0, (18.0 - lit_row as f64 - dice.between(0.0, 1.0)) / tilt, dice.between(0.0, columns));
            let mut weight = 1.0;
            while weight > 1e-3 {
                let Some(next) = fly(at, &walls, columns, &mut dice) else { break };
                at = next;
                let rows_off = at.1 * TILTS[at.0].cos();
                let row = if at.0 == 0 { 18.0 - rows_off } else { 18.0 + rows_off };
                landed[(row as usize).min(rows - 1)] += weight;
                weight *= f64::from(albedo);
            }
        }
        let mut image = Array3::zeros((rows, size().columns, 1));
        let mut first = groove.dark(1);
        groove.reflect(lit_row, 0, |_| 1.0, &mut first[0].row_mut(0));
        let [upper, lower] = groove.irradiance(0, &first);
        groove.add_seen([upper.row(0), lower.row(0)], 0, &mut image.view_mut());
        for band in 0..rows / 4 {
            let rows = band * 4..band * 4 + 4;
            let flux = f64::from(albedo) * columns / f64::from(particles);
            // The landed flux is irradiance times wall area; the image shows albedo times irradiance.
            let expected: f64 = rows
                .clone()
                .map(|row| landed[row] * flux * TILTS[usize::from(row >= 18)].cos() * f64::from(albedo))
                .sum();
            let seen: f64 = rows.map(|row| f64::from(image.index_axis(Axis(0), row).sum())).sum();
            assert!((seen / expected - 1.0).abs() < 0.04, "row {lit_row}, band {band}: {seen} {expected}");
        }
    }
}

/// Emits a diffuse particle from `(wall, distance from the edge, x)`; returns where it lands on the other wall.
fn fly(
    from: (usize, f64, f64),
    walls: &[Wall; 2],
    columns: f64,
    dice: &mut Dice,
) -> Option<(usize, f64, f64)> {
    let opening = PI - TILTS[0] - TILTS[1];
    let (r, phi) = (dice.between(0.0, 1.0).sqrt(), dice.between(0.0, 2.0 * PI));
    let direction = [r * phi.cos(), r * phi.sin(), (1.0 - r * r).sqrt()];
    let towards = direction[2] * opening.cos() - direction[1] * opening.sin();
    let t = from.1 * opening.sin() / towards;
    let landed = (from.1 + t * direction[1]) * opening.cos() + t * direction[2] * opening.sin();
    let x = from.2 + t * direction[0];
    let wall = 1 - from.0;
    let height = walls[wall].extent(walls[wall].len() - 1).end;
    (t > 0.0 && (0.0..height).contains(&landed) && (0.0..columns).contains(&x)).then_some((wall, landed, x))
}

#[test]
fn patches_tile_the_wall() {
    for rows in 1..400 {
        let wall = Wall::new(rows, 0.8);
        assert_eq!((wall.rings[0], wall.rings[wall.len()]), (0.0, rows as f64));
        assert!(wall.rings.windows(2).all(|pair| pair[1] - pair[0] >= 0.5), "{rows}: {:?}", wall.rings);
    }
}
