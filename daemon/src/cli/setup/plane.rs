//! The questions about a plane rig.

use std::path::{Path, PathBuf};

use raysweep_drivers::search::Answering;
use toml::{Table, Value};

use super::camera::ChosenCamera;
use super::found::ConnectedDevices;
use super::questions::{AnswerChoice, Questions};
use super::text::RigText;
use crate::cli::failure::CommandFailure;
use crate::rig::check_scene;

/// Lines of a video frame for each line that is drawn: those of 720p60.
const LINES_PER_ROW: f64 = 750.0 / 720.0;
/// Lines before the first one that is drawn, for each that is.
const BEFORE_PER_ROW: f64 = 25.0 / 720.0;
const SHORTEST_ROW_TIME_US: f64 = 0.1;
const LONGEST_ROW_TIME_US: f64 = 10_000.0;

const SIM: &str = "sim";
const BENCH: &str = "bench";

/// Asks for a plane rig, whose file will be in `folder`; returns its text.
pub(super) fn ask(
    questions: &mut Questions,
    connected: &ConnectedDevices,
    folder: &Path,
) -> Result<String, CommandFailure> {
    let rows = questions.whole("projector_rows", "Rows that the projector draws", 720, 1..=8192)?;
    let rate_hz =
        questions.number("projector_hz", "Pictures of the projector per second", 60.0, 1.0..=250.0)?;
    let camera = ChosenCamera::ask(questions, connected, Some(rows as usize))?;
    let projector = ask_projector(questions, connected, &camera)?;
    let vsync = ask_vsync(questions, connected, &camera)?;
    let period_us = 1e6 / rate_hz;
    let row_time_us = period_us / (f64::from(rows) * LINES_PER_ROW);
    // All rows are drawn before the next edge.
    let longest_us = floored(rounded(period_us) / f64::from(rows)).min(LONGEST_ROW_TIME_US);
    let row_time_us = row_time_us.clamp(SHORTEST_ROW_TIME_US, longest_us);
    let row_time_us = questions.number(
        "row_time_us",
        "Microseconds from one row of the projector to the next (`raysweep calibrate` measures it)",
        rounded(row_time_us),
        SHORTEST_ROW_TIME_US..=longest_us,
    )?;
    let latest_us = floored(rounded(period_us) - f64::from(rows) * row_time_us).max(0.0);
    let first_row_us = questions.number(
        "first_row_us",
        "Microseconds from the VSYNC edge to the first row (`raysweep calibrate` measures it)",
        rounded(BEFORE_PER_ROW * f64::from(rows) * row_time_us).min(latest_us),
        0.0..=latest_us,
    )?;
    let text = camera.write(RigText::new("plane"));
    let text = write_vsync(text.table("vsync"), &vsync, period_us, questions)?;
    let text = write_projector(text.table("projector"), &projector)
        .key("rows", i64::from(rows))
        .key_with("row_time_us", row_time_us, "nominal; `raysweep calibrate` measures it")
        .key_with("first_row_us", first_row_us, "nominal; `raysweep calibrate` measures it");
    let is_on_a_bench = [&projector, &vsync].contains(&&BENCH.to_owned());
    let text = match is_on_a_bench {
        true => {
            let socket = questions.text(
                "bench",
                "Socket of the raysweep-sim-camera that simulates VSYNC and projector",
                "bench.sock",
            )?;
            let scene = questions
                .read("scene", "What the simulated camera sees", "v-groove", |name| scene(name, folder))?;
            let side = questions.whole("scene_rows", "Rows and columns of that scene", 128, 8..=1024)?;
            text.table("sim")
                .key("bench", socket)
                .key("scene", scene)
                .key("scene_rows", i64::from(side))
                .key("scene_columns", i64::from(side))
        }
        false if camera.is_simulated() && (projector != SIM || vsync != SIM) => text.table("sim").key_with(
            "realtime",
            true,
            "beside real devices the simulated camera keeps their time",
        ),
        false => text,
    };
    Ok(text.finish())
}

/// The name of a scene that is there.
fn scene(name: &str, folder: &Path) -> Result<String, String> {
    check_scene(name, folder).map(|()| name.to_owned())
}

fn ask_projector(
    questions: &mut Questions,
    connected: &ConnectedDevices,
    camera: &ChosenCamera,
) -> Result<String, CommandFailure> {
    let displays = connected.displays.iter().map(|display| {
        let value = format!("drm:{}:{}", display.card.display(), display.connector);
        AnswerChoice::new(
            value,
            format!("a display output, {}", display.modes.first().map_or("", |mode| mode)),
        )
    });
    let mut choices: Vec<AnswerChoice> = displays.collect();
    choices
        .push(AnswerChoice::new("external", "worked by a person, who is asked for white and for darkness"));
    choices.push(simulated(camera));
    let default = choices[0].value.clone();
    questions.choose(
        "projector",
        "What drives the projector?",
        &choices,
        &["drm:CARD:CONNECTOR"],
        Some(&default),
    )
}

/// What stands for a simulated device: with a real camera, the process of a simulated one.
fn simulated(camera: &ChosenCamera) -> AnswerChoice {
    match camera.is_simulated() {
        true => AnswerChoice::new(SIM, "simulated, to rehearse"),
        false => AnswerChoice::new(BENCH, "simulated beside raysweep-sim-camera, to rehearse"),
    }
}

fn ask_vsync(
    questions: &mut Questions,
    connected: &ConnectedDevices,
    camera: &ChosenCamera,
) -> Result<String, CommandFailure> {
    let boxes =
        connected.answering.iter().filter(|(_, found)| matches!(found, Some(Answering::TriggerBox(_))));
    let mut choices: Vec<AnswerChoice> = boxes
        .map(|(port, _)| {
            AnswerChoice::new(
                format!("triggerbox:{}", port.display()),
                "makes the VSYNC for projector and camera",
            )
        })
        .collect();
    choices.extend(connected.analysers.iter().map(|analyser| AnswerChoice::new("fx2lafw", &analyser.about)));
    choices.extend(connected.pulse_sources.iter().map(|source| {
        AnswerChoice::new(
            format!("pps:{}", source.path.display()),
            format!("the kernel's stamps, {}", source.about),
        )
    }));
    choices.extend(connected.serial_ports.iter().map(|port| {
        let about = format!("a modem line of {}", port.about);
        AnswerChoice::new(format!("modemline:{}", port.path.display()), about)
    }));
    choices.push(simulated(camera));
    let default = choices[0].value.clone();
    let forms = ["triggerbox:PORT", "pps:SOURCE", "modemline:PORT"];
    let question = "What watches the projector's VSYNC line?";
    questions.choose("vsync", question, &choices, &forms, Some(&default))
}

fn write_vsync(
    text: RigText,
    vsync: &str,
    period_us: f64,
    questions: &mut Questions,
) -> Result<RigText, CommandFailure> {
    let period = |text: RigText| text.key_with("period_us", rounded(period_us), "nominal");
    Ok(match vsync.split_once(':') {
        Some(("triggerbox", port)) => {
            let likely = if port.contains("ACM") || port.contains("Pico") { "usb" } else { "uart" };
            let link = questions.choose(
                "triggerbox_link",
                "How is the triggerbox connected?",
                &[
                    AnswerChoice::new("uart", "Arduino Uno or Nano, through a UART"),
                    AnswerChoice::new("usb", "Raspberry Pi Pico, by its own USB"),
                ],
                &[],
                Some(likely),
            )?;
            let config = Table::from_iter([
                ("port".to_owned(), Value::from(port)),
                ("link".to_owned(), Value::from(link)),
            ]);
            period(text.key("driver", "triggerbox")).key("triggerbox", config)
        }
        Some(("modemline", port)) => {
            let line = questions.choose(
                "modem_line",
                "Which modem line carries the VSYNC?",
                &[AnswerChoice::new("dcd", "pin 1 of a 9-pin connector"), AnswerChoice::new("cts", "pin 8")],
                &[],
                Some("dcd"),
            )?;
            let config = Table::from_iter([
                ("port".to_owned(), Value::from(port)),
                ("line".to_owned(), Value::from(line)),
            ]);
            period(text.key("driver", "modemline")).key("modemline", config)
        }
        Some((_, source)) => {
            let config = Table::from_iter([("source".to_owned(), Value::from(source))]);
            period(text.key("driver", "pps")).key("pps", config)
        }
        None if vsync == "fx2lafw" => {
            let text = period(text.key("driver", "fx2lafw"));
            let channel = questions.whole(
                "analyser_channel",
                "Input of the analyser that carries the VSYNC",
                0,
                0..=7,
            )?;
            let channels = Table::from_iter([("vsync".to_owned(), Value::from(i64::from(channel)))]);
            text.key("fx2lafw", Table::from_iter([("channels".to_owned(), Value::from(channels))]))
        }
        None => period(text.key("driver", SIM)),
    })
}

fn write_projector(text: RigText, projector: &str) -> RigText {
    match projector.split_once(':') {
        Some((_, output)) => {
            let (card, connector) = output.split_once(':').unwrap_or((output, ""));
            let card = PathBuf::from(card).display().to_string();
            let text = text.key("driver", "drm").key("drm.card", card);
            if connector.is_empty() { text } else { text.key("drm.connector", connector) }
        }
        None if projector == "external" => text.key("driver", "external"),
        None => text.key("driver", SIM),
    }
}

/// To a thousandth of a microsecond, and no more.
fn floored(us: f64) -> f64 {
    (us * 1e3).floor() / 1e3
}

/// To a thousandth of a microsecond.
fn rounded(us: f64) -> f64 {
    (us * 1e3).round() / 1e3
}
