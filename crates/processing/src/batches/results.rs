//! Makes videos, report and manifest from stored batches: the same after a run and offline.

use std::collections::BTreeMap;

use ndarray::{Array3, Array4, Axis};
use raysweep_config::DotRigFile;
use raysweep_session::dots::BatchEntry;
use raysweep_session::ledger::State;
use raysweep_session::pattern::PatternFile;
use raysweep_session::products::VideoWriter;
use raysweep_session::report::Picture;
use raysweep_session::{Result, Session, manifest, pattern};
use serde_json::{Map, Value, json};

use super::calibration::{Calibration, read_batch};
use super::product::{DotSpec, SceneBatches, light_of};
use super::report::{self, VideoStrip};
use super::task::DotTask;
use crate::mirror_response::Predistortion;
use crate::software::SOFTWARE;
use crate::video::Encoder;

/// Number of images of a video in the report.
const SHOWN: usize = 6;

/// What was made of stored batches.
pub struct BatchProducts {
    calibration: Option<Calibration>,
    strips: Vec<VideoStrip>,
    /// What could not be made, and what makes the products worse than they look.
    pub problems: Vec<String>,
}

/// Makes the calibration and the videos; adds what fails to `problems`.
///
/// # Errors
/// When the session cannot be written.
pub fn make(
    session: &Session,
    state: &State,
    task: &DotTask,
    specs: &[DotSpec],
    mut problems: Vec<String>,
    go_on: &dyn Fn() -> bool,
) -> Result<BatchProducts> {
    let dots = session.dots()?;
    problems.extend(state.left_out());
    let calibration = Calibration::of(&dots, task, state, &mut problems);
    if let Some(calibration) = &calibration {
        calibration.write(session)?;
    }
    let about_all = common(task, state);
    let mut videos: Vec<Video> = Vec::new();
    for spec in specs {
        match patterns_of(session, spec) {
            Ok(patterns) => videos.push(Video { spec, patterns, writers: Vec::new(), strips: Vec::new() }),
            Err(problem) => problems.push(problem),
        }
    }
    // A video's length must be known before its first image, so all batches are checked first.
    let mut sound: Vec<&BatchEntry> = Vec::new();
    for entry in state.batches().filter(|entry| entry.plane.is_none()) {
        match read_batch(&dots, task.shape, entry) {
            Ok(_) => sound.push(entry),
            Err(problem) => problems.push(problem),
        }
    }
    for (image, entry) in sound.iter().enumerate() {
        if !go_on() {
            break;
        }
        let Ok((batch, seen)) = read_batch(&dots, task.shape, entry) else { continue };
        let light = light_of(&batch);
        let scene = SceneBatches {
            calibration: calibration.as_ref(),
            image: (image, sound.len()),
            seen: &seen,
            light: &light,
        };
        let mut continued = Vec::new();
        for mut video in videos {
            if !go_on() {
                break;
            }
            match video.spec.draw(&batch, &scene, video.patterns.as_ref()) {
                Ok(images) => {
                    video.append(session, &about_all, images, (image, sound.len()), entry)?;
                    continued.push(video);
                }
                Err(problem) => problems.push(format!("product {}: {problem}", video.spec.name)),
            }
        }
        videos = continued;
    }
    let mut strips = Vec::new();
    let mut encoder = Encoder::default();
    for Video { writers, strips: of_video, .. } in videos {
        if !go_on() {
            break;
        }
        for (name, writer) in writers {
            writer.commit()?;
            let batches_per_s = 1.0 / task.batches.path.duration_s();
            encoder.encode(session.products().dir(), &name, batches_per_s, go_on)?;
        }
        strips.extend(of_video);
    }
    problems.append(&mut encoder.problems);
    Ok(BatchProducts { calibration, strips, problems })
}

impl BatchProducts {
    /// Writes report and manifest, the last files of a session.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn write_report(
        &self,
        session: &Session,
        state: &State,
        task: &DotTask,
        rig: &DotRigFile,
    ) -> Result<()> {
        let Self { calibration, strips, problems } = self;
        let page = report::make(session, state, task, calibration.as_ref(), strips, problems)?.to_html()?;
        raysweep_session::durable::write(&session.report_path(), page.as_bytes())?;
        write_manifest(session, state, task, rig)
    }
}

/// Copies the lighting patterns of a plan into its session, so that its products can be made again from the session
/// alone.
///
/// # Errors
/// What is wrong with a pattern.
pub fn keep_patterns(session: &Session, task: &DotTask) -> std::result::Result<(), String> {
    for spec in &task.specs {
        let Some(file) = task.open_pattern(spec)? else { continue };
        let patterns = file.read().map_err(|error| format!("product {}: {error}", spec.name))?;
        let kept = session.pattern_path(&spec.name);
        kept.parent()
            .map_or(Ok(()), raysweep_session::durable::create_dir_all)
            .and_then(|()| pattern::write(&kept, &patterns))
            .map_err(|error| error.to_string())?;
    }
    Ok(())
}

/// The patterns of a product: the copy in the session or, for a product that the plan does not name, the file.
fn patterns_of(session: &Session, spec: &DotSpec) -> std::result::Result<Option<Array4<f32>>, String> {
    let Some(file) = spec.pattern_file() else { return Ok(None) };
    let kept = session.pattern_path(&spec.name);
    let read = PatternFile::open(if kept.exists() { &kept } else { file }).and_then(PatternFile::read);
    read.map(Some).map_err(|error| format!("product {}: {error}", spec.name))
}

/// A video that is being written.
struct Video<'a> {
    spec: &'a DotSpec,
    patterns: Option<Array4<f32>>,
    writers: Vec<(String, VideoWriter)>,
    strips: Vec<VideoStrip>,
}

impl Video<'_> {
    fn append(
        &mut self,
        session: &Session,
        about_all: &Map<String, Value>,
        images: Vec<Array3<f32>>,
        (number, count): (usize, usize),
        entry: &BatchEntry,
    ) -> Result<()> {
        for (place, (image, (name, about))) in images.into_iter().zip(self.spec.videos()).enumerate() {
            if self.writers.len() <= place {
                let (rows, columns, channels) = image.dim();
                let axes: &[&str] = if channels == 1 { &["k", "t", "s"] } else { &["k", "t", "s", "rgb"] };
                let mut metadata = about_all.clone();
                metadata.insert("about".into(), json!(about));
                metadata.insert("axes".into(), json!(axes));
                let writer = session.products().video(&name, count, [rows, columns, channels], &metadata)?;
                self.writers.push((name.clone(), writer));
                self.strips.push(VideoStrip { name, about, pictures: Vec::new() });
            }
            let scale = self.writers[place].1.append(image.view())?;
            if number.is_multiple_of(count.div_ceil(SHOWN)) {
                let picture = match image.len_of(Axis(2)) {
                    1 => Picture::grey(image.index_axis(Axis(2), 0), scale),
                    _ => Picture::rgb(image.view(), scale),
                };
                let caption = format!("batch {} ({:.2} s)", entry.batch, entry.start_s);
                self.strips[place].pictures.push(picture.with_caption(caption));
            }
        }
        Ok(())
    }
}

/// Metadata that all videos share.
fn common(task: &DotTask, state: &State) -> Map<String, Value> {
    let left_out = state.left_out();
    let mut entries = vec![
        ("plan", json!(task.name)),
        ("images_per_s", json!(1.0 / task.batches.path.duration_s())),
        ("software", json!(SOFTWARE)),
    ];
    if !left_out.is_empty() {
        entries.push(("left_out", json!(left_out)));
    }
    entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

fn write_manifest(session: &Session, state: &State, task: &DotTask, rig: &DotRigFile) -> Result<()> {
    let software = BTreeMap::from([("raysweep".to_owned(), env!("CARGO_PKG_VERSION").to_owned())]);
    let plan = &task.batches;
    let settings = json!({
        "rig": {
            "pixel_format": task.format,
            "white_dn": rig.camera.white_dn(),
            "black_dn": rig.camera.black_dn(),
            "mirror": rig.mirror.as_ref().map(|mirror| mirror.driver.name()),
        },
        "dots": plan.dots,
        "camera_rate_hz": plan.camera_rate_hz(),
        "exposure_us": plan.exposure_us,
        "trailing_index": plan.trailing_index(),
        "background_indices": plan.background_indices,
        "samples": task.path.points().len(),
        "rate_hz": task.path.rate_hz(),
        "mirror_response": task.predistortion.as_ref().map(Predistortion::to_json),
    });
    let settings = settings.as_object().cloned().unwrap_or_default();
    manifest::write(session, state, software, settings)?;
    Ok(())
}
