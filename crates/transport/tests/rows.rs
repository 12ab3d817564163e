//! The weights of rows with non-ideal time, position and extent, compared with a simulation of the clock.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

mod stepping;

use proptest::prelude::*;
use raysweep_transport::plane::{Beam, CameraRows, RowModel, RowTiming, Setting, SlotKind, reach};
use stepping::by_stepping_through_time;

const TAU_US: f64 = 20.0;

/// The light emitted while row `v` is drawn, when `light` falls on the scene under each row.
fn drawn_light(light: &[f64], beam: Beam, v: usize) -> f64 {
    let Beam::Gaussian { sigma_rows } = beam else { return light[v] };
    let bell = |distance: f64| (-distance * distance / (2.0 * sigma_rows * sigma_rows)).exp();
    let total: f64 = (-600..=600).map(|distance| bell(f64::from(distance))).sum();
    light.iter().enumerate().map(|(row, light)| light * bell(row as f64 - v as f64) / total).sum()
}

prop_compose! {
    /// A small projector with a measured table, an extended beam and a short retrace, and a camera with another pitch
    /// and a slightly different speed.
    fn rigs()(
        (rows, dwells_us) in (6_usize..14).prop_flat_map(|rows| (Just(rows), prop::collection::vec(8.0..32.0, rows))),
        retrace_us in 0.0..90.0,
        first_us in -15.0..15.0,
        pitch in prop_oneof![Just(1.0), Just(2.0), 0.3..2.5],
        drift in -0.02..0.02,
        sigma_rows in prop_oneof![Just(0.0), 0.2..2.5],
    ) -> RowTiming {
        let mut starts_us = vec![first_us];
        dwells_us.iter().for_each(|dwell_us| starts_us.push(starts_us[starts_us.len() - 1] + dwell_us));
        let nominal_us = rows as f64 * TAU_US;
        let period_us = nominal_us.max(starts_us[rows] - first_us) + retrace_us;
        let camera = CameraRows {
            first_row: 1,
            rows: ((rows - 2) as f64 / pitch) as usize + 1,
            pitch,
            row_time_us: pitch * TAU_US * (1.0 + drift),
        };
        RowTiming::new(rows, TAU_US, period_us)
            .and_then(|timing| timing.with_row_table(&starts_us))
            .and_then(|timing| timing.with_beam(Beam::of_sigma(sigma_rows)))
            .and_then(|timing| timing.with_camera(camera))
            .unwrap()
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn weights_follow_the_clock(
        timing in rigs(),
        (delay, exposure_us) in (-0.95..0.95, 1.0..700.0),
        light in prop::collection::vec(0.0..1.0, 14),
    ) {
        let light = &light[..timing.projector_rows()];
        let drawn: Vec<f64> = (0..light.len()).map(|v| drawn_light(light, timing.beam(), v)).collect();
        // The simulation needs an integer number of steps.
        let setting = Setting::new(delay * timing.period_us(), f64::round(exposure_us * 100.0) / 100.0);
        for t in 0..timing.camera_rows() {
            let by_clock = by_stepping_through_time(&timing, &setting, t, |v| drawn[v]);
            let predicted: f64 = timing.weights(t, &setting).iter().zip(light).map(|(w, light)| w * light).sum();
            prop_assert!((predicted - by_clock).abs() < 0.01, "row {t}: {predicted} is not {by_clock}");
        }
    }

    /// No row is missing or duplicated, and the model's weights are the timing's.
    #[test]
    fn the_model_has_every_row_that_is_seen(
        timing in rigs(),
        points in prop::collection::vec((-0.9..0.9, 5.0..200.0), 1..6),
    ) {
        let settings: Vec<Setting> = points
            .iter()
            .map(|&(delay, exposure_us)| Setting::new(delay * timing.period_us(), exposure_us))
            .collect();
        let Ok(reach) = reach(&timing, &settings) else { return Ok(()) };
        for t in 0..timing.camera_rows() {
            let model = RowModel::new(&timing, &settings, &reach, t);
            for v in 0..timing.projector_rows() {
                let u = timing.relative_row(v, t);
                let slots: Vec<usize> = (0..model.slots.len()).filter(|&slot| model.slots[slot].u == u).collect();
                let weights: Vec<f64> = settings.iter().map(|setting| timing.weights(t, setting)[v]).collect();
                let most = weights.iter().fold(0.0, |most: f64, &weight| most.max(weight));
                match slots[..] {
                    [slot] => {
                        prop_assert_eq!(model.weights.column(slot).to_vec(), weights);
                        prop_assert_eq!(model.slots[slot].kind == SlotKind::Own, reach.contains(&u));
                    }
                    _ => prop_assert!(slots.is_empty() && !reach.contains(&u) && most < 0.05),
                }
            }
        }
    }

    /// With any table and beam, an exposure of a whole period sees the light that was drawn, each row once; the beam
    /// loses only light that leaves the frame.
    #[test]
    fn a_whole_period_sees_all_light_once(timing in rigs(), delay in -0.9..0.9) {
        let setting = Setting::new(delay * timing.period_us(), timing.period_us());
        let ones = vec![1.0; timing.projector_rows()];
        for t in 0..timing.camera_rows() {
            let sum: f64 = timing.weights(t, &setting).iter().sum();
            let sent: f64 = (0..ones.len()).map(|v| drawn_light(&ones, timing.beam(), v)).sum();
            prop_assert!((sum - sent).abs() < 1e-5, "{sum} is not {sent}");
        }
    }
}

#[test]
fn the_reach_of_a_bent_table_holds_what_any_row_sees() {
    // The middle of the sweep is early by 4 rows of 200; a delay of 0 sees 4 rows further there than at the ends.
    let nominal = RowTiming::new(200, TAU_US, 5000.0).unwrap();
    let starts_us: Vec<f64> = (0..=200)
        .map(|v| f64::from(v) / 200.0)
        .map(|x| 200.0 * TAU_US * x - 4.0 * TAU_US * 4.0 * x * (1.0 - x))
        .collect();
    let bent = nominal.clone().with_row_table(&starts_us).unwrap();
    let settings = [Setting::new(0.0, 11.0 * TAU_US)];
    assert_eq!(reach(&nominal, &settings), Ok(-5..=5));
    assert_eq!(reach(&bent, &settings), Ok(-5..=9));

    // The reach does not depend on the beam; rows that only the beam reaches are solved for and dropped.
    let spread = nominal.with_beam(Beam::Gaussian { sigma_rows: 1.5 }).unwrap();
    assert_eq!(reach(&spread, &settings), Ok(-5..=5));
    let model = RowModel::new(&spread, &settings, &(-5..=5), 100);
    let dropped: Vec<i32> =
        model.slots.iter().filter(|slot| slot.kind == SlotKind::Wrapped).map(|slot| slot.u).collect();
    // Rows 6, 7 and 8 lie 0.33, 1 and 1.67 sigma off the edge: 0.37, 0.16 and 0.048.
    assert_eq!(dropped, [-7, -6, 6, 7]);
}
