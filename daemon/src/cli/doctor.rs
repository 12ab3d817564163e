//! `raysweep doctor`: by the daemon, or without one.

use std::io::ErrorKind;
use std::path::Path;

use raysweep_core::io_text;
use raysweep_proto::{Client, ClientError, DoctorCheck, DoctorParams, DoctorReport, Grade};

use super::exit::Exit;
use super::failure::CommandFailure;
use super::plan_file::read_plan;
use super::printer::Printer;
use super::show::counted;
use crate::control::Control;
use crate::doctor::{examine, user};
use crate::rig::{AnyRig, RigError};
use crate::runner::Runner;

/// Has the daemon examine its rig.
pub(super) fn by_daemon(
    socket: &Path,
    plan: Option<&Path>,
    printer: Printer,
) -> Result<Exit, CommandFailure> {
    let text = plan.map(read_plan).transpose()?;
    let mut client = Client::connect(socket)?;
    let examined = client.doctor(&DoctorParams { plan: text.clone() });
    print(&examined.map_err(|error| of_plan(error, plan, text.as_deref()))?, printer)
}

/// Examines the rig of a rig file. A plan's needs depend on the camera, so they are known only if the devices open.
pub(super) fn by_hand(
    rig: &Path,
    plan: Option<&Path>,
    data: &Path,
    printer: Printer,
) -> Result<Exit, CommandFailure> {
    let text = plan.map(read_plan).transpose()?;
    let without_plan =
        || -> Result<_, CommandFailure> { Ok(examine(&load(rig)?.into(), data, None, &|| true)) };
    let Some(plan) = plan else { return print(&without_plan()?, printer) };
    let loaded = load(rig)?;
    if matches!(loaded, AnyRig::Dots(_)) {
        let shown = plan.display();
        eprintln!(
            "{shown}: not examined: opening a mirror may move it; `raysweep doctor {shown}` asks the daemon"
        );
        return print(&without_plan()?, printer);
    }
    let opened = Runner::new(loaded, data.to_owned()).inspect_err(|error| {
        eprintln!("{}: not examined, because its needs depend on devices: {error}", plan.display());
    });
    let report = match opened {
        Ok(runner) => {
            let examined = runner.doctor(&DoctorParams { plan: text.clone() }).map_err(ClientError::Rpc);
            examined.map_err(|error| of_plan(error, Some(plan), text.as_deref()))?
        }
        Err(_) => without_plan()?,
    };
    print(&report, printer)
}

/// Loads a rig file, or says who may not read it.
fn load(rig: &Path) -> Result<AnyRig, RigError> {
    AnyRig::load(rig).map_err(|error| match error {
        RigError::Read { path, source } if source.kind() == ErrorKind::PermissionDenied => {
            RigError::Config(format!(
                "cannot read {}: {}: let `{}`, who asks, read the file and its folder",
                path.display(),
                io_text(&source),
                user()
            ))
        }
        other => other,
    })
}

fn of_plan(error: ClientError, plan: Option<&Path>, text: Option<&str>) -> CommandFailure {
    match plan.zip(text) {
        Some((path, text)) => CommandFailure::of_plan(error, path, text),
        None => error.into(),
    }
}

fn print(report: &DoctorReport, printer: Printer) -> Result<Exit, CommandFailure> {
    printer.print(report, text)?;
    Ok(if report.worst() == Grade::Failure { Exit::Failed } else { Exit::Done })
}

/// The report as a table for people.
pub fn text(report: &DoctorReport) -> String {
    let width = report.checks.iter().map(|check| check.name.len()).max().unwrap_or(0);
    let mut lines = vec![format!("examined by raysweep {} as {}", report.version, report.user)];
    for DoctorCheck { name, grade, found, remedy } in &report.checks {
        let mark = match grade {
            Grade::Ok => "OK",
            Grade::Skipped => "skipped",
            Grade::Warning => "warning",
            Grade::Failure => "FAILURE",
        };
        lines.push(format!("{mark:<8} {name:<width$}  {found}"));
        lines.extend(remedy.as_ref().map(|remedy| format!("{:<8} {:<width$}  mend: {remedy}", "", "")));
    }
    let count = |grade: Grade| report.checks.iter().filter(|check| check.grade == grade).count();
    lines.push(match (count(Grade::Failure), count(Grade::Warning)) {
        (0, 0) if count(Grade::Skipped) > 0 => {
            "nothing is wrong with what was examined; see what was skipped".into()
        }
        (0, 0) => "nothing is wrong".into(),
        (failures, warnings) => format!("{}, {}", counted(failures, "failure"), counted(warnings, "warning")),
    });
    lines.join("\n")
}
