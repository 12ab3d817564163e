//! Report and manifest of a session that identified a mirror.

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

use raysweep_config::DotRigFile;
use raysweep_session::ledger::State;
use raysweep_session::report::{Block, NoteLevel, Plot, Report, Section, Series, SeriesStyle, Table};
use raysweep_session::{Result, Session, manifest};
use raysweep_transport::dots::identify::{Identified, Resonance, Transfer};
use serde_json::json;

use super::analysis::FoundAxis;
use super::task::{AXES, ResponseTask};
use crate::mirror_response::AxisResponse;
use crate::report::{accounts, named, page};

/// Makes the report.
pub fn make(session: &Session, state: &State, task: &ResponseTask, axes: &[FoundAxis; 2]) -> Report {
    let plan = &task.response;
    let facts = [
        ("axes stored", format!("{} of {}", state.stored_points(), AXES.len())),
        ("chirp", format!("{} to {} Hz in {} s", plan.band_hz[0], plan.band_hz[1], plan.chirp_s)),
        ("amplitude", format!("{}°, mechanical", plan.amplitude_deg)),
        ("exposure", format!("{:.1} µs", plan.exposure_us)),
        ("frames a second", format!("{:.0}", plan.camera_rate_hz)),
        ("frames lost", state.counts.lost_total().to_string()),
    ];
    let mut sections: Vec<Section> =
        axes.iter().zip(AXES).enumerate().map(|(axis, of)| section(state, axis, of)).collect();
    sections.push(Section {
        title: "How far to trust it".into(),
        intro: "Frames are known by their ids: one that is lost leaves a gap, over which the dot's place is drawn as a straight line. What does not come within the chirp's path is cancelled."
            .into(),
        blocks: accounts(state),
    });
    page(session, state, named(facts), sections)
}

fn section(state: &State, number: usize, (axis, name): (&FoundAxis, &str)) -> Section {
    let mut blocks = vec![match &axis.found {
        Ok(found) => Block::Table(figures(found)),
        Err(refusal) => Block::Note(NoteLevel::Error, refusal.to_string()),
    }];
    blocks.extend(axis.warning(name).map(|warning| Block::Note(NoteLevel::Warning, warning)));
    if let Some(entry) = state.axes().find(|entry| entry.axis == number) {
        let facts = [
            ("frames of the chirp", entry.frames.to_string()),
            ("that never came", entry.lost.to_string()),
            ("that show no dot", entry.empty.to_string()),
        ];
        blocks.push(Block::Facts(facts.map(|(key, value)| (key.to_owned(), value)).to_vec()));
    }
    if !axis.measured.is_empty() {
        blocks.push(Block::Plots(plots(axis)));
    }
    Section {
        title: format!("Axis {name}"),
        intro: "The dot's movement over the commanded tilt, along the line on which the dot moved, and the resonance that was fitted.".into(),
        blocks,
    }
}

fn figures(found: &Identified) -> Table {
    let Identified { resonance: Resonance { f0_hz, q }, gain, delay_s, residual, band_hz } = found;
    let rows = [
        ("resonance f0", format!("{f0_hz:.2} Hz")),
        ("quality factor Q", format!("{q:.2}")),
        ("delay", format!("{:.1} µs", delay_s * 1e6)),
        ("movement of the dot at rest", format!("{gain:.2} px per degree")),
        ("share left unexplained", format!("{residual:.3}")),
        ("holds from", format!("{:.0} to {:.0} Hz", band_hz[0], band_hz[1])),
    ];
    Table {
        headers: vec!["figure".into(), "value".into()],
        rows: rows.map(|(key, value)| vec![key.to_owned(), value]).to_vec(),
    }
}

fn plots(axis: &FoundAxis) -> Vec<Plot> {
    let fitted = axis.fitted();
    // The delay is removed: it would wrap the phase many times.
    let delay_s = axis.found.as_ref().map_or(0.0, |found| found.delay_s);
    let phase_rad = |at: &Transfer| (at.phase_rad + TAU * at.hz * delay_s + PI).rem_euclid(TAU) - PI;
    let plot = |title: &str, y_label: &str, value: &dyn Fn(&Transfer) -> f64| {
        let points = |of: &[Transfer]| of.iter().map(|at| (at.hz, value(at))).collect();
        let measured =
            Series { name: "measured".into(), style: SeriesStyle::Dots, points: points(&axis.measured) };
        let fit = (!fitted.is_empty()).then(|| Series::line("fitted", points(&fitted)));
        Plot {
            title: title.into(),
            x_label: "frequency / Hz".into(),
            y_label: y_label.into(),
            series: [measured].into_iter().chain(fit).collect(),
            guides: Vec::new(),
        }
    };
    vec![
        plot("Amplitude", "px per degree", &|at| at.amplitude),
        plot("Phase, without the delay", "phase / rad", &phase_rad),
    ]
}

/// Writes the manifest.
///
/// # Errors
/// When the session cannot be written.
pub fn write_manifest(
    session: &Session,
    state: &State,
    task: &ResponseTask,
    rig: &DotRigFile,
    axes: &[FoundAxis; 2],
) -> Result<()> {
    let software = BTreeMap::from([("raysweep".to_owned(), env!("CARGO_PKG_VERSION").to_owned())]);
    let plan = &task.response;
    let found = axes.each_ref().map(|axis| axis.found.as_ref().ok().map(AxisResponse::from));
    let settings = json!({
        "rig": {
            "pixel_format": task.format,
            "mirror": rig.mirror.as_ref().map(|mirror| mirror.driver.name()),
        },
        "band_hz": plan.band_hz,
        "amplitude_deg": plan.amplitude_deg,
        "camera_rate_hz": plan.camera_rate_hz,
        "exposure_us": plan.exposure_us,
        "samples": task.paths[0].points().len(),
        "rate_hz": plan.rate_hz,
        "x": found[0],
        "y": found[1],
    });
    manifest::write(session, state, software, settings.as_object().cloned().unwrap_or_default())?;
    Ok(())
}
