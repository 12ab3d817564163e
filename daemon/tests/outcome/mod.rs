//! What must be the same of a session, however often it was interrupted.

use std::path::Path;

use raysweep_core::Counts;
use raysweep_session::Session;
use raysweep_session::ledger::PointEntry;
use raysweep_session::stack::ArrayName;

/// What must be the same after a crash: each point's attempt, settings, delays and data, and all products. The fate of
/// frames that still had the previous settings belongs to the run's history, not to the point.
#[derive(PartialEq)]
pub struct Outcome {
    pub points: Vec<String>,
    pub files: Vec<(String, Vec<u8>)>,
}

pub fn outcome(session: &Path) -> Outcome {
    let state = Session::open(session).unwrap().state().unwrap();
    assert!(state.counts.balanced(), "{:?}", state.counts);
    let points =
        ArrayName::ALL.into_iter().flat_map(|array| state.stored(array).cloned().collect::<Vec<_>>());
    let points = points.map(|point| PointEntry { counts: Counts::default(), exposed: None, ..point });
    let points = points.map(|point| serde_json::to_string(&point).unwrap()).collect();
    let mut files: Vec<_> = std::fs::read_dir(session.join("products"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| (path.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(path).unwrap()))
        .collect();
    files.sort();
    Outcome { points, files }
}
