//! The fold of a sweep that is larger than the memory: it keeps only how images were taken, and reads their rows
//! again.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use ndarray::Axis;
use rayon::prelude::*;
use raysweep_transport::plane::PlaneError;

use super::tally::{SweepSummary, Tally};
use super::{DEMUX, DemuxFold, NotKept, SweepImage, refused};
use crate::findings::rows_to_choose_by;
use crate::schedule::PointRole;
use crate::strips::{ImageRows, InStrips, NotSolved, PointRows};

impl DemuxFold {
    /// [`Self::finish`] after [`Self::keep_no_images`]: stack and transport are handed over strip by strip.
    ///
    /// # Errors
    /// Those of [`Self::finish`]; if an image cannot be read again, or a strip is refused.
    pub fn finish_in_strips(
        mut self,
        strips: InStrips<'_>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<SweepSummary, NotSolved> {
        let InStrips { images, strip_rows, take } = strips;
        let not_kept = self.not_kept.take().unwrap_or_default();
        let height = self.geometry.height;
        let rows = rows_to_choose_by(height);
        let sampled = self.read_to_choose_by(&not_kept, images, go_on)?;
        let said = self.watch_room(&rows, |is_wanted| {
            let wanted = sampled.iter().filter(|(role, _)| is_wanted(**role));
            wanted.map(|(role, image)| (*role, image.clone())).collect()
        })?;
        let bracket = match self.schedule.bracket() {
            Some(point) => {
                let roles = [Some(point.role), self.schedule.dark_of(point.exposure_us)];
                let is_for_room = |role| self.room.is_some() && matches!(role, PointRole::Dark(_));
                let mut taken = not_kept.clone();
                taken.retain(|role, _| roles.contains(&Some(*role)) || is_for_room(*role));
                self.bracket(&read_rows(&taken, images, &(0..height))?)
            }
            None => None,
        };
        let mut choices = self.choose(self.stack(&rows, sampled)?, bracket)?;
        choices.findings.add_room(said);
        let mut tally = Tally::default();
        for first_row in (0..height).step_by(strip_rows) {
            let rows = first_row..height.min(first_row + strip_rows);
            let halo_rows = choices.halo_rows();
            let around = first_row.saturating_sub(halo_rows)..height.min(rows.end + halo_rows);
            let held = self.hold(around.clone(), read_rows(&not_kept, images, &around)?)?;
            take(&choices.findings, self.strip(&choices, rows, held, &mut tally, go_on)?)?;
        }
        Ok(tally.summary(choices.findings))
    }

    /// The rows of [`rows_to_choose_by`] of all images. They are spread over the whole image, so each image is read
    /// completely: one at a time, because several together may be larger than the memory.
    fn read_to_choose_by(
        &self,
        not_kept: &BTreeMap<PointRole, NotKept>,
        images: &dyn ImageRows,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<BTreeMap<PointRole, Arc<SweepImage>>, NotSolved> {
        let height = self.geometry.height;
        let rows = rows_to_choose_by(height);
        let of_rows = |(role, NotKept { point, setting, stamps }): (&PointRole, &NotKept)| {
            if !go_on() {
                return Err(refused(PlaneError::Stopped));
            }
            let PointRows { image, clipped } = images.read(*point, 0..height).map_err(not_read)?;
            let image = image.select(Axis(0), &rows);
            let clipped = clipped.map(|clipped| clipped.select(Axis(0), &rows));
            let (setting, stamps) = (setting.clone(), stamps.clone());
            Ok((*role, Arc::new(SweepImage { setting, image, clipped, stamps })))
        };
        not_kept.iter().map(of_rows).collect()
    }
}

/// Reads some camera rows of the images.
fn read_rows(
    not_kept: &BTreeMap<PointRole, NotKept>,
    images: &dyn ImageRows,
    rows: &Range<usize>,
) -> Result<BTreeMap<PointRole, Arc<SweepImage>>, NotSolved> {
    not_kept
        .par_iter()
        .map(|(role, NotKept { point, setting, stamps })| {
            let PointRows { image, clipped } = images.read(*point, rows.clone()).map_err(not_read)?;
            let (setting, stamps) = (setting.clone(), stamps.clone());
            Ok((*role, Arc::new(SweepImage { setting, image, clipped, stamps })))
        })
        .collect()
}

fn not_read(what: String) -> NotSolved {
    NotSolved { of: DEMUX, what }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, concatenate, s};
    use raysweep_core::{Counts, Raster, SettingsId};
    use raysweep_transport::plane::board::{BoardCalibration, CalibrationCovariance, Estimate};
    use raysweep_transport::plane::{NoiseModel, PixelResponse, RESPONSE_ROWS, Setting};

    use super::*;
    use crate::demux::{DemuxOptions, Snapshot, Solved};
    use crate::schedule::{Point, Schedule, Spot, SpotScan, SweepGeometry};
    use crate::strips::Strip;
    use crate::unit::Unit;

    /// More rows than the choice needs, with saturation only in the last strip.
    const HEIGHT: usize = 130;
    const WIDTH: usize = 12;
    const STRIP_ROWS: usize = 50;
    /// A pixel whose direct light saturates, and that light.
    const HIGHLIGHT: ([usize; 2], f64) = ([20, 5], 6.0);
    /// Level of the light of the bracket.
    const DIM: f64 = 0.25;

    fn geometry() -> SweepGeometry {
        SweepGeometry {
            raster: Raster { rows: 140, row_time_us: 20.0, period_us: 3000.0, first_row_us: 0.0 },
            row_table_us: None,
            beam_sigma_rows: None,
            spot: Spot::Uniform,
            projector_columns: None,
            first_row: 5,
            row_pitch: 1.0,
            camera_row_time_us: 20.0,
            height: HEIGHT,
            width: WIDTH,
            white_dn: 1000.0,
            black_dn: 100.0,
            saturation_dn: 3900.0,
            calibration: None,
        }
    }

    /// With a bracket as the last point.
    fn schedule() -> Schedule {
        let point = |role, delay_us, exposure_us| Point { role, delay_us, exposure_us, frames: 1 };
        let regular = [
            point(PointRole::Dark(0), 0.0, 60.0),
            point(PointRole::Dark(1), 0.0, 3000.0),
            point(PointRole::Regular, 0.0, 3000.0),
        ];
        let delays_us = (-4..=4).map(|step| f64::from(step) * 25.0);
        let sweep =
            (0..).zip(delays_us).map(|(index, delay_us)| point(PointRole::Sweep(index), delay_us, 60.0));
        let bracket = point(PointRole::Bracket(9), 0.0, 60.0);
        Schedule { points: regular.into_iter().chain(sweep).chain([bracket]).collect() }
    }

    /// Direct light with equally bright light on either side of it, and noise.
    fn image(ordinal: usize, point: &Point) -> Array2<f32> {
        let timing = geometry().timing().unwrap();
        let setting = Setting::new(point.delay_us, point.exposure_us);
        Array2::from_shape_fn((HEIGHT, WIDTH), |(t, s)| {
            let light = |v: usize| match timing.relative_row(v, t) {
                0 if [t, s] == HIGHLIGHT.0 => HIGHLIGHT.1,
                0 => 0.4 + 0.01 * s as f64,
                u => 0.1 * (-f64::from(u.abs()) / 2.0).exp(),
            };
            let weights = timing.weights(t, &setting);
            let lit: f64 = weights.iter().enumerate().map(|(v, weight)| weight * light(v)).sum();
            let lit = match point.role {
                PointRole::Dark(_) => 0.0,
                PointRole::Bracket(_) => DIM * lit,
                PointRole::Regular | PointRole::Sweep(_) => lit,
            };
            let seed = ((ordinal * HEIGHT + t) * WIDTH + s) as f64;
            let noise = (seed * 12.9898).sin() * 43_758.545_3;
            let highlight = if (t, s, ordinal) == (HEIGHT - 2, 3, 6) { 4000.0 } else { 0.0 };
            (100.0 + 1000.0 * lit + 10.0 * (noise - noise.floor()) + highlight).min(4000.0) as f32
        })
    }

    struct Kept(Vec<Array2<f32>>);

    impl ImageRows for Kept {
        fn read(&self, point: u32, rows: Range<usize>) -> Result<PointRows, String> {
            Ok(PointRows { image: self.0[point as usize].slice(s![rows, ..]).to_owned(), clipped: None })
        }
    }

    fn push_all(fold: &mut DemuxFold, images: &Kept) {
        push_points(fold, &schedule().points, images);
    }

    fn push_points(fold: &mut DemuxFold, points: &[Point], images: &Kept) {
        push_where(fold, points, images, |_| true);
    }

    fn push_where(fold: &mut DemuxFold, points: &[Point], images: &Kept, is_taken: fn(&Point) -> bool) {
        for ((ordinal, point), image) in (0..).zip(points).zip(&images.0).filter(|((_, it), _)| is_taken(it))
        {
            let unit = Unit {
                id: SettingsId { point: ordinal, attempt: 0 },
                frames: 1,
                delay_us: point.delay_us,
                exposure_us: point.exposure_us,
                delays_us: vec![point.delay_us],
                run: 1,
                starts_ns: Vec::new(),
                sum: Arc::new(Array2::zeros((0, 0))),
                clipped: None,
                counts: Counts::default(),
            };
            fold.push(&unit, image.view());
        }
    }

    #[test]
    fn direct_light_is_one_band_with_its_neighbours_unless_an_edge_tells_them_apart() {
        let one_band = |step_us: f64, exposure_us: f64| {
            let mut schedule = schedule();
            for point in &mut schedule.points {
                match point.role {
                    PointRole::Sweep(index) => {
                        (point.delay_us, point.exposure_us) =
                            ((f64::from(index) - 4.0) * step_us, exposure_us);
                    }
                    PointRole::Dark(0) => point.exposure_us = exposure_us,
                    _ => {}
                }
            }
            let images = schedule.points.iter().enumerate().map(|(ordinal, point)| image(ordinal, point));
            let mut fold = DemuxFold::new(DemuxOptions::default(), &schedule, &geometry()).unwrap();
            push_points(&mut fold, &schedule.points, &Kept(images.collect()));
            fold.finish(&|| true).unwrap().stack.one_band
        };
        // Edges lie 2.5 rows of 20 us from the direct row and further; with the other delays, a quarter of a row.
        assert!(one_band(100.0, 100.0));
        assert!(!one_band(25.0, 60.0));
    }

    #[test]
    fn a_live_estimate_leaves_out_what_a_flying_spot_cuts() {
        let schedule = schedule();
        let images = schedule.points.iter().enumerate().map(|(ordinal, point)| image(ordinal, point));
        let images = Kept(images.collect());
        let estimate = |geometry: &SweepGeometry, is_taken: fn(&Point) -> bool| {
            let mut fold = DemuxFold::new(DemuxOptions::default(), &schedule, geometry).unwrap();
            push_where(&mut fold, &schedule.points, &images, is_taken);
            fold.estimate(None, &|| true).unwrap().t
        };
        let flying = SweepGeometry { spot: Spot::Flying(SpotScan::Unknown), ..geometry() };
        // An exposure of 60 us at 25 us begins, and one at -25 us ends, 5 us from the centre of the direct row.
        let uncut = estimate(&geometry(), |point| point.delay_us.abs() != 25.0);
        assert_eq!(estimate(&flying, |_| true), uncut);
        assert_ne!(estimate(&geometry(), |_| true), uncut);
    }

    /// The same rig, calibrated: its white level falls off to one side, and a corner is not lit.
    fn calibrated() -> SweepGeometry {
        let stated = geometry();
        let timing = stated.timing().unwrap();
        let places = Array2::from_shape_fn((HEIGHT, WIDTH), |(t, s)| (5 + t) as f32 + 0.03 * s as f32);
        let mut shares = [0.0; RESPONSE_ROWS];
        shares[7] = 1.0;
        let mut white_dn = Array2::from_shape_fn((HEIGHT, WIDTH), |(t, s)| 1000.0 - (t + 10 * s) as f32);
        white_dn[[HEIGHT - 1, WIDTH - 1]] = f32::NAN;
        stated.calibrated(Arc::new(BoardCalibration {
            row_starts_us: timing.row_starts_us().to_vec(),
            camera_row_time_us: Estimate { value: 20.0, sd: 0.0 },
            exposure_offset_us: Estimate { value: 0.5, sd: 0.0 },
            jitter_us: 0.0,
            covariance: CalibrationCovariance::independent([0.0; 5]),
            response: PixelResponse::with_beam(places, &shares).unwrap(),
            drawing: None,
            white_dn,
            saturation_dn: None,
            dark_offset_dn: Array2::from_elem((HEIGHT, WIDTH), 100.0),
            linearity_per_dn: Some(1e-5),
            noise: NoiseModel { read_variance: 0.0, gain: 0.0 },
            strip: None,
            lamp: None,
        }))
    }

    #[test]
    fn strips_that_do_not_divide_the_image_have_the_bits_of_the_whole() {
        has_the_bits_of_the_whole(&geometry());
    }

    #[test]
    fn so_have_strips_of_a_calibrated_rig() {
        has_the_bits_of_the_whole(&calibrated());
    }

    fn has_the_bits_of_the_whole(geometry: &SweepGeometry) {
        let points = schedule().points;
        let images = Kept(points.iter().enumerate().map(|(ordinal, point)| image(ordinal, point)).collect());
        let fold = || DemuxFold::new(DemuxOptions::default(), &schedule(), geometry).unwrap();

        let mut whole = fold();
        push_all(&mut whole, &images);
        let Solved { stack, transport, summary } = whole.finish(&|| true).unwrap();
        let findings = &summary.findings;
        assert!(findings.choice.is_some() && stack.variance_ratio.is_some(), "{findings:?}");
        assert!(rows_to_choose_by(HEIGHT).len() < HEIGHT);

        let mut in_strips = fold();
        in_strips.keep_no_images();
        push_all(&mut in_strips, &images);
        let mut strips: Vec<Strip> = Vec::new();
        let mut take = |chosen: &crate::Findings, strip| {
            assert_eq!(chosen, findings);
            strips.push(strip);
            Ok(())
        };
        let order = InStrips { images: &images, strip_rows: STRIP_ROWS, take: &mut take };
        let summary_in_strips = in_strips.finish_in_strips(order, &|| true).unwrap();
        assert_eq!(format!("{summary_in_strips:?}"), format!("{summary:?}"));

        assert_eq!(strips.iter().map(|strip| strip.first_row).collect::<Vec<_>>(), [0, 50, 100]);
        assert_eq!(
            strips.iter().map(|strip| strip.stack.valid.is_some()).collect::<Vec<_>>(),
            [true, false, true]
        );
        let rows = |of: &dyn Fn(&Strip) -> Array2<f32>| {
            let parts: Vec<Array2<f32>> = strips.iter().map(of).collect();
            let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
            concatenate(Axis(0), &views).unwrap()
        };
        assert_eq!(rows(&|strip| strip.stack.regular.clone().unwrap()), stack.regular.unwrap());
        assert_eq!(rows(&|strip| strip.stack.variance_ratio.clone().unwrap()), stack.variance_ratio.unwrap());
        let transports: Vec<_> = strips.iter().map(|strip| strip.transport.t.view()).collect();
        assert!(concatenate(Axis(1), &transports).unwrap() == transport.t);
        let images: Vec<_> = strips.iter().map(|strip| strip.stack.images.view()).collect();
        assert!(concatenate(Axis(1), &images).unwrap() == stack.images);

        let (pixel, light) = HIGHLIGHT;
        // The images are those of a rig as it is stated.
        if geometry.calibration.is_none() {
            let (_, said) = findings.remarks.iter().find(|(key, _)| *key == "bracket").unwrap();
            let percent = said.split(' ').find_map(|word| word.parse::<f64>().ok()).unwrap();
            assert!((percent / 25.0 - 1.0).abs() < 0.02, "{said}");
            let direct = f64::from(transport.epipolar(1)[pixel]);
            assert!((direct / light - 1.0).abs() < 0.02, "{direct}");
        }
        assert!(!transport.is_bound(pixel, 0..=0));
    }

    #[test]
    fn without_its_bracket_a_highlight_is_a_bound_and_counted() {
        let points = schedule().points;
        let images = Kept(points.iter().enumerate().map(|(ordinal, point)| image(ordinal, point)).collect());
        let mut fold = DemuxFold::new(DemuxOptions::default(), &schedule(), &geometry()).unwrap();
        push_all(&mut fold, &images);
        fold.taken.retain(|role, _| !matches!(role, PointRole::Bracket(_)));
        let Solved { stack, transport, summary } = fold.finish(&|| true).unwrap();
        let (pixel, light) = HIGHLIGHT;
        assert!(transport.is_bound(pixel, 0..=0));
        let direct = f64::from(transport.epipolar(1)[pixel]);
        assert!((3.0..light).contains(&direct), "{direct}");
        let bounds = summary.figures.iter().find(|(name, _)| *name == "pixels known only as lower bounds");
        assert_eq!(bounds, Some(&("pixels known only as lower bounds", 1.0)));
        let options = serde_json::Map::new();
        let spec = crate::ProductSpec::new("epipolar", None, &options, &schedule(), &geometry()).unwrap();
        let crate::Product::Image { mask, .. } = spec.make(&stack, &transport).unwrap() else { panic!() };
        assert_eq!(mask[pixel] & !crate::mask::NO_EDGE, crate::mask::BOUND_ONLY);
        assert_eq!(mask[[0, 0]] & !crate::mask::NO_EDGE, crate::mask::MEASURED);
    }

    #[test]
    fn a_frame_that_clips_makes_its_mean_a_bound() {
        let image = SweepImage {
            setting: Setting::new(0.0, 60.0),
            image: Array2::from_elem((1, 3), 3800.0),
            stamps: None,
            clipped: Some(Array2::from_shape_vec((1, 3), vec![false, true, false]).unwrap()),
        };
        assert_eq!(image.valid(3900.0).into_raw_vec_and_offset().0, [true, false, true]);
        let unknown = SweepImage { stamps: None, clipped: None, ..image };
        assert!(unknown.valid(3900.0).iter().all(|valid| *valid));
    }
}
