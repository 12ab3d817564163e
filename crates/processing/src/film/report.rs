//! The report of a film: selected cycles, and how well it kept its pace.

use ndarray::{Array2, ArrayView2, Axis, s};
use raysweep_core::{FilmSummary, Percentiles};
use raysweep_pipeline::{Findings, NotSolved};
use raysweep_session::film::{CycleTransport, TransportFilm};
use raysweep_session::ledger::State;
use raysweep_session::report::{
    Block, ContactSheet, NoteLevel, Picture, Plot, Report, Section, Series, SeriesStyle, ToneMap,
};
use raysweep_session::{Result, Session};

use super::product::{FilmProducts, FilmVideo};
use super::task::FilmTask;
use crate::plane::report::{jitter, settings};
use crate::report::{accounts, page, remark};

/// Cycles on the contact sheet.
const SHOWN: usize = 8;
/// Percentile of the pixels that maps to white in a picture.
const PERCENTILE: f64 = 99.5;

/// Writes the report of a film.
///
/// # Errors
/// When its transports cannot be read or the report cannot be written.
pub fn write(
    session: &Session,
    state: &State,
    task: &FilmTask,
    products: &FilmProducts,
    problems: &[String],
) -> Result<()> {
    let page = make(session, state, task, products, problems)?.to_html()?;
    raysweep_session::durable::write(&session.report_path(), page.as_bytes())
}

fn make(
    session: &Session,
    state: &State,
    task: &FilmTask,
    products: &FilmProducts,
    problems: &[String],
) -> Result<Report> {
    let mut sections = Vec::new();
    let mut blocks: Vec<Block> =
        problems.iter().map(|problem| Block::Note(NoteLevel::Error, problem.clone())).collect();
    let texts = shortcomings(state, transports_missing(session, state)?);
    blocks.extend(texts.into_iter().map(|text| Block::Note(NoteLevel::Warning, text)));
    if !blocks.is_empty() {
        sections.push(Section { title: "Problems".into(), intro: String::new(), blocks });
    }
    sections.push(cycles(session, state)?);
    sections.extend(products.videos.iter().map(video));
    sections.extend(findings(state));
    sections.push(pace(state));
    sections.push(trust(state, task));
    Ok(page(session, state, facts(state, task), sections))
}

/// Removes what a film's first cycles showed from its summary.
pub(super) fn forget_findings(film: &mut FilmSummary) {
    *film = FilmSummary {
        late_us: None,
        beam_sigma_rows: None,
        one_band: false,
        findings: Vec::new(),
        warnings: Vec::new(),
        ..std::mem::take(film)
    };
}

/// Enters what a film's first cycles showed into its summary.
pub fn note_findings(film: &mut FilmSummary, learned: std::result::Result<&Findings, NotSolved>) {
    match learned {
        Ok(found) => {
            let said = found.remarks.iter().map(|(subject, said)| ((*subject).to_owned(), said.clone()));
            film.findings = said.collect();
            film.late_us = found.late_us;
            film.beam_sigma_rows = found.beam_sigma_rows;
            film.one_band = found.one_band;
            film.warnings.clone_from(&found.warnings);
        }
        Err(error) => {
            forget_findings(film);
            film.warnings = vec![format!(
                "all cycles are demultiplexed as planned, because nothing could be learned from the first four: {}",
                error.what
            )];
        }
    }
}

/// The number of stored cycles that have no transport; those that were missing when the film ended may have been made
/// since.
fn transports_missing(session: &Session, state: &State) -> Result<usize> {
    let Ok(transports) = TransportFilm::open(&session.transport_film_path()) else {
        return Ok(state.stored_points());
    };
    let mut missing = 0;
    for entry in state.cycles() {
        missing += usize::from(!transports.contains(entry.cycle)?);
    }
    Ok(missing)
}

/// Ways in which the film falls short of its plan, given the number of stored cycles without a transport.
pub fn shortcomings(state: &State, transports_missing: usize) -> Vec<String> {
    let Some(film) = &state.film else { return Vec::new() };
    let mut texts = Vec::new();
    if film.cycles_incomplete > 0 {
        texts.push(format!(
            "{} cycles lack a frame and are not stored; the ledger says which frames, and why",
            film.cycles_incomplete
        ));
    }
    if transports_missing > 0 {
        texts.push(format!(
            "{transports_missing} stored cycles have no transport, and products and videos leave them out, so that time jumps there: `raysweep process` makes them"
        ));
    }
    texts.extend(film.warnings.iter().cloned());
    texts
}

fn facts(state: &State, task: &FilmTask) -> Vec<(String, String)> {
    let delays = task.film.delay_us.values();
    let (first, last) = (
        delays.iter().fold(f64::INFINITY, |a, &b| a.min(b)),
        delays.iter().fold(f64::NEG_INFINITY, |a, &b| a.max(b)),
    );
    let per_second = state.film.as_ref().and_then(|film| film.cycles_per_s);
    [
        ("delay", format!("{first:.0} … {last:.0} µs in {}", delays.len())),
        ("exposure", format!("{:.0} µs", task.film.exposure_us)),
        ("cycles stored", format!("{} of {}", state.stored_points(), task.points())),
        ("cycles a second", per_second.map_or_else(|| "–".into(), |pace| format!("{pace:.3}"))),
        ("camera", format!("{} × {} px", state.session.shape.columns, state.session.shape.rows)),
        ("frames lost", state.counts.lost_total().to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .to_vec()
}

/// The epipolar and the indirect image of some cycles, evenly spaced.
fn cycles(session: &Session, state: &State) -> Result<Section> {
    let transports = TransportFilm::open(&session.transport_film_path()).ok();
    let stored: Vec<_> = state.cycles().collect();
    let shown = SHOWN.min(stored.len());
    let one_band = state.film.as_ref().is_some_and(|film| film.one_band);
    let mut labels = Vec::new();
    let mut images: Vec<[Array2<f32>; 2]> = Vec::new();
    for place in 0..shown {
        let entry = stored[place * (stored.len() - 1) / (shown - 1).max(1)];
        // Damaged cycles are listed among the problems.
        let read = transports.as_ref().and_then(|film| film.read(entry.cycle).ok().flatten());
        let own_row = transports.as_ref().and_then(|film| film.attributes().get("u_min")?.as_i64());
        if let (Some(CycleTransport { t: transport, .. }), Some(u_min)) = (read, own_row) {
            let rows = transport.len_of(Axis(0)) as i64;
            let half = if one_band { 2 } else { 0 };
            // If all delays are long, no pixel's own row is in range.
            let [first, end] = [-half - u_min, half + 1 - u_min].map(|row| row.clamp(0, rows) as usize);
            let epipolar = transport.slice(s![first..end, .., ..]).sum_axis(Axis(0));
            let indirect = transport.sum_axis(Axis(0)) - &epipolar;
            labels.push(format!("{} ({:.2} s)", entry.cycle, entry.start_s));
            images.push([epipolar, indirect]);
        }
    }
    let sheet = |kind: usize, name: &str| {
        let views: Vec<ArrayView2<'_, f32>> = images.iter().map(|image| image[kind].view()).collect();
        let tone_map = ToneMap::percentile(&views, PERCENTILE);
        Block::ContactSheet(ContactSheet {
            column_title: "cycle".into(),
            columns: labels.clone(),
            row_title: "light".into(),
            rows: vec![name.into()],
            pictures: views.iter().map(|view| Some(Picture::thumbnail(*view, tone_map))).collect(),
        })
    };
    let blocks = match images.is_empty() {
        true => vec![Block::Note(NoteLevel::Warning, "No cycle has a transport.".into())],
        false => vec![sheet(0, "epipolar"), sheet(1, "indirect")],
    };
    Ok(Section {
        title: "The film".into(),
        intro: "Some of the cycles, evenly spread. Epipolar: light from the pixel's own projector row; indirect: from all others within the reach. Each sheet has one scale.".into(),
        blocks,
    })
}

fn video(FilmVideo { name, about, pictures }: &FilmVideo) -> Section {
    Section {
        title: format!("Product {name}"),
        intro: format!(
            "{about}. Some of its images, with one scale; products/{name}.mp4 shows all, and products/{name}.npy has their values."
        ),
        blocks: vec![Block::Pictures(pictures.clone())],
    }
}

/// What the film's first cycles showed, if it had enough of them.
fn findings(state: &State) -> Option<Section> {
    let film = state.film.as_ref().filter(|film| !film.findings.is_empty())?;
    Some(Section {
        title: "How the cycles were demultiplexed".into(),
        intro: "From the mean of the first four cycles, which themselves were demultiplexed as planned."
            .into(),
        blocks: film.findings.iter().map(|(what, said)| remark(what, said)).collect(),
    })
}

fn pace(state: &State) -> Section {
    let film = state.film.clone().unwrap_or_default();
    let mut entries = vec![
        ("cycles planned", film.cycles_planned.to_string()),
        ("stored", film.cycles_stored.to_string()),
        ("incomplete", film.cycles_incomplete.to_string()),
        ("transports made during the film", film.transports.to_string()),
        ("sliding estimates", film.sliding_estimates.to_string()),
    ];
    match film.latency_ms {
        Some(Percentiles { p50, p95, p99, max }) => {
            let text = format!("{p50:.0} / {p95:.0} / {p99:.0} / {max:.0} ms");
            entries.push(("latency p50 / p95 / p99 / max", text));
        }
        None => entries.push(("latency", "not measured: the clock was a virtual one".into())),
    }
    let starts: Vec<_> = state.cycles().collect();
    let lengths = starts.windows(2).filter(|pair| pair[1].cycle == pair[0].cycle + 1);
    let points = lengths.map(|pair| (pair[1].cycle as f64, 1e3 * (pair[1].start_s - pair[0].start_s)));
    let plot = Plot {
        title: "From the start of a cycle to that of the next".into(),
        x_label: "cycle".into(),
        y_label: "time / ms".into(),
        series: vec![Series { name: "cycles".into(), style: SeriesStyle::Dots, points: points.collect() }],
        guides: Vec::new(),
    };
    Section {
        title: "Pace".into(),
        intro: "Latency runs from the end of a cycle's last exposure to the publication of its transport."
            .into(),
        blocks: vec![
            Block::Facts(entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()),
            Block::Plots(vec![plot]),
        ],
    }
}

fn trust(state: &State, task: &FilmTask) -> Section {
    let wanted = task.film.delay_us.values();
    let deviations: Vec<f64> = state
        .cycles()
        .flat_map(|cycle| cycle.delays_us.iter().zip(&wanted).map(|(true_us, wanted_us)| true_us - wanted_us))
        .collect();
    let mut blocks = vec![settings(state, &task.task)];
    blocks.extend(accounts(state));
    blocks.push(Block::Plots(jitter(&deviations)));
    Section {
        title: "How far to trust it".into(),
        intro: format!(
            "Every frame is tied to the VSYNC edge of its light; a frame further than {:.0} µs from the wanted delay does not count, and its cycle is not stored. The model uses the measured delays.",
            task.film.max_jitter_us
        ),
        blocks,
    }
}
