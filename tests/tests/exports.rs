//! `raysweep export --format`: every format, read by the programs that are meant to read it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::path::Path;
use std::process::Command;

use raysweep_processing::{ExportFormat, ExportScope, export_as};
use raysweep_tests::{Bench, PRODUCTS, data, rig_text, with_products};

const FORMATS: [(&str, ExportFormat); 7] = [
    ("exr", ExportFormat::Exr),
    ("npy", ExportFormat::Npy),
    ("png", ExportFormat::Png),
    ("tiff16", ExportFormat::Tiff16),
    ("tiff32", ExportFormat::Tiff32),
    ("mat", ExportFormat::Mat),
    ("zip.zip", ExportFormat::Zip),
];

fn files_in(folder: &Path) -> usize {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.map(|path| if path.is_dir() { files_in(&path) } else { 1 }).sum()
}

#[test]
fn every_format_has_the_values_of_the_products() {
    let bench =
        Bench::new(&rig_text(40, "scene = \"v-groove\"\nscene_rows = 24\nscene_columns = 16\nseed = 9", ""));
    let plan = "kind = \"sweep\"\n[sweep]\naverage = 2\ndelay_us = [-200, -100, 0, 100, 200]\nexposure_us = [100, 250]\n";
    let ended = bench.run(&with_products(&PRODUCTS, plan));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let folder = bench.folder.path().join("exports");
    fs::create_dir(&folder).unwrap();
    for (name, format) in FORMATS {
        let to = folder.join(name);
        let files = export_as(&ended.session, &to, false, ExportScope::Results, format).unwrap();
        let found = if to.is_dir() { files_in(&to) } else { files };
        assert!(files == found && files >= 2, "{name}: {files} files, and {found} are there");
        let again =
            export_as(&ended.session, &to, false, ExportScope::Results, format).unwrap_err().to_string();
        assert!(again.contains("already exists"), "{again}");
    }
    let left: Vec<_> = fs::read_dir(&folder).unwrap().flatten().collect();
    assert_eq!(left.len(), FORMATS.len(), "nothing else is left: {left:?}");
    let python = std::env::var_os("RAYSWEEP_PYTHON").expect(
        "RAYSWEEP_PYTHON names a Python with tests/python/requirements.txt: `cargo xtask test` makes one",
    );
    let script = data("").join("../python/read_export.py");
    let read = Command::new(python).arg(script).arg(&ended.session).arg(&folder).output().unwrap();
    assert!(read.status.success(), "{}", String::from_utf8_lossy(&read.stderr));

    // A damaged product is exported in no format.
    let product = ended.session.join("products/epipolar.npy");
    let mut bytes = fs::read(&product).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&product, bytes).unwrap();
    for (name, format) in FORMATS {
        let to = folder.join(format!("damaged-{name}"));
        let refused =
            export_as(&ended.session, &to, false, ExportScope::Results, format).unwrap_err().to_string();
        assert!(refused.contains("products/epipolar.npy"), "{name}: {refused}");
        assert!(!to.exists(), "{name}");
    }
    export_as(&ended.session, &folder.join("anyway"), true, ExportScope::Results, ExportFormat::Mat).unwrap();
}
