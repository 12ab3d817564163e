//! Dark images of the plane rig's camera: mean, noise and hot pixels at each exposure, according to EMVA 1288.

use std::sync::Arc;

use ndarray::{Array2, Array3, Axis};
use raysweep_config::plan::DarksPlan;
use raysweep_config::{Plan, RigFile};
use raysweep_pipeline::{Point, PointRole, Schedule};
use raysweep_session::ledger::State;
use raysweep_session::report::{Block, NoteLevel, Picture, Report, Section, Table, ToneMap};
use raysweep_session::stack::{ArrayName, Contents, Stack, crc32};
use raysweep_session::{Result, Session, durable};
use serde_json::json;

use crate::plane::{KnownRig, PlaneTask, manifest};
use crate::report::{accounts, named, page};
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// Without light, a frame is as good a millisecond late.
const MAX_JITTER_US: f64 = 1000.0;
/// Standard deviation of a normal distribution over its median absolute deviation.
const SIGMA_PER_MAD: f32 = 1.4826;

/// Dark images on a plane rig.
#[derive(Clone)]
pub struct DarksTask {
    /// The plan's own table.
    pub darks: DarksPlan,
    /// The images: two of each exposure, in succession.
    pub task: Arc<PlaneTask>,
}

impl DarksTask {
    /// Dark images on a rig; see [`PlaneTask::new`].
    pub fn new(plan: &Plan, darks: DarksPlan, rig: &KnownRig<'_>) -> Self {
        let pairs = darks.exposure_us.values().into_iter().flat_map(|exposure_us| [exposure_us; 2]);
        let image = |(index, exposure_us)| Point {
            role: PointRole::Dark(index),
            delay_us: 0.0,
            exposure_us,
            frames: darks.frames,
        };
        let schedule = Schedule { points: (0..).zip(pairs).map(image).collect() };
        let task = PlaneTask::new(plan, schedule, MAX_JITTER_US, rig);
        Self { darks, task: Arc::new(task) }
    }

    /// What its session stores.
    pub fn contents(&self) -> Contents {
        Contents::Darks { images: self.points() }
    }

    /// Number of images to store.
    pub fn points(&self) -> usize {
        self.task.schedule.points.len()
    }
}

/// Results of the two images of an exposure, in camera counts.
struct Level {
    exposure_us: f64,
    /// Mean of both images, `[t, s]`.
    image: Array2<f32>,
    mean_dn: f64,
    /// Spatial standard deviation of the pixels' means, corrected for the remaining temporal noise.
    pattern_dn: f64,
    /// Temporal noise of a single frame.
    noise_dn: f64,
    hot: Vec<(usize, usize)>,
}

impl Level {
    /// Computes them from two images of `frames` frames each.
    fn of(exposure_us: f64, [a, b]: [Array2<f32>; 2], frames: u32, hot_sigmas: f64) -> Self {
        let variance = |image: &Array2<f32>| image.mapv(f64::from).var(0.0);
        // EMVA 1288, equation 30: the pattern cancels in the difference.
        let of_mean = variance(&(&a - &b)) / 2.0;
        let image = (&a + &b) / 2.0;
        let mean_dn = image.mapv(f64::from).mean().unwrap_or(0.0);
        let pattern = (variance(&image) - of_mean / 2.0).max(0.0);
        let mut values: Vec<f32> = image.iter().copied().collect();
        let median = median(&mut values);
        let mut distances: Vec<f32> = image.iter().map(|value| (value - median).abs()).collect();
        let sigma = SIGMA_PER_MAD * self::median(&mut distances);
        // At least half a count: images of whole counts may have no spread at all.
        let limit = median + hot_sigmas as f32 * sigma.max(0.5);
        let hot = image.indexed_iter().filter(|(_, value)| **value > limit).map(|(place, _)| place).collect();
        let noise_dn = (of_mean * f64::from(frames)).sqrt();
        Self { exposure_us, image, mean_dn, pattern_dn: pattern.sqrt(), noise_dn, hot }
    }
}

fn median(values: &mut [f32]) -> f32 {
    values.sort_unstable_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// What stored dark images show.
pub struct DarksFindings {
    levels: Vec<Level>,
    /// Images that cannot be used, and why.
    pub problems: Vec<String>,
}

impl DarksFindings {
    /// Evaluates the images that the ledger lists.
    ///
    /// # Errors
    /// When the stack cannot be opened.
    pub fn of(session: &Session, state: &State, task: &DarksTask) -> Result<Self> {
        let (stack, mut problems) = (session.stack()?, state.left_out());
        let DarksPlan { exposure_us, hot_sigmas, .. } = &task.darks;
        let mut levels = Vec::new();
        for (index, exposure_us) in exposure_us.values().into_iter().enumerate() {
            let images = [2 * index, 2 * index + 1].map(|image| read(&stack, state, image));
            match images {
                [Ok((a, frames)), Ok((b, _))] => {
                    levels.push(Level::of(exposure_us, [a, b], frames, *hot_sigmas));
                }
                images => problems.extend(images.into_iter().filter_map(std::result::Result::err)),
            }
        }
        Ok(Self { levels, problems })
    }

    /// Writes images, table, report and manifest.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn write(&self, session: &Session, state: &State, task: &DarksTask, rig: &RigFile) -> Result<()> {
        let Self { levels, problems } = self;
        write_products(session, task, levels)?;
        let page = report(session, state, task, levels, problems).to_html()?;
        durable::write(&session.report_path(), page.as_bytes())?;
        manifest::write(session, state, &task.task, rig)
    }
}

/// The mean of an image's frames, or why it cannot be used.
fn read(stack: &Stack, state: &State, index: usize) -> std::result::Result<(Array2<f32>, u32), String> {
    let entry = state.point(ArrayName::Dark, index).ok_or_else(|| format!("dark {index} is missing"))?;
    let damaged =
        |why: String| format!("dark {index} is damaged ({why}): `raysweep resume` acquires it again");
    let sum = stack.read_point(ArrayName::Dark, index).map_err(|error| damaged(error.to_string()))?;
    if crc32(sum.view()) != entry.crc32 {
        return Err(damaged("its checksum differs from the ledger's".into()));
    }
    if entry.frames == 0 {
        return Err(damaged("the ledger says that it has no frames".into()));
    }
    Ok((sum.mapv(|sum| sum as f32 / entry.frames as f32), entry.frames))
}

fn write_products(session: &Session, task: &DarksTask, levels: &[Level]) -> Result<()> {
    if levels.is_empty() {
        return Ok(());
    }
    let (rows, columns) = levels[0].image.dim();
    let mut images = Array3::zeros((levels.len(), rows, columns));
    for (level, mut image) in levels.iter().zip(images.axis_iter_mut(Axis(0))) {
        image.assign(&level.image);
    }
    let exposures: Vec<f64> = levels.iter().map(|level| level.exposure_us).collect();
    let layers: Vec<String> = (0..levels.len()).map(|k| format!("k{k:04}")).collect();
    let mut metadata = task.task.metadata();
    metadata.insert("units".into(), json!("camera counts (DN)"));
    metadata.insert("axes".into(), json!(["k", "t", "s"]));
    metadata.insert("about".into(), json!("mean dark image of each exposure"));
    metadata.insert("k".into(), json!({ "is": "exposure_us", "at": exposures }));
    metadata.insert("layers".into(), json!(layers));
    session.products().sequence("dark", images.view(), &layers, &metadata)?;
    let column = |value: fn(&Level) -> f64| levels.iter().map(value).collect();
    let table = [
        ("exposure_us", exposures),
        ("mean_dn", column(|level| level.mean_dn)),
        ("noise_dn", column(|level| level.noise_dn)),
        ("pattern_dn", column(|level| level.pattern_dn)),
        ("hot_pixels", column(|level| level.hot.len() as f64)),
    ];
    metadata.insert("axes".into(), json!(["exposure", "column"]));
    metadata.insert(
        "about".into(),
        json!("mean, noise of a frame, spread of the pixels, hot pixels; after EMVA 1288"),
    );
    session.products().table("darks", &table, &metadata)?;
    let hot = levels.iter().flat_map(|level| level.hot.iter().map(|place| (level.exposure_us, *place)));
    let hot: Vec<_> = hot.collect();
    let place = |value: fn(&(f64, (usize, usize))) -> f64| hot.iter().map(value).collect();
    let table = [
        ("exposure_us", place(|(exposure_us, _)| *exposure_us)),
        ("t", place(|(_, (t, _))| *t as f64)),
        ("s", place(|(_, (_, s))| *s as f64)),
    ];
    metadata.insert("axes".into(), json!(["pixel", "column"]));
    metadata.insert("about".into(), json!("pixels above the hot limit, row t and column s, by exposure"));
    session.products().table("hot_pixels", &table, &metadata)
}

fn report(
    session: &Session,
    state: &State,
    task: &DarksTask,
    levels: &[Level],
    problems: &[String],
) -> Report {
    let mut sections = Vec::new();
    let notes: Vec<Block> =
        problems.iter().map(|problem| Block::Note(NoteLevel::Error, problem.clone())).collect();
    if !notes.is_empty() {
        sections.push(Section { title: "Problems".into(), intro: String::new(), blocks: notes });
    }
    let row = |level: &Level| {
        let Level { exposure_us, mean_dn, noise_dn, pattern_dn, hot, .. } = level;
        let numbers = [mean_dn, noise_dn, pattern_dn].map(|value| format!("{value:.3}"));
        [format!("{exposure_us:.0}")].into_iter().chain(numbers).chain([hot.len().to_string()]).collect()
    };
    let headers =
        ["exposure / µs", "mean / DN", "noise of a frame / DN", "spread of pixels / DN", "hot pixels"];
    let table = Table { headers: headers.map(Into::into).to_vec(), rows: levels.iter().map(row).collect() };
    let picture = |level: &Level| {
        let scale = ToneMap::percentile(&[level.image.view()], 99.5);
        Picture::grey(level.image.view(), scale).with_caption(format!("{:.0} µs", level.exposure_us))
    };
    sections.push(Section {
        title: "Dark images".into(),
        intro: format!(
            "Noise from the difference of two images of {} frames each, after EMVA 1288. Hot pixels lie more than {} standard deviations above the median.",
            task.darks.frames, task.darks.hot_sigmas
        ),
        blocks: vec![Block::Table(table), Block::Pictures(levels.iter().map(picture).collect())],
    });
    sections.push(Section { title: "Frames".into(), intro: String::new(), blocks: accounts(state) });
    let shape = state.session.shape;
    let facts = [
        ("images stored", format!("{} of {}", state.stored_points(), shape.points())),
        ("frames an image", task.darks.frames.to_string()),
        ("camera", format!("{} × {} px", shape.columns, shape.rows)),
        ("frames lost", state.counts.lost_total().to_string()),
    ];
    page(session, state, named(facts), sections)
}

/// Reprocesses stored dark images.
///
/// # Errors
/// When products are asked for, or the session cannot be written.
pub fn process(
    stored: &Stored<'_>,
    darks: DarksPlan,
    asked: &Asked,
) -> std::result::Result<Processed, ProcessError> {
    let Stored { session, state, plan, .. } = stored;
    if !asked.products.is_empty() {
        let message = "a session of kind \"darks\" has no products: leave --product out";
        return Err(ProcessError::Product(message.into()));
    }
    let rig = stored.plane_rig()?;
    let shape = state.session.shape;
    let mut task = DarksTask::new(plan, darks, &stored.known(&rig)?);
    Arc::make_mut(&mut task.task).left_out = state.left_out();
    stored.check_contents(task.contents())?;
    let findings = DarksFindings::of(session, state, &task)?;
    findings.write(session, state, &task, &rig)?;
    let (report, points) = (session.report_path(), shape.points());
    Ok(Processed { report, stored: state.stored_points(), points, problems: findings.problems })
}

#[cfg(test)]
mod tests {
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    use super::*;

    /// An image of numbers that are uniform from -0.5 to 0.5.
    fn uniform(seed: u64) -> Array2<f32> {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        Array2::from_shape_simple_fn((200, 200), || (random.next_u64() >> 40) as f32 / (1 << 24) as f32 - 0.5)
    }

    #[test]
    fn noise_is_told_from_pattern_and_hot_pixels_are_found() {
        let pattern = uniform(1) * 6.0 + 64.0;
        let image = |seed: u64| {
            let mut image = &pattern + &(uniform(seed) * 2.0);
            image[[7, 9]] = 300.0;
            image
        };
        let level = Level::of(100.0, [image(2), image(3)], 4, 8.0);
        assert_eq!(level.hot, [(7, 9)]);
        // A uniform distribution of width w has the standard deviation w / sqrt(12); a frame's noise is twice that of
        // a mean of four.
        let [noise_dn, pattern_dn] = [2.0 * 2.0, 6.0].map(|width: f64| width / 12_f64.sqrt());
        assert!((level.noise_dn / noise_dn - 1.0).abs() < 0.02, "{} against {noise_dn}", level.noise_dn);
        let hot = (300.0_f64 - 64.0).powi(2) / 40_000.0;
        let spread = (pattern_dn.powi(2) + hot).sqrt();
        assert!((level.pattern_dn / spread - 1.0).abs() < 0.02, "{} against {spread}", level.pattern_dn);
    }
}
