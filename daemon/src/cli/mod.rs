//! The command line `raysweep`: what it takes, whom it asks, how it ends.

mod devices;
mod exit;
mod failure;
mod follow;
mod preview;
mod printer;
mod show;
mod view;

use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use bytesize::ByteSize;
use clap::{Parser, Subcommand};
use raysweep_drivers::mirror;
use raysweep_proto::{Client, ClientError, Empty, ErrorCode, Event, RpcError, RunParams, RunState, Started};
use serde_json::json;

use self::devices::CameraCommand;
use self::exit::Exit;
use self::failure::CommandFailure;
use self::follow::{Interrupts, OnInterrupt, follow};
use self::printer::Printer;
use self::view::EventView;
use raysweep_processing::{Asked, export, process_asked};

/// Where the packaged daemon listens.
const DEFAULT_SOCKET: &str = "/run/raysweep/raysweepd.sock";

const EXIT_CODES: &str = "\
Exit codes:
  0  done; a run is complete
  1  failed; a run has faulted
  2  wrong usage, or a file that cannot be read
  3  a run was cancelled, is incomplete, or was left running by a second Ctrl-C
  4  no daemon can be reached, or it went away
  5  the daemon refused: forbidden, busy, no such run or session, invalid plan";

/// Asks raysweepd for sweeps of light transport and follows them.
#[derive(Debug, Parser)]
#[command(name = "raysweep", version, after_help = EXIT_CODES)]
struct Arguments {
    /// The daemon's socket [default: $RAYSWEEP_SOCKET, else /run/raysweep/raysweepd.sock]
    #[arg(long, global = true, value_name = "PATH")]
    socket: Option<PathBuf>,
    /// Print JSON: one line a result, an event, or an error
    #[arg(long, global = true)]
    json: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Say what the daemon is doing
    Status,
    /// List what can be asked of the daemon; with --json, with schemas
    Describe,
    /// List the cameras that answer; needs no daemon
    Devices,
    /// Save and restore what a camera is set to; needs no daemon
    #[command(subcommand)]
    Camera(CameraCommand),
    /// Say what a plan would do; nothing moves
    Check {
        /// The plan, a TOML file
        plan: PathBuf,
    },
    /// Run a plan and follow the run; Ctrl-C cancels it, a second Ctrl-C leaves it to the daemon
    Run(RunArguments),
    /// Acquire the points that a session lacks, and follow the run as `run` does
    Resume {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
        /// Do not wait for the end
        #[arg(long)]
        detach: bool,
    },
    /// Follow the run that is under way to its end; Ctrl-C stops watching
    Watch,
    /// Write the running estimate as a picture: epipolar light on the left, indirect light on the right
    Preview {
        /// The PNG file to write
        #[arg(long, value_name = "FILE", default_value = "preview.png")]
        output: PathBuf,
        /// Write it again whenever the estimate is newer, to the end of the run
        #[arg(long)]
        follow: bool,
    },
    /// Hold the run before its next point
    Pause,
    /// Go on with a run that is held
    Continue,
    /// End the run in order; what was acquired is kept
    Cancel,
    /// Permit a mirror's light until the next boot, on a rig without an interlock
    ArmLight,
    /// Take a mirror that a daemon has left behind to the origin, light off first; needs no daemon
    Park {
        /// The mirror's state, in the daemon's data folder
        #[arg(long, value_name = "FILE", default_value = crate::mirror::DEFAULT_STATE)]
        state: PathBuf,
        /// Wait until standard input is closed: how a daemon's guardian outlives it
        #[arg(long)]
        when_closed: bool,
    },
    /// List the daemon's sessions, oldest first
    Sessions,
    /// Make a session's products and report again from what is stored; needs no daemon
    Process {
        /// The session's folder
        session: PathBuf,
        /// Make this too, a `[[product]]` in one line: 'kind = "epipolar", width_rows = 5'; may be given several times
        #[arg(long = "product", value_name = "KEYS")]
        products: Vec<String>,
        /// Make the given products only, not the plan's
        #[arg(long, requires = "products")]
        only: bool,
        /// Take no more memory than this for the results, such as 2GB: larger sweeps are solved some camera rows at a time
        /// [default: what is free]
        #[arg(long, value_name = "SIZE")]
        memory: Option<ByteSize>,
    },
    /// Copy a session's products, report and manifest; needs no daemon
    Export {
        /// The session's folder
        session: PathBuf,
        /// The folder to make [default: SESSION's name with `-export`, here]
        #[arg(long, value_name = "DIR")]
        to: Option<PathBuf>,
    },
}

#[derive(Debug, clap::Args)]
struct RunArguments {
    /// The plan, a TOML file
    plan: PathBuf,
    /// Do not wait for the end
    #[arg(long)]
    detach: bool,
    /// Who runs it
    #[arg(long)]
    operator: Option<String>,
    /// What stands before the camera
    #[arg(long)]
    sample: Option<String>,
    /// Anything else
    #[arg(long)]
    note: Option<String>,
    /// A word to find the session by; may be given several times
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
        Command::Run(RunArguments { plan, detach, operator, sample, note, tags }) => {
            let text = read_plan(&plan)?;
            let params = RunParams { plan: text.clone(), operator, sample, note, tags };
            let begin = |client: &mut Client| {
                client.run(&params).map_err(|error| CommandFailure::of_plan(error, &plan, &text))
            };
            return begin_run(&socket, printer, detach, begin);
        }
        Command::Resume { session, detach } => {
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
                "the run is held before its next point; `raysweep continue` goes on".into()
            })?;
        }
        Command::Continue => {
            connect()?.go_on()?;
            printer.print(&Empty {}, |_| "the run goes on".into())?;
        }
        Command::Cancel => {
            connect()?.cancel()?;
            printer.print(&Empty {}, |_| "the run is being ended; what was acquired is kept".into())?;
        }
        Command::ArmLight => {
            connect()?.arm_light()?;
            printer.print(&Empty {}, |_| "light is permitted until the next boot".into())?;
        }
        Command::Park { state, when_closed } => {
            let parked = if when_closed {
                mirror::park_when_closed(io::stdin(), &state)?
            } else {
                mirror::park(&state)?
            };
            printer.print(&show::parked_name(parked), |_| show::parked(parked))?;
        }
        Command::Sessions => printer.print(&connect()?.sessions()?, |sessions| show::sessions(sessions))?,
        Command::Process { session, products, only, memory } => {
            let memory_limit_bytes = memory.map(|size| size.as_u64());
            let made = process_asked(&session, &Asked { products, only, memory_limit_bytes })?;
            let value = json!({
                "report": made.report, "stored": made.stored, "points": made.points, "problems": made.problems,
            });
            printer.print(&value, |_| show::processed(&made))?;
        }
        Command::Export { session, to } => {
            let to = to.unwrap_or_else(|| export_folder(&session));
            let files = export(&session, &to)?;
            let value = json!({ "folder": to, "files": files });
            printer.print(&value, |_| format!("{files} files copied to {}", to.display()))?;
        }
    }
    Ok(Exit::Done)
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
        let message = "no run is under way; `raysweep sessions` lists those that were";
        return Err(ClientError::Rpc(RpcError::new(ErrorCode::NotRunning, message)).into());
    };
    let mut view = EventView::new(printer.json);
    if let Some(text) = status.question {
        // Asked before anybody watched.
        view.show(&Event::Ask { text }).map_err(CommandFailure::Output)?;
    }
    follow(events, &session, interrupts, view, OnInterrupt::Leave)
}

fn socket_path(argument: Option<PathBuf>, variable: Option<OsString>) -> PathBuf {
    let variable = variable.filter(|value| !value.is_empty()).map(PathBuf::from);
    argument.or(variable).unwrap_or_else(|| DEFAULT_SOCKET.into())
}

fn read_plan(path: &Path) -> Result<String, CommandFailure> {
    fs::read_to_string(path).map_err(|source| CommandFailure::File { path: path.to_owned(), source })
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
