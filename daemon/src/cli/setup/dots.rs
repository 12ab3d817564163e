//! The questions about a dot rig.

use raysweep_core::MirrorLimits;
use raysweep_drivers::search::Answering;
use toml::{Table, Value};

use super::camera::ChosenCamera;
use super::found::ConnectedDevices;
use super::questions::{AnswerChoice, Questions};
use super::text::RigText;
use crate::cli::failure::CommandFailure;

/// Rows of the simulated scene above the margin in which the trailing dot shows, and its columns.
const SIM_SIZE: (usize, usize) = (256, 256);
/// Rows of the margin.
const MARGIN_ROWS: usize = 16;

/// Asks for a dot rig; returns its file, and a first plan for it.
pub(super) fn ask(
    questions: &mut Questions,
    connected: &ConnectedDevices,
) -> Result<(String, String), CommandFailure> {
    let camera = ChosenCamera::ask(questions, connected, None)?;
    let mirrors = connected.answering.iter().filter_map(|(port, found)| {
        let (driver, about) = match found.as_ref()? {
            Answering::PlayzerX(about) => ("playzerx", about),
            Answering::Mti(about) => ("mti", about),
            Answering::Optotune(about) => ("optotune", about),
            Answering::TriggerBox(_) => return None,
        };
        Some(AnswerChoice::new(format!("{driver}:{}", port.display()), about))
    });
    let mut choices: Vec<AnswerChoice> = mirrors.collect();
    choices.push(AnswerChoice::new("sim", "simulated, to rehearse"));
    let default = choices[0].value.clone();
    let forms = ["playzerx:PORT", "mti:PORT", "optotune:PORT"];
    let mirror = questions.choose(
        "mirror",
        "Which mirror? A port that was not asked can be named, too",
        &choices,
        &forms,
        Some(&default),
    )?;
    let text = camera.write(RigText::new("dots")).table("mirror");
    let text = match mirror.split_once(':') {
        Some((driver, port)) => write_mirror(questions, text, driver, port)?,
        None => text.key("driver", "sim"),
    };
    let (rows, columns) = camera.size().unwrap_or(SIM_SIZE);
    Ok((text.finish(), first_plan(rows, columns)))
}

fn write_mirror(
    questions: &mut Questions,
    text: RigText,
    driver: &str,
    port: &str,
) -> Result<RigText, CommandFailure> {
    let text = text.key("driver", driver).key("port", port);
    let full_scale_deg = questions.number(
        "full_scale_deg",
        "Mechanical tilt of the mirror at the controller's full scale, in degrees, by its data sheet",
        6.5,
        0.1..=45.0,
    )?;
    let text = text.key_with("full_scale_deg", full_scale_deg, "mechanical; from the mirror's data sheet");
    let text = write_limits(questions, text, full_scale_deg)?;
    let text = if driver == "optotune" {
        let question = "Serial port whose RTS line enables the laser";
        let laser = questions.read("laser_port", question, "", |port| match port {
            "" => {
                Err("an Optotune mirror's laser is enabled by the RTS line of a serial port: name it".into())
            }
            port => Ok(port.to_owned()),
        })?;
        text.key("laser_port", laser)
    } else {
        text
    };
    let interlock = questions.text(
        "interlock",
        "File that begins with 1 while the interlock is closed, such as a GPIO's value (empty: none; an operator then permits light by `raysweep arm-light`)",
        "",
    )?;
    Ok(match interlock.is_empty() {
        true => text.comment("No interlock: light needs `raysweep arm-light` after each boot."),
        false => text.key("interlock", interlock),
    })
}

/// Asks for the mirror's limits, because those of one mirror destroy another.
fn write_limits(
    questions: &mut Questions,
    text: RigText,
    full_scale_deg: f64,
) -> Result<RigText, CommandFailure> {
    let MirrorLimits { max_tilt, bandwidth_hz, .. } = MirrorLimits::A7B2_3_3600AL;
    let max_tilt = questions.number(
        "max_tilt",
        "Limits of the mirror, by its data sheet: beyond them it may be destroyed. The defaults are those of an A7B2.3-3600AL, or follow from the first two.\nLargest mechanical tilt to either side, in degrees",
        max_tilt.0.min(full_scale_deg),
        0.01..=full_scale_deg,
    )?;
    let bandwidth_hz = questions.number("bandwidth_hz", "Bandwidth in hertz", bandwidth_hz, 1.0..=1e5)?;
    let suggested = MirrorLimits::by_tilt_and_bandwidth(max_tilt, bandwidth_hz);
    let max_step = questions.number(
        "max_step",
        "Largest step from one sample to the next, in degrees",
        suggested.max_step.0,
        1e-4..=max_tilt,
    )?;
    let max_slew = questions.number(
        "max_slew_deg_per_s",
        "Largest speed, in degrees per second",
        (suggested.max_slew_deg_per_s * 100.0).round() / 100.0,
        1e-3..=1e7,
    )?;
    let out_of_band = questions.number(
        "out_of_band",
        "What a path may hold beyond the bandwidth, in degrees, root mean square",
        suggested.out_of_band.0,
        0.0..=max_tilt,
    )?;
    let limits = [
        ("max_tilt", max_tilt),
        ("max_step", max_step),
        ("max_slew_deg_per_s", max_slew),
        ("bandwidth_hz", bandwidth_hz),
        ("out_of_band", out_of_band),
    ];
    let limits = limits.map(|(key, value)| (key.to_owned(), Value::from(value)));
    Ok(text
        .comment("Beyond these the mirror may be destroyed. Unless from its data sheet, max_step, max_slew_deg_per_s and")
        .comment("out_of_band are [A].")
        .key("limits", Table::from_iter(limits)))
}

/// A few batches of few dots; the trailing dot shows at the lower edge of the picture.
fn first_plan(rows: usize, columns: usize) -> String {
    let (first_row, middle) = (rows.saturating_sub(MARGIN_ROWS), columns / 2);
    let (from, to) = (middle.saturating_sub(MARGIN_ROWS), middle + MARGIN_ROWS);
    format!(
        "# A first look, written by `raysweep setup`: two batches of the calibration plane and two of the scene.\n\
         kind = \"batches\"\nname = \"first look\"\n\n[batches]\ncount = 2\ndots = 900\nexposure_us = 70\n\
         # Where the trailing dot shows: first row, row after the last, first column, column after the last.\n\
         trailing_region = [{first_row}, {rows}, {from}, {to}]\n\n[batches.path]\nshape = \"raster\"\n\
         amplitude_deg = [2.2, 1.2]\nlines = 30\nflyback = 0.1\n\n[[batches.calibration]]\nbatches = 2\n"
    )
}
