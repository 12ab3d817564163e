//! `raysweep materials` and `raysweep profiles`: how light spreads in stored sweeps, and what that tells of materials.

use std::path::{Path, PathBuf};

use raysweep_processing::materials::{Labelled, Measured, SpreadOptions, apply, compare, evaluate, train};
use serde_json::json;

use super::arguments::{LabelledArguments, MaterialsCommand, SceneScale};
use super::failure::CommandFailure;
use super::printer::Printer;

pub(super) fn tell(
    command: MaterialsCommand,
    folder_of: impl Fn(PathBuf) -> Result<PathBuf, CommandFailure>,
    printer: Printer,
) -> Result<(), CommandFailure> {
    match command {
        MaterialsCommand::Train { labelled, to } => {
            let mm_per_row = scale(labelled.scene)?;
            let model = train(&pairs(labelled, folder_of)?, mm_per_row, &to)?;
            let value = json!({
                "model": to, "materials": model.materials, "recalls": model.recalls(), "c": model.c,
                "gamma": model.gamma, "bins": model.bins, "trained_on": model.trained_on,
            });
            printer.print(&value, |_| {
                format!(
                    "{}\nshares of each material's pixels found as each ({}), in cross-validation:\n{}",
                    to.display(),
                    model.materials.join(", "),
                    model.table()
                )
            })?;
        }
        MaterialsCommand::Apply { session, model, window, scene, to } => {
            let applied = apply(&folder_of(session)?, &model, scale(scene)?, window, &to)?;
            printer.print(&json!(applied), |_| {
                let materials =
                    applied.materials.iter().map(|(name, pixels)| format!("{pixels:>9} px {name}"));
                let rest = [(applied.unknown, "unknown"), (applied.dark, "too dark")];
                let rest = rest.map(|(pixels, name)| format!("{pixels:>9} px {name}"));
                let page = to.join("report.html");
                materials.chain(rest).chain([page.display().to_string()]).collect::<Vec<_>>().join("\n")
            })?;
        }
        MaterialsCommand::Evaluate { labelled, model, to } => {
            let mm_per_row = scale(labelled.scene)?;
            let evaluation = evaluate(&pairs(labelled, folder_of)?, &model, mm_per_row, &to)?;
            let page = to.join("report.html");
            printer.print(&json!(evaluation), |_| format!("{}\n{}", evaluation.table(), page.display()))?;
        }
    }
    Ok(())
}

/// How profiles are looked at.
pub(super) struct ProfileLook {
    pub refractive_index: f64,
    pub maps: bool,
}

pub(super) fn profiles(
    labelled: LabelledArguments,
    ProfileLook { refractive_index, maps }: ProfileLook,
    to: &Path,
    folder_of: impl Fn(PathBuf) -> Result<PathBuf, CommandFailure>,
    printer: Printer,
) -> Result<(), CommandFailure> {
    let options = SpreadOptions { mm_per_row: scale(labelled.scene)?, refractive_index, maps };
    let regions = compare(&pairs(labelled, folder_of)?, options, to)?;
    printer.print(&json!(regions), |_| {
        let cell = |measured: Option<Measured>, unit: &str| {
            measured.map_or("none".to_owned(), |measured| {
                format!("{:.3} ± {:.3}{unit}", measured.value, measured.sd)
            })
        };
        let line = |region: &raysweep_processing::materials::RegionSpread| {
            format!(
                "{}: effective width {}, asymmetry {}, decay length {}",
                region.label,
                cell(region.effective_width_rows, " rows"),
                cell(region.asymmetry, ""),
                cell(region.decay_length_mm, " mm")
            )
        };
        let page = to.join("report.html").display().to_string();
        regions.iter().map(line).chain([page]).collect::<Vec<_>>().join("\n")
    })?;
    Ok(())
}

fn scale(SceneScale { mm_per_row }: SceneScale) -> Result<Option<f64>, CommandFailure> {
    match mm_per_row.filter(|mm| !(1e-3..=1e3).contains(mm)) {
        Some(mm) => {
            Err(CommandFailure::Sessions(format!("--mm-per-row {mm}: must be from 0.001 to 1000 mm")))
        }
        None => Ok(mm_per_row),
    }
}

/// Each session with its file of labels.
fn pairs(
    LabelledArguments { sessions, labels, .. }: LabelledArguments,
    folder_of: impl Fn(PathBuf) -> Result<PathBuf, CommandFailure>,
) -> Result<Vec<Labelled>, CommandFailure> {
    let of = |at: usize| -> Option<&Path> {
        labels.get(if labels.len() == 1 { 0 } else { at }).map(PathBuf::as_path)
    };
    if labels.len() != 1 && labels.len() != sessions.len() {
        return Err(CommandFailure::Sessions(format!(
            "--labels is given {} times for {} sessions: give one for each, in their order, or one for all",
            labels.len(),
            sessions.len()
        )));
    }
    let pair = |(at, session)| -> Result<Labelled, CommandFailure> {
        let labels = of(at).map(Path::to_owned).unwrap_or_default();
        Ok(Labelled { session: folder_of(session)?, labels })
    };
    sessions.into_iter().enumerate().map(pair).collect()
}
