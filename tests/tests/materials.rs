//! Materials are told in media that a Monte Carlo renderer made (`tests/examples/media.rs`), through the whole chain:
//! simulated rig with a 12-bit sensor, sweep, transport, model. Training and test have other containers, tilts,
//! distances and exposures.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use raysweep_processing::materials::{
    Evaluation, Labelled, MaterialModel, SpreadOptions, apply, compare, evaluate, train,
};
use raysweep_tests::{Bench, Ended, data, rig_text};

/// Containers in a scene, from the left: their labels, size and first row, as the renderer has them.
struct Scene {
    file: &'static str,
    rows: usize,
    mm_per_row: f64,
    size_px: [usize; 2],
    first_row: usize,
    labels: &'static [&'static str],
}

const FIRST: Scene = Scene {
    file: "media_first.npz",
    rows: 48,
    mm_per_row: 0.25,
    size_px: [40, 20],
    first_row: 4,
    labels: &["lowfat milk", "reduced milk", "regular milk", "soap", "toothpaste"],
};
const SECOND: Scene = Scene {
    file: "media_second.npz",
    rows: 48,
    mm_per_row: 0.3,
    size_px: [36, 18],
    first_row: 7,
    labels: &["soap", "regular milk", "lowfat milk", "toothpaste", "reduced milk"],
};
const THIRD: Scene = Scene {
    file: "media_third.npz",
    rows: 48,
    mm_per_row: 0.27,
    size_px: [38, 20],
    first_row: 5,
    labels: &["toothpaste", "lowfat milk", "soap", "reduced milk", "ketchup", "regular milk"],
};

impl Scene {
    fn plan(&self, exposures_us: &str) -> String {
        format!(
            "kind = \"sweep\"\n[sweep]\nmm_per_row = {}\naverage = 8\nexposure_us = {exposures_us}\n\
             delay_us = {{ start = -660, stop = 660, count = 31 }}\n",
            self.mm_per_row
        )
    }

    fn bench(&self, seed: u32) -> Bench {
        let sim = format!("scene = {:?}\nseed = {seed}", data(self.file));
        let rig = rig_text(self.rows, &sim, "");
        Bench::new(&rig.replace("[camera]\n", "[camera]\npixel_format = \"Mono12\"\n"))
    }

    fn sweep(&self, seed: u32, exposures_us: &str) -> (Bench, Ended) {
        let bench = self.bench(seed);
        let ended = bench.run(&self.plan(exposures_us));
        assert_eq!(ended.state, "complete", "{:?}", ended.error);
        (bench, ended)
    }

    /// Writes the file of labels, also of the card between the containers.
    fn labelled(&self, folder: &Path, session: &Path) -> Labelled {
        let [rows, columns] = self.size_px;
        let regions = self.labels.iter().enumerate().map(|(at, label)| {
            let first = 1 + at * (columns + 2);
            let (end_row, end) = (self.first_row + rows, first + columns);
            format!(
                "[[region]]\nlabel = {label:?}\nregion = [{}, {end_row}, {first}, {end}]\n",
                self.first_row
            )
        });
        let labels = folder.join("labels.toml");
        fs::write(&labels, regions.collect::<String>()).unwrap();
        Labelled { session: session.to_owned(), labels }
    }
}

/// Two sweeps for training, one to be judged, and a model.
struct Trained {
    _benches: [Bench; 3],
    training: Vec<Labelled>,
    unseen: Labelled,
    folder: tempfile::TempDir,
    model: PathBuf,
    trained: MaterialModel,
}

static TRAINED: LazyLock<Trained> = LazyLock::new(|| {
    let (first, one) = FIRST.sweep(1, "[200, 400, 800]");
    let (second, two) = SECOND.sweep(2, "[200, 400, 800]");
    let (third, three) = THIRD.sweep(3, "[150, 300, 600]");
    let training = vec![
        FIRST.labelled(first.folder.path(), &one.session),
        SECOND.labelled(second.folder.path(), &two.session),
    ];
    let unseen = THIRD.labelled(third.folder.path(), &three.session);
    let folder = tempfile::TempDir::new().unwrap();
    let model = folder.path().join("model.json");
    let trained = train(&training, None, &model).unwrap();
    Trained { _benches: [first, second, third], training, unseen, folder, model, trained }
});

fn shares(evaluation: &Evaluation, window_px: usize, at_edges: bool) -> ndarray::Array2<f64> {
    let wanted = |judged: &&raysweep_processing::materials::Judged| {
        (judged.window_px, judged.at_edges) == (window_px, at_edges)
    };
    evaluation.judged.iter().find(wanted).unwrap().shares()
}

#[test]
fn five_media_are_told_in_another_render_and_strangers_are_rejected() {
    let trained = &*TRAINED;
    println!("cross-validated\n{}", trained.trained.table());
    let to = trained.folder.path().join("evaluation");
    let evaluation = evaluate(std::slice::from_ref(&trained.unseen), &trained.model, None, &to).unwrap();
    println!("{}", evaluation.table());
    assert_eq!(evaluation.strangers, ["ketchup"]);
    for window_px in [1, 3] {
        let worst = evaluation.worst(window_px).unwrap();
        assert!(worst >= 0.91, "{window_px} px: {worst}");
        let inside = shares(&evaluation, window_px, false);
        for material in 0..5 {
            let rejected = inside[[material, 5]];
            assert!(rejected <= 0.05, "{window_px} px: {rejected} of material {material} is unknown");
        }
        let stranger = inside[[5, 5]];
        assert!(stranger >= 0.8, "{window_px} px: {stranger} of the ketchup is unknown");
    }
}

#[test]
fn a_map_has_what_the_labels_say_and_the_card_is_unknown() {
    let trained = &*TRAINED;
    let to = trained.folder.path().join("map");
    let map = apply(&trained.unseen.session, &trained.model, None, 3, &to).unwrap();
    let found = raysweep_session::products::Products::new(&to).read_image("materials").unwrap();
    assert_eq!(found.dim(), (48, 132));
    let all: usize = map.materials.iter().map(|(_, pixels)| pixels).sum::<usize>() + map.unknown + map.dark;
    assert_eq!(all, 48 * 132);
    // The first container has toothpaste, the columns between containers show the card.
    let toothpaste = map.materials.iter().position(|(name, _)| name == "toothpaste").unwrap();
    let middle = found.slice(ndarray::s![16..32, 6..16]);
    let right = middle.iter().filter(|value| **value == (toothpaste + 1) as f32).count();
    assert!(right * 100 >= 98 * middle.len(), "{middle}");
    assert!(found.slice(ndarray::s![1..3, ..]).iter().all(|value| *value == 0.0 || value.is_nan()));
    let page = fs::read_to_string(to.join("report.html")).unwrap();
    assert!(page.contains("toothpaste") && page.contains("unknown"));
}

#[test]
fn a_model_that_was_written_and_read_finds_the_same_and_a_damaged_one_is_refused() {
    let trained = &*TRAINED;
    let text = fs::read_to_string(&trained.model).unwrap();
    let read = MaterialModel::read(&trained.model).unwrap();
    assert_eq!((&read.materials, &read.bins), (&trained.trained.materials, &trained.trained.bins));
    let folder = tempfile::TempDir::new().unwrap();
    let cut = |to: usize| text[..to].to_owned();
    let cases = [
        ("no model", String::new()),
        ("cut", cut(text.len() / 2)),
        ("another format", text.replace("\"raysweep_materials\": 1", "\"raysweep_materials\": 2")),
        ("a material too many", text.replacen("\"materials\": [", "\"materials\": [\"brick\", ", 1)),
        (
            "bins that do not begin at 0",
            text.replacen("\"edges\": [\n      0.0", "\"edges\": [\n      0.01", 1),
        ),
        ("no machine", text.replacen("svm_type c_svc", "svm_type c_sv", 1)),
        ("a count that is too large", text.replacen("total_sv ", "total_sv 99999999", 1)),
    ];
    for (what, damaged) in cases {
        assert_ne!(damaged, text, "{what}");
        let path = folder.path().join("model.json");
        fs::write(&path, damaged).unwrap();
        let error = MaterialModel::read(&path).unwrap_err().to_string();
        assert!(error.contains("model.json"), "{what}: {error}");
    }
}

#[test]
fn what_cannot_be_trained_says_why_and_writes_nothing() {
    let trained = &*TRAINED;
    let folder = tempfile::TempDir::new().unwrap();
    let to = folder.path().join("model.json");
    let with = |labels: &str| {
        let file = folder.path().join("labels.toml");
        fs::write(&file, labels).unwrap();
        let labelled = Labelled { session: trained.training[0].session.clone(), labels: file };
        let error = train(&[labelled], None, &to).unwrap_err().to_string();
        assert!(!to.exists());
        error
    };
    let region = |label: &str, region: &str| format!("[[region]]\nlabel = \"{label}\"\nregion = {region}\n");
    let milk = region("milk", "[8, 40, 4, 18]");
    for (what, labels, said) in [
        ("outside", region("milk", "[0, 49, 0, 4]"), "the image has 48 rows and 112 columns"),
        ("one material", milk.clone(), "only `milk` is labelled"),
        ("too few pixels", format!("{milk}{}", region("soap", "[10, 20, 70, 74]")), "at least 40 are needed"),
        ("the same", format!("{milk}{}", region("cream", "[8, 40, 18, 21]")), "`cream`"),
        ("nothing", String::new(), "no pixel is labelled"),
        ("an unknown key", "regions = 1\n".to_owned(), "unknown field `regions`"),
        ("no image", "image = \"nothing.png\"\n[values]\n1 = \"milk\"\n".to_owned(), "nothing.png"),
    ] {
        let error = with(&labels);
        assert!(error.contains(said), "{what}: {error}");
    }
    // The left and the right half of one container are one material.
    let halves = format!("{}{}", region("left", "[8, 40, 2, 11]"), region("right", "[8, 40, 11, 20]"));
    let error = with(&halves);
    assert!(error.contains("cannot be told from the others"), "{error}");
}

#[test]
fn painted_labels_are_read_and_those_of_another_size_refused() {
    let trained = &*TRAINED;
    let folder = tempfile::TempDir::new().unwrap();
    let paint = |rows: usize, columns: usize| {
        let mut values = vec![0_u8; rows * columns];
        for (at, value) in values.iter_mut().enumerate() {
            // Containers are 20 columns wide, with 2 between them.
            let (t, s) = (at / columns, at % columns);
            if (4..44).contains(&t) && (1..110).contains(&s) && (s - 1) % 22 < 20 {
                *value = (1 + (s - 1) / 22) as u8;
            }
        }
        let file = fs::File::create(folder.path().join("labels.png")).unwrap();
        let mut encoder = png::Encoder::new(file, columns as u32, rows as u32);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.write_header().unwrap().write_image_data(&values).unwrap();
    };
    let names: String =
        (1..).zip(FIRST.labels).map(|(value, label)| format!("{value} = {label:?}\n")).collect();
    let file = folder.path().join("labels.toml");
    fs::write(&file, format!("image = \"labels.png\"\n[values]\n{names}")).unwrap();
    paint(48, 112);
    let by_hand =
        raysweep_processing::materials::Labels::read(&trained.training[0].labels, (48, 112)).unwrap();
    let painted = raysweep_processing::materials::Labels::read(&file, (48, 112)).unwrap();
    assert_eq!(painted, by_hand);
    paint(48, 111);
    let error = raysweep_processing::materials::Labels::read(&file, (48, 112)).unwrap_err().to_string();
    assert!(error.contains("has 48 rows and 111 columns"), "{error}");
}

#[test]
fn the_decay_length_of_a_known_slab_comes_out_within_a_tenth() {
    let slab = Scene {
        file: "media_slab.npz",
        rows: 80,
        mm_per_row: 0.25,
        size_px: [76, 28],
        first_row: 2,
        labels: &["slab"],
    };
    let (bench, ended) = slab.sweep(4, "[100, 200, 400, 800]");
    let mut labelled = slab.labelled(bench.folder.path(), &ended.session);
    // Away from the walls, which absorb.
    let labels = bench.folder.path().join("middle.toml");
    fs::write(&labels, "[[region]]\nlabel = \"slab\"\nregion = [30, 50, 8, 24]\n").unwrap();
    labelled.labels = labels;
    let to = bench.folder.path().join("profiles");
    let options = SpreadOptions { mm_per_row: None, refractive_index: 1.33, maps: true };
    let regions = compare(&[labelled.clone()], options, &to).unwrap();
    // Reduced scattering 2.0 per mm, absorption 0.2 per mm.
    let known_mm = 1.0 / (3.0 * 0.2 * (0.2 + 2.0_f64)).sqrt();
    let found = regions[0].decay_length_mm.unwrap();
    println!("decay length {} +- {} mm, known {known_mm}", found.value, found.sd);
    assert!((found.value / known_mm - 1.0).abs() < 0.1, "{} of {known_mm}", found.value);
    assert!(found.sd < 0.1 * known_mm, "{}", found.sd);
    let width = regions[0].effective_width_rows.unwrap();
    // Of the order of the mean free path, 0.45 mm or 1.8 rows.
    assert!((1.0..6.0).contains(&width.value) && width.sd < 0.5, "{width:?}");
    let asymmetry = regions[0].asymmetry.unwrap();
    assert!(asymmetry.value.abs() < 0.05, "{}", asymmetry.value);
    let maps = raysweep_session::products::Products::new(to.join(ended.session.file_name().unwrap()));
    let map = maps.read_image("decay-length").unwrap();
    let mut middle: Vec<f32> = map.slice(ndarray::s![30..50, 8..24]).iter().copied().collect();
    middle.sort_by(f32::total_cmp);
    let median = f64::from(middle[middle.len() / 2]);
    assert!((median / known_mm - 1.0).abs() < 0.15, "{median} of {known_mm}");
    for file in ["profiles.csv", "profiles-rows.svg", "profiles-us.svg", "profiles-log.svg", "report.html"] {
        assert!(fs::metadata(to.join(file)).unwrap().len() > 200, "{file}");
    }
    let csv = fs::read_to_string(to.join("profiles.csv")).unwrap();
    let shares: f64 =
        csv.lines().skip(1).map(|line| line.split(',').nth(5).unwrap().parse::<f64>().unwrap()).sum();
    assert!((shares - 1.0).abs() < 1e-6, "the profile's area is {shares}");

    // Without the size of a row, there are widths and no decay.
    let plan = fs::read_to_string(ended.session.join("plan.toml")).unwrap();
    fs::write(ended.session.join("plan.toml"), plan.replace("mm_per_row = 0.25\n", "")).unwrap();
    let to = bench.folder.path().join("rows");
    let regions = compare(&[labelled], SpreadOptions { maps: false, ..options }, &to).unwrap();
    assert!(regions[0].decay_length_mm.is_none() && regions[0].effective_width_rows.is_some());
    assert!(fs::read_to_string(to.join("report.html")).unwrap().contains("sweep.mm_per_row"));
}
