//! The images under a plan's pictures: what each shows, and the settings with which it is taken.

use std::ops::Range;
use std::sync::Arc;

use raysweep_config::plan::{PatternPlan, PatternsPlan};
use raysweep_config::{ConfigError, Plan};
use raysweep_core::Pattern;
use raysweep_pipeline::{Point, PointRole, Schedule};
use raysweep_session::stack::Contents;

use crate::plane::{KnownRig, PlaneTask};

/// Minimum number of frames of a dark image, whose noise enters all images of its exposure.
const MIN_DARK_AVERAGE: u32 = 32;

/// Images under pictures on a plane rig.
#[derive(Clone)]
pub struct PatternsTask {
    /// The plan's own table.
    pub patterns: PatternsPlan,
    /// Its points: dark images, the regular image under white, then all settings under each picture.
    pub task: Arc<PlaneTask>,
    /// All pictures, in the order of acquisition.
    pub pictures: Vec<Pattern>,
    /// The pictures of each `[[pattern]]`.
    series: Vec<Range<usize>>,
    settings: Vec<PictureSetting>,
}

/// A setting in which each picture is taken.
#[derive(Debug, Clone, PartialEq)]
pub struct PictureSetting {
    /// Its name in products.
    pub name: String,
    /// Delay t_d.
    pub delay_us: f64,
    /// Exposure t_e.
    pub exposure_us: f64,
}

/// The setting with a whole period of exposure.
pub(super) const REGULAR: &str = "regular";
/// The only other setting, if it sees what the projector draws in the pixel's own row.
pub(super) const EPIPOLAR: &str = "epipolar";

impl PatternsTask {
    /// Images under pictures on a rig; see [`PlaneTask::new`].
    ///
    /// # Errors
    /// With the position in the plan of a picture that the projector cannot show.
    pub fn new(plan: &Plan, patterns: PatternsPlan, rig: &KnownRig<'_>) -> Result<Self, ConfigError> {
        let settings = settings(&patterns, rig.file.vsync.period_us);
        let (mut pictures, mut series) = (Vec::new(), Vec::new());
        for (index, pattern) in patterns.pattern.iter().enumerate() {
            let made = pattern
                .pictures(rig.file.projector.rows)
                .map_err(|error| plan.places.error(&["pattern", &index.to_string()], error.to_string()))?;
            series.push(pictures.len()..pictures.len() + made.len());
            pictures.extend(made);
        }
        let schedule = schedule(&patterns, &settings, pictures.len(), rig.file.vsync.period_us);
        let task = Arc::new(PlaneTask::new(plan, schedule, patterns.max_jitter_us, rig));
        Ok(Self { patterns, task, pictures, series, settings })
    }

    /// What its session stores.
    pub fn contents(&self) -> Contents {
        Contents::Patterns {
            patterns: self.pictures.len(),
            settings: self.settings.len(),
            exposures: self.task.schedule.dark_len(),
        }
    }

    /// Number of images under pictures.
    pub fn points(&self) -> usize {
        self.task.schedule.sweep_len()
    }

    /// The settings in which each picture is taken.
    pub fn settings(&self) -> &[PictureSetting] {
        &self.settings
    }

    /// Number of pictures whose images are kept as they are taken.
    pub fn captured(&self) -> usize {
        self.captured_series().map(|pictures| pictures.len()).sum()
    }

    /// The most of them in one series.
    pub fn longest_captured(&self) -> usize {
        self.captured_series().map(|pictures| pictures.len()).max().unwrap_or(0)
    }

    fn captured_series(&self) -> impl Iterator<Item = &Range<usize>> {
        let plans = self.patterns.pattern.iter().zip(&self.series);
        plans
            .filter(|(plan, _)| !matches!(plan, PatternPlan::Checkerboard { .. }))
            .map(|(_, pictures)| pictures)
    }

    /// The picture under which a point is taken; `None`: no light.
    pub fn picture(&self, ordinal: u32) -> Option<&Pattern> {
        match self.task.schedule.points.get(ordinal as usize)?.role {
            PointRole::Sweep(index) => self.pictures.get(index as usize / self.settings.len()),
            PointRole::Regular => Some(&Pattern::White),
            PointRole::Dark(_) | PointRole::Bracket(_) => None,
        }
    }

    /// The index in the stack of a picture's image in a setting.
    pub(super) fn index(&self, picture: usize, setting: usize) -> usize {
        picture * self.settings.len() + setting
    }

    /// Each `[[pattern]]` with its pictures and a name that no other one has.
    pub(super) fn series(&self) -> Vec<(String, &PatternPlan, Range<usize>)> {
        let names: Vec<String> = self.patterns.pattern.iter().map(name_of).collect();
        let unique = |index: usize| {
            let earlier = names[..index].iter().filter(|name| **name == names[index]).count();
            if earlier == 0 { names[index].clone() } else { format!("{}-{}", names[index], earlier + 1) }
        };
        let plans = self.patterns.pattern.iter().zip(&self.series).enumerate();
        plans.map(|(index, (plan, pictures))| (unique(index), plan, pictures.clone())).collect()
    }

    /// The picture of the first `[[pattern]]` of a kind.
    pub(super) fn picture_of(&self, wanted: &PatternPlan) -> Option<usize> {
        let at = self.patterns.pattern.iter().position(|plan| plan == wanted)?;
        Some(self.series[at].start)
    }
}

fn name_of(pattern: &PatternPlan) -> String {
    match pattern {
        PatternPlan::White {} => "white".into(),
        PatternPlan::Black {} => "black".into(),
        PatternPlan::Line { row } => format!("line-{row}"),
        PatternPlan::Rows { .. } => "rows".into(),
        PatternPlan::Checkerboard { size_px, .. } => format!("checkerboard-{size_px}px"),
        PatternPlan::Stripes { .. } => "stripes".into(),
        PatternPlan::GrayCode { direction, .. } => format!("gray-code-{direction}"),
        PatternPlan::PhaseShift { direction, .. } => format!("phase-shift-{direction}"),
    }
}

fn settings(patterns: &PatternsPlan, period_us: f64) -> Vec<PictureSetting> {
    let grid = patterns.settings_us();
    let name = |(delay_us, exposure_us): (f64, f64)| match grid[..] {
        [(0.0, _)] => EPIPOLAR.to_owned(),
        // Names of products have no points.
        _ => format!("delay_{delay_us}us_exposure_{exposure_us}us").replace('.', "p"),
    };
    let regular = PictureSetting { name: REGULAR.into(), delay_us: 0.0, exposure_us: period_us };
    let gated = grid.iter().map(|&(delay_us, exposure_us)| PictureSetting {
        name: name((delay_us, exposure_us)),
        delay_us,
        exposure_us,
    });
    patterns.regular.then_some(regular).into_iter().chain(gated).collect()
}

fn schedule(
    patterns: &PatternsPlan,
    settings: &[PictureSetting],
    pictures: usize,
    period_us: f64,
) -> Schedule {
    let frames = patterns.average;
    let mut exposures: Vec<f64> = Vec::new();
    for exposure_us in settings.iter().map(|setting| setting.exposure_us).chain([period_us]) {
        if !exposures.contains(&exposure_us) {
            exposures.push(exposure_us);
        }
    }
    // The longest last: its dark image is compared with the regular image.
    exposures.sort_by(f64::total_cmp);
    let dark = |(index, exposure_us)| Point {
        role: PointRole::Dark(index),
        delay_us: 0.0,
        exposure_us,
        frames: frames.max(MIN_DARK_AVERAGE),
    };
    let regular = Point { role: PointRole::Regular, delay_us: 0.0, exposure_us: period_us, frames };
    let under_pictures = (0..pictures).flat_map(|_| settings);
    let image = |(index, setting): (u32, &PictureSetting)| Point {
        role: PointRole::Sweep(index),
        delay_us: setting.delay_us,
        exposure_us: setting.exposure_us,
        frames,
    };
    let points = (0..).zip(exposures).map(dark).chain([regular]).chain((0..).zip(under_pictures).map(image));
    Schedule { points: points.collect() }
}
