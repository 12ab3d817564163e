//! Shared by the reports of the plane rig's procedures.

use std::collections::BTreeMap;

use raysweep_pipeline::{Spot, SweepGeometry};
use raysweep_session::ledger::State;
use raysweep_session::report::{Block, Plot, Series, SeriesStyle};

use super::task::PlaneTask;

/// Deviations of single frames from the commanded delay: over time, and as a histogram.
pub(crate) fn jitter(deviations_us: &[f64]) -> Vec<Plot> {
    let mut histogram: BTreeMap<i64, f64> = BTreeMap::new();
    for us in deviations_us {
        *histogram.entry(us.round() as i64).or_default() += 1.0;
    }
    let plot = |title: &str, x: &str, y: &str, style, points| Plot {
        title: title.into(),
        x_label: x.into(),
        y_label: y.into(),
        series: vec![Series { name: "frames".into(), style, points }],
        guides: Vec::new(),
    };
    vec![
        plot(
            "Delay of each frame, measured minus wanted",
            "frame",
            "deviation / µs",
            SeriesStyle::Dots,
            deviations_us.iter().enumerate().map(|(index, &us)| (index as f64, us)).collect(),
        ),
        plot(
            "How often each deviation occurred",
            "deviation / µs",
            "frames",
            SeriesStyle::Bars,
            histogram.into_iter().map(|(us, frames)| (us as f64, frames)).collect(),
        ),
    ]
}

/// Settings of the rig and the plan, so that reports can be compared.
pub(crate) fn settings(state: &State, task: &PlaneTask) -> Block {
    let geometry = &task.geometry;
    let stages = task.stages.iter().map(|stage| {
        let options: Vec<String> =
            stage.options.iter().map(|(key, value)| format!("{key} = {value}")).collect();
        if options.is_empty() {
            stage.name.clone()
        } else {
            format!("{} ({})", stage.name, options.join(", "))
        }
    });
    let mut entries = vec![
        ("stages", stages.collect::<Vec<_>>().join(", ")),
        ("row time", row_times(geometry)),
        ("first row after VSYNC", format!("{:.3} µs", geometry.first_row_us())),
        (
            "projector rows",
            format!(
                "{}; camera row 0 sees projector row {}; each camera row sees {} further down than the one before",
                geometry.raster.rows,
                geometry.first_row,
                if geometry.row_pitch == 1.0 {
                    "one row".to_owned()
                } else {
                    format!("{} rows", geometry.row_pitch)
                }
            ),
        ),
        ("white", white(geometry)),
        ("software", state.session.software.clone()),
    ];
    entries.push(match &task.calibration_made {
        Some(made) => {
            ("calibration", format!("made {made}: row times, responses and white level of each pixel"))
        }
        None => ("beam", beam(geometry)),
    });
    Block::Facts(entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect())
}

/// When rows are lit and exposed, according to the model.
fn row_times(geometry: &SweepGeometry) -> String {
    let is_measured = geometry.row_table_us.is_some() || geometry.calibration.is_some();
    let table = if is_measured { ", by the measured table" } else { "" };
    format!("projector {:.4} µs{table}, camera {:.4} µs", geometry.row_time_us(), geometry.camera_row_time_us)
}

fn white(geometry: &SweepGeometry) -> String {
    let median = if geometry.calibration.is_some() { ", the median of the pixels" } else { "" };
    format!("{:.1} counts above black{median}", geometry.white_dn)
}

/// How a row's light spreads in space and time, according to the model.
fn beam(geometry: &SweepGeometry) -> String {
    let spot = match geometry.spot {
        Spot::Uniform => "rows lit evenly",
        Spot::Flying(_) => "a flying spot",
    };
    match geometry.beam_sigma_rows {
        Some(0.0) => format!("ideal, {spot}"),
        Some(sigma_rows) => format!("sigma {sigma_rows} rows, {spot}"),
        None => format!("not stated by the rig, {spot}"),
    }
}
