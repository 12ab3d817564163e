use std::ops::RangeInclusive;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};
use rayon::prelude::*;

use super::super::PlaneError;
use super::response::{PLACE_STEPS, ResponseClass, collected_rows};
use super::{RowTiming, Setting};

/// A row is an unknown if some setting collects at least this share of its dwell.
pub const MIN_WEIGHT: f64 = 0.05;

/// The relative rows that a plan can estimate: the contiguous range of `u` whose largest weight over all settings and
/// camera rows, in the frame that the delays refer to, is at least [`MIN_WEIGHT`].
///
/// The beam is not taken into account: it sends light of the drawn rows to their neighbours, but the reach depends
/// only on the drawn rows, so that the transport has the same shape whatever is known of the beam.
///
/// # Errors
/// Those of [`RowTiming::check`]; [`PlaneError::NothingSeen`] if no row qualifies.
pub fn reach(timing: &RowTiming, settings: &[Setting]) -> Result<RangeInclusive<i32>, PlaneError> {
    timing.check(settings)?;
    let mut reach: Option<(i32, i32)> = None;
    for t in 0..timing.camera_rows() {
        for setting in settings {
            for (v, share) in timing.shares_in_frame(t, 0, setting) {
                if share >= MIN_WEIGHT {
                    let u = timing.relative_row(v, t);
                    let (first, last) = reach.unwrap_or((u, u));
                    reach = Some((first.min(u), last.max(u)));
                }
            }
        }
    }
    reach.map(|(first, last)| first..=last).ok_or(PlaneError::NothingSeen)
}

/// An unknown of one camera row: the light it receives from one projector row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Slot {
    /// Relative row of the projector row.
    pub u: i32,
    /// Whether the row is part of the result.
    pub kind: SlotKind,
}

/// How a slot's estimate is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SlotKind {
    /// Inside the plan's reach: part of the transport.
    Own,
    /// Outside the reach, but lit while an exposure extended over the retrace into the next or previous frame, or by
    /// the beam of a row that was drawn during the exposure: solved for, because the exposure saw it, and then
    /// dropped.
    Wrapped,
}

/// The forward model of all pixels of one camera row.
#[derive(Debug, Clone, PartialEq)]
pub struct RowModel {
    /// The unknowns: own slots by ascending `u`, then wrapped slots by ascending `u`. Rows that do not exist in the
    /// projector are not included.
    pub slots: Vec<Slot>,
    /// `A' = A B`: weight of each slot in each setting, shape `[settings, slots]`.
    pub weights: Array2<f64>,
}

impl RowModel {
    /// The model of camera row `t` for the plan's settings; `reach` is that of the whole plan.
    pub fn new(timing: &RowTiming, settings: &[Setting], reach: &RangeInclusive<i32>, t: usize) -> Self {
        let seen: Vec<Vec<f64>> = settings.iter().map(|setting| timing.weights(t, setting)).collect();
        let (own, outside): (Vec<usize>, Vec<usize>) =
            (0..timing.projector_rows()).partition(|&v| reach.contains(&timing.relative_row(v, t)));
        let wrapped = outside.into_iter().filter(|&v| seen.iter().any(|weights| weights[v] >= MIN_WEIGHT));
        let rows: Vec<(usize, SlotKind)> = own
            .into_iter()
            .map(|v| (v, SlotKind::Own))
            .chain(wrapped.map(|v| (v, SlotKind::Wrapped)))
            .collect();
        let slots = rows.iter().map(|&(v, kind)| Slot { u: timing.relative_row(v, t), kind }).collect();
        let weights = Array2::from_shape_fn((settings.len(), rows.len()), |(n, slot)| seen[n][rows[slot].0]);
        Self { slots, weights }
    }

    /// The models of the pixels of camera row `t`, each with its columns: one model for all, unless their responses
    /// were measured.
    pub(in super::super) fn of_pixels(
        timing: &RowTiming,
        settings: &[Setting],
        reach: &RangeInclusive<i32>,
        t: usize,
        columns: usize,
    ) -> Vec<(Self, Vec<usize>)> {
        let Some(response) = timing.response() else {
            return vec![(Self::new(timing, settings, reach, t), (0..columns).collect())];
        };
        let drawn = drawn(timing, settings, t);
        let classes = response.classes(t, 0..columns, PLACE_STEPS);
        classes
            .into_iter()
            .map(|class| (Self::measured(drawn.view(), reach, &class), class.columns))
            .collect()
    }

    /// The model of the pixel in the middle of camera row `t`, as a typical one.
    pub(in super::super) fn typical(
        timing: &RowTiming,
        settings: &[Setting],
        reach: &RangeInclusive<i32>,
        t: usize,
    ) -> Self {
        let Some(response) = timing.response() else { return Self::new(timing, settings, reach, t) };
        let (_, columns) = response.size();
        let middle = std::iter::once(columns / 2);
        let class = response.classes(t, middle, PLACE_STEPS).swap_remove(0);
        Self::measured(drawn(timing, settings, t).view(), reach, &class)
    }

    /// The model of pixels with a measured response. `drawn` is the share of each projector row's dwell inside the
    /// exposure of each setting, `[settings, projector rows]`; relative rows count from the pixels' own row.
    pub(in super::super) fn measured(
        drawn: ArrayView2<f64>,
        reach: &RangeInclusive<i32>,
        class: &ResponseClass,
    ) -> Self {
        let (settings, projector_rows) = drawn.dim();
        let mut light = Array2::zeros((settings, projector_rows));
        for (mut light, drawn) in light.rows_mut().into_iter().zip(drawn.rows()) {
            light.assign(&collected_rows(drawn, &class.shares, 0, projector_rows));
        }
        let kind = |lit: i64| match i32::try_from(lit - class.own_row) {
            Ok(u) if reach.contains(&u) => Some((u, SlotKind::Own)),
            Ok(u) => {
                let is_seen = light.column(lit as usize).iter().any(|&weight| weight >= MIN_WEIGHT);
                is_seen.then_some((u, SlotKind::Wrapped))
            }
            Err(_) => None,
        };
        let slots = (0..projector_rows as i64).filter_map(kind);
        let (own, wrapped): (Vec<_>, Vec<_>) = slots.partition(|(_, kind)| *kind == SlotKind::Own);
        let slots: Vec<Slot> = own.into_iter().chain(wrapped).map(|(u, kind)| Slot { u, kind }).collect();
        let weights = Array2::from_shape_fn((settings, slots.len()), |(n, slot)| {
            light[[n, (class.own_row + i64::from(slots[slot].u)) as usize]]
        });
        Self { slots, weights }
    }
}

/// The share of each projector row's dwell inside the exposure of camera row `t` for each setting,
/// `[settings, projector rows]`.
pub(in super::super) fn drawn(timing: &RowTiming, settings: &[Setting], t: usize) -> Array2<f64> {
    let mut drawn = Array2::zeros((settings.len(), timing.projector_rows()));
    for (mut drawn, setting) in drawn.rows_mut().into_iter().zip(settings) {
        drawn.iter_mut().zip(timing.drawn(t, setting)).for_each(|(to, share)| *to = share);
    }
    drawn
}

/// The image that the model predicts for one setting.
///
/// `transport` is `[v, t, s]` over the projector rows starting at the camera's first row, shape `[rows, camera_rows,
/// columns]`; the projector lights nothing else. Returns `[t, s]`.
///
/// # Errors
/// Those of [`RowTiming::check`]; [`PlaneError::Shape`] if the transport does not fit the window or extends beyond
/// the projector.
pub fn predict(
    timing: &RowTiming,
    transport: ArrayView3<f32>,
    setting: &Setting,
) -> Result<Array2<f32>, PlaneError> {
    timing.check(std::slice::from_ref(setting))?;
    let (rows, camera_rows, columns) = transport.dim();
    let most_rows = timing.projector_rows() - timing.first_row();
    if camera_rows != timing.camera_rows() || rows > most_rows {
        return Err(PlaneError::Shape {
            array: "transport",
            axes: "[projector rows from the camera's first on, camera rows, columns]",
            actual: transport.shape().to_vec(),
            expected: vec![rows.min(most_rows), timing.camera_rows(), columns],
        });
    }
    timing.check_columns(columns)?;
    let mut image = Array2::zeros((camera_rows, columns));
    image.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut image_row)| {
        let mut sum = vec![0.0; columns];
        for (weights, alike) in timing.pixel_weights(t, columns, setting) {
            for (v, &weight) in weights[timing.first_row()..].iter().enumerate().take(rows) {
                if weight > 0.0 {
                    let light = transport.slice(s![v, t, ..]);
                    alike.iter().for_each(|&column| sum[column] += weight * f64::from(light[column]));
                }
            }
        }
        image_row.iter_mut().zip(sum).for_each(|(pixel, sum)| *pixel = sum as f32);
    });
    Ok(image)
}

/// Converts a transport `[v, t, s]` over a window's projector rows to relative rows: `[u, t, s]` for `u` in `reach`,
/// zero where the window has no such row. Only for cameras whose rows have the projector's pitch.
pub fn relative_rows(transport: ArrayView3<f32>, reach: &RangeInclusive<i32>) -> Array3<f32> {
    let (rows, camera_rows, columns) = transport.dim();
    let mut relative = Array3::zeros((reach.clone().count(), camera_rows, columns));
    for (mut plane, u) in relative.axis_iter_mut(Axis(0)).zip(reach.clone()) {
        for t in 0..camera_rows {
            if let Ok(v) = usize::try_from(t as i64 + i64::from(u))
                && v < rows
            {
                plane.row_mut(t).assign(&transport.slice(s![v, t, ..]));
            }
        }
    }
    relative
}

#[cfg(test)]
mod tests {
    use super::*;

    const TAU_US: f64 = 22.22;

    /// The paper's sweep: t_d -1500..1500 us in 15, t_e 600..1200 us in 5, delays fastest.
    fn paper_sweep() -> Vec<Setting> {
        (0..75)
            .map(|point| {
                Setting::new(
                    -1500.0 + 3000.0 / 14.0 * (point % 15) as f64,
                    600.0 + 150.0 * (point / 15) as f64,
                )
            })
            .collect()
    }

    fn timing(row_time_us: f64) -> RowTiming {
        RowTiming::new(720, row_time_us, 50_000.0 / 3.0).unwrap()
    }

    #[test]
    fn the_papers_sweep_reaches_94_rows() {
        assert_eq!(reach(&timing(TAU_US), &paper_sweep()), Ok(-94..=94));
        // 2100 us / 18.52 us = 113.4: the weight of row 113 is 0.9, that of row 114 is 0.
        assert_eq!(reach(&timing(18.52), &paper_sweep()), Ok(-113..=113));
    }

    #[test]
    fn the_reach_stops_at_the_projectors_borders() {
        let whole = RowTiming::new(32, TAU_US, 16_667.0).unwrap();
        assert_eq!(reach(&whole, &paper_sweep()), Ok(-31..=31));
        let window = timing(TAU_US).window(0, 10).unwrap();
        assert_eq!(reach(&window, &paper_sweep()), Ok(-9..=94));
    }

    #[test]
    fn a_delay_that_only_sees_the_retrace_sees_nothing() {
        let tiny = RowTiming::new(8, TAU_US, 16_667.0).unwrap();
        assert_eq!(reach(&tiny, &[Setting::new(5000.0, 600.0)]), Err(PlaneError::NothingSeen));
        assert_eq!(reach(&tiny, &[Setting::new(0.0, 1.0)]), Err(PlaneError::NothingSeen));
    }

    #[test]
    fn rows_beyond_the_border_are_no_slots() {
        let model = RowModel::new(&timing(TAU_US), &paper_sweep(), &(-94..=94), 30);
        assert_eq!(model.slots.first(), Some(&Slot { u: -30, kind: SlotKind::Own }));
        assert_eq!(model.slots.iter().filter(|slot| slot.kind == SlotKind::Own).count(), 30 + 1 + 94);
        let inner = RowModel::new(&timing(TAU_US), &paper_sweep(), &(-94..=94), 360);
        assert_eq!(inner.slots.len(), 189);
        assert_eq!(inner.weights.dim(), (75, 189));
    }

    #[test]
    fn late_exposures_of_row_700_reach_over_the_retrace() {
        // The retrace begins 19.5 rows after row 700's centre, the next frame (16666.67 - 700.5 * 22.22) us = 1101.56
        // us after it. The expected numbers follow from the edges t_d + t_e/2 of the sweep.
        let late = |limit_us: f64| {
            let ends = paper_sweep().into_iter().map(|s| s.delays_us[0] + s.exposure_us / 2.0);
            ends.filter(|&end_us| end_us > limit_us).count()
        };
        assert_eq!((late(19.5 * TAU_US), late(1101.56)), (38, 22));

        let model = RowModel::new(&timing(TAU_US), &paper_sweep(), &(-94..=94), 700);
        let wrapped: Vec<usize> =
            (0..model.slots.len()).filter(|&i| model.slots[i].kind == SlotKind::Wrapped).collect();
        let seen = |n: usize| wrapped.iter().any(|&i| model.weights[[n, i]] > 0.0);
        assert_eq!((0..75).filter(|&n| seen(n)).count(), 22);
        assert_eq!(model.slots[wrapped[0]].u, -700, "the next frame begins with row 0");
        // The last exposure ends at 2100 us: (2100 - 1101.56) / 22.22 = 44.93 rows of the next frame.
        assert_eq!(wrapped.len(), 45);
        let last = model.weights.row(74);
        let sum: f64 = wrapped.iter().map(|&i| last[i]).sum();
        assert!((sum - (2100.0 - 1101.56) / TAU_US).abs() < 1e-3, "{sum}");

        // With 18.52 us rows the retrace is long enough to keep every exposure out of the next frame.
        let model = RowModel::new(&timing(18.52), &paper_sweep(), &(-113..=113), 700);
        assert!(model.slots.iter().all(|slot| slot.kind == SlotKind::Own));
    }

    #[test]
    fn row_sums_are_exposure_over_row_time_less_what_the_retrace_keeps_dark() {
        let settings = paper_sweep();
        let inner = RowModel::new(&timing(TAU_US), &settings, &(-95..=95), 360);
        for (weights, setting) in inner.weights.axis_iter(Axis(0)).zip(&settings) {
            assert!((weights.sum() - setting.exposure_us / TAU_US).abs() < 1e-9);
        }
        // Row 700, t_d 1500 us, t_e 1200 us: in 900..2100 us only the next frame's rows are lit, from 1101.56 us on.
        let outer = RowModel::new(&timing(TAU_US), &settings, &(-94..=94), 700);
        assert!((outer.weights.row(74).sum() - (2100.0 - 1101.56) / TAU_US).abs() < 1e-3);
    }

    #[test]
    fn prediction_is_the_weighted_sum_of_rows() {
        let timing = timing(TAU_US).centred(6).unwrap();
        let transport = Array3::from_shape_fn((6, 6, 2), |(v, t, s)| (100 * v + 10 * t + s) as f32);
        // t_e of two rows centred on the boundary between u = 1 and u = 2 sees exactly those.
        let image = predict(&timing, transport.view(), &Setting::new(1.5 * TAU_US, 2.0 * TAU_US)).unwrap();
        for t in 0..6 {
            let expected: f32 = (t + 1..=t + 2).filter(|&v| v < 6).map(|v| transport[[v, t, 1]]).sum();
            assert!((image[[t, 1]] - expected).abs() < 1e-3 * (1.0 + expected));
        }
        assert!(matches!(
            predict(&timing, transport.slice(s![.., ..5, ..]), &Setting::new(0.0, 100.0)),
            Err(PlaneError::Shape { .. })
        ));
    }

    #[test]
    fn relative_rows_shift_each_camera_row() {
        let transport = Array3::from_shape_fn((4, 4, 1), |(v, t, _)| (10 * v + t) as f32);
        let relative = relative_rows(transport.view(), &(-1..=2));
        assert_eq!(relative.slice(s![.., 0, 0]).to_vec(), [0.0, 0.0, 10.0, 20.0]);
        assert_eq!(relative.slice(s![.., 3, 0]).to_vec(), [23.0, 33.0, 0.0, 0.0]);
    }
}
