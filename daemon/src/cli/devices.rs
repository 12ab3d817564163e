//! Cameras that respond, and their settings; needs no daemon.

use std::path::PathBuf;

use clap::Subcommand;

use super::exit::Exit;
use super::failure::CommandFailure;
use super::printer::Printer;

#[derive(Debug, Subcommand)]
pub(super) enum CameraCommand {
    /// Write all settings of the camera to a feature file
    Save {
        /// The file to write
        file: PathBuf,
        /// The camera's address or name [default: the only one that responds]
        #[arg(long, value_name = "NAME")]
        camera: Option<String>,
    },
    /// Set the camera from a feature file, and list the lines that it refused
    Load {
        /// The file to read
        file: PathBuf,
        /// The camera's address or name [default: the only one that responds]
        #[arg(long, value_name = "NAME")]
        camera: Option<String>,
    },
}

#[cfg(not(feature = "aravis"))]
pub(super) fn devices(_: Printer) -> Result<Exit, CommandFailure> {
    Err(CommandFailure::WithoutAravis)
}

#[cfg(not(feature = "aravis"))]
pub(super) fn camera(_: CameraCommand, _: Printer) -> Result<Exit, CommandFailure> {
    Err(CommandFailure::WithoutAravis)
}

#[cfg(feature = "aravis")]
pub(super) use with_aravis::{camera, devices};

#[cfg(feature = "aravis")]
mod with_aravis {
    use std::fs;

    use raysweep_drivers::camera::aravis::{
        FoundCamera, RefusedLine, discover, load_features, save_features,
    };
    use serde_json::json;

    use super::super::plan_file::read_small;
    use super::{CameraCommand, CommandFailure, Exit, Printer};

    /// Lists the cameras that respond.
    pub fn devices(printer: Printer) -> Result<Exit, CommandFailure> {
        printer.print(&discover(), |found| table(found))?;
        Ok(Exit::Done)
    }

    pub fn camera(command: CameraCommand, printer: Printer) -> Result<Exit, CommandFailure> {
        match command {
            CameraCommand::Save { file, camera } => {
                let camera = the_camera(camera)?;
                let text = save_features(&camera)?;
                fs::write(&file, &text)
                    .map_err(|source| CommandFailure::Write { path: file.clone(), source })?;
                let lines = text.lines().filter(|line| !line.starts_with('#')).count();
                let value = json!({ "camera": camera, "file": file, "lines": lines });
                printer
                    .print(&value, |_| format!("{lines} lines of {camera} written to {}", file.display()))?;
                Ok(Exit::Done)
            }
            CameraCommand::Load { file, camera } => {
                let text = read_small(&file)?;
                let camera = the_camera(camera)?;
                let (taken, refused) = load_features(&camera, &text)?;
                let value = json!({ "camera": camera, "taken": taken, "refused": refused });
                printer.print(&value, |_| loaded(&camera, taken, &refused))?;
                Ok(if refused.is_empty() { Exit::Done } else { Exit::Failed })
            }
        }
    }

    fn the_camera(named: Option<String>) -> Result<String, CommandFailure> {
        if let Some(named) = named {
            return Ok(named);
        }
        let found = discover();
        match found.as_slice() {
            [only] => Ok(only.name.clone()),
            _ => Err(CommandFailure::WhichCamera(table(&found))),
        }
    }

    fn table(found: &[FoundCamera]) -> String {
        if found.is_empty() {
            return "no camera found: check its power, and that it is on a network of this machine".into();
        }
        let heading = ["NAME", "ADDRESS", "PROTOCOL", "VENDOR", "MODEL"].map(str::to_owned);
        let rows = found.iter().map(|camera| {
            let FoundCamera { name, vendor, model, address, protocol } = camera.clone();
            [name, address, protocol, vendor, model]
        });
        let rows: Vec<[String; 5]> = [heading].into_iter().chain(rows).collect();
        let width = |column: usize| rows.iter().map(|row| row[column].len()).max().unwrap_or(0);
        let widths = [0, 1, 2, 3].map(width);
        let lines = rows.iter().map(|[name, address, protocol, vendor, model]| {
            let [a, b, c, d] = widths;
            format!("{name:a$}  {address:b$}  {protocol:c$}  {vendor:d$}  {model}")
        });
        lines.collect::<Vec<_>>().join("\n")
    }

    fn loaded(camera: &str, taken: usize, refused: &[RefusedLine]) -> String {
        let mut text = format!("{taken} lines taken by {camera}");
        for RefusedLine { line, reason } in refused {
            text += &format!("\nrefused: {line}: {reason}");
        }
        text
    }
}
