//! The daemon: owns a rig, serves a socket, and shuts down cleanly.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use clap::Parser;
use nix::sys::stat::{Mode, umask};
use nix::unistd::{AccessFlags, access};
use raysweep::Runner;
use raysweep::arguments::DaemonArguments;
use raysweep::cli::doctor_text;
use raysweep::control::Control;
use raysweep::doctor;
use raysweep::journal;
use raysweep::live::{LiveError, LiveFile};
use raysweep::mirror;
use raysweep::rig::{AnyRig, RigError};
use raysweep::server::{self, Access, Listening};
use raysweep_core::io_text;
use raysweep_drivers::mirror::{Parked, park};
use raysweep_proto::Grade;
use sd_notify::NotifyState;
use tokio::signal::unix::{Signal, SignalKind, signal};

/// Exit code if the rig file cannot be used: starting again would not help, and systemd does not.
const UNUSABLE: u8 = 2;

fn main() -> ExitCode {
    journal::log_to_stderr();
    // The group may read sessions and process them; nobody else may write them.
    umask(Mode::S_IWGRP | Mode::S_IRWXO);
    let mut arguments = DaemonArguments::parse();
    // Clients print the paths of sessions, in other working directories.
    if let Ok(data) = std::path::absolute(&arguments.data) {
        arguments.data = data;
    }
    match if arguments.check { check(&arguments) } else { run(&arguments) } {
        Ok(code) => code,
        Err(error) => {
            for line in error.to_string().lines() {
                // Excerpts of files are indented.
                let program = if line.starts_with("  ") { "" } else { "raysweepd: " };
                eprintln!("{}{program}{line}", journal::error_prefix());
            }
            match error.downcast_ref() {
                Some(RigError::Read { .. } | RigError::Config(_)) => ExitCode::from(UNUSABLE),
                _ => ExitCode::FAILURE,
            }
        }
    }
}

/// Examines the rig as `raysweep doctor` does.
fn check(arguments: &DaemonArguments) -> Result<ExitCode, Box<dyn std::error::Error>> {
    let rig = AnyRig::load(&arguments.rig)?;
    let report = doctor::examine(&rig.into(), &arguments.data, None, &|| true);
    println!("{}", doctor_text(&report));
    Ok(if report.worst() == Grade::Failure { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

fn run(arguments: &DaemonArguments) -> Result<ExitCode, Box<dyn std::error::Error>> {
    let rig = AnyRig::load(&arguments.rig)?;
    prepare_data(&arguments.data).map_err(|error| {
        format!(
            "--data {}: {}; give a folder that raysweepd can write to",
            arguments.data.display(),
            io_text(&error)
        )
    })?;
    // Must come before opening a mirror's driver, which refuses a mirror that was left unparked.
    park_left_behind(&arguments.data);
    // Outlives the runner, and so the mirror's driver.
    let _guardian = match &rig {
        AnyRig::Dots(rig) if rig.has_real_mirror() => Some(
            mirror::guardian(&arguments.data)
                .map_err(|error| format!("cannot start `raysweep park`, which guards the mirror: {error}"))?,
        ),
        _ => None,
    };
    let runner = Runner::new(rig, arguments.data.clone())?;
    let camera = runner.camera();
    let opened = format!(
        "{} ({} x {} {:?}), rig {}",
        camera.model,
        camera.width,
        camera.height,
        camera.format,
        arguments.rig.display()
    );
    tracing::info!("{opened}");
    let runner = match arguments.memory {
        Some(size) => runner.with_memory_limit(size.as_u64()),
        None => runner,
    };
    let runner = Arc::new(match live_file(arguments)? {
        Some(file) => runner.with_live(file),
        None => runner,
    });
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let served = runtime.block_on(serve(arguments, runner.clone()));
    // If the server failed, a run may still be in progress; after a clean shutdown there is none.
    runner.shut_down();
    runtime.shutdown_timeout(Duration::from_secs(1));
    served.map(|()| ExitCode::SUCCESS)
}

/// The live file at the requested path; by default beside the socket, where failure is tolerated: no run needs it.
fn live_file(arguments: &DaemonArguments) -> Result<Option<LiveFile>, LiveError> {
    if let Some(path) = &arguments.live {
        return LiveFile::create(path).map(Some);
    }
    let made = LiveFile::create(&arguments.socket.with_extension("live"));
    Ok(made.map_err(|error| tracing::warn!(%error, "there will be no live images")).ok())
}

/// Moves a mirror that an earlier daemon left off-centre to the origin, before anything else happens.
fn park_left_behind(data: &Path) {
    match park(&mirror::state_file(data)) {
        Ok(Parked::Already | Parked::NeverMoved) => {}
        Ok(parked) => tracing::warn!(?parked, "parked a mirror that was left behind"),
        // Runs without a mirror can continue; the mirror's driver refuses to open until it is parked.
        Err(error) => tracing::error!(%error, "a mirror that was left behind is not parked"),
    }
}

/// Creates the data folder if it is missing, and checks that sessions can be stored in it.
fn prepare_data(folder: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    Ok(access(folder, AccessFlags::W_OK | AccessFlags::X_OK)?)
}

async fn serve(arguments: &DaemonArguments, runner: Arc<Runner>) -> Result<(), Box<dyn std::error::Error>> {
    // Before anybody can reach the daemon.
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut hangup = signal(SignalKind::hangup())?;
    let retire = signal(SignalKind::user_defined1())?;
    let Listening { listener, file } = match Listening::inherited()? {
        Some(listening) => listening,
        None => Listening::bind(&arguments.socket)?,
    };
    tracing::info!("listening on {}", listening_on(&listener, &arguments.socket).display());
    let watchdog = tokio::spawn(feed_watchdog(runner.clone()));
    let _ = sd_notify::notify(&[NotifyState::Ready]);
    let ended = {
        let runner = runner.clone();
        async move {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
                // The terminal was closed.
                _ = hangup.recv() => {}
                () = idle_after(retire, runner.clone()) => {}
            }
            tracing::info!("shutting down");
            let _ = sd_notify::notify(&[NotifyState::Stopping]);
            // Keep serving clients until the run has ended, so that they learn the result.
            let _ = tokio::task::spawn_blocking(move || runner.shut_down()).await;
        }
    };
    let control: Arc<dyn Control> = runner;
    let served =
        server::serve(listener, control, Access::new(Some(arguments.operators.clone())), ended).await;
    watchdog.abort();
    drop(file);
    Ok(served?)
}

/// Waits for the signal by which an upgrade asks the daemon to end, and then until no run is in progress.
async fn idle_after(mut asked: Signal, runner: Arc<Runner>) {
    asked.recv().await;
    tracing::info!("asked to end once no run is in progress");
    loop {
        let runner = runner.clone();
        if tokio::task::spawn_blocking(move || runner.close_if_idle()).await.unwrap_or(false) {
            return;
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
}

/// The path of a socket: its own, or the one that was asked for.
fn listening_on(listener: &tokio::net::UnixListener, asked: &Path) -> PathBuf {
    let own = listener.local_addr().ok().and_then(|address| address.as_pathname().map(Path::to_owned));
    own.unwrap_or_else(|| asked.to_owned())
}

/// Notifies systemd's watchdog as often as the unit asks, but only while the daemon still responds.
async fn feed_watchdog(runner: Arc<Runner>) {
    let Some(interval) = sd_notify::watchdog_enabled() else { return };
    loop {
        tokio::time::sleep(interval / 2).await;
        let runner = runner.clone();
        if tokio::task::spawn_blocking(move || runner.status()).await.is_ok() {
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
        }
    }
}
