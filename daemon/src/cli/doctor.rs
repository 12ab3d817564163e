//! `raysweep doctor`: by the daemon, or without one.

use std::path::Path;

use raysweep_proto::{Client, DoctorCheck, DoctorParams, DoctorReport, Grade};

use super::exit::Exit;
use super::failure::CommandFailure;
use super::plan_file::read_plan;
use super::printer::Printer;
use crate::doctor::examine;
use crate::rig::AnyRig;

/// Has the daemon examine its rig.
pub(super) fn by_daemon(
    socket: &Path,
    plan: Option<&Path>,
    printer: Printer,
) -> Result<Exit, CommandFailure> {
    let text = plan.map(read_plan).transpose()?;
    let mut client = Client::connect(socket)?;
    let examined = client.doctor(&DoctorParams { plan: text.clone() });
    let report = examined.map_err(|error| match (plan, &text) {
        (Some(path), Some(text)) => CommandFailure::of_plan(error, path, text),
        _ => error.into(),
    })?;
    print(&report, printer)
}

/// Examines the rig of a rig file.
pub(super) fn by_hand(rig: &Path, data: &Path, printer: Printer) -> Result<Exit, CommandFailure> {
    let rig = AnyRig::load(rig)?;
    print(&examine(&rig.into(), data, None, &|| true), printer)
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
        (0, 0) => "nothing is wrong".into(),
        (failures, warnings) => format!("{}, {}", counted(failures, "failure"), counted(warnings, "warning")),
    });
    lines.join("\n")
}

fn counted(count: usize, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}
