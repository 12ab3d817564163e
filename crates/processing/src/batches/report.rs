//! The report of a dot rig's session.

use ndarray::Axis;
use raysweep_session::dots::FlatArrays;
use raysweep_session::ledger::State;
use raysweep_session::report::{
    Block, NoteLevel, Picture, Plot, Report, Section, Series, SeriesStyle, Table, ToneMap,
};
use raysweep_session::{Result, Session};

use raysweep_transport::dots::calibrate::Extension;

use super::calibration::Calibration;
use super::task::DotTask;
use crate::report::{accounts, page};

/// Pictures of selected images of a video.
pub(super) struct VideoStrip {
    pub name: String,
    pub about: String,
    pub pictures: Vec<Picture>,
}

/// Percentile of the pixels that maps to white in a picture.
const PERCENTILE: f64 = 99.5;

/// Makes the report.
///
/// # Errors
/// When a picture cannot be drawn.
pub(super) fn make(
    session: &Session,
    state: &State,
    task: &DotTask,
    calibration: Option<&Calibration>,
    strips: &[VideoStrip],
    problems: &[String],
) -> Result<Report> {
    let mut sections = Vec::new();
    let blocks: Vec<Block> =
        problems.iter().map(|problem| Block::Note(NoteLevel::Warning, problem.clone())).collect();
    if !blocks.is_empty() {
        sections.push(Section { title: "Problems".into(), intro: String::new(), blocks });
    }
    sections.extend(strips.iter().map(video));
    sections.extend(calibration.map(|calibration| planes(calibration, task)));
    sections.push(trust(state, task));
    Ok(page(
        session,
        state,
        facts(state, task).into_iter().chain(flat_field(session, task)?).collect(),
        sections,
    ))
}

fn facts(state: &State, task: &DotTask) -> Vec<(String, String)> {
    let plan = &task.batches;
    [
        ("batches stored", format!("{} of {}", state.stored_points(), plan.total())),
        ("dots a batch", plan.dots.to_string()),
        ("batches a second", format!("{:.2}", 1.0 / plan.path.duration_s())),
        ("exposure", format!("{:.1} µs", plan.exposure_us)),
        ("camera", format!("{} × {} px", task.shape.width(), task.shape.height())),
        ("frames lost", state.counts.lost_total().to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .to_vec()
}

/// Non-uniformity of the sensor, if the run measured it.
fn flat_field(session: &Session, task: &DotTask) -> Result<Option<(String, String)>> {
    let dots = session.dots()?;
    if !dots.has_flat() {
        return Ok(None);
    }
    let FlatArrays { gain, repaired } = dots.read_flat([task.shape.height(), task.shape.width()])?;
    let (mean, sigma) = (gain.mean().unwrap_or(1.0), gain.std(0.0));
    let repaired = repaired.iter().filter(|repaired| **repaired).count();
    let text = format!("gains spread by {:.2} %, {repaired} pixels repaired", 100.0 * sigma / mean);
    Ok(Some(("flat field".into(), text)))
}

fn video(strip: &VideoStrip) -> Section {
    Section {
        title: strip.name.clone(),
        intro: format!(
            "Some of the batches, evenly spread: {}. All are in products/{}.",
            strip.about, strip.name
        ),
        blocks: vec![Block::Pictures(strip.pictures.clone())],
    }
}

fn planes(calibration: &Calibration, task: &DotTask) -> Section {
    let seen = calibration.centroids.xy.iter().flatten().count();
    let neighbours: usize =
        (0..calibration.confusion.dots()).map(|dot| calibration.confusion.neighbours(dot).len()).sum();
    let mut entries = vec![
        ("dots seen on the plane", format!("{seen} of {}", calibration.centroids.xy.len())),
        (
            "neighbours of a dot, itself among them",
            format!("{:.1} in the mean", neighbours as f64 / seen.max(1) as f64),
        ),
        ("dots that fall into several pieces on the plane", calibration.not_unimodal.to_string()),
    ];
    if let Some(px) = calibration.radius_px {
        entries.push(("radius of a dot", format!("{px:.1} px")));
    }
    for (plane, depth_mm) in
        task.batches.calibration.iter().enumerate().filter_map(|(plane, of)| Some((plane, of.depth_mm?)))
    {
        entries.push(("depth of a plane", format!("{}: {depth_mm} mm", plane + 1)));
    }
    entries.push(match &calibration.extension {
        Ok(Extension { dots, sd_px }) => (
            "dots beside the plane, placed by the mirror's path",
            format!("{dots}; the others follow the path to {sd_px:.2} px"),
        ),
        Err(sd_px) => (
            "dots beside the plane",
            format!(
                "not placed: the dots lie {sd_px:.1} px from where the mirror's path would have them, as behind a mirror that lags; a plan of kind \"response\" identifies it, so that later paths allow for that"
            ),
        ),
    });
    entries.push(match &calibration.epipolar {
        Ok(fit) => (
            "the second plane's dots from their epipolar lines",
            format!(
                "{:.3} px (standard deviation), without {} outliers of {}; the planes are {:.1} px apart",
                fit.sd_px, fit.outliers, fit.dots, fit.parallax_px
            ),
        ),
        Err(why) => ("epipolar geometry", why.clone()),
    });
    let rows = calibration.drifts.iter().map(|(batch, drift)| {
        vec![
            batch.to_string(),
            format!("{:+.3}", drift.right_px),
            format!("{:+.3}", drift.down_px),
            format!("{:.3}", drift.rms_px),
            drift.dots.to_string(),
        ]
    });
    let rows: Vec<Vec<String>> = rows.collect();
    let mut blocks =
        vec![Block::Facts(entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect())];
    if !rows.is_empty() {
        let headers =
            ["batch", "right / px", "down / px", "single dots / px rms", "dots"].map(str::to_owned).to_vec();
        blocks.push(Block::Table(Table { headers, rows }));
    }
    let confusion = calibration.confusion_image();
    let largest = confusion.iter().copied().fold(1.0, f32::max);
    let cover = calibration.coverage.index_axis(Axis(2), 0);
    blocks.push(Block::Pictures(vec![
        Picture::grey(confusion.view(), ToneMap { white: largest })
            .with_caption("confusion matrix: pixels that two dots share"),
        Picture::grey(cover, ToneMap::percentile(&[cover], PERCENTILE))
            .with_caption("coverage: sum of the dots' spreads"),
    ]));
    Section {
        title: "Calibration planes".into(),
        intro: "How the dots land on the plane, and how they drift from its first batch to the others."
            .into(),
        blocks,
    }
}

fn trust(state: &State, task: &DotTask) -> Section {
    let over = |value: fn(&raysweep_session::dots::BatchEntry) -> f64| {
        state.batches().map(|entry| (entry.batch as f64, value(entry))).collect::<Vec<_>>()
    };
    let plot = |title: &str, points: Vec<(f64, f64)>| Plot {
        title: title.into(),
        x_label: "batch".into(),
        y_label: "dots".into(),
        series: vec![Series { name: "batches".into(), style: SeriesStyle::Dots, points }],
        guides: Vec::new(),
    };
    let mut blocks = accounts(state);
    blocks.push(Block::Plots(vec![
        plot("Dots without a frame", over(|entry| entry.missing.len() as f64)),
        plot("Dots in which nothing stood out", over(|entry| entry.empty as f64)),
        plot("Dots that ended at the cap on discs", over(|entry| entry.capped as f64)),
    ]));
    Section {
        title: "How far to trust it".into(),
        intro: format!(
            "Batches are cut anew by each trailing dot (index {}); frames that no two of them enclose are not used. Dots without a frame have no light and are missing in every sum of their batch.",
            task.batches.trailing_index()
        ),
        blocks,
    }
}
