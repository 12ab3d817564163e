//! A simulated GigE Vision camera that views the simulated rig of a rig file, or delivers test images.

use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;
use raysweep::rig::Rig;
use raysweep_sim::WireDevices;
use raysweep_sim::bench::BenchServer;
use raysweep_sim::gige::{CameraClock, Faults, GigeCamera, GigeSetup, Look};
use serde::de::DeserializeOwned;

/// A simulated GigE Vision camera: any GenICam client finds it, sets it and receives its pictures.
#[derive(Parser)]
#[command(name = "raysweep-sim-camera", version)]
struct Arguments {
    /// The rig file, whose `[sim]` says what the camera sees.
    #[arg(long, value_name = "FILE", required_unless_present = "test_pictures")]
    rig: Option<PathBuf>,
    /// Instead of a scene, test pictures of this size, as fast as a client takes them.
    #[arg(long, value_name = "WIDTHxHEIGHT", conflicts_with = "rig", value_parser = size)]
    test_pictures: Option<(usize, usize)>,
    /// Where the camera listens; each camera of a machine needs an address of its own.
    #[arg(long, default_value = "127.0.0.1")]
    address: Ipv4Addr,
    /// Serial number, which clients find the camera by.
    #[arg(long, default_value = "1", value_parser = serial)]
    serial: String,
    /// What goes wrong, such as `packet_loss=0.01`; can be given again and again.
    #[arg(long = "fault", value_name = "KEY=VALUE")]
    faults: Vec<String>,
    /// How the camera's clock runs, such as `drift_ppm=30`; can be given again and again.
    #[arg(long = "clock", value_name = "KEY=VALUE")]
    clock: Vec<String>,
    /// Offers the camera's description as a zip file, as many cameras do.
    #[arg(long)]
    zipped: bool,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("raysweep-sim-camera: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let setup = GigeSetup {
        address: arguments.address,
        serial: arguments.serial.clone(),
        clock: table::<CameraClock>("clock", &arguments.clock)?,
        faults: table::<Faults>("fault", &arguments.faults)?,
        zipped: arguments.zipped,
    };
    if let Some((width, height)) = arguments.test_pictures {
        let _camera = GigeCamera::start(&setup, Look::at_test_pictures((height, width)))?;
        announce(arguments);
        wait_for_ever();
    }
    let path = arguments.rig.as_ref().ok_or("neither --rig nor --test-pictures is given")?;
    let rig = Rig::load(path)?;
    let sim = rig
        .simulated()
        .ok_or("no device of the rig file has the driver `sim`, and it names no `sim.bench`")?;
    let WireDevices { camera, vsync, projector, truth } = sim.open_for_wire();
    let camera = Arc::new(GigeCamera::start(&setup, camera)?);
    let bench = rig.file.sim.bench.as_deref();
    let _bench =
        bench.map(|path| BenchServer::start(path, vsync, projector, truth, camera.clone())).transpose()?;
    announce(arguments);
    wait_for_ever()
}

/// Announces that clients may connect, for scripts that start the camera.
fn announce(arguments: &Arguments) {
    println!("listening on {}", arguments.address);
}

fn wait_for_ever() -> ! {
    loop {
        std::thread::park();
    }
}

/// Parses `KEY=VALUE` words as lines of a TOML table.
fn table<T: DeserializeOwned>(flag: &str, words: &[String]) -> Result<T, String> {
    toml::from_str(&words.join("\n")).map_err(|error| format!("--{flag}: {error}"))
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
