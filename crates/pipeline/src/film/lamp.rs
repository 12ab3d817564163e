//! A lamp that flickers during a film: found in its first cycles, and removed from all cycles after them.

use std::{iter, slice};

use ndarray::{Array2, ArrayViewMut2};
use raysweep_transport::plane::calibrate::{
    CalibrateError, CycleFlicker, FrameExposures, LampFlicker, Sample, Unexplained, can_be_followed,
};

use super::FilmSolver;
use crate::flicker::{DARK_ROOM, RoomFindings, frame_rate_hz, say_removed};
use crate::scale::LightScale;
use crate::schedule::SweepGeometry;
use crate::stack::SweepStack;

/// Least share of an exposure for which a row of the dark image is taken to have seen the lamp.
const LEAST_SEEN_SHARE: f64 = 0.1;

/// The light of a film's room, as its dark image shows it.
pub(super) struct FilmRoom<'a> {
    geometry: &'a SweepGeometry,
    /// What the dark image shows beyond the camera's own dark, `[t, s]`; 1 = a white pixel lit by its own row.
    light: Array2<f32>,
    /// The frames of the dark image.
    frames: FrameExposures,
}

/// A lamp that flickers in that room, as the first cycles saw it.
pub(super) struct FilmLamp(LampFlicker);

impl<'a> FilmRoom<'a> {
    /// The room in a dark image of all camera rows, whose frames are these.
    pub fn new(
        geometry: &'a SweepGeometry,
        scale: &LightScale,
        dark: &Array2<f32>,
        frames: FrameExposures,
    ) -> Self {
        let light = scale.light(dark.view(), geometry.dark_offset_dn().view());
        Self { geometry, light, frames }
    }

    fn row_time_s(&self) -> f64 {
        self.geometry.camera_row_time_us * 1e-6
    }

    /// Its light, of white in a row's time.
    fn level(&self) -> f64 {
        let sum: f64 = self.light.iter().map(|&light| f64::from(light)).sum();
        sum / self.light.len().max(1) as f64 / self.frames.exposure_us * self.geometry.raster.row_time_us
    }

    /// Its light at each pixel, of white per us: what the dark image shows of it over what that saw of the lamp.
    fn levels_per_us(&self, lamp: Option<&LampFlicker>) -> Array2<f32> {
        let mut levels = self.light.clone();
        let exposure_us = self.frames.exposure_us;
        for (t, mut row) in levels.rows_mut().into_iter().enumerate() {
            let seen_us = exposure_us + lamp.map_or(0.0, |lamp| lamp.excess_us(&self.frames, t));
            // A row that was dark almost all the time does not tell its level.
            let seen_us = seen_us.max(LEAST_SEEN_SHARE * exposure_us);
            row.mapv_inplace(|light| light / seen_us as f32);
        }
        levels
    }

    /// What transport does not explain of a cycle, which may contain the flicker of a lamp; `None` if the room is dark,
    /// or if the cycle cannot show it.
    pub fn unexplained(&self, stack: &SweepStack, frames: &[FrameExposures]) -> Option<Unexplained> {
        let is_lit = self.level() >= DARK_ROOM;
        is_lit.then(|| self.unexplained_at(&self.levels_per_us(None), stack, frames).ok()).flatten()
    }

    fn unexplained_at(
        &self,
        levels_per_us: &Array2<f32>,
        stack: &SweepStack,
        frames: &[FrameExposures],
    ) -> Result<Unexplained, CalibrateError> {
        let valid = stack.valid.as_ref().map(|valid| valid.view());
        let sample = Sample::new(stack.timing.clone(), stack.settings.clone(), stack.images.view(), valid)?;
        let of_pixels: Vec<f64> = sample.pixels().map(|(t, s)| f64::from(levels_per_us[[t, s]])).collect();
        let beam_sigma_rows = self.geometry.beam_sigma_rows.unwrap_or(0.0);
        Unexplained::of_cycle(&sample, beam_sigma_rows, frames, &of_pixels)
    }
}

impl FilmLamp {
    /// Searches the first cycles for a lamp. `frames` has for each setting its frames in all of them.
    pub fn find(
        room: &FilmRoom<'_>,
        cycles: &[Unexplained],
        frames: &[FrameExposures],
    ) -> (Option<Self>, RoomFindings) {
        let calibration = room.geometry.calibration.as_ref();
        let expected_hz = calibration.and_then(|calibration| calibration.lamp).map(|lamp| lamp.frequency_hz);
        let found = CycleFlicker::find(cycles, room.row_time_s(), expected_hz);
        // Those of the dark image have one trigger delay: they follow each other in the camera's pace.
        let Some((found, rate_hz)) = found.zip(frame_rate_hz(iter::once(&room.frames))) else {
            return (None, RoomFindings::default());
        };
        let CycleFlicker { frequency_hz, share } = found;
        if !can_be_followed(frequency_hz, rate_hz) {
            return (None, RoomFindings::in_step(frequency_hz, room.level() * share, rate_hz));
        }
        let followed = |cycles: &[Unexplained]| {
            let lamp = LampFlicker::follow(cycles, (frequency_hz, room.row_time_s()));
            lamp.ok().filter(LampFlicker::is_seen)
        };
        let is_in_all = cycles.iter().all(|cycle| followed(slice::from_ref(cycle)).is_some());
        match followed(cycles).filter(|_| is_in_all).map(Self) {
            Some(lamp) => {
                let said = lamp.say(room, frames);
                (Some(lamp), RoomFindings { remark: Some(("room light", said)), warning: None })
            }
            None => {
                let [seen, unseen] = ["the first cycles together show", "not all of them show"];
                (None, RoomFindings::unsteady(frequency_hz, seen, unseen))
            }
        }
    }

    /// Removes it from the images of a cycle, or from their means over cycles; `frames` are those of each setting. Phase
    /// and amplitude wander, so they are found in each cycle anew; a cycle in which no lamp can be like that, because its
    /// scene moves, stays as it is.
    pub fn remove(&self, room: &FilmRoom<'_>, frames: &[FrameExposures], stack: &mut SweepStack) {
        let Self(lamp) = self;
        let levels_per_us = room.levels_per_us(Some(lamp));
        let rows = 0..room.geometry.height;
        let in_dark: Vec<f64> = rows.clone().map(|t| lamp.excess_us(&room.frames, t)).collect();
        for image in stack.images.outer_iter_mut() {
            add(image, &levels_per_us, &in_dark);
        }
        let unexplained = room.unexplained_at(&levels_per_us, stack, frames);
        let of_cycle = unexplained
            .and_then(|cycle| LampFlicker::follow(&[cycle], (lamp.frequency_hz, room.row_time_s())));
        let of_cycle = of_cycle.ok().filter(LampFlicker::is_possible);
        for (image, frames) in stack.images.outer_iter_mut().zip(frames) {
            let less_us: Vec<f64> = match &of_cycle {
                Some(lamp) => rows.clone().map(|t| -lamp.excess_us(frames, t)).collect(),
                None => in_dark.iter().map(|us| -us).collect(),
            };
            add(image, &levels_per_us, &less_us);
        }
    }

    fn say(&self, room: &FilmRoom<'_>, frames: &[FrameExposures]) -> String {
        let Self(lamp) = self;
        let single = frames.iter().flat_map(|frames| {
            let frame = move |&opened_s: &f64| FrameExposures { opened_s: vec![opened_s], ..*frames };
            frames.opened_s.iter().map(frame)
        });
        let excess_us =
            |frame: &FrameExposures, t: usize| lamp.excess_us(frame, t) - lamp.excess_us(&room.frames, t);
        let (mut sum, mut count) = (0.0_f64, 0_u32);
        for frame in single {
            for t in Sample::rows_of(room.geometry.height) {
                sum += excess_us(&frame, t).powi(2);
                count += 1;
            }
        }
        let removed_us = (sum / f64::from(count.max(1))).sqrt();
        let by = format!(
            "the times of the frames, in each cycle after the first {} anew",
            FilmSolver::FIRST_CYCLES
        );
        say_removed(room.level(), 100.0 * lamp.share(), lamp.frequency_hz, &by, removed_us)
    }
}

/// Adds to an image what its rows see of the room in these times.
fn add(mut image: ArrayViewMut2<'_, f32>, levels_per_us: &Array2<f32>, seen_us: &[f64]) {
    for ((mut row, levels), &us) in image.rows_mut().into_iter().zip(levels_per_us.rows()).zip(seen_us) {
        row.scaled_add(us as f32, &levels);
    }
}
