//! Readers of bytes from outside, each as a plain function of them, which a fuzzer can call too. A body
//! returns the reader's error, and panics if something is wrong with the reader.

use std::cell::OnceCell;
use std::fmt::Display;
use std::fs;
use std::path::Path;
use std::time::Duration;

use raysweep::live::LiveReader;
use raysweep_config::rig::AnyRigFile;
use raysweep_config::{ConfigError, Plan};
use raysweep_core::{Camera, FramePool, PixelFormat};
use raysweep_drivers::camera::replay::{RawPacking, ReplayCamera, ReplayConfig, ReplayPace};
use raysweep_processing::calibration::{CalibrationArrays, KeptCalibration};
use raysweep_proto::{
    CheckParams, DesignParams, Request, ResumeParams, RpcError, RunParams, UseCalibrationParams,
    ViewfinderParams, params,
};
use raysweep_session::integrity::Audit;
use raysweep_session::ledger::LedgerText;
use raysweep_session::stack::ArrayName;
use raysweep_session::{Session, manifest};
use raysweep_sim::gige::gvcp::GvcpRequest;
use raysweep_sim::scene::Scene;
use tempfile::TempDir;

/// A reader.
pub type Body = fn(&[u8]) -> Result<(), String>;

/// All readers, by the names of their folders in `fuzz/seeds`.
pub const BODIES: [(&str, Body); 13] = [
    ("socket_line", socket_line),
    ("plan", plan),
    ("rig", rig),
    ("calibration_header", calibration_header),
    ("calibration_arrays", calibration_arrays),
    ("ledger", ledger),
    ("manifest", session_manifest),
    ("zarr_metadata", zarr_metadata),
    ("gvcp", gvcp),
    ("scene", scene),
    ("recording_npy", recording_npy),
    ("recording_png", recording_png),
    ("live_file", live_file),
];

/// Longest text of an error that a person reads.
const MOST_ERROR_BYTES: usize = 64 << 10;

fn said<T>(read: Result<T, impl Display>) -> Result<T, String> {
    read.map_err(|error| {
        let text = error.to_string();
        assert!(!text.trim().is_empty() && text.len() < MOST_ERROR_BYTES, "{} bytes of error", text.len());
        text
    })
}

thread_local! {
    static FOLDER: OnceCell<TempDir> = const { OnceCell::new() };
}

/// Does something in a folder of this thread.
fn in_folder<T>(act: impl FnOnce(&Path) -> T) -> T {
    FOLDER.with(|folder| act(folder.get_or_init(|| tempfile::tempdir_in("/dev/shm").unwrap()).path()))
}

/// A file with these bytes.
fn in_file<T>(name: &str, bytes: &[u8], act: impl FnOnce(&Path) -> T) -> T {
    in_folder(|folder| {
        let file = folder.join(name);
        fs::write(&file, bytes).unwrap();
        act(&file)
    })
}

fn socket_line(bytes: &[u8]) -> Result<(), String> {
    let line = said(std::str::from_utf8(bytes))?;
    let request = Request::parse(line).map_err(|response| {
        // It is sent to the client.
        serde_json::to_string(&response).unwrap()
    })?;
    let given = || request.params.clone();
    let readings: [Result<(), RpcError>; 6] = [
        params::<CheckParams>(given()).map(drop),
        params::<DesignParams>(given()).map(drop),
        params::<RunParams>(given()).map(drop),
        params::<ResumeParams>(given()).map(drop),
        params::<UseCalibrationParams>(given()).map(drop),
        params::<ViewfinderParams>(given()).map(drop),
    ];
    readings.into_iter().map(said).find(Result::is_ok).unwrap_or(Err("no method has these parameters".into()))
}

fn configured<T>(text: &str, read: Result<T, ConfigError>) -> Result<(), String> {
    read.map(drop).map_err(|error| {
        assert!(!error.render("file.toml", text).is_empty());
        said::<()>(Err(error)).unwrap_err()
    })
}

fn plan(bytes: &[u8]) -> Result<(), String> {
    let text = said(std::str::from_utf8(bytes))?;
    let _ = configured(text, Plan::parse_stored(text));
    configured(text, Plan::parse(text))
}

fn rig(bytes: &[u8]) -> Result<(), String> {
    let text = said(std::str::from_utf8(bytes))?;
    configured(text, AnyRigFile::parse(text))
}

fn calibration_header(bytes: &[u8]) -> Result<(), String> {
    in_file("calibration.toml", bytes, |file| {
        let read = KeptCalibration::read(file.parent().unwrap());
        said(read).map(drop)
    })
}

/// Beyond the checksum in the header.
fn calibration_arrays(bytes: &[u8]) -> Result<(), String> {
    said(CalibrationArrays::from_bytes(bytes)).map(drop)
}

fn ledger(bytes: &[u8]) -> Result<(), String> {
    let _ = in_file("ledger.jsonl", bytes, |file| said(said(LedgerText::read(file))?.replay(file)));
    in_session("ledger.jsonl", bytes)
}

fn session_manifest(bytes: &[u8]) -> Result<(), String> {
    in_session("manifest.json", bytes)
}

fn zarr_metadata(bytes: &[u8]) -> Result<(), String> {
    in_session("stack.zarr/sum/zarr.json", bytes)
}

/// Reads all of a session one of whose files has these bytes.
fn in_session(name: &str, bytes: &[u8]) -> Result<(), String> {
    in_folder(|folder| {
        let folder = folder.join("session");
        let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/sessions/sweep");
        if !folder.exists() {
            copy(&example, &folder);
        }
        fs::write(folder.join(name), bytes).unwrap();
        let read = read_session(&folder);
        match fs::read(example.join(name)) {
            Ok(sound) => fs::write(folder.join(name), sound).unwrap(),
            Err(_) => fs::remove_file(folder.join(name)).unwrap(),
        }
        read
    })
}

fn read_session(folder: &Path) -> Result<(), String> {
    let session = said(Session::open(folder))?;
    let (state, audit) = said(Audit::of(&session))?;
    let damage: Vec<String> = audit.damage.iter().map(ToString::to_string).collect();
    let stack = said(session.stack())?;
    for array in ArrayName::ALL {
        for point in state.stored(array) {
            let _ = said(stack.read_point(array, point.index));
        }
    }
    if folder.join("manifest.json").exists() {
        said(manifest::verify(&session))?;
    }
    if damage.is_empty() { Ok(()) } else { Err(damage.join("; ")) }
}

fn gvcp(bytes: &[u8]) -> Result<(), String> {
    let request = GvcpRequest::parse(bytes).ok_or("not a request")?;
    request.command.map(drop).map_err(|status| format!("{status:?}"))
}

fn scene(bytes: &[u8]) -> Result<(), String> {
    in_file("scene.npz", bytes, |file| said(Scene::load(file)).map(drop))
}

fn recording_npy(bytes: &[u8]) -> Result<(), String> {
    recording("recording.npy", bytes)
}

fn recording_png(bytes: &[u8]) -> Result<(), String> {
    recording("recording.png", bytes)
}

fn recording(name: &str, bytes: &[u8]) -> Result<(), String> {
    in_file(name, bytes, |path| {
        let config = ReplayConfig {
            path: path.to_owned(),
            width: None,
            height: None,
            header_bytes: 0,
            packing: RawPacking::PixelFormat,
            pace: ReplayPace::Pipeline,
        };
        let mut camera = said(ReplayCamera::open(&config, PixelFormat::Mono12, 1000.0))?;
        let (rows, columns) = (camera.capabilities().height, camera.capabilities().width);
        let frame_bytes = rows.saturating_mul(columns).saturating_mul(2);
        if name.ends_with(".npy") {
            // A picture of many equal pixels may be a small file.
            assert!(frame_bytes / 2 <= bytes.len(), "{rows} x {columns} pixels in {} bytes", bytes.len());
        } else if frame_bytes > 1 << 20 {
            return Ok(());
        }
        said(camera.arm())?;
        let mut buffer = FramePool::new(1, frame_bytes).take();
        for _ in 0..camera.frames().min(4) {
            said(camera.next_frame(&mut buffer, Duration::ZERO))?;
        }
        Ok(())
    })
}

fn live_file(bytes: &[u8]) -> Result<(), String> {
    in_file("live", bytes, |file| {
        let reader = said(LiveReader::open(file))?;
        let names = said(reader.names())?;
        names.keys().try_for_each(|name| said(reader.newest(name)).map(drop))
    })
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let (from, to) = (entry.path(), to.join(entry.file_name()));
        match from.is_dir() {
            true => copy(&from, &to),
            false => fs::write(&to, fs::read(&from).unwrap()).unwrap(),
        }
    }
}
