//! A simulated GigE Vision camera that views the simulated rig of a rig file, or delivers test images.

use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;
use raysweep::arguments::SimCameraArguments;
use raysweep::rig::Rig;
use raysweep_sim::WireDevices;
use raysweep_sim::bench::BenchServer;
use raysweep_sim::gige::{CameraClock, Faults, GigeCamera, GigeSetup, Look};
use serde::de::DeserializeOwned;

fn main() -> ExitCode {
    match run(&SimCameraArguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("raysweep-sim-camera: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &SimCameraArguments) -> Result<(), Box<dyn std::error::Error>> {
    let faults = table::<Faults>("fault", &arguments.faults)?;
    faults.check().map_err(|error| format!("--fault: {error}"))?;
    let setup = GigeSetup {
        address: arguments.address,
        serial: arguments.serial.clone(),
        clock: table::<CameraClock>("clock", &arguments.clock)?,
        faults,
        zipped: arguments.zipped,
    };
    let pictures = arguments.test_pictures.map(|(width, height)| Look::at_test_pictures((height, width)));
    let Some(path) = &arguments.rig else {
        let _camera =
            GigeCamera::start(&setup, pictures.ok_or("neither --rig nor --test-pictures is given")?)?;
        announce(arguments);
        wait_for_ever();
    };
    let rig = Rig::load(path)?;
    let sim = rig
        .simulated()
        .ok_or("no device of the rig file has the driver `sim`, and it names no `sim.bench`")?;
    let WireDevices { camera, bench: devices } = sim.open_for_wire();
    let camera = Arc::new(GigeCamera::start(&setup, pictures.unwrap_or(camera))?);
    let bench = rig.file.sim.bench.as_deref();
    let _bench = bench.map(|path| BenchServer::start(path, devices, camera.clone())).transpose()?;
    announce(arguments);
    wait_for_ever()
}

/// Announces that clients may connect, for scripts that start the camera.
fn announce(arguments: &SimCameraArguments) {
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
