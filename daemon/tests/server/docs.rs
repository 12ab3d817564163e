//! Checks the statements of `docs/reference/socket.md`.

use std::process::Command;

use raysweep_proto::describe;

use crate::fake::{Daemon, session};

const DOCS: &str = include_str!("../../../docs/reference/socket.md");

#[test]
fn the_tables_have_every_method_and_every_error() {
    let description = describe("");
    for method in description.methods {
        let role = serde_json::to_value(method.role).unwrap();
        let row = format!("| `{}` | {} |", method.name, role.as_str().unwrap());
        assert!(DOCS.contains(&row), "{row}");
    }
    for error in description.errors {
        let name = serde_json::to_value(error.name).unwrap();
        let row = format!("| {} | `{}` |", error.code, name.as_str().unwrap());
        assert!(DOCS.contains(&row), "{row}");
    }
}

#[test]
fn the_tables_have_every_field_of_the_live_file() {
    let live = describe("").live;
    for field in live.header.iter().chain(&live.slot) {
        let count = if field.count > 1 { format!(" x {}", field.count) } else { String::new() };
        let dtype = field.dtype.replace('|', "\\|");
        let row = format!("| `{}` | {} | `{dtype}`{count} |", field.name, field.offset);
        assert!(DOCS.contains(&row), "{row}");
    }
}

#[test]
fn the_python_example_runs_a_plan_to_its_end() {
    let daemon = Daemon::start();
    let (_, section) = DOCS.split_once("## From Python").unwrap();
    let (_, example) = section.split_once("```python\n").unwrap();
    let (example, _) = example.split_once("```").unwrap();
    let plan = daemon.folder.path().join("plan.toml");
    let python = |text: &str| {
        std::fs::write(&plan, text).unwrap();
        let output =
            Command::new("python3").args(["-c", example]).arg(&daemon.path).arg(&plan).output().unwrap();
        (output.status.code(), [output.stdout, output.stderr].concat())
    };
    let (code, printed) = python("kind = \"sweep\"");
    let printed = String::from_utf8(printed).unwrap();
    assert!(code == Some(0) && printed.contains("'state': 'complete'"), "{printed}");
    assert!(printed.contains(session().to_str().unwrap()), "{printed}");
    let (code, printed) = python("bad plan");
    let printed = String::from_utf8(printed).unwrap();
    assert!(code == Some(1) && printed.contains("count is 0"), "{printed}");
}
