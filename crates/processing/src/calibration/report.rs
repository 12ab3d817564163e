//! The report of a calibration.

use std::ops::Range;

use ndarray::Array2;
use raysweep_session::Session;
use raysweep_session::ledger::State;
use raysweep_session::report::{
    Block, Guide, NoteLevel, Picture, Plot, Report, Section, Series, SeriesStyle, Table, ToneMap,
};
use raysweep_transport::plane::board::Estimate;
use raysweep_transport::plane::board::times::ExposureMode;
use raysweep_transport::plane::{FIRST_RESPONSE_ROW, RESPONSE_ROWS};

use super::{BoardFindings, CalibrationTask, KeptCalibration};
use crate::report::{accounts, named, page};

/// Number of pixels whose responses are shown of each part of the image.
const SHOWN_PIXELS: usize = 60;
/// Rows on either side of the place that are shown.
const SHOWN_ROWS: f64 = 4.0;

/// The page.
pub(super) fn make(
    session: &Session,
    state: &State,
    task: &CalibrationTask,
    findings: &BoardFindings,
    kept: &KeptCalibration,
) -> Report {
    let mut sections = Vec::new();
    let warnings = findings.warnings();
    if !warnings.is_empty() {
        let notes = warnings.into_iter().map(|warning| Block::Note(NoteLevel::Warning, warning));
        sections.push(section("Warnings", "", notes.collect()));
    }
    let drawing = kept.header.drawing.as_ref();
    let drawing = drawing.map(|drawing| Block::Note(NoteLevel::Info, format!("rows: {}", drawing.text())));
    let blocks = [found(findings)].into_iter().chain(drawing).collect();
    sections.push(section("Found", "Each with its standard deviation.", blocks));
    sections.push(times(task, findings));
    sections.push(responses(findings));
    sections.push(pixels(findings));
    sections.extend(ambient(kept));
    sections.push(section(
        "Checks",
        "Each with the limit beyond which a calibration is refused.",
        vec![checks(kept)],
    ));
    sections.push(section("Frames", "", accounts(state)));
    let shape = state.session.shape;
    let facts = [
        ("images stored", format!("{} of {}", state.stored_points(), shape.points())),
        ("camera", format!("{} × {} px", shape.columns, shape.rows)),
        ("frames lost", state.counts.lost_total().to_string()),
    ];
    page(session, state, named(facts), sections)
}

fn section(title: &str, intro: &str, blocks: Vec<Block>) -> Section {
    Section { title: title.into(), intro: intro.into(), blocks }
}

fn found(findings: &BoardFindings) -> Block {
    let (times, pixels) = (&findings.times, &findings.pixels);
    let latency = Estimate { value: times.row_starts_us[times.seen_rows.start], sd: times.latency_sd_us };
    let rows = [
        ("time from row to row of the projector / µs", times.row_time_us, 5),
        ("time from row to row of the camera / µs", times.camera_row_time_us, 5),
        ("start of the first row seen, after the trigger edge / µs", latency, 2),
        ("exposures are longer than nominal by / µs", times.exposure_offset_us, 3),
        ("jitter of the light against the VSYNC edge / µs", times.jitter_us, 2),
        ("white / DN", pixels.white.level_dn, 1),
        ("gain / (e⁻/DN)", pixels.transfer.electrons_per_dn, 3),
        ("read noise / e⁻", pixels.transfer.read_noise_e, 2),
        ("non-uniformity of the pixels", pixels.prnu, 5),
    ];
    let curve = pixels.curve.known().map(|linearity| {
        let Estimate { value, sd } = linearity.per_dn;
        let millionths = Estimate { value: value * 1e6, sd: sd * 1e6 };
        ("curve of the camera: a of DN (1 + a DN) / 10⁻⁶", millionths, 2)
    });
    let rows = rows.into_iter().chain(curve).map(|(name, Estimate { value, sd }, digits)| {
        vec![name.to_owned(), format!("{value:.digits$}"), format!("{sd:.digits$}")]
    });
    let saturation = pixels
        .saturation_dn
        .map(|dn| vec!["pixels saturate from / DN".to_owned(), format!("{dn:.0}"), String::new()]);
    let rows = rows.chain(saturation).collect();
    Block::Table(Table { headers: ["", "value", "± 1 sd"].map(Into::into).to_vec(), rows })
}

/// The room's light, if it was measured.
fn ambient(kept: &KeptCalibration) -> Option<Section> {
    let (found, level) = (kept.header.ambient.as_ref()?, kept.arrays.ambient_dn_per_us.as_ref()?);
    let picture = Picture::grey(level.view(), ToneMap::percentile(&[level.view()], 99.5))
        .with_caption("light of the room, in counts per µs");
    let notes =
        found.lines().into_iter().map(|(name, said)| Block::Note(NoteLevel::Info, format!("{name}: {said}")));
    let intro = "From black pictures of two exposures, by the times of their frames.";
    Some(section("Light of the room", intro, notes.chain([Block::Pictures(vec![picture])]).collect()))
}

fn times(task: &CalibrationTask, findings: &BoardFindings) -> Section {
    let (times, raster) = (&findings.times, &task.task.geometry.raster);
    let starts = &times.row_starts_us;
    let seen = times.seen_rows.clone();
    let nominal = |row: usize| raster.first_row_us + row as f64 * raster.row_time_us;
    let against_nominal = seen.clone().map(|row| (row as f64, starts[row] - nominal(row))).collect();
    let (first, last) = (seen.start, seen.end);
    let slope_us = (starts[last] - starts[first]) / (last - first) as f64;
    let straight = |row: usize| starts[first] + slope_us * (row - first) as f64;
    let bend = seen.clone().map(|row| (row as f64, starts[row] - straight(row))).collect();
    let sd: Vec<(f64, f64)> = seen.map(|row| (row as f64, times.row_starts_sd_us[row])).collect();
    let jitters = times.jitters.iter().enumerate();
    let jitters: Vec<(f64, f64)> =
        jitters.filter_map(|(frame, jitter)| jitter.map(|jitter| (frame as f64, jitter.late_us))).collect();
    let plots = vec![
        plot(
            "Row starts against the rig file",
            ("projector row", "µs"),
            vec![line("found", against_nominal)],
        ),
        plot(
            "Row starts against a straight line",
            ("projector row", "µs"),
            vec![line("found", bend), line("standard deviation", sd)],
        ),
        plot(
            "Light of each frame against the mean",
            ("frame", "late / µs"),
            vec![Series { name: "frames".into(), style: SeriesStyle::Dots, points: jitters }],
        ),
    ];
    let residuals = times.residuals.iter().map(|residual| {
        let shutter = match residual.shutter {
            ExposureMode::Global => "global",
            ExposureMode::Rolling => "rolling",
        };
        vec![
            shutter.to_owned(),
            format!("{:.1}", residual.exposure_us),
            residual.frames.to_string(),
            residual.samples.to_string(),
            format!("{:.2}", residual.chi2_per_sample),
        ]
    });
    let headers = ["shutter", "exposure / µs", "frames", "samples", "χ² per sample"];
    let table = Table { headers: headers.map(Into::into).to_vec(), rows: residuals.collect() };
    section(
        "When rows are lit",
        "From frames of the white board with a global shutter, and from short rolling exposures.",
        vec![Block::Plots(plots), Block::Table(table)],
    )
}

fn responses(findings: &BoardFindings) -> Section {
    let responses = findings.responses();
    let (rows, columns) = responses.place.dim();
    // Pixels look at different fractions of a row, and together they show the beam between the rows.
    let sampled = |part: Range<usize>| -> Vec<(f64, f64)> {
        let pixels = part.len() * columns;
        let some = (0..pixels).step_by((pixels / SHOWN_PIXELS).max(1));
        let places = some.map(|n| (part.start + n / columns, n % columns));
        let lit = places.filter(|&pixel| responses.place[pixel].is_finite());
        lit.flat_map(|(t, s)| {
            let place = f64::from(responses.place[[t, s]]);
            let from_place = place.round() - place + f64::from(FIRST_RESPONSE_ROW);
            (0..RESPONSE_ROWS).map(move |d| (from_place + d as f64, f64::from(responses.response[[d, t, s]])))
        })
        .filter(|(distance, _)| distance.abs() <= SHOWN_ROWS)
        .collect()
    };
    let dots =
        |name: &str, part| Series { name: name.into(), style: SeriesStyle::Dots, points: sampled(part) };
    let kernel = Plot {
        guides: vec![Guide { x: 0.0, label: "place".into() }],
        ..plot(
            "Share of a pixel's direct light by drawn row",
            ("drawn row - place", "share"),
            vec![
                dots("top third of the image", 0..rows.div_ceil(3)),
                dots("bottom third", rows - rows.div_ceil(3)..rows),
            ],
        )
    };
    let mut offset = Array2::from_shape_fn((rows, columns), |(t, s)| responses.place[[t, s]] - t as f32);
    let least = offset.iter().copied().fold(f32::INFINITY, f32::min);
    offset -= least;
    let scale = ToneMap::percentile(&[offset.view()], 99.5);
    let caption = format!("place minus camera row, beyond its smallest value of {least:.2} rows");
    let picture = Picture::grey(offset.view(), scale).with_caption(caption);
    let intro = match findings.second {
        None | Some(Err(_)) => {
            "From pictures of every 16th row. If the board scatters light inside, the response contains that: a second board of another material shows it (calibration.boards = 2)."
        }
        Some(Ok(_)) => {
            "From pictures of every 16th row on two boards; those of the narrower response are shown."
        }
    };
    let notes = findings.found().into_iter().map(|found| Block::Note(NoteLevel::Info, found));
    let blocks = notes.chain([Block::Plots(vec![kernel]), Block::Pictures(vec![picture])]);
    section("Where pixels look", intro, blocks.collect())
}

fn pixels(findings: &BoardFindings) -> Section {
    let pixels = &findings.pixels;
    let groups = pixels.transfer.groups.iter().map(|&[signal, variance]| (signal, variance)).collect();
    let transfer = plot(
        "Photon transfer",
        ("signal / DN", "variance / DN²"),
        vec![Series { name: "groups of pixels".into(), style: SeriesStyle::Dots, points: groups }],
    );
    let picture = |image: &Array2<f32>, caption: &str| {
        Picture::grey(image.view(), ToneMap::percentile(&[image.view()], 99.5)).with_caption(caption)
    };
    let pictures = vec![
        picture(&pixels.white.white_dn, "white, above black"),
        picture(&pixels.dark.offset_dn, "dark level at no exposure"),
        picture(&pixels.dark.slope_dn_per_us, "dark current"),
        picture(&pixels.dark.hot.mapv(|hot| f32::from(u8::from(hot))), "unusual dark current or noise"),
    ];
    section(
        "Pixels",
        "White contains the lens's shading, the board's brightness and the projector's.",
        vec![Block::Plots(vec![transfer]), Block::Pictures(pictures)],
    )
}

fn checks(kept: &KeptCalibration) -> Block {
    let rows = kept.header.checks.iter().map(|(name, [value, limit])| {
        vec![name.replace('_', " "), format!("{value:.4}"), format!("{limit}")]
    });
    Block::Table(Table { headers: ["", "value", "limit"].map(Into::into).to_vec(), rows: rows.collect() })
}

fn plot(title: &str, (x_label, y_label): (&str, &str), series: Vec<Series>) -> Plot {
    Plot { title: title.into(), x_label: x_label.into(), y_label: y_label.into(), series, guides: Vec::new() }
}

fn line(name: &str, points: Vec<(f64, f64)>) -> Series {
    Series { name: name.into(), style: SeriesStyle::Line, points }
}
