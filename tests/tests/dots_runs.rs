//! Dot rig runs with additional features: sensor calibration, raw frames, patterns from files, pause and cancel, video
//! files.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::HashMap;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use ndarray::{Array2, Array3, Array4, Axis, Zip, concatenate, s};
use raysweep::control::Control;
use raysweep::rig::DotDevices;
use raysweep::{Probes, Runner};
use raysweep_core::{DeviceError, Mirror, MirrorCapabilities, MirrorPath, MirrorProgress};
use raysweep_pipeline::dots::{ColumnStage, ColumnWorker};
use raysweep_processing::process;
use raysweep_proto::{RunParams, RunState};
use raysweep_session::dots::BatchEntry;
use raysweep_tests::dots::{plan, rig};
use raysweep_tests::{Bench, Ended, end_of, wait_until};
use raysweep_transport::dots::{Background, DotsError, NoiseFloor, SparseColumn};

fn entries(ended: &Ended) -> Vec<BatchEntry> {
    ended.open().1.batches().cloned().collect()
}

/// Checksums with batch and plane.
fn checksums(ended: &Ended) -> Vec<(usize, Option<usize>, u32)> {
    entries(ended).iter().map(|entry| (entry.batch, entry.plane, entry.crc32)).collect()
}

fn completed(bench: &Bench, plan: &str) -> Ended {
    let ended = bench.run(plan);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    ended
}

/// The floodlit video `[k, t, s]`, in f64.
fn floodlit(ended: &Ended) -> Array3<f64> {
    let path = ended.open().0.products_path().join("floodlit.npy");
    let video: Array3<f32> = ndarray_npy::read_npy(path).unwrap();
    video.mapv(f64::from)
}

const FLOODLIT: &str = "product = [{ kind = \"floodlit\" }]";

#[test]
fn a_flat_field_takes_away_the_fixed_pattern_and_keeps_the_energy() {
    let uneven =
        |percent: f64| rig(&format!("[sim.dots.sensor]\nprnu_percent = {percent}\nread_noise_e = 5\n"));
    let with_flat = |plan: String| plan.replace("dark_frames = 64", "dark_frames = 64\nflat_frames = 256");
    let plan = plan(FLOODLIT, 2);
    // Summed over all dots: a uniform sensor, a non-uniform one, and a non-uniform one with known gains.
    let truth = floodlit(&completed(&Bench::dots(&uneven(0.0)), &plan));
    let raw = floodlit(&completed(&Bench::dots(&uneven(8.0)), &plan));
    let bench = Bench::dots(&uneven(8.0));
    let corrected = completed(&bench, &with_flat(plan.clone()));
    let flat = floodlit(&corrected);
    let bright = truth.mean().unwrap() / 2.0;
    let pattern = |video: &Array3<f64>| {
        let lit = Zip::from(video).and(&truth).fold((0.0, 0.0), |(sum, count), &light, &truth| {
            if truth < bright { (sum, count) } else { (sum + (light / truth - 1.0).powi(2), count + 1.0) }
        });
        (lit.0 / lit.1).sqrt()
    };
    let (before, after) = (pattern(&raw), pattern(&flat));
    let energy = flat.sum() / truth.sum();
    println!("fixed pattern {before:.4} without a flat field, {after:.4} with one, energy {energy:.4}");
    assert!(before > 0.03, "{before}");
    assert!(after < before / 4.0, "{after} of {before}");
    assert!((energy - 1.0).abs() < 0.005, "{energy}");

    // A later plan reuses the flat field of the session without acquiring it again.
    let name = corrected.session.file_name().unwrap();
    let stage = format!("[[stage]]\nname = \"correct\"\nflat_field = {name:?}\n");
    let later = completed(&bench, &(plan.clone() + &stage));
    assert!(pattern(&floodlit(&later)) < before / 4.0);
    let gains = |ended: &Ended| ended.open().0.dots().unwrap().read_flat([128, 128]).unwrap();
    assert_eq!(gains(&later), gains(&corrected));
    let refused = bench.runner.check(&with_flat(plan + &stage)).unwrap_err();
    assert_eq!(refused.data.unwrap().field.as_deref(), Some("stage.0.flat_field"));
}

#[test]
fn a_flat_field_that_cannot_be_used_ends_the_run_with_what_to_do() {
    let plan = plan(FLOODLIT, 1).replace("dark_frames = 64", "dark_frames = 64\nflat_frames = 64");
    // The corners receive less than a quarter of the light.
    let bench = Bench::dots(&rig("[sim.dots.sensor]\nvignetting_percent = 100\n"));
    let ended = bench.run(&plan);
    assert_eq!(ended.state, "faulted");
    assert!(ended.error.as_ref().unwrap().contains("diffuser"), "{:?}", ended.error);
    assert!(entries(&ended).is_empty());
    let bench = Bench::dots(&rig(""));
    let plan = plan.replace("flat_frames = 64", "flat_frames = 0")
        + "[[stage]]\nname = \"correct\"\nflat_field = \"nowhere\"\n";
    let refused = bench.runner.check(&plan).unwrap_err();
    assert_eq!(refused.data.unwrap().field.as_deref(), Some("stage.0.flat_field"));
}

#[test]
fn raw_frames_are_kept_with_the_place_of_each() {
    let plan = plan(FLOODLIT, 2).replace("dark_frames = 64", "dark_frames = 64\nkeep_raw = true");
    let faults = "[sim.dots.camera]\ndropped = 0.01\n";
    let bench = Bench::dots(&rig(faults));
    let ended = completed(&bench, &plan);
    let packed = rig(faults)
        .replace("driver = \"sim\"\n[mirror]", "driver = \"sim\"\npixel_format = \"Mono12p\"\n[mirror]");
    let packed_bench = Bench::dots(&packed);
    let packed = completed(&packed_bench, &plan);
    let read = |ended: &Ended| -> (Array3<u16>, String) {
        let path = ended.open().0.raw_path();
        (ndarray_npy::read_npy(&path).unwrap(), std::fs::read_to_string(path.with_extension("csv")).unwrap())
    };
    let (frames, lines) = read(&ended);
    let (packed_frames, packed_lines) = read(&packed);
    assert_eq!((frames.dim(), lines.lines().count()), (packed_frames.dim(), packed_lines.lines().count()));
    let differ = Zip::from(&frames).and(&packed_frames).fold(0, |sum, a, b| sum + u32::from(a != b));
    assert_eq!(differ, 0, "12 bits are 16 bits wide in the file, however they came");
    // The ids also count earlier dark frames, whose number depends on how the mirror comes to rest.
    let places_of = |lines: &str| -> Vec<Vec<String>> {
        let fields = |line: &str| line.split(',').map(str::to_owned).collect::<Vec<_>>();
        lines.lines().map(fields).map(|line| [&line[..1], &line[2..]].concat()).collect()
    };
    assert_eq!(places_of(&lines), places_of(&packed_lines));
    assert_eq!(frames.dim().1, 128);
    assert!(frames.iter().any(|&counts| counts > 255) && frames.iter().all(|&counts| counts < 4096));

    let mut rows = lines.lines();
    assert_eq!(rows.next(), Some("frame,id,batch,dot"));
    let mut places = HashMap::new();
    let mut noted = vec![0; frames.dim().0];
    for row in rows {
        let fields: Vec<Option<usize>> = row.split(',').map(|field| field.parse().ok()).collect();
        let [Some(frame), Some(_), batch, dot] = fields[..] else { panic!("{row}") };
        noted[frame] += 1;
        if let (Some(batch), Some(dot)) = (batch, dot) {
            assert!(places.insert((batch, dot), frame).is_none(), "{row}");
        }
    }
    assert!(noted.iter().all(|&times| times == 1), "each frame has one line");
    let session = ended.open().0;
    for entry in entries(&ended) {
        let columns = session.dots().unwrap().read(entry.batch).unwrap();
        for dot in (1..299).filter(|&dot| !entry.missing.contains(&dot)) {
            // The column's brightest pixel has the same brightness, apart from the background, in the frame listed in
            // the table.
            let frame = frames.index_axis(Axis(0), places[&(entry.batch, dot)]);
            let words = columns.word_offsets[dot] as usize..columns.word_offsets[dot + 1] as usize;
            let first: usize =
                columns.masks[..words.start].iter().map(|mask| mask.count_ones() as usize).sum();
            let pixels: Vec<usize> = words
                .flat_map(|word| {
                    let (at, mask) = (columns.words[word] as usize * 32, columns.masks[word]);
                    (0..32).filter(move |bit| mask >> bit & 1 == 1).map(move |bit| at + bit)
                })
                .collect();
            let brightest = (0..pixels.len())
                .max_by(|&a, &b| columns.values[first + a].total_cmp(&columns.values[first + b]));
            let Some(brightest) = brightest else { continue };
            let raw = f64::from(frame[[pixels[brightest] / 128, pixels[brightest] % 128]]);
            let above = f64::from(columns.values[first + brightest]);
            assert!((raw - above - 64.0).abs() < 8.0, "batch {}, dot {dot}: {raw}, {above}", entry.batch);
        }
        let missing = (1..299).filter(|&dot| !places.contains_key(&(entry.batch, dot))).collect::<Vec<_>>();
        assert_eq!(missing, entry.missing);
    }
}

#[test]
fn lighting_patterns_come_from_images_and_sequences() {
    let folder = tempfile::tempdir().unwrap();
    let bench = Bench::dots(&format!("plan_folders = [{:?}]\n{}", folder.path(), rig("")));
    let file = |name: &str| folder.path().join(name);
    let half = |at: usize, columns: usize| if at < columns / 2 { 1.0_f32 } else { 0.0 };
    let left = Array2::from_shape_fn((4, 8), |(_, column)| half(column, 8));
    let right = left.mapv(|light| 1.0 - light);
    // Three images; the second is red.
    let sequence = Array4::from_shape_fn((3, 4, 8, 3), |(image, row, column, colour)| match image {
        0 => left[[row, column]],
        1 => {
            if colour == 0 {
                1.0
            } else {
                0.0
            }
        }
        _ => right[[row, column]],
    });
    ndarray_npy::write_npy(file("left.npy"), &left).unwrap();
    ndarray_npy::write_npy(file("sequence.npy"), &sequence).unwrap();
    let products = format!(
        "product = [{{ kind = \"relight\", name = \"white\", pattern = \"white\" }}, \
         {{ kind = \"relight\", name = \"left\", image = {:?} }}, \
         {{ kind = \"relight\", name = \"sequence\", image = {:?} }}]",
        file("left.npy"),
        file("sequence.npy")
    );
    let ended = completed(&bench, &plan(&products, 4));
    let path = |name: &str| ended.open().0.products_path().join(format!("{name}.npy"));
    let white: Array3<f32> = ndarray_npy::read_npy(path("white")).unwrap();
    let left_lit: Array3<f32> = ndarray_npy::read_npy(path("left")).unwrap();
    let lit: Array4<f32> = ndarray_npy::read_npy(path("sequence")).unwrap();
    let colour = |image: usize, colour: usize| lit.slice(s![image, .., .., colour]);
    let brightest = white.fold(0.0, |most: f32, &light| most.max(light));
    let near = |a: ndarray::ArrayView2<f32>, b: ndarray::ArrayView2<f32>| {
        Zip::from(a).and(b).all(|a, b| (a - b).abs() <= 1e-3 * brightest)
    };
    for image in 0..4 {
        let is_left = image % 3 == 0;
        match image {
            1 => {
                assert!(near(colour(1, 0), white.index_axis(Axis(0), 1)));
                assert!(colour(1, 1).iter().all(|&light| light == 0.0));
            }
            image => {
                let lit_left = left_lit.index_axis(Axis(0), image);
                let lit_right = &white.index_axis(Axis(0), image) - &lit_left;
                let expected = if is_left { lit_left } else { lit_right.view() };
                assert!((0..3).all(|of| near(colour(image, of), expected)), "image {image}");
            }
        }
    }
    // Dots of the left half light the left half of the groove more than the right half.
    let side = |columns: std::ops::Range<usize>| left_lit.slice(s![.., ..112, columns]).sum();
    assert!(side(0..64) > 2.0 * side(64..128), "{} {}", side(0..64), side(64..128));

    // The session stores the patterns: products can be recomputed when the original files are gone.
    let before = std::fs::read(path("sequence")).unwrap();
    drop(folder);
    std::fs::remove_dir_all(ended.open().0.products_path()).unwrap();
    assert_eq!(process(&ended.session).unwrap().problems, [""; 0]);
    assert!(std::fs::read(path("sequence")).unwrap() == before);

    let gone = bench.runner.run(RunParams { plan: plan(&products, 1), ..RunParams::default() }).unwrap_err();
    assert!(gone.message.contains("left.npy"), "{}", gone.message);
}

/// Performs an action once a given number of frames have been denoised.
struct Trap {
    inner: Arc<dyn ColumnStage>,
    shared: Arc<Shared>,
}

struct Shared {
    frames_left: AtomicUsize,
    runner: OnceLock<Arc<Runner>>,
    spring: fn(&Runner),
}

struct TrapWorker(Box<dyn ColumnWorker>, Arc<Shared>);

impl ColumnStage for Trap {
    fn worker(&self) -> Box<dyn ColumnWorker> {
        Box::new(TrapWorker(self.inner.worker(), self.shared.clone()))
    }
}

impl ColumnWorker for TrapWorker {
    fn column(
        &mut self,
        frame: &[u16],
        background: &Background,
        floor: NoiseFloor,
        column: &mut SparseColumn,
    ) -> Result<(), DotsError> {
        if self.1.frames_left.fetch_sub(1, Relaxed) == 1 {
            (self.1.spring)(self.1.runner.get().unwrap());
        }
        self.0.column(frame, background, floor, column)
    }
}

/// A mirror, and the last that was asked of it, feeding left out.
struct Watched(Box<dyn Mirror>, Arc<Mutex<&'static str>>);

impl Mirror for Watched {
    fn capabilities(&self) -> &MirrorCapabilities {
        self.0.capabilities()
    }

    fn load(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        self.0.load(path)
    }

    fn start(&mut self, batches: u32) -> Result<(), DeviceError> {
        *self.1.lock().unwrap() = "start";
        self.0.start(batches)
    }

    fn feed(&mut self) -> Result<MirrorProgress, DeviceError> {
        self.0.feed()
    }

    fn park(&mut self) -> Result<(), DeviceError> {
        self.0.park()?;
        *self.1.lock().unwrap() = "park";
        Ok(())
    }
}

/// A bench whose stage calls `spring` before it denoises, at the given frame of the passes with light; and the last that
/// was asked of its mirror.
fn trapped(rig: &str, frame: usize, spring: fn(&Runner)) -> (Bench, Arc<Mutex<&'static str>>) {
    let asked = Arc::new(Mutex::new(""));
    let watched = asked.clone();
    let instead = move |mut devices: DotDevices| {
        let mirror = devices.mirror.take().map(|mirror| Watched(mirror, watched.clone()));
        devices.mirror = mirror.map(|mirror| Box::new(mirror) as Box<dyn Mirror>);
        devices
    };
    let shared = Arc::new(Shared { frames_left: AtomicUsize::new(frame), runner: OnceLock::new(), spring });
    let around = {
        let shared = shared.clone();
        move |inner| Arc::new(Trap { inner, shared: shared.clone() }) as Arc<dyn ColumnStage>
    };
    let probes = Probes {
        column_stage: Some(Arc::new(around)),
        dot_devices: Some(Arc::new(instead)),
        ..Probes::default()
    };
    let bench = Bench::dots_with_probes(rig, probes);
    assert!(shared.runner.set(bench.runner.clone()).is_ok());
    (bench, asked)
}

/// Where the brightest pixel of each dot is in a batch; `None` for a dot without light.
fn places(ended: &Ended, batch: usize) -> Vec<Option<usize>> {
    let columns = ended.open().0.dots().unwrap().read(batch).unwrap();
    let mut values = columns.values.iter();
    let dots = columns.word_offsets.windows(2).map(|range| {
        let words = range[0] as usize..range[1] as usize;
        let pixels = words.flat_map(|word| {
            let (at, mask) = (columns.words[word] as usize * 32, columns.masks[word]);
            (0..32).filter(move |bit| mask >> bit & 1 == 1).map(move |bit| at + bit)
        });
        let lit = pixels.zip(values.by_ref().copied()).collect::<Vec<_>>();
        lit.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).map(|(pixel, _)| pixel)
    });
    dots.collect()
}

#[test]
fn a_pause_parks_the_mirror_at_once_and_costs_no_batch() {
    let straight = Bench::dots(&rig(""));
    let through = completed(&straight, &plan(FLOODLIT, 2));
    let batches = |ended: &Ended| -> Vec<_> {
        entries(ended).iter().map(|entry| (entry.batch, entry.plane, entry.missing.len())).collect()
    };
    // Before the first trailing dot, in the second batch of the first plane, and in the scene; a pass plays two batches
    // more than are asked for.
    for (frame, expected) in [(10, 0), (700, 1), (2 * 1200 + 800, 5)] {
        let (bench, asked) = trapped(&rig(""), frame, |runner| runner.pause().unwrap());
        let mut events = bench.runner.events();
        let plan = plan(FLOODLIT, 2).replace("dark_frames = 64", "dark_frames = 64\nkeep_raw = true");
        bench.runner.run(RunParams { plan, ..RunParams::default() }).unwrap();
        wait_until(|| bench.runner.status().state == RunState::Paused && *asked.lock().unwrap() == "park");
        // Enough time for a run that does not pause to acquire the rest.
        std::thread::sleep(Duration::from_millis(500));
        let stored = bench.runner.status().progress.map_or(0, |progress| progress.points_stored);
        assert_eq!((bench.runner.status().state, *asked.lock().unwrap()), (RunState::Paused, "park"));
        bench.runner.go_on().unwrap();
        let held = end_of(&mut events);
        assert_eq!(held.state, "complete", "{:?}", held.error);
        assert_eq!(stored, expected, "at frame {frame}");
        assert_eq!(batches(&held), batches(&through), "at frame {frame}");
        for batch in 0..4 {
            // Noise moves the brightest pixel at most to a neighbour, and neighbouring dots are further apart.
            let moved =
                places(&held, batch).into_iter().zip(places(&through, batch)).filter(|pair| match pair {
                    (Some(a), Some(b)) => (a / 128).abs_diff(b / 128) > 1 || (a % 128).abs_diff(b % 128) > 1,
                    (a, b) => a != b,
                });
            assert_eq!(moved.count(), 0, "at frame {frame}: dots of batch {batch} are elsewhere");
        }
        let (of_held, of_through) = (held.open().1.counts, through.open().1.counts);
        assert!(of_held.balanced(), "{of_held:?}");
        assert_eq!((of_held.lost_total(), of_held.averaged), (0, of_through.averaged));
        let raw = held.open().0.raw_path();
        let frames: Array3<u16> = ndarray_npy::read_npy(&raw).unwrap();
        let lines = std::fs::read_to_string(raw.with_extension("csv")).unwrap();
        assert_eq!(lines.lines().count(), 1 + frames.dim().0, "at frame {frame}: each frame has one line");
    }
}

#[test]
fn no_path_begins_in_a_pause() {
    for _ in 0..2 {
        let (bench, asked) = trapped(&rig(""), usize::MAX, |_| {});
        let mut events = bench.runner.events();
        bench.runner.run(RunParams { plan: plan(FLOODLIT, 2), ..RunParams::default() }).unwrap();
        wait_until(|| bench.runner.pause().is_ok());
        std::thread::sleep(Duration::from_millis(200));
        assert_eq!(bench.runner.status().state, RunState::Paused);
        assert_ne!(*asked.lock().unwrap(), "start", "the mirror plays");
        bench.runner.go_on().unwrap();
        assert_eq!(end_of(&mut events).state, "complete");
    }
}

#[test]
fn a_cancelled_run_makes_videos_of_the_batches_that_are_there() {
    let straight = Bench::dots(&rig(""));
    let through = completed(&straight, &plan(FLOODLIT, 6));
    // Both planes take four batches each of 300 dots; this frame is in the fourth batch of the scene.
    let (bench, _) = trapped(&rig(""), 2 * 4 * 300 + 4 * 300 + 150, |runner| runner.cancel().unwrap());
    let ended = bench.run(&plan(FLOODLIT, 6));
    assert_eq!(ended.state, "cancelled", "{:?}", ended.error);
    let stored = checksums(&ended);
    assert!((5..10).contains(&stored.len()), "{stored:?}");
    assert_eq!(stored, checksums(&through)[..stored.len()]);
    assert!(!ended.open().0.products_path().join("floodlit.npy").exists());
    let made = process(&ended.session).unwrap();
    assert_eq!((made.stored, made.points), (stored.len(), 10));
    let (video, whole) = (floodlit(&ended), floodlit(&through));
    assert_eq!(video.dim().0, stored.len() - 4);
    assert!(video == whole.slice(s![..video.dim().0, .., ..]));
}

/// Returns a program's standard output.
fn output(program: &str, before: &[&str], file: &Path, after: &[&str]) -> Vec<u8> {
    let output = Command::new(program).args(before).arg(file).args(after).output();
    let output = output.expect("ffmpeg and ffprobe: `cargo xtask test` installs them");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

/// Decodes a file to RGB images.
fn decoded(file: &Path) -> Vec<u8> {
    output("ffmpeg", &["-loglevel", "error", "-i"], file, &["-f", "rawvideo", "-pix_fmt", "rgb24", "-"])
}

#[test]
fn videos_are_the_pictures_of_the_sequence_at_the_rate_of_the_batches() {
    let products = "product = [{ kind = \"floodlit\" }, { kind = \"relight\" }, { kind = \"dual\", size_px = [13, 15] }]";
    let bench = Bench::dots(&rig(""));
    let ended = completed(&bench, &plan(products, 5));
    let folder = ended.open().0.products_path();
    for (name, size, padded) in [
        ("floodlit", [128, 128], [128, 128]),
        ("relit", [128, 128], [128, 128]),
        ("dual", [13, 15], [14, 16]),
    ] {
        let video = folder.join(format!("{name}.mp4"));
        let fields = "stream=codec_name,width,height,r_frame_rate,nb_read_frames";
        let said = output(
            "ffprobe",
            &["-loglevel", "error", "-count_frames", "-show_entries", fields, "-of", "csv=p=0"],
            &video,
            &[],
        );
        let [rows, columns] = padded;
        assert_eq!(
            String::from_utf8(said).unwrap().trim(),
            format!("h264,{columns},{rows},20/1,5"),
            "{name}"
        );
        let images = decoded(&video);
        for image in 0..5 {
            let picture = decoded(&folder.join(name).join(format!("{image:04}.png")));
            let [height, width] = size;
            let mut differences = Vec::new();
            for (row, column) in (0..height).flat_map(|row| (0..width).map(move |column| (row, column))) {
                let (of_video, of_picture) =
                    (((image * rows + row) * columns + column) * 3, (row * width + column) * 3);
                // Luminance, because colour is stored at half resolution.
                let light = |rgb: &[u8]| {
                    0.299 * f64::from(rgb[0]) + 0.587 * f64::from(rgb[1]) + 0.114 * f64::from(rgb[2])
                };
                differences.push(light(&images[of_video..][..3]) - light(&picture[of_picture..][..3]));
            }
            let mean = |of: &dyn Fn(f64) -> f64| {
                differences.iter().map(|&difference| of(difference)).sum::<f64>() / differences.len() as f64
            };
            let rms = mean(&|difference| difference * difference).sqrt();
            println!("{name} {image}: rms {rms:.2} of 255, mean {:.2}", mean(&|difference| difference));
            assert!(rms < 8.0 && mean(&|difference| difference).abs() < 2.5, "{name} {image}: {rms}");
        }
    }
}

#[test]
fn a_recording_may_end_before_its_plan_does() {
    let plan = plan(FLOODLIT, 3).replace("[batches]\n", "[batches]\ncalibration = []\n");
    let plan = plan.split("[[batches.calibration]]").next().unwrap();
    // Beyond what any mirror may do: this one has done it already.
    let large = plan.replace("[2.3, 1.3]", "[20, 11]");
    let raw = plan.replace("dark_frames = 64", "dark_frames = 64\nkeep_raw = true");
    let bench = Bench::dots(&rig(""));
    let recorded = completed(&bench, &raw);
    let frames: Array3<u16> = ndarray_npy::read_npy(recorded.open().0.raw_path()).unwrap();
    let dark =
        Array3::from_shape_fn((64, 128, 128), |(n, t, s)| 62 + ((7 * n + 5 * t + 3 * s + n * s) % 5) as u16);
    let recording = concatenate![Axis(0), dark, frames];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recording.npy");
    let played = |frames: usize| {
        ndarray_npy::write_npy(&path, &recording.slice(s![..frames, .., ..])).unwrap();
        let bench =
            Bench::dots(&format!("kind = \"dots\"\n[camera]\ndriver = \"replay\"\nreplay.path = {path:?}\n"));
        let ended = completed(&bench, &large);
        let (session, state) = ended.open();
        assert!(state.end.as_ref().unwrap().final_s.is_some());
        let report = std::fs::read_to_string(session.report_path()).unwrap();
        (state.batches().count(), report.contains("the recording ends after"))
    };
    assert_eq!(played(recording.dim().0), (3, false));
    // A trailing dot more than the batches need.
    assert_eq!(played(64 + 4 * 300 + 40), (3, false));
    assert_eq!(played(64 + 2 * 300 + 140), (1, true));
}
