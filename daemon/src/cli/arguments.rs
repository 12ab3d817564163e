//! What the command line `raysweep` takes.

use std::path::PathBuf;

use bytesize::ByteSize;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Parser, Subcommand};
use raysweep_config::plan::FinderTrigger;
use raysweep_core::FinderPicture;
use raysweep_processing::ExportFormat;

use super::calibration::CalibrationCommand;
use super::devices::CameraCommand;
use super::sessions::SessionFilter;
use crate::arguments::{DEFAULT_DATA, memory_size};

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
pub struct Arguments {
    /// The daemon's socket [default: $RAYSWEEP_SOCKET, else /run/raysweep/raysweepd.sock]
    #[arg(long, global = true, value_name = "PATH")]
    pub socket: Option<PathBuf>,
    /// Print JSON, one line for each result, event or error
    #[arg(long, global = true)]
    pub json: bool,
    /// Follow runs without their progress: print only questions, warnings, errors and the result
    #[arg(long, short, global = true)]
    pub quiet: bool,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Show what the daemon is doing
    Status,
    /// List the daemon's methods; with --json, including their schemas
    Describe,
    /// List the cameras that respond; needs no daemon
    Devices,
    /// Find the devices that are connected, ask what nothing else can tell, and write a rig file and a first plan. Moves no
    /// mirror, turns no light on, and asks a serial port only if you agree
    Setup {
        /// Answers for all questions, a TOML file, instead of a terminal
        #[arg(long, value_name = "FILE")]
        answers: Option<PathBuf>,
        /// The rig file to write
        #[arg(long, value_name = "FILE", default_value = "rig.toml")]
        rig: PathBuf,
        /// The plan to write
        #[arg(long, value_name = "FILE", default_value = "first-plan.toml")]
        plan: PathBuf,
        /// Replace files that are there
        #[arg(long)]
        force: bool,
    },
    /// Examine the rig and its host, as the daemon's user: devices, permissions, VSYNC, triggers, disk; say what mends
    /// what is wrong. Moves no mirror and turns no light on
    Doctor {
        /// A plan, whose needs the disk is examined for
        plan: Option<PathBuf>,
        /// Examine the rig of this rig file, without a daemon and as the user who asks
        #[arg(long, value_name = "FILE")]
        rig: Option<PathBuf>,
        /// With --rig: the folder in which the daemon would store sessions
        #[arg(long, value_name = "DIR", requires = "rig", default_value = DEFAULT_DATA)]
        data: PathBuf,
    },
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
    /// Look at the scene under white light, and print a plan whose exposures do not saturate it, with the averaging that
    /// its noise needs and what aperture or gain should do
    Expose {
        /// A plan of kind "sweep" or "film", a TOML file: no exposure is made longer than its longest
        plan: PathBuf,
    },
    /// Run a plan and follow the run; Ctrl-C cancels it, a second Ctrl-C exits without waiting for its end
    Run(RunArguments),
    /// Show live pictures for focusing, aligning and exposing until Ctrl-C, and say what they tell; while a viewfinder
    /// runs, change what it shows
    Viewfinder(ViewfinderArguments),
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
    /// Follow the run in progress to its end, across restarts of the daemon; Ctrl-C stops following
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
    /// Show the rig in a browser: live pictures, progress, sessions; serves one page on this machine until Ctrl-C
    #[cfg(feature = "view")]
    View {
        /// Port on 127.0.0.1 [default: any free one]
        #[arg(long, value_name = "PORT", default_value_t = 0, hide_default_value = true)]
        port: u16,
    },
    /// Pause the run before its next point, or with its mirror parked at once
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
    /// Show a session on one screen: settings, counts, warnings, findings, remarks and files
    Show {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
        /// Also write a small PNG file of each picture, of several the first, into this folder, and list them
        #[arg(long, value_name = "FOLDER")]
        thumbnails: Option<PathBuf>,
    },
    /// Compare two sessions: settings, calibration, counts, warnings and products
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
        /// The session's folder in .trash, or its name within the .trash of the daemon's data folder
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
    /// Tell materials in sweeps by how light spreads in them; needs no daemon, unless sessions are given by their names
    #[command(subcommand)]
    Materials(MaterialsCommand),
    /// Compare how light spreads in marked regions of sweeps: area-normalised delay profiles, widths, decay lengths
    Profiles {
        #[command(flatten)]
        labelled: LabelledArguments,
        /// Refractive index of the media, below air, for decay lengths
        #[arg(long, value_name = "N", default_value_t = 1.33)]
        refractive_index: f64,
        /// Also write maps of width, asymmetry and decay length, with their standard deviations
        #[arg(long)]
        maps: bool,
        /// The folder to create
        #[arg(long, value_name = "FOLDER")]
        to: PathBuf,
    },
    /// Relight a scene by the transport of a sweep, beside captures of it under the same pictures of rows, and tell by how
    /// much they differ; needs no daemon, unless sessions are given by name
    Relit {
        /// The sweep's folder, or its name within the daemon's data folder
        sweep: PathBuf,
        /// Sessions of kind `patterns`, with regular images under pictures of rows
        #[arg(required = true)]
        captures: Vec<PathBuf>,
        /// The folder to create, with images and pictures
        #[arg(long, value_name = "FOLDER")]
        to: PathBuf,
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
        /// The folder or archive to create [default: the session's name with `-export` and the format, in the current folder]
        #[arg(long, value_name = "PATH")]
        to: Option<PathBuf>,
        /// Products alone in the format of another program, with a README of their axes and units; `zip` archives the copy
        #[arg(long, value_parser = format_parser())]
        format: Option<ExportFormat>,
        /// Also copy its arrays: the images that the camera took, and the light transport
        #[arg(long)]
        stack: bool,
        /// Copy the files even if some are damaged
        #[arg(long)]
        accept_damage: bool,
    },
}

#[derive(Debug, Subcommand)]
pub enum MaterialsCommand {
    /// Train a model on labelled sweeps
    Train {
        #[command(flatten)]
        labelled: LabelledArguments,
        /// The file to create
        #[arg(long, value_name = "FILE")]
        to: PathBuf,
    },
    /// Find a model's materials in a sweep: a map, and a page with it
    Apply {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
        /// A file written by `materials train`
        #[arg(long, value_name = "FILE")]
        model: PathBuf,
        /// Side of the square of pixels whose mean profile is judged, odd: larger ones see through noise, and blur
        #[arg(long, value_name = "PX", default_value_t = 3)]
        window: usize,
        #[command(flatten)]
        scene: SceneScale,
        /// The folder to create
        #[arg(long, value_name = "FOLDER")]
        to: PathBuf,
    },
    /// Compare what a model finds in sweeps with their labels: confusion matrices
    Evaluate {
        #[command(flatten)]
        labelled: LabelledArguments,
        /// A file written by `materials train`
        #[arg(long, value_name = "FILE")]
        model: PathBuf,
        /// The folder to create
        #[arg(long, value_name = "FOLDER")]
        to: PathBuf,
    },
}

#[derive(Debug, clap::Args)]
pub struct LabelledArguments {
    /// Folders of sweeps, or their names within the daemon's data folder
    #[arg(required = true, value_name = "SESSION")]
    pub sessions: Vec<PathBuf>,
    /// What the pixels of a session show, TOML: once for each session in their order, or once for all
    #[arg(long, required = true, value_name = "FILE")]
    pub labels: Vec<PathBuf>,
    #[command(flatten)]
    pub scene: SceneScale,
}

#[derive(Debug, Clone, Copy, clap::Args)]
pub struct SceneScale {
    /// Height of a projector row on the scene, instead of `sweep.mm_per_row` of the plans
    #[arg(long, value_name = "MM")]
    pub mm_per_row: Option<f64>,
}

#[derive(Debug, clap::Args)]
pub struct RunArguments {
    /// The plan, a TOML file
    pub plan: PathBuf,
    #[command(flatten)]
    pub about: RunDescription,
}

#[derive(Debug, clap::Args)]
pub struct RunDescription {
    /// Return at once instead of following the run
    #[arg(long)]
    pub detach: bool,
    /// Name of the operator
    #[arg(long)]
    pub operator: Option<String>,
    /// Name of the sample
    #[arg(long)]
    pub sample: Option<String>,
    /// Any other remark
    #[arg(long)]
    pub note: Option<String>,
    /// A tag to find the session by; may be repeated
    #[arg(long = "tag", value_name = "TAG")]
    pub tags: Vec<String>,
}

#[derive(Debug, clap::Args)]
pub struct ViewfinderArguments {
    /// What the projector shows; on a dot rig all but `black` are the dot [default: white]
    #[arg(long, value_parser = picture_parser())]
    pub picture: Option<FinderPicture>,
    /// What begins each frame of a plane rig: `none` lets the camera run freely, before the VSYNC is wired [default: vsync]
    #[arg(long, value_parser = trigger_parser())]
    pub trigger: Option<FinderTrigger>,
    /// Region of the focus score and the other figures: first row, row after the last, first column, column after the last
    #[arg(long, value_name = "T0,T1,S0,S1", value_parser = region)]
    pub region: Option<[usize; 4]>,
    /// Exposure of each frame in microseconds [default: 0.9 of the projector's period, or all of it without a trigger]
    #[arg(long, value_name = "US", value_parser = exposure)]
    pub exposure_us: Option<f64>,
    /// Have the white board put before the camera first, as for aligning
    #[arg(long)]
    pub board: bool,
    /// End after this many seconds [default: with Ctrl-C or `raysweep cancel`]
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,
    /// Start it with this plan of kind "viewfinder" instead
    #[arg(long, value_name = "FILE", conflicts_with_all = ["picture", "trigger", "region", "exposure_us", "board", "seconds"])]
    pub plan: Option<PathBuf>,
    #[command(flatten)]
    pub about: RunDescription,
}

fn format_parser() -> impl TypedValueParser<Value = ExportFormat> {
    let values = ExportFormat::ALL.map(|format| {
        let (name, about) = format.described();
        PossibleValue::new(name).help(about)
    });
    PossibleValuesParser::new(values).map(|name| {
        let named = ExportFormat::ALL.into_iter().find(|format| format.described().0 == name);
        // The parser allows these names alone.
        named.unwrap_or(ExportFormat::Npy)
    })
}

fn picture_parser() -> impl TypedValueParser<Value = FinderPicture> {
    PossibleValuesParser::new(FinderPicture::ALL.map(FinderPicture::name)).map(|name| {
        let named = FinderPicture::ALL.into_iter().find(|picture| picture.name() == name);
        named.unwrap_or_default()
    })
}

fn trigger_parser() -> impl TypedValueParser<Value = FinderTrigger> {
    PossibleValuesParser::new(FinderTrigger::ALL.map(FinderTrigger::name)).map(|name| {
        let named = FinderTrigger::ALL.into_iter().find(|trigger| trigger.name() == name);
        named.unwrap_or_default()
    })
}

/// An exposure in microseconds.
fn exposure(text: &str) -> Result<f64, String> {
    let exposure_us = text.parse().ok().filter(|us: &f64| us.is_finite() && *us > 0.0);
    exposure_us.ok_or_else(|| "give a number of microseconds above 0, such as 600".into())
}

fn region(text: &str) -> Result<[usize; 4], String> {
    let numbers: Result<Vec<usize>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    let region = numbers.ok().and_then(|numbers| <[usize; 4]>::try_from(numbers).ok());
    region.ok_or_else(|| "give four whole numbers separated by commas, such as 0,128,0,128".into())
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

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::super::exit::Exit;
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
}
