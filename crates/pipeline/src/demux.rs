//! `demux`: from the averaged images of a sweep to its light transport.

mod options;
mod strips;
mod tally;

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use ndarray::{Array2, Array3, ArrayView2, ArrayViewMut2, Axis, Zip, s};
use raysweep_transport::plane::{Demux, PlaneError, RowTiming, Setting, Transport};

pub use self::options::{DEMUX, DemuxOptions};
use self::tally::Tally;
pub use self::tally::{PREDICTED_SHARE, SweepSummary};
use crate::bracket::BracketImage;
use crate::findings::{Choices, choose, rows_to_choose_by};
use crate::flicker::{FrameStamps, RoomFindings, RoomFlicker, RoomImages, on_one_clock, stamps};
use crate::jitter::{StripFindings, StripGauge, StripLight};
use crate::schedule::{PointRole, Schedule, SweepGeometry};
use crate::spot::SpotCut;
use crate::stack::SweepStack;
use crate::stage_refused::StageRefused;
use crate::strips::{NotSolved, Strip};
use crate::unit::Unit;

/// One image of the sweep and its settings.
struct SweepImage {
    setting: Setting,
    /// Mean counts.
    image: Array2<f32>,
    /// Where any of its frames saturates; `None` if nowhere, or if it is not known.
    clipped: Option<Array2<bool>>,
    /// When its frames were exposed, if it is known.
    stamps: Option<FrameStamps>,
}

/// How an image was taken that is not kept.
#[derive(Clone)]
struct NotKept {
    /// The point's ordinal.
    point: u32,
    setting: Setting,
    stamps: Option<FrameStamps>,
}

impl SweepImage {
    /// Where neither the mean nor, as far as it is known, any of its frames reaches `saturation_dn`, `[t, s]`. Noise
    /// clips single frames of means that stay below.
    fn valid(&self, saturation_dn: f64) -> Array2<bool> {
        let mut valid = self.image.mapv(|counts| f64::from(counts) < saturation_dn);
        if let Some(clipped) = &self.clipped {
            valid.zip_mut_with(clipped, |valid, &clipped| *valid &= !clipped);
        }
        valid
    }
}

/// Collects a sweep and demultiplexes it. Clones share the images.
#[derive(Clone)]
pub struct DemuxFold {
    options: DemuxOptions,
    schedule: Arc<Schedule>,
    geometry: Arc<SweepGeometry>,
    timing: RowTiming,
    taken: BTreeMap<PointRole, Arc<SweepImage>>,
    /// The images that are not kept; `None` if images are kept.
    not_kept: Option<BTreeMap<PointRole, NotKept>>,
    /// Pixels that a stage replaced in some image, `[t, s]`; `None` if none.
    filled: Option<Arc<Array2<bool>>>,
    /// The images' light in the strip of the board, if one is in view.
    strip: Option<StripLight>,
    /// A lamp whose flicker the images contain; `None` until it is found in them.
    room: Option<Arc<RoomFlicker>>,
}

/// The camera rows of a sweep to be solved, and the neighbouring rows on which they depend.
struct Held {
    /// The camera row of row 0 of the images.
    first_row: usize,
    stack: SweepStack,
    /// The regular image and its dark image, if both were taken.
    regular: Option<(Arc<SweepImage>, Arc<SweepImage>)>,
    /// The dark images, if a lamp flickers.
    darks: BTreeMap<PointRole, Arc<SweepImage>>,
}

/// A sweep that was solved in one piece.
pub struct Solved {
    /// The images in use.
    pub stack: SweepStack,
    /// The light transport `[u, t, s]`.
    pub transport: Transport,
    /// How it was estimated, and how far to trust it.
    pub summary: SweepSummary,
}

/// A sweep at some time, as the live estimate takes it: a [`DemuxFold`]. The tests of that estimate script others.
pub trait Snapshot: Send + Sync {
    /// Number of points of the sweep that it can use for an estimate.
    fn points(&self) -> usize;

    /// The transport estimated from these points; starting from the estimate of fewer points makes it faster. Stops
    /// early, with an error, soon after `go_on` returns false.
    ///
    /// # Errors
    /// If it cannot be estimated, or `go_on` returned false.
    fn estimate(
        &self,
        before: Option<&Transport>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, NotSolved>;
}

/// Smallest number of points for a useful estimate.
const MIN_LIVE_POINTS: usize = 5;

impl DemuxFold {
    /// A fold for the sweep of `schedule`.
    ///
    /// # Errors
    /// If the options or the geometry do not give a valid model.
    pub fn new(
        options: DemuxOptions,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<Self, StageRefused> {
        let invalid =
            |error: PlaneError| StageRefused::Invalid { name: DEMUX.into(), what: error.to_string() };
        options.prior().check().map_err(invalid)?;
        let timing = geometry.timing().map_err(invalid)?;
        let strip = StripGauge::of(geometry).map_err(invalid)?.map(StripLight::new);
        let (schedule, geometry) = (Arc::new(schedule.clone()), Arc::new(geometry.clone()));
        let fold = Self {
            options,
            schedule,
            geometry,
            timing,
            taken: BTreeMap::new(),
            not_kept: None,
            filled: None,
            strip,
            room: None,
        };
        fold.demux().map_err(invalid)?;
        Ok(fold)
    }

    /// The plan's demultiplexer, before any image is taken: its reach and its conditioning.
    ///
    /// # Errors
    /// If delays and exposures do not give a valid model on this rig.
    pub fn demux(&self) -> Result<Demux, PlaneError> {
        let sweep = self.schedule.points.iter().filter(|point| matches!(point.role, PointRole::Sweep(_)));
        let planned =
            sweep.map(|point| self.geometry.setting(&[point.delay_us], point.exposure_us)).collect();
        Demux::new(self.timing.clone(), planned, self.options.prior())
    }

    /// The dark image for the exposure of a role's image, if it was taken.
    fn dark_of(
        &self,
        taken: &BTreeMap<PointRole, Arc<SweepImage>>,
        role: PointRole,
    ) -> Option<Arc<SweepImage>> {
        let point = self.schedule.points.iter().find(|point| point.role == role)?;
        taken.get(&self.schedule.dark_of(point.exposure_us)?).cloned()
    }

    /// The sweep in these images of camera rows `rows`, without those whose dark image is missing. Each image is
    /// dropped as soon as it is in the stack: unless a clone of the fold shares it, a sweep is held in memory once, not twice.
    fn stack(
        &self,
        rows: &[usize],
        mut taken: BTreeMap<PointRole, Arc<SweepImage>>,
    ) -> Result<SweepStack, NotSolved> {
        let darks = taken.extract_if(.., |role, _| matches!(role, PointRole::Dark(_))).collect();
        taken.retain(|role, _| matches!(role, PointRole::Sweep(_)) && self.dark_of(&darks, *role).is_some());
        if taken.is_empty() {
            return Err(NotSolved {
                of: DEMUX,
                what: "no point of the sweep is stored together with the dark image of its exposure: resume the run"
                    .into(),
            });
        }
        let scale = self.geometry.scale_of(rows);
        let measured = self.geometry.white_of(rows).mapv(f64::is_finite);
        let valid_of = |taken: &SweepImage| taken.valid(self.geometry.saturation_dn);
        let saturates = |taken: &Arc<SweepImage>| valid_of(taken).iter().any(|valid| !valid);
        let shape = (taken.len(), rows.len(), self.geometry.width);
        let is_masked = measured.iter().any(|measured| !measured) || taken.values().any(saturates);
        let mut valid = is_masked.then(|| Array3::from_elem(shape, true));
        let mut images = Array3::zeros(shape);
        let mut settings = Vec::with_capacity(taken.len());
        let mut dark_frames = Vec::with_capacity(taken.len());
        let mut delay_sds_us = Vec::with_capacity(taken.len());
        let point_of = |role: &PointRole| self.schedule.points.iter().find(|point| point.role == *role);
        let StripFindings { late_us, .. } = self.jitter();
        let planned = taken.keys().filter_map(point_of);
        let (delays_us, exposures_us) = planned.map(|point| (point.delay_us, point.exposure_us)).unzip();
        let flicker = self.flicker(&darks, rows);
        for (index, (role, sample)) in taken.into_iter().enumerate() {
            if let Some(valid) = &mut valid {
                valid.index_axis_mut(Axis(0), index).assign(&(valid_of(&sample) & &measured));
            }
            if let Some(dark) = self.dark_of(&darks, role) {
                let mut image = images.index_axis_mut(Axis(0), index);
                image.assign(&scale.light(sample.image.view(), dark.image.view()));
                if let Some(flicker) = &flicker {
                    flicker.subtract(role, self.schedule_dark(role), image);
                }
                dark_frames.push(dark.setting.delays_us.len().max(1));
            }
            let late_us = late_us.get(&role).copied().unwrap_or(self.geometry.unseen_jitter(&sample.setting));
            settings.push(sample.setting.earlier(late_us.value));
            delay_sds_us.push(late_us.sd);
        }
        Ok(SweepStack {
            delays_us,
            exposures_us,
            dark_frames,
            delay_sds_us,
            valid,
            ..SweepStack::new(self.timing.clone(), self.options.prior(), settings, images)
        })
    }

    /// How late the light of each image is, as far as a strip of the board shows it.
    fn jitter(&self) -> StripFindings {
        let dark_of = |role: PointRole| self.schedule_dark(role);
        self.strip.as_ref().map_or_else(StripFindings::default, |strip| strip.findings(dark_of))
    }

    /// Searches the images of the camera rows `rows` for a lamp that flickers, and follows it; `sampled` gives the dark
    /// images of these rows, or all of them.
    fn watch_room(
        &mut self,
        rows: &[usize],
        sampled: impl Fn(&dyn Fn(PointRole) -> bool) -> BTreeMap<PointRole, Arc<SweepImage>>,
    ) -> Result<RoomFindings, NotSolved> {
        let darks = sampled(&|role| matches!(role, PointRole::Dark(_)));
        let room = |images: &BTreeMap<PointRole, Arc<SweepImage>>| {
            let stamped = images
                .iter()
                .map(|(role, image)| Some((*role, image.setting.exposure_us, image.stamps.as_ref()?)));
            let stamped: Vec<_> = stamped.collect::<Option<_>>()?;
            let times = on_one_clock(stamped.into_iter())?;
            Some(RoomImages::new(&self.geometry, rows, counts_of(&darks), times))
        };
        let Some(seen) = room(&darks).and_then(|room| room.seen()) else {
            return Ok(RoomFindings::default());
        };
        let all = sampled(&|_| true);
        let Some(room) = room(&all) else { return Ok(RoomFindings::default()) };
        let stack = self.stack(rows, all.clone())?;
        let roles = all.keys().filter(|role| matches!(role, PointRole::Sweep(_)));
        let roles: Vec<(PointRole, PointRole)> = roles
            .filter_map(|&role| Some((role, self.schedule_dark(role)?)))
            .filter(|(_, dark)| all.contains_key(dark))
            .collect();
        let frames = self.schedule.points.iter().find(|point| is_of_sweep(point.role));
        let (found, said) = room.follow(&seen, &stack, &roles, frames.map_or(1, |point| point.frames));
        self.room = found.map(Arc::new);
        Ok(said)
    }

    /// The dark point of a point of the plan.
    fn schedule_dark(&self, role: PointRole) -> Option<PointRole> {
        let point = self.schedule.points.iter().find(|point| point.role == role)?;
        self.schedule.dark_of(point.exposure_us)
    }

    /// The flicker to be subtracted from images of camera rows `rows`, to which the dark images belong.
    fn flicker<'a>(
        &'a self,
        darks: &BTreeMap<PointRole, Arc<SweepImage>>,
        rows: &'a [usize],
    ) -> Option<RowFlicker<'a>> {
        let room = self.room.as_deref()?;
        let levels = room.levels_dn_per_us(&counts_of(darks), rows)? / self.geometry.white_of(rows);
        Some(RowFlicker { room, rows, levels })
    }

    /// Camera rows `rows`, to which the images belong.
    fn hold(
        &self,
        rows: Range<usize>,
        taken: BTreeMap<PointRole, Arc<SweepImage>>,
    ) -> Result<Held, NotSolved> {
        let regular = taken.get(&PointRole::Regular).cloned().zip(self.dark_of(&taken, PointRole::Regular));
        let first_row = rows.start;
        let darks = self.room.as_ref().map_or_else(BTreeMap::new, |_| darks_of(&taken));
        Ok(Held { first_row, stack: self.stack(&rows.collect::<Vec<_>>(), taken)?, regular, darks })
    }

    /// Chooses how to demultiplex, from a stack that contains only the rows of [`rows_to_choose_by`].
    fn choose(&self, stack: SweepStack, bracket: Option<BracketImage>) -> Result<Choices, NotSolved> {
        let rows = rows_to_choose_by(self.geometry.height);
        let bracket = bracket.map(|image| (image, stack.clone()));
        self.demux()
            .and_then(|planned| choose(&planned, &self.options, &self.geometry, &rows, stack))
            .and_then(|choices| match bracket {
                Some((image, stack)) => choices.with_bracket(image, &rows, stack),
                None => Ok(choices),
            })
            .map(|mut choices| {
                let StripFindings { remark, warning, .. } = self.jitter();
                choices.findings.remarks.extend(remark.map(|said| ("jitter", said)));
                choices.findings.warnings.extend(warning);
                choices
            })
            .map_err(refused)
    }

    /// The image under less light among these images of all camera rows, if it and its dark image were taken.
    fn bracket(&self, taken: &BTreeMap<PointRole, Arc<SweepImage>>) -> Option<BracketImage> {
        let role = self.schedule.bracket()?.role;
        let (bracket, dark) = taken.get(&role).zip(self.dark_of(taken, role))?;
        let rows: Vec<usize> = (0..self.geometry.height).collect();
        let white = self.geometry.white_of(&rows);
        let mut image = self.geometry.scale_of(&rows).light(bracket.image.view(), dark.image.view());
        if let Some(flicker) = self.flicker(&darks_of(taken), &rows) {
            flicker.subtract(role, self.schedule_dark(role), image.view_mut());
        }
        Some(BracketImage {
            setting: bracket.setting.clone(),
            image,
            valid: bracket.valid(self.geometry.saturation_dn) & white.mapv(f64::is_finite),
        })
    }

    /// Stack and transport of some camera rows; adds their figures and warnings to `tally`.
    fn strip(
        &self,
        choices: &Choices,
        rows: Range<usize>,
        held: Held,
        tally: &mut Tally,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Strip, NotSolved> {
        let Held { first_row: held_from, mut stack, regular, darks } = held;
        let first_row = rows.start;
        let inner = rows.start - held_from..rows.end - held_from;
        let camera_rows: Vec<usize> = rows.clone().collect();
        let measured = self.geometry.white_of(&camera_rows).mapv(f64::is_finite);
        let solved = rows.clone();
        let transport = choices.solve(rows, held_from, &mut stack, go_on).map_err(refused)?;
        tally.add_sweep(stack.settings.len(), &measured, &transport);
        if let Some((regular, dark)) = regular {
            let [image, dark] = [&regular, &dark].map(|taken| taken.image.slice(s![inner.clone(), ..]));
            let mut light = self.geometry.scale_of(&camera_rows).light(image, dark);
            let role = PointRole::Regular;
            let darks = darks.iter().map(|(role, taken)| (*role, taken.rows(inner.clone()))).collect();
            if let Some(flicker) = self.flicker(&darks, &camera_rows) {
                flicker.subtract(role, self.schedule_dark(role), light.view_mut());
            }
            let valid = regular.valid(self.geometry.saturation_dn).slice_move(s![inner, ..]);
            tally.add_regular(&valid, &measured, &light, &transport);
            stack.regular = Some(light);
            stack.regular_valid = Some(valid);
        }
        stack.filled = self.filled.as_ref().map(|filled| filled.slice(s![solved, ..]).to_owned());
        Ok(Strip { first_row, stack, transport })
    }
}

impl DemuxFold {
    /// Takes the next unit; a later attempt at a point replaces an earlier one.
    pub fn push(&mut self, unit: &Unit, image: ArrayView2<'_, f32>) {
        let Some(point) = self.schedule.points.get(unit.id.point as usize) else { return };
        let setting = self.geometry.setting(&unit.delays_us, unit.exposure_us);
        if let Some(strip) = &mut self.strip {
            strip.push(point.role, &setting, image);
        }
        let stamps = stamps(unit.run, &unit.starts_ns);
        match &mut self.not_kept {
            Some(not_kept) => {
                drop(not_kept.insert(point.role, NotKept { point: unit.id.point, setting, stamps }));
            }
            None => {
                // Sessions store the clipped frames of the sweep and its bracket alone.
                let clipped = unit.clipped.as_ref().filter(|_| is_of_sweep(point.role));
                let clipped = clipped.map(|frames| frames.mapv(|frames| frames > 0));
                let taken = SweepImage { setting, image: image.to_owned(), clipped, stamps };
                drop(self.taken.insert(point.role, Arc::new(taken)));
            }
        }
    }

    /// Notes which pixels of a unit's image its stages replaced.
    pub fn note_filled(&mut self, unit: &Unit, image: ArrayView2<'_, f32>) {
        let raw = unit.mean();
        if raw != image {
            let none = || Arc::new(Array2::from_elem(image.dim(), false));
            let filled = Arc::make_mut(self.filled.get_or_insert_with(none));
            Zip::from(filled).and(&raw).and(image).for_each(|filled, raw, image| *filled |= raw != image);
        }
    }

    /// The units taken so far, from which another thread can compute an estimate while more arrive; `None` if they are
    /// too few. Cheap: images are shared, not copied.
    pub fn snapshot(&self) -> Option<Self> {
        (self.points() >= MIN_LIVE_POINTS).then(|| self.clone())
    }

    /// Computes the transport from the units taken. Stops early, with an error, soon after `go_on` returns false.
    ///
    /// # Errors
    /// If too few units were taken, or `go_on` returned false.
    pub fn finish(mut self, go_on: &(dyn Fn() -> bool + Sync)) -> Result<Solved, NotSolved> {
        let taken = std::mem::take(&mut self.taken);
        let mut tally = Tally::default();
        let height = self.geometry.height;
        let rows = rows_to_choose_by(height);
        let said = self.watch_room(&rows, |is_wanted| of_rows(&taken, &rows, is_wanted))?;
        let bracket = self.bracket(&taken);
        let held = self.hold(0..height, taken)?;
        let mut choices = self.choose(held.stack.of_rows(&rows), bracket)?;
        choices.findings.add_room(said);
        let Strip { stack, transport, .. } = self.strip(&choices, 0..height, held, &mut tally, go_on)?;
        Ok(Solved { stack, transport, summary: tally.summary(choices.findings) })
    }

    /// Stops keeping images and providing snapshots: [`Self::finish_in_strips`] reads the images again.
    pub fn keep_no_images(&mut self) {
        self.not_kept = Some(BTreeMap::new());
    }
}

impl Snapshot for DemuxFold {
    fn points(&self) -> usize {
        let taken = |role: PointRole| self.taken.contains_key(&role);
        let lit = self.schedule.points.iter().filter(|point| matches!(point.role, PointRole::Sweep(_)));
        lit.filter(|point| taken(point.role) && self.schedule.dark_of(point.exposure_us).is_some_and(taken))
            .count()
    }

    fn estimate(
        &self,
        before: Option<&Transport>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, NotSolved> {
        let rows: Vec<usize> = (0..self.geometry.height).collect();
        let mut fold = self.clone();
        let sampled = rows_to_choose_by(self.geometry.height);
        fold.watch_room(&sampled, |is_wanted| of_rows(&self.taken, &sampled, is_wanted))?;
        let mut stack = fold.stack(&rows, fold.taken.clone())?;
        let cut = SpotCut::of(&self.geometry, &stack.timing, &stack.settings).map_err(refused)?;
        stack.keep(|n| cut.keeps(n));
        let SweepStack { settings, images, valid, .. } = stack;
        let valid = valid.as_ref().map(|valid| valid.view());
        self.demux()
            .and_then(|demux| cut.modelled_by(demux.with_settings(settings)?))
            .and_then(|demux| match before {
                Some(before) => demux.solve_from(before, images.view(), valid, go_on),
                None => demux.solve_while(images.view(), valid, go_on),
            })
            .map_err(refused)
    }
}

/// A lamp's flicker in images of some camera rows.
struct RowFlicker<'a> {
    room: &'a RoomFlicker,
    rows: &'a [usize],
    /// The room's light at their pixels, of white per us.
    levels: Array2<f64>,
}

impl RowFlicker<'_> {
    /// Subtracts it from the light of an image and its dark image.
    fn subtract(&self, light: PointRole, dark: Option<PointRole>, image: ArrayViewMut2<'_, f32>) {
        if let Some(dark) = dark {
            self.room.subtract((light, dark), self.rows, &self.levels, image);
        }
    }
}

impl SweepImage {
    /// Some of its rows.
    fn rows(&self, rows: Range<usize>) -> Arc<Self> {
        self.select(&rows.collect::<Vec<_>>())
    }

    fn select(&self, rows: &[usize]) -> Arc<Self> {
        Arc::new(Self {
            setting: self.setting.clone(),
            image: self.image.select(Axis(0), rows),
            clipped: self.clipped.as_ref().map(|clipped| clipped.select(Axis(0), rows)),
            stamps: self.stamps.clone(),
        })
    }
}

/// Some camera rows of some of the images.
fn of_rows(
    taken: &BTreeMap<PointRole, Arc<SweepImage>>,
    rows: &[usize],
    is_wanted: &dyn Fn(PointRole) -> bool,
) -> BTreeMap<PointRole, Arc<SweepImage>> {
    let wanted = taken.iter().filter(|(role, _)| is_wanted(**role));
    wanted.map(|(role, image)| (*role, image.select(rows))).collect()
}

fn darks_of(taken: &BTreeMap<PointRole, Arc<SweepImage>>) -> BTreeMap<PointRole, Arc<SweepImage>> {
    let darks = taken.iter().filter(|(role, _)| matches!(role, PointRole::Dark(_)));
    darks.map(|(role, image)| (*role, image.clone())).collect()
}

fn counts_of(images: &BTreeMap<PointRole, Arc<SweepImage>>) -> BTreeMap<PointRole, &Array2<f32>> {
    images.iter().map(|(role, image)| (*role, &image.image)).collect()
}

/// Whether a point is one of the sweep's own images.
fn is_of_sweep(role: PointRole) -> bool {
    match role {
        PointRole::Sweep(_) | PointRole::Bracket(_) => true,
        PointRole::Dark(_) | PointRole::Regular => false,
    }
}

fn refused(error: PlaneError) -> NotSolved {
    NotSolved { of: DEMUX, what: error.to_string() }
}
