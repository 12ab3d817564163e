//! The products of a film: one video each, with an image for each cycle that has a transport.

use ndarray::{Array2, Axis};
use raysweep_pipeline::ProductSpec;
use raysweep_session::film::{CycleEntry, TransportFilm};
use raysweep_session::ledger::State;
use raysweep_session::products::{VideoWriter, video_tone_map};
use raysweep_session::report::{Picture, ToneMap};
use raysweep_session::{Result, Session};
use raysweep_transport::plane::{Beam, Transport};
use serde_json::json;

use super::task::FilmTask;
use crate::video::Encoder;

/// Images of a product in the report.
const SHOWN: usize = 8;

/// What the products of a film became.
#[derive(Default)]
pub struct FilmProducts {
    /// Those that were made.
    pub(super) videos: Vec<FilmVideo>,
    /// What could not be made, and why.
    pub problems: Vec<String>,
}

/// A product that was made.
pub(super) struct FilmVideo {
    pub name: String,
    pub about: String,
    /// Some of its images, evenly spread.
    pub pictures: Vec<Picture>,
}

/// Makes the products of a film from its stored transports, and writes those with a wanted name; all are shown in the
/// report. Returns early, with what is made so far, soon after `go_on`
/// returns false.
///
/// # Errors
/// When the session cannot be read or written.
pub fn write_products(
    session: &Session,
    state: &State,
    task: &FilmTask,
    specs: &[ProductSpec],
    is_wanted: &dyn Fn(&str) -> bool,
    go_on: &dyn Fn() -> bool,
) -> Result<FilmProducts> {
    let mut made = FilmProducts::default();
    if specs.is_empty() {
        return Ok(made);
    }
    let transports = TransportFilm::open(&session.transport_film_path())?;
    let u_min = transports.attributes().get("u_min").and_then(|u_min| i32::try_from(u_min.as_i64()?).ok());
    let mut cycles = Vec::new();
    for entry in state.cycles() {
        if transports.contains(entry.cycle)? {
            cycles.push(entry);
        }
    }
    let (Some(u_min), false) = (u_min, cycles.is_empty()) else {
        made.problems.push("no cycle has a transport, so no product is made".into());
        return Ok(made);
    };
    let found = state.film.clone().unwrap_or_default();
    let timing = task.task.geometry.timing().and_then(|timing| match found.beam_sigma_rows {
        Some(sigma_rows) => timing.with_beam(Beam::of_sigma(sigma_rows)),
        None => Ok(timing),
    });
    let timing = match timing {
        Ok(timing) => timing,
        Err(error) => {
            made.problems.push(error.to_string());
            return Ok(made);
        }
    };
    let mut drafts: Vec<Draft<'_>> =
        specs.iter().map(|spec| Draft::new(spec, is_wanted(spec.name()))).collect();
    for (number, entry) in cycles.iter().enumerate() {
        if !go_on() {
            return Ok(made);
        }
        let Some(t) = transports.read(entry.cycle)? else { continue };
        let exists = Array2::from_elem((t.len_of(Axis(0)), t.len_of(Axis(1))), true);
        let transport = Transport::measured(t, u_min, exists);
        let mut sound = Vec::new();
        for mut draft in drafts {
            match draft.spec.frame(&timing, &transport, found.one_band) {
                Ok((image, about)) => {
                    draft.append(session, task, &cycles, (number, image), about)?;
                    sound.push(draft);
                }
                Err(error) => made.problems.push(error.to_string()),
            }
        }
        drafts = sound;
    }
    let mut encoder = Encoder::default();
    for Draft { spec, writer, about, pictures, .. } in drafts.into_iter().take_while(|_| go_on()) {
        if let Some(writer) = writer {
            writer.commit()?;
            encoder.encode(session.products().dir(), spec.name(), images_per_s(&cycles))?;
        }
        made.videos.push(FilmVideo { name: spec.name().to_owned(), about, pictures });
    }
    made.problems.append(&mut encoder.problems);
    Ok(made)
}

/// A product that is being made.
struct Draft<'a> {
    spec: &'a ProductSpec,
    is_written: bool,
    /// `None` before its first image, and if it is not written.
    writer: Option<VideoWriter>,
    /// `None` before its first image.
    tone_map: Option<ToneMap>,
    about: String,
    pictures: Vec<Picture>,
}

impl<'a> Draft<'a> {
    fn new(spec: &'a ProductSpec, is_written: bool) -> Self {
        Self { spec, is_written, writer: None, tone_map: None, about: String::new(), pictures: Vec::new() }
    }

    fn append(
        &mut self,
        session: &Session,
        task: &FilmTask,
        cycles: &[&CycleEntry],
        (number, image): (usize, Array2<f32>),
        about: String,
    ) -> Result<()> {
        let tone_map = *self.tone_map.get_or_insert_with(|| video_tone_map(&[image.view()]));
        if self.is_written {
            let writer = match &mut self.writer {
                Some(writer) => writer,
                None => self.writer.insert(begin(session, task, cycles, (self.spec.name(), &about), &image)?),
            };
            writer.append(image.view().insert_axis(Axis(2)))?;
        }
        self.about = about;
        if number.is_multiple_of(cycles.len().div_ceil(SHOWN)) {
            let entry = cycles[number];
            let caption = format!("cycle {} ({:.2} s)", entry.cycle, entry.start_s);
            self.pictures.push(Picture::grey(image.view(), tone_map).with_caption(caption));
        }
        Ok(())
    }
}

/// Begins the video of a product.
fn begin(
    session: &Session,
    task: &FilmTask,
    cycles: &[&CycleEntry],
    (name, about): (&str, &str),
    image: &Array2<f32>,
) -> Result<VideoWriter> {
    let mut metadata = task.task.metadata();
    let at: Vec<usize> = cycles.iter().map(|entry| entry.cycle).collect();
    let start_s: Vec<f64> = cycles.iter().map(|entry| entry.start_s).collect();
    metadata.insert("about".into(), json!(about));
    metadata.insert("axes".into(), json!(["k", "t", "s"]));
    metadata.insert("k".into(), json!({ "is": "cycle", "at": at, "start_s": start_s }));
    metadata.insert("images_per_s".into(), json!(images_per_s(cycles)));
    session.products().video(name, cycles.len(), [image.nrows(), image.ncols(), 1], &metadata)
}

/// The pace of a video: that of the cycles, on average.
fn images_per_s(cycles: &[&CycleEntry]) -> f64 {
    let span_s = cycles.first().zip(cycles.last()).map_or(0.0, |(first, last)| last.start_s - first.start_s);
    if span_s > 0.0 { (cycles.len() - 1) as f64 / span_s } else { 1.0 }
}
