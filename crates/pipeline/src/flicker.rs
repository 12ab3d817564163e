//! The room's light in a sweep: whether it flickers, and what remains of that in the images after their dark images are
//! subtracted.

use std::collections::{BTreeMap, BTreeSet};

use ndarray::{Array2, ArrayViewMut2};
use raysweep_core::ns_from_us;
use raysweep_transport::plane::calibrate::{
    DarkFlicker, DarkRows, FrameExposures, LampFlicker, Sample, TimedImage, Unexplained, can_be_followed,
    cancelling_frames,
};

use crate::schedule::{PointRole, SweepGeometry};
use crate::stack::SweepStack;

/// When the frames of a point were exposed; each run of a session has its own clock.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct FrameStamps {
    pub run: u32,
    /// Start of the exposure of row 0 in each frame.
    pub starts_ns: Vec<i64>,
}

/// Light of the room, of white in a row's time, that is too weak to matter even if all of it flickers.
pub(crate) const DARK_ROOM: f64 = 2e-5;
/// Largest amplitude that may remain, of white in a row's time.
const MOST_FLICKER: f64 = 0.0005;
/// A dark image with a larger share of saturated pixels is not used.
const MOST_SATURATED: f64 = 0.01;
/// Time between the end of a run and the start of the next, on their common clock. What it is does not matter as long
/// as no amplitude bridges it.
const BETWEEN_RUNS_S: f64 = 1000.0;
/// How often the levels of the pixels and the lamp are found in turn.
const ROUNDS: usize = 2;

/// A lamp, and when it shone on each image.
pub(crate) struct RoomFlicker {
    lamp: LampFlicker,
    /// The dark images that do not saturate.
    darks: BTreeSet<PointRole>,
    times: BTreeMap<PointRole, FrameExposures>,
}

/// What is to be said of the room's light; nothing if it does not flicker.
#[derive(Default)]
pub(crate) struct RoomFindings {
    pub remark: Option<(&'static str, String)>,
    pub warning: Option<String>,
}

impl RoomFindings {
    /// A lamp in step with the frames.
    pub(crate) fn in_step(frequency_hz: f64, amplitude: f64, rate_hz: f64) -> Self {
        let warning = (amplitude > MOST_FLICKER).then(|| format!(
            "the room's light flickers at {frequency_hz:.1} Hz by {amplitude:.4} of white in a row's time. That is the same in all frames at {rate_hz:.1} frames/s, so it cannot be told from the scene, and no number of frames cancels it: switch the lamp off, or use one that does not flicker"
        ));
        Self { remark: None, warning }
    }

    /// A lamp of which only some of the images show that it flickers.
    pub(crate) fn unsteady(frequency_hz: f64, seen_in: &str, unseen_in: &str) -> Self {
        let warning = format!(
            "{seen_in} that the room's light flickers at {frequency_hz:.2} Hz, but {unseen_in} the same flicker, so nothing was removed: leave the lamps alone during a run, or switch them off"
        );
        Self { remark: None, warning: Some(warning) }
    }
}

/// The exposures of all points on one clock, on which the runs of the session follow each other; `None` if those of a
/// point are not known.
pub(crate) fn on_one_clock<'a>(
    points: impl Iterator<Item = (PointRole, f64, &'a FrameStamps)> + Clone,
) -> Option<BTreeMap<PointRole, FrameExposures>> {
    let mut spans = BTreeMap::<u32, (i64, i64)>::new();
    for (_, _, stamps) in points.clone() {
        let (first, last) = (stamps.starts_ns.iter().min()?, stamps.starts_ns.iter().max()?);
        let span = spans.entry(stamps.run).or_insert((*first, *last));
        *span = (span.0.min(*first), span.1.max(*last));
    }
    let mut next_s = 0.0;
    let mut zeros = BTreeMap::new();
    for (run, (first, last)) in spans {
        zeros.insert(run, (first, next_s));
        next_s += last.saturating_sub(first) as f64 * 1e-9 + BETWEEN_RUNS_S;
    }
    let of_point = |(role, exposure_us, stamps): (PointRole, f64, &FrameStamps)| {
        let (first, from_s) = zeros[&stamps.run];
        let opened = stamps.starts_ns.iter().map(|start| from_s + (start - first) as f64 * 1e-9);
        (role, FrameExposures { exposure_us, opened_s: opened.collect() })
    };
    Some(points.map(of_point).collect())
}

/// Most frequent time between consecutive frames, as a rate.
pub(crate) fn frame_rate_hz<'a>(images: impl Iterator<Item = &'a FrameExposures>) -> Option<f64> {
    let steps = images.flat_map(|frames| frames.opened_s.windows(2).map(|pair| pair[1] - pair[0]));
    let mut steps: Vec<f64> = steps.filter(|step| *step > 0.0).collect();
    steps.sort_by(f64::total_cmp);
    steps.get(steps.len() / 2).map(|step| 1.0 / step)
}

/// The light of the room at each pixel in counts per us: the slope of the dark images over what their exposures saw of
/// it. `darks` contains their images of camera rows `rows`.
pub(crate) fn levels_dn_per_us(
    darks: &BTreeMap<PointRole, &Array2<f32>>,
    times: &BTreeMap<PointRole, FrameExposures>,
    lamp: Option<&LampFlicker>,
    rows: &[usize],
) -> Option<Array2<f64>> {
    let images: Vec<(&Array2<f32>, &FrameExposures)> =
        darks.iter().filter_map(|(role, image)| Some((*image, times.get(role)?))).collect();
    let columns = images.first()?.0.ncols();
    let mut levels = Array2::zeros((rows.len(), columns));
    for (at, &t) in rows.iter().enumerate() {
        let seen_us: Vec<f64> = images
            .iter()
            .map(|(_, frames)| frames.exposure_us + lamp.map_or(0.0, |lamp| lamp.excess_us(frames, t)))
            .collect();
        let mean_us = seen_us.iter().sum::<f64>() / seen_us.len() as f64;
        let spread: f64 = seen_us.iter().map(|us| (us - mean_us).powi(2)).sum();
        if spread == 0.0 {
            return None;
        }
        for (us, (image, _)) in seen_us.iter().zip(&images) {
            let weight = (us - mean_us) / spread;
            levels
                .row_mut(at)
                .zip_mut_with(&image.row(at), |level, counts| *level += weight * f64::from(*counts));
        }
    }
    Some(levels)
}

/// Images of the sample's camera rows, from which the lamp is found.
pub(crate) struct RoomImages<'a> {
    geometry: &'a SweepGeometry,
    /// The camera rows of all images, ascending.
    rows: &'a [usize],
    /// Counts of the dark images that do not saturate, `[rows, s]`.
    darks: BTreeMap<PointRole, &'a Array2<f32>>,
    times: BTreeMap<PointRole, FrameExposures>,
}

/// A lamp that flickers, as the dark images show it.
pub(crate) struct SeenFlicker {
    frequency_hz: f64,
    /// Share of the room's light; `None` if too few exposures tell.
    share: Option<f64>,
    /// The room's light, of white in a row's time.
    level: f64,
}

impl<'a> RoomImages<'a> {
    /// The images of camera rows `rows`; `times` are the exposures of all points.
    pub(crate) fn new(
        geometry: &'a SweepGeometry,
        rows: &'a [usize],
        mut darks: BTreeMap<PointRole, &'a Array2<f32>>,
        times: BTreeMap<PointRole, FrameExposures>,
    ) -> Self {
        // In a bright room, the dark image of a whole period may saturate.
        darks.retain(|_, image| {
            let saturated =
                image.iter().filter(|&&counts| f64::from(counts) >= geometry.saturation_dn).count();
            (saturated as f64) < MOST_SATURATED * image.len() as f64
        });
        Self { geometry, rows, darks, times }
    }

    fn row_time_s(&self) -> f64 {
        self.geometry.camera_row_time_us * 1e-6
    }

    /// The room's light, of white in a row's time.
    fn level(&self, lamp: Option<&LampFlicker>) -> Option<f64> {
        let levels = levels_dn_per_us(&self.darks, &self.times, lamp, self.rows)?;
        Some(levels.mean()? * self.geometry.raster.row_time_us / self.geometry.white_dn)
    }

    /// The flicker in the dark images. Without at least three exposures they cannot show one, and that of the
    /// calibration is assumed.
    pub(crate) fn seen(&self) -> Option<SeenFlicker> {
        let level = self.level(None)?;
        if level < DARK_ROOM {
            return None;
        }
        // Dark images of another run lie too far away to tell the frequency.
        let run = |frames: &FrameExposures| {
            (frames.opened_s.first().copied().unwrap_or(0.0) / BETWEEN_RUNS_S) as i64
        };
        let timed = self.darks.iter().filter_map(|(role, image)| Some((self.times.get(role)?, *image)));
        let timed: Vec<(&FrameExposures, &Array2<f32>)> = timed.collect();
        let of_first = timed.iter().filter(|(frames, _)| run(frames) == run(timed[0].0));
        let means = |(frames, image): &(&FrameExposures, &Array2<f32>)| DarkRows {
            frames: (*frames).clone(),
            means_dn: image
                .rows()
                .into_iter()
                .map(|row| row.iter().map(|&counts| f64::from(counts)).sum::<f64>() / row.len() as f64)
                .collect(),
        };
        let darks: Vec<DarkRows> = of_first.map(means).collect();
        if darks.len() < 3 {
            let lamp = self.geometry.calibration.as_ref()?.lamp?;
            return Some(SeenFlicker { frequency_hz: lamp.frequency_hz, share: None, level });
        }
        let DarkFlicker { frequency_hz, share } = DarkFlicker::find(&darks, self.rows, self.row_time_s())?;
        Some(SeenFlicker { frequency_hz, share: Some(share), level })
    }

    /// Follows the flicker through the sweep; `stack` contains the same rows, not corrected yet. The settings of its
    /// images belong to `roles`, each with the role of its dark image.
    pub(crate) fn follow(
        self,
        seen: &SeenFlicker,
        stack: &SweepStack,
        roles: &[(PointRole, PointRole)],
        frames: u32,
    ) -> (Option<RoomFlicker>, RoomFindings) {
        let Some(rate_hz) = frame_rate_hz(self.times.values()) else {
            return (None, RoomFindings::default());
        };
        let &SeenFlicker { frequency_hz, share, level } = seen;
        if !can_be_followed(frequency_hz, rate_hz) {
            let amplitude = level * share.unwrap_or(1.0);
            return (None, RoomFindings::in_step(frequency_hz, amplitude, rate_hz));
        }
        match self.fitted(seen, stack, roles) {
            Some(lamp) if lamp.is_seen() => {
                // Flicker in the dark images changes what they seem to show of the level.
                let level = self.level(Some(&lamp)).unwrap_or(level);
                let darks = self.darks.keys().copied().collect();
                let room = RoomFlicker { lamp, darks, times: self.times };
                let said = room.say((level, share), self.rows, roles, (frames, rate_hz));
                (Some(room), RoomFindings { remark: Some(("room light", said)), warning: None })
            }
            _ if share.is_none() => (None, RoomFindings::default()),
            _ => (
                None,
                RoomFindings::unsteady(frequency_hz, "the dark images show", "the sweep does not show"),
            ),
        }
    }

    fn fitted(
        &self,
        seen: &SeenFlicker,
        stack: &SweepStack,
        roles: &[(PointRole, PointRole)],
    ) -> Option<LampFlicker> {
        let timed = roles.iter().map(|(light, dark)| {
            Some(TimedImage { light: self.times.get(light)?.clone(), dark: self.times.get(dark)?.clone() })
        });
        let timed: Vec<TimedImage> = timed.collect::<Option<_>>()?;
        let valid = stack.valid.as_ref().map(|valid| valid.view());
        let sample = Sample::of_rows(
            stack.timing.clone(),
            stack.settings.clone(),
            self.rows,
            stack.images.view(),
            valid,
        )
        .ok()?;
        let white_dn = self.geometry.white_of(self.rows);
        let beam_sigma_rows = self.geometry.beam_sigma_rows.unwrap_or(0.0);
        let mut found: Option<LampFlicker> = None;
        for _ in 0..ROUNDS {
            let levels = levels_dn_per_us(&self.darks, &self.times, found.as_ref(), self.rows)? / &white_dn;
            let of_pixels = sample.pixels().filter_map(|(t, s)| {
                let at = self.rows.binary_search(&t).ok()?;
                Some(levels[[at, s]])
            });
            let of_pixels: Vec<f64> = of_pixels.collect();
            let lamp =
                (found.as_ref().map_or(seen.frequency_hz, |found| found.frequency_hz), self.row_time_s());
            let unexplained =
                Unexplained::of_sweep(&sample, beam_sigma_rows, timed.clone(), &of_pixels).ok()?;
            found = Some(LampFlicker::follow(&[unexplained], lamp).ok()?);
        }
        found
    }
}

impl RoomFlicker {
    /// What an image saw too much of the room's light in camera row `t`, after its dark image was subtracted, in us.
    fn excess_us(&self, light: PointRole, dark: PointRole, t: usize) -> f64 {
        let seen_us = |role| self.times.get(&role).map_or(0.0, |frames| self.lamp.excess_us(frames, t));
        seen_us(light) - seen_us(dark)
    }

    /// Subtracts it from the light of camera rows `rows`; `levels` is the room's light at their pixels, per us.
    pub(crate) fn subtract(
        &self,
        (light, dark): (PointRole, PointRole),
        rows: &[usize],
        levels: &Array2<f64>,
        mut image: ArrayViewMut2<'_, f32>,
    ) {
        for ((mut image, levels), &t) in image.rows_mut().into_iter().zip(levels.rows()).zip(rows) {
            let excess_us = self.excess_us(light, dark, t);
            image.zip_mut_with(&levels, |light, level| *light -= (level * excess_us) as f32);
        }
    }

    /// The room's light at the pixels of these rows of the dark images, in counts per us.
    pub(crate) fn levels_dn_per_us(
        &self,
        darks: &BTreeMap<PointRole, &Array2<f32>>,
        rows: &[usize],
    ) -> Option<Array2<f64>> {
        let usable = darks.iter().filter(|(role, _)| self.darks.contains(role));
        let usable = usable.map(|(role, image)| (*role, *image)).collect();
        levels_dn_per_us(&usable, &self.times, Some(&self.lamp), rows)
    }

    fn say(
        &self,
        (level, share): (f64, Option<f64>),
        rows: &[usize],
        roles: &[(PointRole, PointRole)],
        (frames, rate_hz): (u32, f64),
    ) -> String {
        let frequency_hz = self.lamp.frequency_hz;
        let squares = roles
            .iter()
            .flat_map(|&(light, dark)| rows.iter().map(move |&t| self.excess_us(light, dark, t).powi(2)));
        let (sum, count) = squares.fold((0.0, 0), |(sum, count), square| (sum + square, count + 1));
        // Images at even distances may hardly show the lamp itself, only how it changes.
        let percent = 100.0 * share.unwrap_or_else(|| self.lamp.share());
        let removed_us = (sum / f64::from(count.max(1))).sqrt();
        let cure = match cancelling_frames(frequency_hz, &[rate_hz], frames) {
            Some(enough) if enough == frames => String::new(),
            Some(enough) => format!("; the mean of {enough} frames instead of {frames} would cancel it"),
            None => "; no number of frames up to 64 would cancel it".into(),
        };
        let removed = say_removed(level, percent, frequency_hz, "the times of the frames", removed_us);
        removed + &cure
    }
}

/// What is said of a lamp that was removed.
pub(crate) fn say_removed(level: f64, percent: f64, frequency_hz: f64, by: &str, removed_us: f64) -> String {
    format!(
        "{level:.4} of white in a row's time, {percent:.1} % of it flickering at {frequency_hz:.2} Hz: removed by {by}, as much as {removed_us:.1} us of it in each image (root mean square)"
    )
}

/// The time stamps of a unit's frames; `None` if they were not stored.
pub(crate) fn stamps(run: u32, starts_ns: &[i64]) -> Option<FrameStamps> {
    let within = ns_from_us(1e15);
    let is_plausible =
        !starts_ns.is_empty() && starts_ns.iter().all(|start| (-within..=within).contains(start));
    is_plausible.then(|| FrameStamps { run, starts_ns: starts_ns.to_vec() })
}
