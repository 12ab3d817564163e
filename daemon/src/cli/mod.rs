//! The command line `raysweep`: what it takes, whom it asks, how it ends.

mod calibration;
mod devices;
mod exit;
mod failure;
mod follow;
mod manuals;
mod preview;
mod printer;
mod resume;
mod sessions;
mod show;
mod view;

use crate::arguments::memory_size;
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use bytesize::ByteSize;
use clap::{Parser, Subcommand};
use raysweep_drivers::mirror::{self, Parked};
use raysweep_proto::{
    Client, ClientError, DesignParams, Empty, ErrorCode, Event, RpcError, RunParams, RunState, Started,
};
use serde_json::json;

use self::calibration::CalibrationCommand;
use self::devices::CameraCommand;
use self::exit::Exit;
use self::failure::CommandFailure;
use self::follow::{Interrupts, OnInterrupt, follow};
use self::printer::Printer;
use self::sessions::{Compared, SessionFilter, SessionView};
use self::view::EventView;
use raysweep_processing::{Asked, ExportScope, ProcessError, copy_acquired, export, process_asked};
use raysweep_session::Session;
use raysweep_session::integrity::Audit;
use raysweep_session::ledger::Remark;

/// Where the packaged daemon listens.
const DEFAULT_SOCKET: &str = "/run/raysweep/raysweepd.sock";

const EXIT_CODES: &str = "\
Exit codes:
  0  done; a run is complete
  1  failed; a run has faulted
  2  wrong usage, or a file that cannot be read
  3  a run was cancelled, is incomplete, or was left running by a second Ctrl-C
  4  the daemon cannot be reached, or the connection was lost
  5  the daemon refused: forbidden, busy, no such run or session, invalid plan";

/// Controls raysweepd: checks and runs plans, follows runs, and processes sessions.
#[derive(Debug, Parser)]
#[command(name = "raysweep", version, after_help = EXIT_CODES)]
struct Arguments {
    /// The daemon's socket [default: $RAYSWEEP_SOCKET, else /run/raysweep/raysweepd.sock]
    #[arg(long, global = true, value_name = "PATH")]
    socket: Option<PathBuf>,
    /// Print JSON, one line for each result, event or error
    #[arg(long, global = true)]
    json: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Show what the daemon is doing
    Status,
    /// List the daemon's methods; with --json, including their schemas
    Describe,
    /// List the cameras that respond; needs no daemon
    Devices,
    /// Save and restore a camera's settings; needs no daemon
    #[command(subcommand)]
    Camera(CameraCommand),
    /// Show what a plan would do, without moving anything
    Check {
        /// The plan, a TOML file
        plan: PathBuf,
    },
    /// Print a plan whose settings are the best found for a wanted error or a time of light
    Design {
        /// A plan of kind "sweep" or "film", a TOML file: its ranges of delays and exposures are kept
        plan: PathBuf,
        /// Wanted median relative error of the light transport, such as 0.03: the shortest plan is sought
        #[arg(long, value_name = "ERROR", required_unless_present = "light")]
        error: Option<f64>,
        /// Time of light for the settings, or for one cycle of a film, such as 2s or 250ms: the best plan is sought
        #[arg(long, value_name = "TIME", conflicts_with = "error", value_parser = seconds)]
        light: Option<f64>,
        /// How well the edges of single frames are known in time, as a standard deviation in microseconds [default: 0.5]
        #[arg(long, value_name = "US")]
        edge_us: Option<f64>,
    },
    /// Run a plan and follow the run; Ctrl-C cancels it, a second Ctrl-C exits without waiting for its end
    Run(RunArguments),
    /// Calibrate the rig from a white board, and follow the run as `run` does
    Calibrate {
        /// A plan of kind "calibration" [default: one with nothing but its kind]
        #[arg(long, value_name = "FILE")]
        plan: Option<PathBuf>,
        #[command(flatten)]
        about: RunDescription,
    },
    /// Show, list, choose and compare calibrations
    #[command(subcommand)]
    Calibration(CalibrationCommand),
    /// Acquire the missing points of a session, and follow the run as `run` does
    Resume {
        /// The session's folder, or its name within the daemon's data folder
        #[arg(required_unless_present = "auto")]
        session: Option<PathBuf>,
        /// Resume the newest session if a crash or a power failure cut it off and its rig file has `auto_resume = true`:
        /// the service does this when it starts
        #[arg(long, conflicts_with = "session")]
        auto: bool,
        /// Return at once instead of following the run
        #[arg(long)]
        detach: bool,
    },
    /// Follow the run in progress to its end; Ctrl-C stops following
    Watch,
    /// Write the live images as a picture: epipolar light on the left, indirect light on the right; on a dot rig the newest
    /// batch under all dots
    Preview {
        /// The PNG file to write
        #[arg(long, value_name = "FILE", default_value = "preview.png")]
        output: PathBuf,
        /// Write the picture again for each new estimate, until the end of the run
        #[arg(long)]
        follow: bool,
    },
    /// Pause the run before its next point
    Pause,
    /// Continue a paused run
    Continue,
    /// Cancel the run; what was acquired is kept
    Cancel,
    /// Permit light until the next boot, on a rig with a mirror but no interlock
    ArmLight,
    /// Turn off the light and park the mirror after a daemon has crashed; needs no daemon
    Park {
        /// The mirror's state file, in the daemon's data folder
        #[arg(long, value_name = "FILE", default_value = crate::mirror::DEFAULT_STATE)]
        state: PathBuf,
        /// Park when standard input is closed: raysweepd starts its guardian process like this
        #[arg(long)]
        when_closed: bool,
        /// Print nothing if no mirror was ever moved
        #[arg(long)]
        if_moved: bool,
    },
    /// List the daemon's sessions, oldest first
    Sessions(SessionFilter),
    /// Show a session on one screen: settings, counts, findings, remarks and files
    Show {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
    },
    /// Compare two sessions: settings, calibration, counts and products
    Diff {
        /// The first session's folder or name
        a: PathBuf,
        /// The second session's folder or name
        b: PathBuf,
        /// Also draw a product of the first, of the second and their difference, side by side, as this PNG file
        #[arg(long, value_name = "FILE")]
        picture: Option<PathBuf>,
        /// The product to draw
        #[arg(long, value_name = "NAME", default_value = "epipolar", requires = "picture")]
        product: String,
    },
    /// Run the plan of a session again with the same metadata, say what has changed since, and follow the run as `run` does
    Rerun {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
        /// Return at once instead of following the run
        #[arg(long)]
        detach: bool,
    },
    /// Add a dated remark to a session's ledger, where nothing is ever changed
    Note {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
        /// The remark
        text: String,
        /// Who says it
        #[arg(long, value_name = "NAME")]
        by: Option<String>,
    },
    /// Move a session to the folder .trash beside it, from which `restore` brings it back
    Trash {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
        /// Delete it instead; nothing brings it back
        #[arg(long)]
        for_good: bool,
    },
    /// Move a session back from the folder .trash
    Restore {
        /// The session's folder in .trash
        session: PathBuf,
    },
    /// Make a session's products and report again from its stored data; needs no daemon, unless the session is given by
    /// its name
    Process {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
        /// Make them in this new folder, and leave those of the session as they are
        #[arg(long, value_name = "DIR")]
        to: Option<PathBuf>,
        /// Also make this product, a `[[product]]` in one line: 'kind = "epipolar", width_rows = 5'; may be repeated
        #[arg(long = "product", value_name = "KEYS")]
        products: Vec<String>,
        /// Make only these products, not the plan's
        #[arg(long, requires = "products")]
        only: bool,
        /// Memory limit for the results, such as 2GB; larger sweeps are solved in strips of camera rows [default: the free
        /// memory]
        #[arg(long, value_name = "SIZE", value_parser = memory_size)]
        memory: Option<ByteSize>,
        /// Go on if something of the session is damaged: without it, which report, products and manifest then say
        #[arg(long)]
        accept_damage: bool,
        /// Take plan.toml and rig.toml as they are now, although they are not as the session was begun with
        #[arg(long)]
        accept_edits: bool,
    },
    /// Check all checksums of a session, and list what is damaged; needs no daemon, unless the session is given by its name
    Verify {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
    },
    /// Write manual pages and shell completions of all programs, for packages
    #[command(hide = true)]
    Manuals {
        /// The folder to create
        folder: PathBuf,
    },
    /// Copy a session's products, report and manifest; needs no daemon, unless the session is given by its name
    Export {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
        /// The folder to create [default: the session's name with `-export`, in the current folder]
        #[arg(long, value_name = "DIR")]
        to: Option<PathBuf>,
        /// Also copy its arrays: the images that the camera took, and the light transport
        #[arg(long)]
        stack: bool,
        /// Copy the files even if some are damaged
        #[arg(long)]
        accept_damage: bool,
    },
}

#[derive(Debug, clap::Args)]
struct RunArguments {
    /// The plan, a TOML file
    plan: PathBuf,
    #[command(flatten)]
    about: RunDescription,
}

#[derive(Debug, clap::Args)]
struct RunDescription {
    /// Return at once instead of following the run
    #[arg(long)]
    detach: bool,
    /// Name of the operator
    #[arg(long)]
    operator: Option<String>,
    /// Name of the sample
    #[arg(long)]
    sample: Option<String>,
    /// Any other remark
    #[arg(long)]
    note: Option<String>,
    /// A tag to find the session by; may be repeated
    #[arg(long = "tag", value_name = "TAG")]
    tags: Vec<String>,
}

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
    let Arguments { socket, json, command } = arguments;
    let socket = socket_path(socket, std::env::var_os("RAYSWEEP_SOCKET"));
    let connect = || Client::connect(&socket);
    let printer = Printer { json };
    match command {
        Command::Status => printer.print(&connect()?.status()?, show::status)?,
        Command::Describe => printer.print(&connect()?.describe()?, show::description)?,
        Command::Devices => return devices::devices(printer),
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
            // The daemon's working directory is another: what exists here is named in full.
            let session = fs::canonicalize(&session).unwrap_or(session);
            return begin_run(&socket, printer, detach, |client| Ok(client.resume(&session)?));
        }
        Command::Watch => return watch(&socket, printer),
        Command::Preview { output, follow } => {
            return preview::preview(&socket, &output, follow, printer);
        }
        Command::Pause => {
            connect()?.pause()?;
            printer.print(&Empty {}, |_| {
                "the run pauses before its next point; `raysweep continue` continues it".into()
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
        Command::Park { state, if_moved: true, .. } if !state.exists() => {}
        Command::Park { state, when_closed, .. } => {
            let is_there = state.exists();
            let parked = if when_closed {
                mirror::park_when_closed(io::stdin(), &state)?
            } else {
                mirror::park(&state)?
            };
            match parked {
                // Exit code 0, because a service also parks after runs of a rig without a mirror.
                Parked::Already if !is_there && !when_closed => {
                    printer.print(&show::nothing_parked_name(), |_| show::nothing_parked(&state))?;
                }
                parked => printer.print(&show::parked_name(parked), |_| show::parked(parked))?,
            }
        }
        Command::Sessions(filter) => {
            let mut listed = connect()?.sessions()?;
            listed.retain(|session| filter.keeps(session));
            printer.print(&listed, |sessions| show::sessions(sessions))?;
        }
        Command::Show { session } => {
            printer.print(&SessionView::read(&folder_of(session, &socket))?, SessionView::text)?;
        }
        Command::Diff { a, b, picture, product } => {
            let (a, b) = (folder_of(a, &socket), folder_of(b, &socket));
            if let Some(path) = picture {
                let png = sessions::picture_of_difference([&a, &b], &product)?;
                fs::write(&path, png).map_err(|source| CommandFailure::Write { path, source })?;
            }
            printer.print(&Compared::read([&a, &b])?, Compared::text)?;
        }
        Command::Rerun { session, detach } => {
            return rerun(&socket, printer, &folder_of(session, &socket), detach);
        }
        Command::Note { session, text, by } => {
            if text.trim().is_empty() {
                return Err(CommandFailure::Sessions("the remark is empty: say something".into()));
            }
            let remark = Remark { at: jiff::Timestamp::now(), by, text };
            let noted =
                Session::open(&folder_of(session, &socket)).and_then(|session| session.note(remark.clone()));
            noted.map_err(ProcessError::from)?;
            printer.print(&remark, |_| "noted".into())?;
        }
        Command::Trash { session, for_good } => {
            let session = Session::open(&folder_of(session, &socket)).map_err(ProcessError::from)?;
            let dir = session.dir().to_owned();
            match for_good {
                true => {
                    session.delete_for_good().map_err(ProcessError::from)?;
                    printer.print(&json!({ "deleted": dir }), |_| format!("{} is deleted", dir.display()))?;
                }
                false => {
                    let to = session.trash().map_err(ProcessError::from)?;
                    let said = format!("moved to {0}; `raysweep restore {0}` brings it back", to.display());
                    printer.print(&json!({ "moved_to": to }), |_| said)?;
                }
            }
        }
        Command::Restore { session } => {
            let to =
                Session::open(&session).and_then(|session| session.restore()).map_err(ProcessError::from)?;
            printer.print(&json!({ "moved_to": to }), |_| format!("moved to {}", to.display()))?;
        }
        Command::Process { session, to, products, only, memory, accept_damage, accept_edits } => {
            let session = folder_of(session, &socket);
            if let Some(to) = &to {
                copy_acquired(&session, to)?;
            }
            let session = to.unwrap_or(session);
            let memory_limit_bytes = memory.map(|size| size.as_u64());
            let asked = Asked { products, only, memory_limit_bytes, accept_damage, accept_edits };
            let made = process_asked(&session, &asked)?;
            let value = json!({
                "report": made.report, "stored": made.stored, "points": made.points, "problems": made.problems,
            });
            printer.print(&value, |_| show::processed(&made))?;
        }
        Command::Verify { session } => return verify(&folder_of(session, &socket), printer),
        Command::Manuals { folder } => {
            manuals::write(&folder).map_err(|source| CommandFailure::Write { path: folder, source })?;
        }
        Command::Export { session, to, stack, accept_damage } => {
            let session = folder_of(session, &socket);
            let to = to.unwrap_or_else(|| export_folder(&session));
            let scope = if stack { ExportScope::ResultsAndArrays } else { ExportScope::Results };
            let files = export(&session, &to, accept_damage, scope)?;
            let value = json!({ "folder": to, "files": files });
            printer.print(&value, |_| format!("{files} files copied to {}", to.display()))?;
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

/// Runs a plan, given by its path and its text.
fn run(
    socket: &Path,
    printer: Printer,
    path: &Path,
    text: &str,
    about: RunDescription,
) -> Result<Exit, CommandFailure> {
    let RunDescription { detach, operator, sample, note, tags } = about;
    let params = RunParams { plan: text.to_owned(), operator, sample, note, tags };
    begin_run(socket, printer, detach, |client| {
        client.run(&params).map_err(|error| CommandFailure::of_plan(error, path, text))
    })
}

/// Runs the plan of a session again, and says what has changed since.
fn rerun(socket: &Path, printer: Printer, session: &Path, detach: bool) -> Result<Exit, CommandFailure> {
    let params = sessions::run_again(session)?;
    let plan = session.join("plan.toml");
    begin_run(socket, printer, detach, |client| {
        let started =
            client.run(&params).map_err(|error| CommandFailure::of_plan(error, &plan, &params.plan))?;
        let said = match sessions::changes(session, &started.session) {
            Ok(changes) if changes.is_empty() => "nothing on the rig has changed since".into(),
            Ok(changes) => format!("changed since: {}", changes.join("\n               ")),
            // The run goes on all the same.
            Err(failure) => format!("what has changed since is not known: {failure}"),
        };
        eprintln!("{said}");
        Ok(started)
    })
}

/// Begins a run and follows it, unless it is to be left alone.
fn begin_run(
    socket: &Path,
    printer: Printer,
    detach: bool,
    begin: impl FnOnce(&mut Client) -> Result<Started, CommandFailure>,
) -> Result<Exit, CommandFailure> {
    let mut client = Client::connect(socket)?;
    if detach {
        let started = begin(&mut client)?;
        printer.print(&started, |started| format!("session: {}", started.session.display()))?;
        return Ok(Exit::Done);
    }
    // Before the run begins, so that none of its events is missed, and no Ctrl-C ends us with the run unattended.
    let events = Client::connect(socket)?.subscribe()?;
    let interrupts = Interrupts::new().map_err(CommandFailure::Signals)?;
    let Started { session } = begin(&mut client)?;
    follow(events, &session, interrupts, EventView::new(printer.json), OnInterrupt::Cancel(client))
}

fn watch(socket: &Path, printer: Printer) -> Result<Exit, CommandFailure> {
    let events = Client::connect(socket)?.subscribe()?;
    let interrupts = Interrupts::new().map_err(CommandFailure::Signals)?;
    let status = Client::connect(socket)?.status()?;
    let under_way = !matches!(status.state, RunState::Idle | RunState::Faulted);
    let Some(session) = status.session.filter(|_| under_way) else {
        let message = "no run in progress; `raysweep sessions` lists earlier runs";
        return Err(ClientError::Rpc(RpcError::new(ErrorCode::NotRunning, message)).into());
    };
    let mut view = EventView::new(printer.json);
    // What was said before anybody watched.
    let state = Event::State { state: status.state, session: Some(session.clone()) };
    let said =
        [Some(state), status.progress.map(Event::Progress), status.question.map(|text| Event::Ask { text })];
    for event in said.into_iter().flatten() {
        view.show(&event).map_err(CommandFailure::Output)?;
    }
    follow(events, &session, interrupts, view, OnInterrupt::Leave)
}

fn socket_path(argument: Option<PathBuf>, variable: Option<OsString>) -> PathBuf {
    let variable = variable.filter(|value| !value.is_empty()).map(PathBuf::from);
    argument.or(variable).unwrap_or_else(|| DEFAULT_SOCKET.into())
}

/// A time with its unit, `s` or `ms`, in seconds.
fn seconds(text: &str) -> Result<f64, String> {
    let (number, unit_s) = match (text.strip_suffix("ms"), text.strip_suffix('s')) {
        (Some(number), _) => (number, 1e-3),
        (None, Some(number)) => (number, 1.0),
        (None, None) => return Err("give a number and its unit, s or ms".into()),
    };
    number.trim().parse::<f64>().map(|number| number * unit_s).map_err(|error| error.to_string())
}

fn read_plan(path: &Path) -> Result<String, CommandFailure> {
    fs::read_to_string(path).map_err(|source| CommandFailure::File { path: path.to_owned(), source })
}

/// The folder of a session, which is given by its folder, or by its name in the data folder of the daemon, if that answers.
fn folder_of(given: PathBuf, socket: &Path) -> PathBuf {
    if given.exists() || given.components().count() != 1 {
        return given;
    }
    let listed = Client::connect(socket).and_then(|mut client| client.sessions()).unwrap_or_default();
    let named = listed.into_iter().find(|info| info.session.file_name() == Some(given.as_os_str()));
    named.map_or(given, |info| info.session)
}

fn export_folder(session: &Path) -> PathBuf {
    let session = fs::canonicalize(session).unwrap_or_else(|_| session.to_owned());
    let mut name = session.file_name().unwrap_or_default().to_owned();
    name.push("-export");
    name.into()
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_arguments_are_consistent_and_help_states_every_exit_code() {
        Arguments::command().debug_assert();
        let help = Arguments::command().render_help().to_string();
        for exit in
            [Exit::Done, Exit::Failed, Exit::Usage, Exit::Incomplete, Exit::Unreachable, Exit::Refused]
        {
            assert!(help.contains(&format!("\n  {}  ", exit as u8)), "{exit:?} in\n{help}");
        }
    }

    #[test]
    fn times_have_units() {
        assert_eq!((seconds("2s"), seconds("250 ms")), (Ok(2.0), Ok(0.25)));
        assert!(seconds("2").is_err() && seconds("s").is_err());
    }

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
