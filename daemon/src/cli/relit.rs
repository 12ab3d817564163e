//! `raysweep relit`: a scene relit by the transport of a sweep, beside captures of it.

use std::path::{Path, PathBuf};

use raysweep_processing::{RelitImage, RelitPicture, relit};
use serde_json::json;

use super::failure::CommandFailure;
use super::printer::Printer;

pub(super) fn compare(
    sweep: PathBuf,
    captures: Vec<PathBuf>,
    to: &Path,
    folder_of: impl Fn(PathBuf) -> Result<PathBuf, CommandFailure>,
    printer: Printer,
) -> Result<(), CommandFailure> {
    let captures = captures.into_iter().map(&folder_of).collect::<Result<Vec<_>, _>>()?;
    let pictures = relit(&folder_of(sweep)?, &captures, to)?;
    printer.print(&json!(pictures), |_| {
        let files = format!("{}: images, and pictures of them side by side", to.display());
        pictures.iter().map(text).chain([files]).collect::<Vec<_>>().join("\n")
    })?;
    Ok(())
}

fn text(RelitPicture { name, shows, reference_s, compared_px, images, .. }: &RelitPicture) -> String {
    let line = |RelitImage { light_s, snr_db, psnr_db, .. }: &RelitImage| {
        let what = match light_s {
            Some(light_s) => format!("captured in {light_s:.3} s"),
            None => "relit".to_owned(),
        };
        match snr_db.zip(*psnr_db) {
            Some((snr_db, psnr_db)) => format!("  {what}: SNR {snr_db:.1} dB, PSNR {psnr_db:.1} dB"),
            None => format!("  {what}: no light, or no difference"),
        }
    };
    let head =
        format!("{name}, {shows}, against the capture of {reference_s:.3} s, over {compared_px} pixels:");
    std::iter::once(head).chain(images.iter().map(line)).collect::<Vec<_>>().join("\n")
}
