//! `raysweep setup`: from connected devices to a first rig file. Moves no mirror and turns no light on.

mod camera;
mod dots;
mod found;
mod plane;
mod questions;
mod text;

use std::fs;
use std::path::{Path, PathBuf};

use raysweep_config::rig::AnyRigFile;
use raysweep_config::{ConfigError, Plan};
use raysweep_drivers::search::ask;
use raysweep_processing::ProcessError;
use raysweep_session::durable;
use serde_json::json;

use self::found::{ConnectedDevices, answer_text};
use self::questions::{AnswerChoice, Questions};
use super::exit::Exit;
use super::failure::CommandFailure;
use super::printer::{Printer, printable};

/// A first sweep: the paper's settings with few frames each, so that something is seen soon. Fewer settings do not tell
/// the pixel's own row from the rows beside it, and reach less of the light.
const FIRST_SWEEP: &str = "\
# A first look, written by `raysweep setup`; `raysweep expose` fits exposures and frames to the scene.
kind = \"sweep\"
name = \"first look\"

[sweep]
delay_us = { start = -1500, stop = 1500, count = 15 }
exposure_us = { start = 600, stop = 1200, count = 5 }
average = 2
";

/// What is written, and where.
pub struct SetupFiles<'a> {
    pub answers: Option<&'a Path>,
    pub rig: &'a Path,
    pub plan: &'a Path,
    /// Whether existing files are replaced.
    pub force: bool,
}

/// Finds what is connected, asks for the rest, and writes a rig file and a first plan.
pub fn setup(files: &SetupFiles<'_>, printer: Printer) -> Result<Exit, CommandFailure> {
    let SetupFiles { answers, rig, plan, force } = *files;
    // Before anything is asked: answers should not be lost.
    may_write([rig, plan], force)?;
    let is_replaced = |answers: &&Path| {
        let itself = fs::canonicalize(answers).ok();
        itself.is_some() && [rig, plan].into_iter().any(|path| fs::canonicalize(path).ok() == itself)
    };
    if let Some(answers) = answers.filter(is_replaced) {
        let message =
            format!("{}: it has the answers, and is not replaced: give another name", answers.display());
        return Err(CommandFailure::Setup(message));
    }
    let mut questions = Questions::of(answers)?;
    let mut connected = ConnectedDevices::search();
    let is_spoken = !printer.json;
    if is_spoken {
        println!("{}", printable(&connected.text()));
    }
    ask_ports(&mut questions, &mut connected, is_spoken)?;
    let kinds = [
        AnswerChoice::new("plane", "a raster projector and a rolling-shutter camera"),
        AnswerChoice::new("dots", "a MEMS mirror that moves a dot, and a fast camera"),
    ];
    let kind = questions.choose("kind", "Which kind of rig?", &kinds, &[], Some("plane"))?;
    let (rig_text, plan_text) = match kind.as_str() {
        "dots" => dots::ask(&mut questions, &connected)?,
        _ => (plane::ask(&mut questions, &connected, folder_of(rig))?, FIRST_SWEEP.to_owned()),
    };
    questions.finish()?;
    check(rig, &rig_text, AnyRigFile::parse(&rig_text).map(drop))?;
    check(plan, &plan_text, Plan::parse(&plan_text).map(drop))?;
    // They may have been made while the questions were asked.
    may_write([rig, plan], force)?;
    durable::write_all(&[(rig, rig_text.as_bytes()), (plan, plan_text.as_bytes())])
        .map_err(ProcessError::from)?;
    let value =
        json!({ "rig": rig.to_string_lossy(), "plan": plan.to_string_lossy(), "connected": connected });
    // The shell empties the file that it writes to before the plan is read.
    let fitted = if plan.ends_with("plan.toml") { "fitted-plan.toml" } else { "plan.toml" };
    printer.print(&value, |_| {
        format!(
            "written: {0} and {1}\nnext: `raysweep doctor --rig {0}`; then start the daemon with it, focus with `raysweep viewfinder`, {2}",
            rig.display(),
            plan.display(),
            match kind.as_str() {
                "plane" => format!(
                    "align with `raysweep viewfinder --picture align --board`, `raysweep calibrate`, `raysweep expose {} > {fitted}`, and `raysweep run {fitted}`",
                    plan.display()
                ),
                _ => format!("and `raysweep run {}`", plan.display()),
            }
        )
    })?;
    Ok(Exit::Done)
}

/// Asks the ports that the operator agrees to what is connected there.
fn ask_ports(
    questions: &mut Questions,
    connected: &mut ConnectedDevices,
    is_spoken: bool,
) -> Result<(), CommandFailure> {
    let ports: Vec<PathBuf> = connected.serial_ports.iter().map(|port| port.path.clone()).collect();
    let chosen = questions.ports(
        "ask_ports",
        "Ask serial ports for mirror controllers and triggerboxes? That resets some boards, may confuse other devices, and may switch on for a moment what a port's control lines enable, such as a laser: name only ports whose device you know to be one of these",
        &ports,
    )?;
    for port in chosen {
        let answer = ask(&port);
        if is_spoken {
            let said = format!("{}: {}", port.display(), answer_text(answer.as_ref()));
            println!("{}", printable(&said));
        }
        connected.answering.push((port, answer));
    }
    Ok(())
}

/// Holds a text against the rules of its file: what was asked for may not go together.
fn check(path: &Path, text: &str, parsed: Result<(), ConfigError>) -> Result<(), CommandFailure> {
    parsed.map_err(|error| {
        let shown = error.render(&path.display().to_string(), text);
        CommandFailure::Setup(format!("the answers do not go together; nothing is written:\n{shown}"))
    })
}

fn folder_of(file: &Path) -> &Path {
    file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Refuses files that must not be written. What is no regular file would be replaced by one, even a device.
fn may_write(files: [&Path; 2], force: bool) -> Result<(), CommandFailure> {
    let refused = |what: String| Err(CommandFailure::Setup(what));
    for path in files {
        let shown = path.display();
        match fs::symlink_metadata(path) {
            Ok(found) if !found.is_file() => {
                return refused(format!(
                    "{shown} is not a regular file: name another one with --rig or --plan"
                ));
            }
            Ok(_) if !force => {
                return refused(format!(
                    "{shown} is there already: name another file with --rig or --plan, or replace it with --force"
                ));
            }
            _ => {}
        }
    }
    // Both may be new, so only their folders can be looked up.
    let [rig, plan] = files.map(|path| {
        let folder = folder_of(path);
        (fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned()), path.file_name())
    });
    match rig == plan {
        true => refused(format!(
            "--rig and --plan both name {}: give two files, one for each",
            files[0].display()
        )),
        false => Ok(()),
    }
}
