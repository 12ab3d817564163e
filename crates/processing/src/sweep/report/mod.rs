//! The report of a sweep: what was recorded, the results, and how far to trust them.

mod findings;
mod products;

use ndarray::{Array1, Array2};
use raysweep_pipeline::{PREDICTED_SHARE, PointRole, SweepSummary};
use raysweep_session::ledger::{PointEntry, State};
use raysweep_session::report::{
    Block, ContactSheet, Marker, NoteLevel, Picture, Plot, Report, Section, Series, ToneSamples,
};
use raysweep_session::stack::{ArrayName, Stack};
use raysweep_session::{Result, Session, durable, transport};

use self::products::PERCENTILE;
use super::results::Results;
use super::strips::Overview;
use super::task::SweepTask;
use crate::plane::place;
use crate::plane::report::{jitter, settings};
use crate::report::{accounts, page};

/// The same for the stack's indirect light, which is far dimmer and fills more of its images.
const INDIRECT_PERCENTILE: f64 = 70.0;

/// Writes the report.
///
/// # Errors
/// When the stack cannot be read or the report cannot be written.
pub fn write(
    session: &Session,
    state: &State,
    task: &SweepTask,
    results: &Results,
    overview: Option<&Overview>,
) -> Result<()> {
    let page = make(session, state, task, results, overview)?.to_html()?;
    durable::write(&session.report_path(), page.as_bytes())
}

fn make(
    session: &Session,
    state: &State,
    task: &SweepTask,
    results: &Results,
    overview: Option<&Overview>,
) -> Result<Report> {
    let Results { products, summary, problems, .. } = results;
    let stack = session.stack()?;
    let markers = overview.map(mark).unwrap_or_default();
    let sweep = SweepImages { task, state, stack: &stack };
    let mut sections = Vec::new();
    let errors = problems.iter().map(|problem| Block::Note(NoteLevel::Error, problem.clone()));
    let warnings = summary.iter().flat_map(|summary| &summary.warnings);
    let warnings = warnings.map(|text| Block::Note(NoteLevel::Warning, text.clone()));
    let blocks: Vec<Block> = errors.chain(warnings).collect();
    if !blocks.is_empty() {
        sections.push(Section { title: "Problems".into(), intro: String::new(), blocks });
    }
    if let Some(overview) = overview {
        let pixels: Vec<[usize; 2]> = markers.iter().map(|marker| [marker.row, marker.column]).collect();
        let over_rows = transport::read_profiles(&session.transport_path(), &pixels)?;
        sections.extend(products::images(products, task.task.mosaic, &markers));
        sections.push(profiles(&sweep, overview.u_min, &over_rows, &markers)?);
        sections.extend(products::sequences(products, task.task.mosaic));
        sections.extend(products::profiles(products));
        sections.extend(products::cross_sections(products));
    }
    sections.push(sweep.contact_sheet()?);
    sections.extend(summary.iter().map(|summary| findings::section(&summary.findings)));
    sections.push(trust(state, task, summary.as_ref()));
    Ok(page(session, state, facts(state, task), sections))
}

fn facts(state: &State, task: &SweepTask) -> Vec<(String, String)> {
    let sweep = &task.sweep;
    let range = |values: Vec<f64>| match (values.first(), values.last()) {
        (Some(first), Some(last)) => format!("{first:.0} … {last:.0} µs in {}", values.len()),
        _ => String::new(),
    };
    let stored = state.stored(ArrayName::Sum).count();
    let lost = state.counts.lost_total();
    [
        ("delay", range(sweep.delay_us.values())),
        ("exposure", range(sweep.exposure_us.values())),
        ("frames averaged", sweep.average.to_string()),
        ("points stored", format!("{stored} of {}", state.session.shape.points())),
        ("camera", format!("{} × {} px", state.session.shape.columns, state.session.shape.rows)),
        ("frames lost", lost.to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .to_vec()
}

/// Chooses pixels to plot: the brightest of each kind of light.
fn mark(overview: &Overview) -> Vec<Marker> {
    let Overview { epipolar, near, middle, total, .. } = overview;
    let kinds = [epipolar.clone(), near - epipolar, middle - near, total - middle];
    let mut markers: Vec<Marker> = Vec::new();
    for image in &kinds {
        let brightest = image
            .indexed_iter()
            .filter(|((t, s), _)| {
                // Far enough from the others to be distinguished in the picture.
                let apart = image.nrows().min(image.ncols()) / 10;
                markers.iter().all(|marker| marker.row.abs_diff(*t).max(marker.column.abs_diff(*s)) > apart)
            })
            .max_by(|a, b| a.1.total_cmp(b.1));
        if let Some(((row, column), _)) = brightest {
            markers.push(Marker { label: (markers.len() + 1).to_string(), row, column });
        }
    }
    markers
}

/// Light of the marked pixels over the delay, and over relative rows from `u_min` on.
fn profiles(
    sweep: &SweepImages<'_>,
    u_min: i32,
    over_rows: &[Array1<f32>],
    markers: &[Marker],
) -> Result<Section> {
    let exposure_us = sweep.task.sweep.exposure_us.values().into_iter().fold(f64::INFINITY, f64::min);
    let over_delays = sweep.at_exposure(exposure_us, markers)?;
    let delay = markers.iter().enumerate().map(|(index, marker)| {
        let points = over_delays.iter().map(|(delay_us, light)| (*delay_us, f64::from(light[index])));
        Series::line(
            format!("pixel {} (t {}, s {})", marker.label, marker.row, marker.column),
            points.collect(),
        )
    });
    let delay = Plot {
        title: format!("Delay profiles at an exposure of {exposure_us:.0} µs"),
        x_label: "delay t_d / µs".into(),
        y_label: "light".into(),
        series: delay.collect(),
        guides: Vec::new(),
    };
    let rows = markers.iter().zip(over_rows).map(|(marker, profile)| {
        let points = profile
            .iter()
            .enumerate()
            .map(|(index, &light)| (f64::from(u_min) + index as f64, f64::from(light.max(1e-5)).log10()));
        Series::line(format!("pixel {}", marker.label), points.collect())
    });
    let rows = Plot {
        title: "Transport over relative projector rows".into(),
        x_label: "u = v − t / rows".into(),
        y_label: "log10 of light".into(),
        series: rows.collect(),
        guides: Vec::new(),
    };
    Ok(Section {
        title: "Profiles of the marked pixels".into(),
        intro: "Left: what the camera saw over the delay. Right: what demultiplexing makes of all images: the light from each projector row.".into(),
        blocks: vec![Block::Plots(vec![delay, rows])],
    })
}

/// The sweep's images, read from the stack on demand.
struct SweepImages<'a> {
    task: &'a SweepTask,
    state: &'a State,
    stack: &'a Stack,
}

impl SweepImages<'_> {
    /// A point's image minus its dark image, in the scene's units.
    fn light(&self, role: PointRole) -> Result<Option<Array2<f32>>> {
        let Some(point) = self.task.task.schedule.points.iter().find(|point| point.role == role) else {
            return Ok(None);
        };
        let dark = self
            .task
            .task
            .schedule
            .dark_of(point.exposure_us)
            .map(|dark| self.mean(dark))
            .transpose()?
            .flatten();
        let Some((image, dark)) = self.mean(role)?.zip(dark) else { return Ok(None) };
        let geometry = &self.task.task.geometry;
        let scale = geometry.scale_of(&(0..geometry.height).collect::<Vec<_>>());
        Ok(Some(scale.light(image.view(), dark.view())))
    }

    fn mean(&self, role: PointRole) -> Result<Option<Array2<f32>>> {
        let (array, index) = place(role);
        let Some(entry) = self.state.point(array, index) else { return Ok(None) };
        // Damaged points are listed among the problems; the report shows them as missing.
        let Ok(sum) = self.stack.read_point(array, index) else { return Ok(None) };
        Ok(Some(sum.mapv(|sum| sum as f32 / entry.frames as f32)))
    }

    /// Delay and light of the marked pixels, for each image at an exposure.
    fn at_exposure(&self, exposure_us: f64, markers: &[Marker]) -> Result<Vec<(f64, Vec<f32>)>> {
        let mut lights = Vec::new();
        for point in &self.task.task.schedule.points {
            if matches!(point.role, PointRole::Sweep(_))
                && point.exposure_us == exposure_us
                && let Some(image) = self.light(point.role)?
            {
                let light = markers.iter().map(|marker| image[[marker.row, marker.column]]);
                lights.push((point.delay_us, light.collect()));
            }
        }
        // Extra settings follow the grid, wherever their delays lie.
        lights.sort_by(|a: &(f64, Vec<f32>), b| a.0.total_cmp(&b.0));
        Ok(lights)
    }

    /// Number of pixels in the sweep's images that the ledger lists.
    fn stored_px(&self) -> usize {
        let shape = &self.state.session.shape;
        self.state.stored(ArrayName::Sum).count() * shape.rows * shape.columns
    }

    fn contact_sheet(&self) -> Result<Section> {
        let (delays, exposures) = (self.task.sweep.delay_us.values(), self.task.sweep.exposure_us.values());
        let places = delays.len() * exposures.len();
        // The sweep may not fit into memory: read one image at a time.
        let mut samples = ToneSamples::new(self.stored_px());
        let mut thumbnails = Vec::with_capacity(places);
        for index in 0..places as u32 {
            let light = self.light(PointRole::Sweep(index))?;
            light.iter().for_each(|light| samples.add(light.view()));
            thumbnails.push(light.map(|light| Picture::reduced(light.view())));
        }
        let label = |value: &f64| format!("{value:.0}");
        let sheet = |tone_map| ContactSheet {
            column_title: "delay / µs".into(),
            columns: delays.iter().map(label).collect(),
            row_title: "exposure / µs".into(),
            rows: exposures.iter().map(label).collect(),
            pictures: thumbnails
                .iter()
                .map(|image| image.as_ref().map(|image| Picture::thumbnail(image.view(), tone_map)))
                .collect(),
        };
        Ok(Section {
            title: "The stack".into(),
            intro: "Every image of the sweep's grid, dark image subtracted. A camera row collects the light of projector rows that lie delay / row time below its own, over a band as wide as the exposure. The second sheet is exposed for the indirect light.".into(),
            blocks: vec![
                Block::ContactSheet(sheet(samples.percentile(PERCENTILE))),
                Block::ContactSheet(sheet(samples.percentile(INDIRECT_PERCENTILE))),
            ],
        })
    }
}

fn trust(state: &State, task: &SweepTask, summary: Option<&SweepSummary>) -> Section {
    let mut blocks = vec![settings(state, &task.task)];
    if let Some(summary) = summary {
        let figures = summary.figures.iter().map(|&(name, value)| (name.to_owned(), short(value)));
        blocks.push(Block::Facts(figures.collect()));
    }
    blocks.extend(accounts(state));
    let deviation = |point: &PointEntry| {
        let delay_us = point.delay_us;
        point.delays_us.iter().map(move |true_us| true_us - delay_us).collect::<Vec<_>>()
    };
    blocks.push(Block::Plots(jitter(&state.stored(ArrayName::Sum).flat_map(deviation).collect::<Vec<_>>())));
    blocks.extend(summary.and_then(regular_note));
    let sweep = &task.sweep;
    Section {
        title: "How far to trust it".into(),
        intro: format!(
            "Every frame is tied to the VSYNC edge of its light; a frame further than {:.0} µs from the wanted delay was taken again. The model uses the measured delays.",
            sweep.max_jitter_us
        ),
        blocks,
    }
}

/// Formats a number with at most four decimals.
fn short(value: f64) -> String {
    format!("{value:.4}").trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn regular_note(summary: &SweepSummary) -> Option<Block> {
    let (_, share) = summary.figures.iter().find(|(name, _)| *name == PREDICTED_SHARE)?;
    Some(Block::Note(
        NoteLevel::Info,
        format!(
            "Summed over all rows, the transport predicts {:.2} % of the light of the regular image. This checks the sum of all light, not where it came from.",
            share * 100.0
        ),
    ))
}
