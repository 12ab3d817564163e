//! Command lines of the daemon and of the simulated camera: for the programs, and for their manual pages.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use bytesize::ByteSize;
use clap::Parser;

/// The packaged daemon's data folder.
pub const DEFAULT_DATA: &str = "/var/lib/raysweep";

/// Capture daemon for light-transport rigs.
#[derive(Parser)]
#[command(
    name = "raysweepd",
    version,
    after_help = "Exit codes:\n  0  shut down cleanly\n  1  could not start, or failed\n  2  wrong usage, or a rig file that cannot be used"
)]
pub struct DaemonArguments {
    /// The rig file.
    #[arg(long, value_name = "FILE")]
    pub rig: PathBuf,
    /// Socket for clients; under systemd's socket activation, the passed socket is used instead.
    #[arg(long, value_name = "PATH", default_value = "/run/raysweep/raysweepd.sock")]
    pub socket: PathBuf,
    /// File with the newest live images, which clients map [default: the socket's path with the extension `live`]
    #[arg(long, value_name = "PATH")]
    pub live: Option<PathBuf>,
    /// Data folder, in which sessions are stored.
    #[arg(long, value_name = "DIR", default_value = DEFAULT_DATA)]
    pub data: PathBuf,
    /// Group whose members may operate the rig; other users who can connect may only observe.
    #[arg(long, value_name = "GROUP", default_value = "raysweep")]
    pub operators: String,
    /// Memory limit for the results of a run, such as 2GB; larger sweeps are solved in strips of camera rows after their
    /// end [default: the free memory when the run begins]
    #[arg(long, value_name = "SIZE", value_parser = memory_size)]
    pub memory: Option<ByteSize>,
    /// Read the rig file, examine every device as `raysweep doctor` does, print what was found, and exit.
    #[arg(long)]
    pub check: bool,
}

/// A simulated GigE Vision camera: any GenICam client finds it, sets it and receives its pictures.
#[derive(Parser)]
#[command(name = "raysweep-sim-camera", version)]
pub struct SimCameraArguments {
    /// The rig file, whose `[sim]` says what the camera sees.
    #[arg(long, value_name = "FILE", required_unless_present = "test_pictures")]
    pub rig: Option<PathBuf>,
    /// Instead of a scene, test pictures of this size, as fast as a client takes them; with --rig, beside its VSYNC and
    /// projector.
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size)]
    pub test_pictures: Option<(usize, usize)>,
    /// Where the camera listens; each camera of a machine needs an address of its own.
    #[arg(long, default_value = "127.0.0.1")]
    pub address: Ipv4Addr,
    /// Serial number, which clients find the camera by.
    #[arg(long, default_value = "1", value_parser = serial)]
    pub serial: String,
    /// What goes wrong, such as `packet_loss=0.01`; can be given again and again.
    #[arg(long = "fault", value_name = "KEY=VALUE")]
    pub faults: Vec<String>,
    /// How the camera's clock runs, such as `drift_ppm=30`; can be given again and again.
    #[arg(long = "clock", value_name = "KEY=VALUE")]
    pub clock: Vec<String>,
    /// Offers the camera's description as a zip file, as many cameras do.
    #[arg(long)]
    pub zipped: bool,
}

fn size(text: &str) -> Result<(usize, usize), String> {
    let sides =
        text.split_once('x').and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    sides
        .filter(|(width, height)| (1..=8192).contains(width) && (1..=8192).contains(height))
        .ok_or_else(|| format!("{text}: give WIDTHxHEIGHT, each 1 to 8192, such as 512x512"))
}

fn serial(text: &str) -> Result<String, String> {
    let fits = (1..16).contains(&text.len()) && text.is_ascii();
    if fits {
        Ok(text.to_owned())
    } else {
        Err(format!("{text}: a serial number has 1 to 15 ASCII characters"))
    }
}

/// Reads the size of a memory limit.
///
/// # Errors
/// What to give instead.
pub fn memory_size(text: &str) -> Result<ByteSize, String> {
    text.parse().map_err(|_not_a_size| "give a size, such as 2GB or 512MiB".to_owned())
}
