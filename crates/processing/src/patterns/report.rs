//! The report of a session with pictures.

use ndarray::{ArrayView2, Axis};
use raysweep_session::Session;
use raysweep_session::ledger::State;
use raysweep_session::report::{Block, NoteLevel, Picture, Report, Section, Table, ToneMap};
use raysweep_session::stack::ArrayName;
use raysweep_transport::plane::separation::Separated;

use super::task::REGULAR;
use super::{PERCENTILE, PatternProducts, PatternsTask, SeparatedSeries};
use crate::plane::colour::{Values, in_colour};
use crate::plane::report::{jitter, settings};
use crate::report::{accounts, named, page};

/// The page.
pub(super) fn make(
    session: &Session,
    state: &State,
    task: &PatternsTask,
    products: &PatternProducts,
) -> Report {
    let PatternProducts { series, captured, black, problems, shortcomings } = products;
    let mut sections = Vec::new();
    let note = |level, texts: &[String]| {
        texts.iter().map(|text| Block::Note(level, text.clone())).collect::<Vec<_>>()
    };
    let notes = [note(NoteLevel::Error, problems), note(NoteLevel::Warning, shortcomings)].concat();
    if !notes.is_empty() {
        sections.push(section("Problems", "", notes));
    }
    sections.extend(series.iter().map(|series| separation(task, series, *black)));
    if !captured.is_empty() {
        let intro = "Each product has its own scale. Of long series, some images are shown.";
        sections.push(section("Images under pictures", intro, vec![Block::Pictures(captured.clone())]));
    }
    sections.push(section("Settings", "", vec![settings(state, &task.task)]));
    let deviations: Vec<f64> = task
        .task
        .schedule
        .points
        .iter()
        // A whole period has the same light at any delay.
        .filter(|point| point.exposure_us < task.task.geometry.raster.period_us)
        .filter_map(|point| {
            let (array, index) = crate::plane::place(point.role);
            let entry = state.point(array, index).filter(|_| array == ArrayName::Sum)?;
            Some(entry.delays_us.iter().map(|delay_us| delay_us - point.delay_us).collect::<Vec<_>>())
        })
        .flatten()
        .collect();
    let mut frames = accounts(state);
    if !deviations.is_empty() {
        frames.push(Block::Plots(jitter(&deviations)));
    }
    sections.push(section("Frames", "", frames));
    let shape = state.session.shape;
    let facts = [
        ("images stored", format!("{} of {}", state.stored_points(), shape.points())),
        ("pictures", task.pictures.len().to_string()),
        ("frames an image", task.patterns.average.to_string()),
        ("camera", format!("{} × {} px", shape.columns, shape.rows)),
        ("frames lost", state.counts.lost_total().to_string()),
    ];
    page(session, state, named(facts), sections)
}

fn section(title: &str, intro: &str, blocks: Vec<Block>) -> Section {
    Section { title: title.into(), intro: intro.into(), blocks }
}

/// Direct and global light of each setting, side by side with one scale.
fn separation(task: &PatternsTask, series: &SeparatedSeries, black: Option<f64>) -> Section {
    let SeparatedSeries { suffix, separation, size_px, .. } = series;
    let mut blocks = Vec::new();
    for (setting, Separated { direct, global, .. }) in task.settings().iter().zip(&separation.settings) {
        let [total, direct, global] = [&(direct + global), direct, global]
            .map(|image| in_colour(image.view(), task.task.mosaic, Values::Light).into_owned());
        let scale = ToneMap::percentile(&total.axis_iter(Axis(2)).collect::<Vec<_>>(), PERCENTILE);
        let name = if setting.name == REGULAR { "" } else { &setting.name };
        let caption = |kind: &str| format!("{name} {kind}{suffix}").trim().to_owned();
        blocks.push(Block::Pictures(vec![
            Picture::coloured(total.view(), scale).with_caption(caption("total")),
            Picture::coloured(direct.view(), scale).with_caption(caption("direct")),
            Picture::coloured(global.view(), scale).with_caption(caption("global")),
        ]));
    }
    let row = |setting: &str, Separated { direct, direct_sd, global, global_sd }: &Separated| {
        let medians =
            [direct, direct_sd, global, global_sd].map(|image| format!("{:.4}", median(image.view())));
        [setting.to_owned()].into_iter().chain(medians).collect::<Vec<_>>()
    };
    let headers = ["median of all pixels", "direct", "± 1 sd", "global", "± 1 sd"];
    let rows =
        task.settings().iter().zip(&separation.settings).map(|(setting, light)| row(&setting.name, light));
    blocks.push(Block::Table(Table { headers: headers.map(Into::into).to_vec(), rows: rows.collect() }));
    let marked = separation.is_spread.iter().filter(|marked| **marked).count();
    if marked > 0 {
        let spread = separation.spread_px.mapv(|px| if px.is_nan() { 0.0 } else { px });
        let picture = Picture::grey(spread.view(), ToneMap::percentile(&[spread.view()], 99.5))
            .with_caption("distance over which light spreads, in projector pixels");
        blocks.push(Block::Pictures(vec![picture]));
    }
    let blur = separation.blur_px.map_or_else(|| "not known".into(), |[x, y]| format!("{x:.1}, {y:.1} px"));
    let black =
        black.map_or_else(|| "not measured".into(), |black| format!("{:.2} % of white", 100.0 * black));
    let share = 100.0 * marked as f64 / separation.is_spread.len().max(1) as f64;
    let facts = [
        ("blur along x, y", blur),
        ("projector's black", black),
        ("direct is a bound in", format!("{share:.1} % of pixels")),
    ];
    blocks.push(Block::Facts(facts.map(|(key, value)| (key.to_owned(), value)).to_vec()));
    Section {
        title: format!("Direct and global light by squares of {size_px} pixels"),
        intro:
            "After Nayar et al. (SIGGRAPH 2006), from all shifts of the checkerboard. Each row has one scale."
                .into(),
        blocks,
    }
}

fn median(image: ArrayView2<f32>) -> f32 {
    let mut values: Vec<f32> = image.iter().copied().filter(|value| value.is_finite()).collect();
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f32::NAN)
}
