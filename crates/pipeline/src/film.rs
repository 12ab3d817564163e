//! Films: a short sweep with one frame per setting, repeated without pause. Each cycle has its own light transport.

mod lamp;

use std::sync::Arc;

use ndarray::{Array2, Array3, Axis};
use raysweep_core::{CameraCapabilities, CameraSettings, Counts};
use raysweep_transport::plane::calibrate::{FrameExposures, Unexplained};
use raysweep_transport::plane::{Demux, PlaneError, Setting, Transport};

use self::lamp::{FilmLamp, FilmRoom};
use crate::demux::{DEMUX, DemuxFold, DemuxOptions};
use crate::findings::{Choices, Findings, choose, rows_to_choose_by};
use crate::flicker::RoomFindings;
use crate::jitter::StripGauge;
use crate::scale::LightScale;
use crate::schedule::{PointRole, Schedule, SweepGeometry};
use crate::stack::SweepStack;
use crate::stage_refused::StageRefused;
use crate::strips::NotSolved;
use crate::unit::Unit;

/// The order in which a cycle takes its settings, as indices, and the VSYNC periods from each frame to the next one
/// (from the last frame to the first of the next cycle).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CycleOrder {
    /// Indices of the settings.
    pub settings: Vec<usize>,
    /// Periods after the frame at the same position.
    pub periods: Vec<u32>,
}

impl CycleOrder {
    /// The order that takes the fewest periods on this camera. `margin_us` of every period is kept free, because
    /// edges jitter.
    ///
    /// A camera that overlaps readout and exposure misses a trigger if the trigger delay decreases by more than
    /// period - readout. With descending delays, the largest decrease in a cycle is the largest gap between
    /// neighbouring delays. No order does better, because each gap must be crossed on the way from the largest delay
    /// to the smallest. If even that is too much, at least one such decrease per cycle is unavoidable, and ascending
    /// order has exactly one.
    pub fn fastest(
        shots: &[CameraSettings],
        camera: &CameraCapabilities,
        period_us: f64,
        margin_us: f64,
    ) -> Self {
        let mut upwards: Vec<usize> = (0..shots.len()).collect();
        upwards.sort_by(|&a, &b| shots[a].trigger_delay_us.total_cmp(&shots[b].trigger_delay_us));
        let downwards: Vec<usize> = upwards.iter().rev().copied().collect();
        let timed = |settings: Vec<usize>| {
            let next = settings.iter().cycle().skip(1);
            let periods = settings
                .iter()
                .zip(next)
                .map(|(&a, &b)| camera.periods_between(&shots[a], &shots[b], period_us - margin_us))
                .collect();
            Self { settings, periods }
        };
        let (downwards, upwards) = (timed(downwards), timed(upwards));
        if upwards.cycle_periods() < downwards.cycle_periods() { upwards } else { downwards }
    }

    /// Number of VSYNC periods in a cycle.
    pub fn cycle_periods(&self) -> u32 {
        self.periods.iter().sum()
    }
}

/// One sound frame of a film.
#[derive(Debug, Clone)]
pub struct FilmFrame {
    /// The measured delay and the actual exposure.
    pub setting: Setting,
    /// Start of the exposure of row 0, on the host's clock.
    pub exposure_start_ns: i64,
    /// Raw counts, `[t, s]`.
    pub raw: Arc<Array2<u32>>,
    /// Counts after all stages, `[t, s]`; `None` if a stage failed.
    pub image: Option<Arc<Array2<f32>>>,
}

impl FilmFrame {
    /// The only frame of a film's unit, with its image after all stages.
    pub fn of(unit: &Unit, image: Option<Arc<Array2<f32>>>) -> Option<Self> {
        let setting = Setting { delays_us: unit.delays_us.clone(), exposure_us: unit.exposure_us };
        let exposure_start_ns = *unit.starts_ns.last()?;
        Some(Self { setting, exposure_start_ns, raw: unit.sum.clone(), image })
    }

    /// Its image after all stages, if it has one.
    pub fn staged(&self) -> Option<FilmImage> {
        let (setting, counts) = (self.setting.clone(), self.image.clone()?);
        Some(FilmImage { setting, starts_ns: vec![self.exposure_start_ns], counts })
    }
}

/// An image of a film after all stages: a frame, or the dark image.
#[derive(Debug, Clone)]
pub struct FilmImage {
    /// The measured delays of its frames and the actual exposure.
    pub setting: Setting,
    /// Start of the exposure of row 0 in each of its frames, on the film's clock; empty if it was not stored.
    pub starts_ns: Vec<i64>,
    /// Mean counts, `[t, s]`.
    pub counts: Arc<Array2<f32>>,
}

impl FilmImage {
    /// A unit's image.
    pub fn of(unit: &Unit, counts: Array2<f32>) -> Self {
        let setting = Setting { delays_us: unit.delays_us.clone(), exposure_us: unit.exposure_us };
        let is_complete = unit.starts_ns.len() == unit.frames as usize;
        let starts_ns = if is_complete { unit.starts_ns.clone() } else { Vec::new() };
        Self { setting, starts_ns, counts: Arc::new(counts) }
    }
}

/// A cycle during acquisition.
#[derive(Debug, Clone)]
pub struct Cycle {
    /// Number of the cycle, from 0.
    pub number: u32,
    /// The frames, by setting.
    pub frames: Vec<Option<FilmFrame>>,
    /// What became of its triggers.
    pub counts: Counts,
    /// Number of settings whose fate is decided.
    pub decided: usize,
}

impl Cycle {
    /// An empty cycle of `settings` settings.
    pub fn new(number: u32, settings: usize) -> Self {
        Self { number, frames: vec![None; settings], counts: Counts::default(), decided: 0 }
    }

    /// Whether all settings are decided.
    pub fn is_over(&self) -> bool {
        self.decided == self.frames.len()
    }

    /// The settings without a sound frame.
    pub fn missing(&self) -> Vec<usize> {
        let missing = self.frames.iter().enumerate().filter(|(_, frame)| frame.is_none());
        missing.map(|(setting, _)| setting).collect()
    }
}

/// Computes a cycle's light transport from its frames.
pub struct FilmSolver {
    options: DemuxOptions,
    /// The plan's demultiplexer.
    demux: Demux,
    geometry: SweepGeometry,
    scale: LightScale,
    /// Which pixels have a scale, `[t, s]`.
    measured: Array2<bool>,
    /// Number of frames in the dark image.
    dark_frames: usize,
    /// The film's first cycles; `None` after it has learned from them.
    first: Option<FirstCycles>,
    /// What the plan says, by which those are solved.
    planned: Known,
    /// What they showed.
    learned: Option<Known>,
    /// The strip of the board that shows each frame's jitter, if it is in view.
    strip: Option<StripGauge>,
}

/// What is known before a cycle is solved.
struct Known {
    choices: Choices,
    /// A lamp that flickers.
    lamp: Option<FilmLamp>,
}

/// A film's first cycles.
#[derive(Default)]
struct FirstCycles {
    cycles: usize,
    sum: Option<SweepStack>,
    /// Their frames of each setting.
    frames: Vec<FrameExposures>,
    /// What may show a lamp; of fewer cycles if the room is dark, or if it is not known when frames were exposed.
    unexplained: Vec<Unexplained>,
}

impl FilmSolver {
    /// Cycles from whose mean a film learns: enough for single frames' noise and jitter, and no more than wait for a
    /// solver at a time, so that a film processed again learns from the same cycles.
    pub const FIRST_CYCLES: usize = 4;

    /// A solver for the cycles of `schedule`.
    ///
    /// # Errors
    /// If options or geometry do not give a valid model.
    pub fn new(
        options: DemuxOptions,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<Self, StageRefused> {
        let invalid =
            |error: PlaneError| StageRefused::Invalid { name: DEMUX.into(), what: error.to_string() };
        let demux = DemuxFold::new(options, schedule, geometry)?.demux().map_err(invalid)?;
        let rows: Vec<usize> = (0..geometry.height).collect();
        let dark = schedule.points.iter().find(|point| matches!(point.role, PointRole::Dark(_)));
        Ok(Self {
            options,
            planned: Known { choices: Choices::planned(demux.clone(), geometry), lamp: None },
            learned: None,
            demux,
            geometry: geometry.clone(),
            scale: geometry.scale_of(&rows),
            measured: geometry.white_of(&rows).mapv(f64::is_finite),
            dark_frames: dark.map_or(1, |dark| dark.frames as usize),
            first: Some(FirstCycles::default()),
            strip: StripGauge::of(geometry).map_err(invalid)?,
        })
    }

    /// The relative rows that are estimated: first and last.
    pub fn reach_rows(&self) -> (i32, i32) {
        let reach = self.demux.reach();
        (*reach.start(), *reach.end())
    }

    /// The transport from one frame of each setting, in the settings' order, with the delays and the exposure that the
    /// camera states. `dark` is the image without light. Stops early, with an error, soon after `go_on` returns false.
    ///
    /// It does not start from the previous cycle's transport: the noise of single frames determines which rows are 0,
    /// so this would save no steps (5.2 per pixel with and without), and the bits would depend on what was solved
    /// before.
    ///
    /// # Errors
    /// If a frame's delay does not give a valid model, or `go_on` returned false.
    pub fn solve(
        &self,
        frames: &[FilmImage],
        dark: &FilmImage,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, NotSolved> {
        let known = self.learned.as_ref().unwrap_or(&self.planned);
        let mut stack = self.stack(known, frames, dark);
        known.choices.solve(0..self.geometry.height, 0, &mut stack, go_on).map_err(not_solved)
    }

    /// The stack from which the transport of a cycle was solved, for its products; the number of cycles solved before it
    /// decides how. Of a solver that has learned: its noise, and whether near rows are one band, are also those of the
    /// cycles from which it has learned. What only [`crate::ProductSpec::needs_noise`] products ask for is made if it `is_judged`.
    ///
    /// # Errors
    /// As [`Self::solve`].
    pub fn solved_stack(
        &self,
        (cycles_before, is_judged): (usize, bool),
        frames: &[FilmImage],
        dark: &FilmImage,
    ) -> Result<SweepStack, NotSolved> {
        let learned = self.learned.as_ref();
        let known = learned.filter(|_| cycles_before >= Self::FIRST_CYCLES).unwrap_or(&self.planned);
        let (choices, learned) = (&known.choices, learned.map(|learned| &learned.choices));
        let mut stack = self.stack(known, frames, dark);
        if is_judged {
            choices.prepare(&(0..self.geometry.height), 0, &mut stack, &|| true).map_err(not_solved)?;
            stack.noise = learned.and_then(Choices::noise_without_darks);
        } else {
            stack.timing = choices.timing().clone();
        }
        stack.one_band = learned.is_some_and(|learned| learned.findings.one_band);
        Ok(stack)
    }

    /// Takes the frames of another complete cycle, as for [`Self::solve`]. Once it has the first few, it chooses from
    /// their mean how to demultiplex the cycles after them, as a sweep does from its images, and returns what it found.
    /// Takes about as long as solving a few small cycles, and only this once.
    ///
    /// # Errors
    /// If their mean does not give a valid model; then the cycles after them are demultiplexed as planned, too.
    pub fn learn(&mut self, frames: &[FilmImage], dark: &FilmImage) -> Option<Result<&Findings, NotSolved>> {
        let mut first = self.first.take()?;
        let stack = self.stack(&self.planned, frames, dark);
        let exposed = self.exposed(frames, dark);
        if let Some((room, frames)) = &exposed {
            first.unexplained.extend(room.unexplained(&stack, frames));
            first.add_frames(frames);
        }
        first.add(stack);
        if first.cycles < Self::FIRST_CYCLES {
            self.first = Some(first);
            return None;
        }
        let mut mean = first.sum?;
        mean.images /= first.cycles as f32;
        let (mut lamp, mut said) = (None, RoomFindings::default());
        if let Some((room, _)) = exposed
            && first.unexplained.len() == first.cycles
        {
            (lamp, said) = FilmLamp::find(&room, &first.unexplained, &first.frames);
            if let Some(lamp) = &lamp {
                lamp.remove(&room, &first.frames, &mut mean);
            }
        }
        let rows = rows_to_choose_by(self.geometry.height);
        Some(match choose(&self.demux, &self.options, &self.geometry, &rows, mean.of_rows(&rows)) {
            Ok(mut choices) => {
                choices.findings.add_room(said);
                Ok(&self.learned.insert(Known { choices, lamp }).choices.findings)
            }
            Err(error) => Err(not_solved(error)),
        })
    }

    /// The room in the dark image, and when these frames were exposed, on one clock; `None` if that was not stored.
    fn exposed(&self, frames: &[FilmImage], dark: &FilmImage) -> Option<(FilmRoom<'_>, Vec<FrameExposures>)> {
        let zero_ns = *dark.starts_ns.first()?;
        let since_s = |start_ns: &i64| start_ns.saturating_sub(zero_ns) as f64 * 1e-9;
        let exposures = |image: &FilmImage| FrameExposures {
            exposure_us: image.setting.exposure_us,
            opened_s: image.starts_ns.iter().map(since_s).collect(),
        };
        let is_known = frames.iter().all(|frame| !frame.starts_ns.is_empty());
        is_known.then(|| {
            let room = FilmRoom::new(&self.geometry, &self.scale, &dark.counts, exposures(dark));
            (room, frames.iter().map(exposures).collect())
        })
    }

    /// These frames as the model sees them, without the lamp that is known.
    fn stack(&self, known: &Known, frames: &[FilmImage], dark: &FilmImage) -> SweepStack {
        let is_unsaturated = |counts: f32| f64::from(counts) < self.geometry.saturation_dn;
        let shape = (frames.len(), self.geometry.height, self.geometry.width);
        let saturates =
            || frames.iter().any(|frame| frame.counts.iter().any(|&counts| !is_unsaturated(counts)));
        let is_masked = self.measured.iter().any(|measured| !measured) || saturates();
        let mut valid = is_masked.then(|| Array3::from_elem(shape, true));
        let mut images = Array3::zeros(shape);
        let dark_view = dark.counts.view();
        for (index, FilmImage { counts, .. }) in frames.iter().enumerate() {
            if let Some(valid) = &mut valid {
                valid.index_axis_mut(Axis(0), index).assign(&(counts.mapv(is_unsaturated) & &self.measured));
            }
            images.index_axis_mut(Axis(0), index).assign(&self.scale.light(counts.view(), dark_view));
        }
        let setting = |FilmImage { setting, counts, .. }: &FilmImage| {
            let setting = self.geometry.setting(&setting.delays_us, setting.exposure_us);
            let late_us = self.strip.as_ref().and_then(|strip| {
                strip.late_us(&setting, strip.of_image(&counts.view()), strip.of_image(&dark_view))
            });
            let late_us = late_us.unwrap_or(self.geometry.unseen_jitter(&setting));
            (setting.earlier(late_us.value), late_us.sd)
        };
        let exposures_us = frames.iter().map(|frame| frame.setting.exposure_us).collect();
        let (settings, delay_sds_us) = frames.iter().map(setting).unzip();
        let mut stack = SweepStack {
            exposures_us,
            dark_frames: vec![self.dark_frames; frames.len()],
            delay_sds_us,
            valid,
            ..SweepStack::new(self.demux.timing().clone(), self.demux.prior(), settings, images)
        };
        if let Some(lamp) = &known.lamp
            && let Some((room, frames)) = self.exposed(frames, dark)
        {
            lamp.remove(&room, &frames, &mut stack);
        }
        stack
    }
}

fn not_solved(error: PlaneError) -> NotSolved {
    NotSolved { of: "film", what: error.to_string() }
}

impl FirstCycles {
    fn add_frames(&mut self, frames: &[FrameExposures]) {
        if self.frames.is_empty() {
            self.frames = frames.to_vec();
            return;
        }
        for (all, frames) in self.frames.iter_mut().zip(frames) {
            all.opened_s.extend(&frames.opened_s);
        }
    }

    fn add(&mut self, cycle: SweepStack) {
        self.cycles += 1;
        let Some(sum) = &mut self.sum else {
            self.sum = Some(cycle);
            return;
        };
        for (sum, setting) in sum.settings.iter_mut().zip(cycle.settings) {
            sum.delays_us.extend(setting.delays_us);
        }
        sum.images += &cycle.images;
        sum.valid = match (sum.valid.take(), cycle.valid) {
            (Some(a), Some(b)) => Some(a & b),
            (a, b) => a.or(b),
        };
    }
}

#[cfg(test)]
mod tests {
    use raysweep_core::{PixelFormat, Readout, Shutter};

    use super::*;

    const PERIOD_US: f64 = 16_666.667;
    /// The default film's delays.
    const DELAYS_US: [f64; 15] = [
        -1500.0, -1000.0, -640.0, -420.0, -333.0, -311.0, -289.0, 0.0, 289.0, 311.0, 333.0, 420.0, 640.0,
        1000.0, 1500.0,
    ];

    fn camera(readout: Readout, readout_us: f64) -> CameraCapabilities {
        CameraCapabilities {
            model: "scripted".into(),
            width: 2,
            height: 1,
            format: PixelFormat::Mono12,
            row_time_us: 20.0,
            trigger_latency_us: 8.0,
            readout_us,
            readout,
            exposure_us: 1.0..=1e6,
            trigger_delay_us: 0.0..=1e6,
        }
    }

    fn shots(delays_us: &[f64]) -> Vec<CameraSettings> {
        let shot = |delay_us: &f64| CameraSettings {
            shutter: Shutter::Rolling,
            exposure_us: 600.0,
            trigger_delay_us: 2000.0 + delay_us,
        };
        delays_us.iter().map(shot).collect()
    }

    /// All orders of `rest` after those already in `order`.
    fn orders(order: &mut Vec<usize>, rest: &mut Vec<usize>, visit: &mut impl FnMut(&[usize])) {
        if rest.is_empty() {
            visit(order);
        }
        for place in 0..rest.len() {
            let setting = rest.remove(place);
            order.push(setting);
            orders(order, rest, visit);
            order.pop();
            rest.insert(place, setting);
        }
    }

    #[test]
    fn no_order_takes_fewer_periods_or_falls_back_by_less() {
        let delays_us = [300.0, -1500.0, 0.0, -200.0, 1100.0, 700.0];
        let shots = shots(&delays_us);
        for readout_us in [1_000.0, 15_000.0, 15_700.0, 16_100.0, 16_400.0, 16_600.0, 20_000.0] {
            for readout in [Readout::Overlapped, Readout::Sequential] {
                let camera = camera(readout, readout_us);
                let found = CycleOrder::fastest(&shots, &camera, PERIOD_US, 0.0);
                let fall = |order: &[usize]| {
                    let next = order.iter().cycle().skip(1);
                    order.iter().zip(next).map(|(&a, &b)| delays_us[a] - delays_us[b]).fold(0.0, f64::max)
                };
                let periods = |order: &[usize]| -> u32 {
                    let next = order.iter().cycle().skip(1);
                    let between =
                        |(&a, &b): (&usize, &usize)| camera.periods_between(&shots[a], &shots[b], PERIOD_US);
                    order.iter().zip(next).map(between).sum()
                };
                let (mut fewest, mut smallest) = (u32::MAX, f64::INFINITY);
                orders(&mut Vec::new(), &mut (0..6).collect(), &mut |order| {
                    fewest = fewest.min(periods(order));
                    smallest = smallest.min(fall(order));
                });
                assert_eq!(found.cycle_periods(), fewest, "{readout:?}, {readout_us} us");
                assert_eq!(found.cycle_periods(), periods(&found.settings));
                if found.settings.first() == Some(&4) {
                    assert_eq!(fall(&found.settings), smallest);
                }
            }
        }
    }

    #[test]
    fn the_default_film_misses_no_trigger_of_a_camera_that_reads_out_in_16_1_ms() {
        let shots = shots(&DELAYS_US);
        let periods = |readout_us: f64| {
            CycleOrder::fastest(&shots, &camera(Readout::Overlapped, readout_us), PERIOD_US, 50.0)
                .cycle_periods()
        };
        // In ascending order the decrease from +1500 to -1500 leaves 13.67 ms; this gives 3.75 cycles per second at
        // 60 Hz.
        assert_eq!((periods(16_100.0), periods(16_400.0)), (15, 16));
        let sequential = camera(Readout::Sequential, 16_100.0);
        assert_eq!(CycleOrder::fastest(&shots, &sequential, PERIOD_US, 50.0).cycle_periods(), 30);
    }

    #[test]
    fn a_cycle_is_over_when_every_setting_is_decided() {
        let mut cycle = Cycle::new(3, 2);
        assert!(!cycle.is_over());
        cycle.decided = 2;
        assert!(cycle.is_over());
        assert_eq!(cycle.missing(), [0, 1]);
    }
}
