//! The live estimate of a run: what clients see during a sweep, and that it does not affect the run.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ndarray::{Array2, ArrayD, Ix2};
use raysweep::control::Control;
use raysweep::live::{EPIPOLAR, INDIRECT, LiveFile, LiveReader, TOTAL};
use raysweep::rig::Rig;
use raysweep::{Probes, Runner};
use raysweep_pipeline::{Stage, StageError, Unit};
use raysweep_proto::Event;
use raysweep_tests::{Bench, data, rig_text};
use serde_json::json;

const PLAN: &str = "kind = \"sweep\"\nname = \"live\"\n[sweep]\naverage = 4\n\
                    delay_us = { start = -240, stop = 240, count = 9 }\nexposure_us = [60, 150]\n";

fn rig() -> String {
    rig_text(24, "scene = \"mix\"\nscene_rows = 24\nscene_columns = 16\nseed = 9", "")
}

/// A bench with live images, and the file that contains them.
fn live_bench(probes: impl FnOnce(&Path) -> Probes) -> (Bench, PathBuf) {
    let folder = tempfile::TempDir::new().unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig()).unwrap();
    let file = folder.path().join("live");
    let rig = Rig::load(&folder.path().join("rig.toml")).unwrap();
    let runner = Runner::new(rig, folder.path().join("sessions")).unwrap().with_probes(probes(&file));
    let runner = Arc::new(runner.with_live(LiveFile::create(&file).unwrap()));
    (Bench { folder, runner }, file)
}

/// Points of the schedule before the sweep: three dark images and the regular image.
const BEFORE: u32 = 4;
/// Points of the sweep that wait until all earlier points are included in an estimate.
const WAITING: [u32; 3] = [6, 11, 17];

/// Epipolar images of the estimates, with the number of points included.
type Seen = Arc<Mutex<Vec<(u64, Array2<f32>)>>>;

/// Holds the sweep until its live estimate has been seen.
struct Patient {
    file: PathBuf,
    seen: Seen,
}

impl Stage for Patient {
    fn name(&self) -> &str {
        "patient"
    }

    fn apply(&self, unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError> {
        let before = unit.id.point.saturating_sub(BEFORE);
        if WAITING.contains(&before) {
            let reader = LiveReader::open(&self.file).unwrap();
            let newest = wait_for(|| {
                let newest = reader.newest(EPIPOLAR).unwrap()?;
                (newest.metadata["points"].as_u64().unwrap() >= u64::from(before)).then_some(newest)
            });
            let points = newest.metadata["points"].as_u64().unwrap();
            self.seen.lock().unwrap().push((points, plane(newest.image)));
        }
        Ok(image)
    }
}

fn wait_for<T>(mut ready: impl FnMut() -> Option<T>) -> T {
    let began = Instant::now();
    loop {
        if let Some(ready) = ready() {
            return ready;
        }
        assert!(began.elapsed() < Duration::from_secs(120), "waited in vain");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn plane(image: ArrayD<f32>) -> Array2<f32> {
    image.into_dimensionality::<Ix2>().unwrap()
}

fn relative_error(found: &Array2<f32>, truth: &Array2<f32>) -> f64 {
    let square = |image: &Array2<f32>| image.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>();
    (square(&(found - truth)) / square(truth)).sqrt()
}

fn product(session: &Path, name: &str) -> Array2<f32> {
    ndarray_npy::read_npy(session.join(format!("products/{name}.npy"))).unwrap()
}

#[test]
fn estimates_appear_while_the_sweep_goes_on_and_come_to_its_result() {
    let seen = Seen::default();
    let (bench, file) = live_bench(|file| {
        let patient = Patient { file: file.to_owned(), seen: seen.clone() };
        Probes { stages: vec![Arc::new(patient)], ..Probes::default() }
    });
    assert_eq!(bench.runner.status().live.as_deref(), Some(&*file));
    assert_eq!(std::fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o644);
    let mut events = bench.runner.events();
    let ended = bench.run(PLAN);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);

    let result = product(&ended.session, "epipolar");
    let mut seen = seen.lock().unwrap().clone();
    seen.sort_by_key(|(points, _)| *points);
    let errors: Vec<f64> = seen.iter().map(|(_, image)| relative_error(image, &result)).collect();
    assert_eq!(errors.len(), WAITING.len());
    assert!(errors[2] < 0.05 && errors[2] < errors[0], "{errors:?}");

    let reader = LiveReader::open(&file).unwrap();
    for (name, wanted) in [
        (EPIPOLAR, result.view()),
        (INDIRECT, product(&ended.session, "non_epipolar").view()),
        (TOTAL, transport(&ended.session).view()),
    ] {
        let newest = reader.newest(name).unwrap().unwrap();
        assert_eq!((&newest.metadata["points"], &newest.metadata["last"]), (&json!(18), &json!(true)));
        assert_eq!(newest.metadata["session"], json!(ended.session));
        assert!(plane(newest.image) == wanted, "{name} is not the result");
    }

    let mut told = Vec::new();
    let mut final_s = None;
    while let Ok(event) = events.try_recv() {
        match event {
            Event::Live { sequence, points, .. } => told.push((sequence, points)),
            Event::Finished { final_s: seconds, .. } => final_s = seconds,
            _ => {}
        }
    }
    assert!(told.len() > WAITING.len() && told.is_sorted() && told.last().unwrap().1 == 18, "{told:?}");
    assert!(final_s.is_some_and(|seconds| seconds > 0.0), "{final_s:?}");
    assert_eq!(ended.open().1.end.unwrap().final_s, final_s);
    drop(bench);
    assert!(!file.exists(), "a daemon that ends leaves nothing");
}

/// Light summed over all rows, from the stored transport.
fn transport(session: &Path) -> Array2<f32> {
    let t: ndarray::Array3<f32> = ndarray_npy::read_npy(session.join("products/transport.npy")).unwrap();
    let sum = t.fold_axis(ndarray::Axis(0), 0.0_f64, |sum, &light| sum + f64::from(light));
    sum.mapv(|sum| sum as f32)
}

#[test]
fn the_results_are_the_same_bits_with_live_images_and_without() {
    let (bench, _file) = live_bench(|_| Probes::default());
    let without = Bench::new(&rig());
    let (seen, unseen) = (bench.run(PLAN), without.run(PLAN));
    let mut compared = 0;
    for folder in ["products", "transport.zarr/transport", "stack.zarr/sum"] {
        for entry in std::fs::read_dir(seen.session.join(folder)).unwrap() {
            let name = entry.unwrap().file_name();
            let bytes = |session: &Path| std::fs::read(session.join(folder).join(&name)).unwrap();
            assert!(bytes(&seen.session) == bytes(&unseen.session), "{folder}/{name:?} differs");
            compared += 1;
        }
    }
    assert!(compared > 20, "{compared}");
}

/// Reads with the example of `docs/reference/socket.md` during writing, and checks that each image is complete.
const RACE: &str = "
reads, last = 0, 0
while last < 3000:
    image, metadata = newest(sys.argv[1], 'race')
    assert (image == metadata['value']).all() and image.shape == tuple(metadata['shape']), metadata
    assert metadata['value'] >= last, 'older than before'
    last, reads = metadata['value'], reads + 1
print('reads', reads)
";

/// The value at which the reader stops.
const LAST: usize = 3000;

#[test]
fn numpy_reads_the_live_file_as_documented_also_while_it_is_written() {
    let python = std::env::var_os("RAYSWEEP_PYTHON").expect(
        "RAYSWEEP_PYTHON names a Python with tests/python/requirements.txt: `cargo xtask test` makes one",
    );
    let docs = std::fs::read_to_string(data("").join("../../docs/reference/socket.md")).unwrap();
    let (_, section) = docs.split_once("## Live images").unwrap();
    let example = section.split("```python\n").nth(1).unwrap().split("```").next().unwrap();

    let folder = tempfile::TempDir::new().unwrap();
    let file = folder.path().join("live");
    let live = LiveFile::create(&file).unwrap();
    let publish = |name: &str, value: usize, shape: [usize; 2]| {
        let image = Array2::from_elem(shape, value as f32).into_dyn();
        let metadata = json!({ "value": value, "shape": shape, "points": 5 });
        live.publish(name, image.view(), metadata.as_object().unwrap()).unwrap();
    };
    publish(EPIPOLAR, 3, [4, 6]);
    publish("race", 0, [1, 1]);
    let early =
        Command::new(&python).args(["-c", example]).args([file.to_str().unwrap(), "later"]).output().unwrap();
    let said = String::from_utf8(early.stderr).unwrap();
    assert!(early.status.code() == Some(1) && said.starts_with("no image 'later' yet"), "{said}");
    let child = Command::new(python)
        .args(["-c", &format!("{example}{RACE}")])
        .args([file.to_str().unwrap(), EPIPOLAR])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    for value in 1..=LAST {
        publish("race", value, [1 + value % 200, 100]);
        std::thread::sleep(Duration::from_micros(500));
    }
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
    assert!(output.status.success() && said.contains("reads"), "{said}");
    assert!(said.contains("(4, 6)") && said.contains("'points': 5"), "{said}");
}
