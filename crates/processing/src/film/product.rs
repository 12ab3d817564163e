//! The products of a film: one video each, with an image for each cycle that has a transport.

use ndarray::{Array2, ArrayView3, Axis};
use raysweep_pipeline::{FilmSolver, Product, ProductSpec, Stages, SweepStack, mask};
use raysweep_session::film::{CycleEntry, CycleTransport, TransportFilm};
use raysweep_session::ledger::State;
use raysweep_session::products::{VideoWriter, video_tone_map};
use raysweep_session::report::{Picture, ToneMap};
use raysweep_session::{Result, Session};
use raysweep_transport::plane::Transport;
use serde_json::json;

use super::frames::{NO_DARK, StoredCycle, StoredFrames};
use super::task::FilmTask;
use crate::plane::colour::{Values, axes, in_colour, mask_in_colour};
use crate::plane::mask_bits;
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

/// Makes the products of a film from its stored transports and frames, and writes those with a wanted name; all are
/// shown in the report. Returns early, with what is made so far, soon after `go_on` returns false.
///
/// # Errors
/// When the session cannot be read or written.
pub fn write_products(
    session: &Session,
    state: &State,
    task: &FilmTask,
    stages: &Stages,
    specs: &[ProductSpec],
    is_wanted: &dyn Fn(&str) -> bool,
    go_on: &dyn Fn() -> bool,
) -> Result<FilmProducts> {
    let mut made = FilmProducts::default();
    if specs.is_empty() {
        return Ok(made);
    }
    let mut source = match Source::open(session, state, task, stages)? {
        Ok(source) => source,
        Err(problem) => {
            made.problems.push(problem);
            return Ok(made);
        }
    };
    let cycles = source.cycles(state)?;
    if cycles.is_empty() {
        made.problems.push("no cycle has a transport, so no product is made".into());
        return Ok(made);
    }
    source.learn(&cycles);
    let is_judged = specs.iter().any(ProductSpec::needs_noise);
    let mut drafts: Vec<Draft<'_>> =
        specs.iter().map(|spec| Draft::new(spec, is_wanted(spec.name()))).collect();
    for number in 0..cycles.len() {
        if !go_on() {
            return Ok(made);
        }
        let (stack, transport) = match source.cycle((number, is_judged), cycles[number])? {
            Ok(cycle) => cycle,
            Err(problem) => {
                made.problems.push(format!("{problem}, so no product is made"));
                return Ok(made);
            }
        };
        let mut sound = Vec::new();
        for mut draft in drafts {
            if !go_on() {
                return Ok(made);
            }
            match draft.spec.make(&stack, &transport) {
                Ok(Product::Image { about, is_light, image, mask, .. }) => {
                    let values = if is_light { Values::Light } else { Values::Errors };
                    let image = in_colour(image.view(), task.task.mosaic, values);
                    let mask = mask_in_colour(mask, task.task.mosaic);
                    draft.append(session, task, &cycles, number, (image.view(), mask), about)?;
                    sound.push(draft);
                }
                Ok(_) => {
                    made.problems.push(format!("product {}: it is more than one image", draft.spec.name()))
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
            encoder.encode(session.products().dir(), spec.name(), images_per_s(&cycles), go_on)?;
        }
        made.videos.push(FilmVideo { name: spec.name().to_owned(), about, pictures });
    }
    made.problems.append(&mut encoder.problems);
    Ok(made)
}

/// What products are made from.
struct Source<'a> {
    transports: TransportFilm,
    u_min: i32,
    frames: StoredFrames<'a>,
    solver: FilmSolver,
}

impl<'a> Source<'a> {
    fn open(
        session: &Session,
        state: &State,
        task: &'a FilmTask,
        stages: &'a Stages,
    ) -> Result<std::result::Result<Self, String>> {
        let Some(frames) = StoredFrames::open(session, state, task, stages)? else {
            return Ok(Err(NO_DARK.into()));
        };
        let transports = TransportFilm::open(&session.transport_film_path())?;
        let solver = task.solver().map_err(|error| error.to_string());
        Ok(solver.map(|solver| Self { transports, u_min: solver.reach_rows().0, frames, solver }))
    }

    /// The cycles that have a transport.
    fn cycles<'b>(&self, state: &'b State) -> Result<Vec<&'b CycleEntry>> {
        let mut cycles = Vec::new();
        for entry in state.cycles() {
            if self.transports.contains(entry.cycle)? {
                cycles.push(entry);
            }
        }
        Ok(cycles)
    }

    /// Learns from the first cycles what the solver of the transports learned from them. What cannot be read is told when
    /// its product is made.
    fn learn(&mut self, cycles: &[&CycleEntry]) {
        for entry in cycles.iter().take(FilmSolver::FIRST_CYCLES) {
            if let Ok(StoredCycle { frames, .. }) = self.frames.read(entry) {
                // The film's summary says what was found.
                let _ = self.solver.learn(&frames, &self.frames.dark);
            }
        }
    }

    /// The stack and the transport of a cycle, the one of this number among those that have one; or what is wrong with it.
    fn cycle(
        &self,
        (number, is_judged): (usize, bool),
        entry: &CycleEntry,
    ) -> Result<std::result::Result<(SweepStack, Transport), String>> {
        let cycle = entry.cycle;
        let Some(CycleTransport { t, mask }) = self.transports.read(cycle)? else {
            return Ok(Err(format!("the transport of cycle {cycle} is gone")));
        };
        let stack = self.frames.read(entry).and_then(|StoredCycle { frames, filled }| {
            let stack = self.solver.solved_stack((number, is_judged), &frames, &self.frames.dark);
            let stack = stack.map_err(|error| format!("cycle {cycle}: {error}"))?;
            Ok(SweepStack { filled: Some(filled), ..stack })
        });
        Ok(stack.map(|stack| (stack, mask::stored_transport(t, self.u_min, mask.view()))))
    }
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
        number: usize,
        (image, mask): (ArrayView3<f32>, Array2<u8>),
        about: String,
    ) -> Result<()> {
        let tone_map = *self
            .tone_map
            .get_or_insert_with(|| video_tone_map(&image.axis_iter(Axis(2)).collect::<Vec<_>>()));
        if self.is_written {
            let writer = match &mut self.writer {
                Some(writer) => writer,
                None => self.writer.insert(begin(
                    session,
                    task,
                    cycles,
                    (self.spec.name(), &about),
                    image.dim().into(),
                )?),
            };
            writer.append_masked(image, mask.view())?;
        }
        self.about = about;
        if number.is_multiple_of(cycles.len().div_ceil(SHOWN)) {
            let entry = cycles[number];
            let caption = format!("cycle {} ({:.2} s)", entry.cycle, entry.start_s);
            let bounds = mask.mapv(|bits| bits & mask::BOUND_ONLY != 0);
            self.pictures
                .push(Picture::coloured(image, tone_map).with_caption(caption).with_hatching(bounds));
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
    size: [usize; 3],
) -> Result<VideoWriter> {
    let mut metadata = task.task.metadata();
    let at: Vec<usize> = cycles.iter().map(|entry| entry.cycle).collect();
    let start_s: Vec<f64> = cycles.iter().map(|entry| entry.start_s).collect();
    metadata.insert("about".into(), json!(about));
    metadata.insert("axes".into(), json!([&["k"], axes(task.task.mosaic)].concat()));
    metadata.insert("mask".into(), mask_bits());
    metadata.insert("k".into(), json!({ "is": "cycle", "at": at, "start_s": start_s }));
    metadata.insert("images_per_s".into(), json!(images_per_s(cycles)));
    session.products().video(name, cycles.len(), size, &metadata)
}

/// The pace of a video: that of the cycles, on average.
fn images_per_s(cycles: &[&CycleEntry]) -> f64 {
    let span_s = cycles.first().zip(cycles.last()).map_or(0.0, |(first, last)| last.start_s - first.start_s);
    if span_s > 0.0 { (cycles.len() - 1) as f64 / span_s } else { 1.0 }
}
