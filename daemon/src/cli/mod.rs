//! The command line `raysweep`: what it takes, whom it asks, how it ends.

mod arguments;
#[cfg(feature = "view")]
mod browser;
mod calibration;
mod compare;
mod devices;
mod doctor;
mod exit;
mod expose;
mod failure;
mod finder_text;
mod folders;
mod follow;
mod manuals;
mod materials;
mod picture_file;
mod plan_file;
mod preview;
mod printer;
mod relit;
mod resume;
mod sessions;
mod setup;
mod show;
mod thumbnails;
mod view;
mod viewfinder;
mod watch;

use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use raysweep_config::{Plan, Procedure};
use raysweep_drivers::mirror::{self, Parked};
use raysweep_proto::{Client, DesignParams, Empty, RunParams, Started};
use serde_json::json;

use self::arguments::{Arguments, Command, RunArguments, RunDescription};
use self::compare::{Compared, write_picture_of_difference};
pub use self::doctor::text as doctor_text;
use self::exit::Exit;
use self::failure::CommandFailure;
use self::folders::{folder_of, trashed_folder_of};
use self::follow::{Interrupts, OnInterrupt, follow};
use self::plan_file::read_plan;
use self::printer::{Printer, printable};
use self::sessions::SessionView;
use self::setup::{SetupFiles, setup};
use self::view::EventView;
use self::viewfinder::{Wanted, change_or_plan, runs};
use raysweep_processing::calibration::{CalibrationHeader, current_in};
use raysweep_processing::{
    Asked, ExportFormat, ExportScope, ProcessError, copy_acquired, export, export_as, process_asked,
};
use raysweep_session::Session;
use raysweep_session::integrity::Audit;
use raysweep_session::ledger::Remark;

/// Where the packaged daemon listens.
const DEFAULT_SOCKET: &str = "/run/raysweep/raysweepd.sock";

/// The command `raysweep`, from its arguments to its exit code.
pub fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let json = arguments.json;
    match execute(arguments) {
        Ok(exit) => exit.into(),
        Err(failure) => failure.report(json).into(),
    }
}

fn execute(arguments: Arguments) -> Result<Exit, CommandFailure> {
    let Arguments { socket, json, quiet, command } = arguments;
    let socket = socket_path(socket, std::env::var_os("RAYSWEEP_SOCKET"));
    let connect = || Client::connect(&socket);
    let printer = Printer { json, quiet };
    match command {
        Command::Status => printer.print(&connect()?.status()?, show::status)?,
        Command::Describe => printer.print(&connect()?.describe()?, show::description)?,
        Command::Devices => return devices::devices(printer),
        Command::Setup { answers, rig, plan, force } => {
            let files = SetupFiles { answers: answers.as_deref(), rig: &rig, plan: &plan, force };
            return setup(&files, printer);
        }
        Command::Doctor { plan, rig: None, .. } => {
            return doctor::by_daemon(&socket, plan.as_deref(), printer);
        }
        Command::Doctor { plan, rig: Some(rig), data } => {
            return doctor::by_hand(&rig, plan.as_deref(), &data, printer);
        }
        Command::Camera(command) => return devices::camera(command, printer),
        Command::Check { plan } => {
            let text = read_plan(&plan)?;
            let report =
                connect()?.check(&text).map_err(|error| CommandFailure::of_plan(error, &plan, &text))?;
            printer.print(&report, show::check)?;
        }
        Command::Design { plan, error, light, edge_us } => {
            let text = read_plan(&plan)?;
            let params = DesignParams { plan: text.clone(), error, light_s: light, edge_us };
            let report =
                connect()?.design(&params).map_err(|error| CommandFailure::of_plan(error, &plan, &text))?;
            printer.print(&report, show::design)?;
        }
        Command::Run(RunArguments { plan, about }) => {
            return run(&socket, printer, &plan, &read_plan(&plan)?, about);
        }
        Command::Calibrate { plan: Some(plan), about } => {
            return run(&socket, printer, &plan, &read_plan(&plan)?, about);
        }
        Command::Calibrate { plan: None, about } => {
            return run(&socket, printer, Path::new("calibrate"), calibration::PLAN, about);
        }
        Command::Expose { plan } => return expose::expose(&socket, &plan, printer),
        Command::Viewfinder(arguments) => match change_or_plan(&socket, &arguments)? {
            Wanted::Plan(path, text) => {
                return run(&socket, printer, &path, &text, arguments.about);
            }
            Wanted::Nothing { is_changed } => return runs(is_changed, printer),
        },
        Command::Calibration(command) => return calibration::calibration(&socket, command, printer),
        Command::Resume { session, detach, .. } => {
            let session = match session {
                Some(session) => session,
                None => match resume::cut_off(&connect()?.sessions()?)? {
                    Ok(session) => session,
                    Err(why) => {
                        printer.print(&json!({ "resumed": null, "why": why }), |_| why.clone())?;
                        return Ok(Exit::Done);
                    }
                },
            };
            let session = folder_of(session, &socket)?;
            // The daemon's working directory is another: what exists here is named in full.
            let session = fs::canonicalize(&session).unwrap_or(session);
            return begin_run(&socket, printer, detach, Interrupts::of_operator, |client| {
                Ok(client.resume(&session)?)
            });
        }
        Command::Watch => return watch::watch(&socket, printer),
        Command::Preview { output, follow } => {
            return preview::preview(&socket, &output, follow, printer);
        }
        #[cfg(feature = "view")]
        Command::View { port } => return browser::view(&socket, port, printer),
        Command::Pause => {
            connect()?.pause()?;
            printer.print(&Empty {}, |_| {
                "the run pauses before its next point, or with its mirror parked at once; `raysweep continue` continues it".into()
            })?;
        }
        Command::Continue => {
            connect()?.go_on()?;
            printer.print(&Empty {}, |_| "the run continues".into())?;
        }
        Command::Cancel => {
            connect()?.cancel()?;
            printer.print(&Empty {}, |_| "the run is being cancelled; what was acquired is kept".into())?;
        }
        Command::ArmLight => {
            connect()?.arm_light()?;
            printer.print(&Empty {}, |_| "light is permitted until the next boot".into())?;
        }
        Command::Park { state, if_moved: true, .. } if matches!(state.try_exists(), Ok(false)) => {}
        Command::Park { state, when_closed, .. } => {
            let parked = if when_closed {
                mirror::park_when_closed(io::stdin(), &state)?
            } else {
                mirror::park(&state)?
            };
            printer.print(&show::parked_name(parked), |_| show::parked(parked, &state))?;
            if parked == Parked::NeverMoved {
                return Ok(Exit::Failed);
            }
        }
        Command::Sessions(filter) => {
            let mut listed = connect()?.sessions()?;
            listed.retain(|session| filter.keeps(session));
            let fitting = listed.len();
            listed.retain(|session| filter.shows(session));
            printer.print(&listed, |sessions| show::sessions(sessions, fitting - sessions.len()))?;
        }
        Command::Show { session, thumbnails } => {
            let session = folder_of(session, &socket)?;
            let mut view = SessionView::read(&session)?;
            if let Some(folder) = thumbnails {
                let session = Session::open(&session).map_err(ProcessError::from)?;
                view.thumbnails = thumbnails::write(&session, &folder)?;
                view.check_products(&session, &thumbnails::pictures(&session))?;
            }
            printer.print(&view, SessionView::text)?;
        }
        Command::Diff { a, b, picture, product } => {
            let (a, b) = (folder_of(a, &socket)?, folder_of(b, &socket)?);
            let mut compared = Compared::read([&a, &b])?;
            if let Some(file) = picture {
                compared.picture = Some(write_picture_of_difference([&a, &b], &product, file)?);
            }
            printer.print(&compared, Compared::text)?;
        }
        Command::Rerun { session, detach } => {
            return rerun(&socket, printer, &folder_of(session, &socket)?, detach);
        }
        Command::Note { session, text, by } => {
            if text.trim().is_empty() {
                return Err(CommandFailure::Sessions("the remark is empty: say something".into()));
            }
            let remark = Remark { at: jiff::Timestamp::now(), by, text };
            let session = folder_of(session, &socket)?;
            let noted = Session::open(&session).and_then(|session| session.note(remark.clone()));
            noted.map_err(ProcessError::from)?;
            printer.print(&remark, |_| "noted".into())?;
        }
        Command::Trash { session, for_good } => {
            let session = Session::open(&folder_of(session, &socket)?).map_err(ProcessError::from)?;
            let dir = session.dir().to_owned();
            let whole = fs::canonicalize(&dir).unwrap_or_else(|_| dir.clone());
            let kept = whole.parent().map(|data| CalibrationHeader::read(&current_in(data)));
            let stays_in_use = matches!(kept, Some(Ok(Some(kept))) if kept.is_of(&whole));
            let (mut told, mut said) = match for_good {
                true => {
                    session.delete_for_good().map_err(ProcessError::from)?;
                    (json!({ "deleted": dir.to_string_lossy() }), format!("{} is deleted", dir.display()))
                }
                false => {
                    let to = session.trash().map_err(ProcessError::from)?;
                    let said = format!("moved to {0}; `raysweep restore {0}` brings it back", to.display());
                    (json!({ "moved_to": to.to_string_lossy() }), said)
                }
            };
            told["stays_in_use"] = json!(stays_in_use);
            if stays_in_use {
                said += "\nits calibration stays in use: `raysweep calibration use` chooses another one";
            }
            printer.print(&told, |_| said)?;
        }
        Command::Restore { session } => {
            let trashed = Session::open(&trashed_folder_of(session, &socket)?);
            let to = trashed.and_then(|session| session.restore()).map_err(ProcessError::from)?;
            printer.print(&json!({ "moved_to": to.to_string_lossy() }), |_| {
                format!("moved to {}", to.display())
            })?;
        }
        Command::Process { session, to, products, only, memory, accept_damage, accept_edits } => {
            let session = folder_of(session, &socket)?;
            if let Some(to) = &to {
                copy_acquired(&session, to)?;
            }
            let given = session.clone();
            let session = to.clone().unwrap_or(session);
            let memory_limit_bytes = memory.map(|size| size.as_u64());
            let asked = Asked { products, only, memory_limit_bytes, accept_damage, accept_edits };
            let made =
                process_asked(&session, &asked).map_err(|error| error.of(&given)).inspect_err(|_| {
                    // It was made for this, and the next try may want its name.
                    if let Some(made) = &to {
                        let _ = fs::remove_dir_all(made);
                    }
                })?;
            let value = json!({
                "report": made.report.to_string_lossy(), "stored": made.stored, "points": made.points, "problems": made.problems,
            });
            printer.print(&value, |_| show::processed(&made))?;
        }
        Command::Verify { session } => return verify(&folder_of(session, &socket)?, printer),
        Command::Materials(command) => materials::tell(command, |given| folder_of(given, &socket), printer)?,
        Command::Profiles { labelled, refractive_index, maps, to } => {
            let about = materials::ProfileLook { refractive_index, maps };
            materials::profiles(labelled, about, &to, |given| folder_of(given, &socket), printer)?;
        }
        Command::Relit { sweep, captures, to } => {
            relit::compare(sweep, captures, &to, |given| folder_of(given, &socket), printer)?;
        }
        Command::Manuals { folder } => {
            manuals::write(&folder).map_err(|source| CommandFailure::Write { path: folder, source })?;
        }
        Command::Export { session, to, format, stack, accept_damage } => {
            if stack && !matches!(format, None | Some(ExportFormat::Zip)) {
                return Err(CommandFailure::Sessions(STACK_WITH_FORMAT.into()));
            }
            let session = folder_of(session, &socket)?;
            let to = to.unwrap_or_else(|| export_path(&session, format));
            let scope = if stack { ExportScope::ResultsAndArrays } else { ExportScope::Results };
            let files = match format {
                Some(format) => export_as(&session, &to, accept_damage, scope, format)?,
                None => export(&session, &to, accept_damage, scope)?,
            };
            // A damaged ledger is exported too, if that is accepted.
            let state = Session::open(&session).and_then(|session| session.state()).ok();
            let unended = state.filter(|state| state.end.is_none());
            let unended = unended.map(|state| (state.stored_points(), state.session.shape.points()));
            let value =
                json!({ "folder": to.to_string_lossy(), "files": files, "is_over": unended.is_none() });
            printer.print(&value, |_| {
                let copied = format!("{files} files copied to {}", to.display());
                match unended {
                    None => copied,
                    Some((stored, points)) => format!(
                        "{copied}\nthe session's run has not ended: it is still being acquired, or was cut off; {stored} of {points} points were stored"
                    ),
                }
            })?;
        }
    }
    Ok(Exit::Done)
}

/// Checks a session.
fn verify(session: &Path, printer: Printer) -> Result<Exit, CommandFailure> {
    let (state, audit) =
        Session::open(session).and_then(|session| Audit::of(&session)).map_err(ProcessError::from)?;
    let (stored, points) = (state.stored_points(), state.session.shape.points());
    let value = json!({ "session": session, "stored": stored, "points": points, "audit": audit });
    printer.print(&value, |_| show::audit(&audit, stored, points))?;
    Ok(if audit.damage.is_empty() { Exit::Done } else { Exit::Failed })
}

/// Whether a run of this plan ends with its client: it is of no use without it, and would leave the light on.
fn ends_with_client(plan: &str) -> bool {
    Plan::parse(plan).is_ok_and(|plan| matches!(plan.procedure, Procedure::Viewfinder(_)))
}

/// How a run that is followed is left.
fn interrupts_of(params: &RunParams) -> fn() -> io::Result<Interrupts> {
    if params.attached { Interrupts::of_any_end } else { Interrupts::of_operator }
}

/// Runs a plan, given by its path and its text.
fn run(
    socket: &Path,
    printer: Printer,
    path: &Path,
    text: &str,
    about: RunDescription,
) -> Result<Exit, CommandFailure> {
    let RunDescription { detach, operator, sample, note, tags } = about;
    let attached = !detach && ends_with_client(text);
    let params = RunParams { plan: text.to_owned(), operator, sample, note, tags, attached };
    begin_run(socket, printer, detach, interrupts_of(&params), |client| {
        client.run(&params).map_err(|error| CommandFailure::of_plan(error, path, text))
    })
}

/// Runs the plan of a session again, and says what has changed since.
fn rerun(socket: &Path, printer: Printer, session: &Path, detach: bool) -> Result<Exit, CommandFailure> {
    let mut params = sessions::run_again(session)?;
    params.attached = !detach && ends_with_client(&params.plan);
    let plan = session.join("plan.toml");
    begin_run(socket, printer, detach, interrupts_of(&params), |client| {
        let started =
            client.run(&params).map_err(|error| CommandFailure::of_plan(error, &plan, &params.plan))?;
        let said = match compare::changes(session, &started.session) {
            Ok(changes) if changes.is_empty() => "nothing on the rig has changed since".into(),
            Ok(changes) => format!("changed since: {}", changes.join("\n               ")),
            // The run goes on all the same.
            Err(failure) => format!("what has changed since is not known: {failure}"),
        };
        eprintln!("{}", printable(&said));
        Ok(started)
    })
}

/// Begins a run and follows it, unless it is to be left alone.
fn begin_run(
    socket: &Path,
    printer: Printer,
    detach: bool,
    interrupts: fn() -> io::Result<Interrupts>,
    begin: impl FnOnce(&mut Client) -> Result<Started, CommandFailure>,
) -> Result<Exit, CommandFailure> {
    let mut client = Client::connect(socket)?;
    if detach {
        let started = begin(&mut client)?;
        printer.print(&started, |started| format!("session: {}", started.session.display()))?;
        return Ok(Exit::Done);
    }
    // Before the run begins, so that none of its events is missed, and no Ctrl-C ends us with the run unattended.
    let mut events = Client::connect(socket)?.subscribe()?;
    let mut interrupts = interrupts().map_err(CommandFailure::Signals)?;
    // On the connection that takes the events: what is attached to it also ends with a client that was stopped.
    let Started { session } = begin(events.client())?;
    let mut view = EventView::new(printer);
    follow(events, &session, &mut interrupts, &mut view, OnInterrupt::Cancel(client))
}

fn socket_path(argument: Option<PathBuf>, variable: Option<OsString>) -> PathBuf {
    let variable = variable.filter(|value| !value.is_empty()).map(PathBuf::from);
    argument.or(variable).unwrap_or_else(|| DEFAULT_SOCKET.into())
}

const STACK_WITH_FORMAT: &str =
    "--stack copies Zarr arrays as they are: leave --format out, or take --format zip";

/// Where a session is exported to by default.
fn export_path(session: &Path, format: Option<ExportFormat>) -> PathBuf {
    let session = fs::canonicalize(session).unwrap_or_else(|_| session.to_owned());
    let mut name = session.file_name().unwrap_or_default().to_owned();
    match format {
        None => name.push("-export"),
        Some(ExportFormat::Zip) => name.push("-export.zip"),
        Some(format) => name.push(format!("-export-{}", format.described().0)),
    }
    name.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_socket_is_the_arguments_then_the_environments_then_the_packages() {
        let path = |argument: Option<&str>, variable: Option<&str>| {
            socket_path(argument.map(PathBuf::from), variable.map(OsString::from))
        };
        assert_eq!(path(Some("a"), Some("b")), Path::new("a"));
        assert_eq!(path(None, Some("b")), Path::new("b"));
        assert_eq!(path(None, Some("")), Path::new(DEFAULT_SOCKET));
        assert_eq!(path(None, None), Path::new(DEFAULT_SOCKET));
    }
}
