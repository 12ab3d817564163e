//! Video files from the pictures of products.

use std::io::ErrorKind;
use std::path::Path;
use std::process::{Command, Stdio};

use raysweep_session::{Result, durable};

/// Encodes PNG sequences as video files, where ffmpeg is installed.
#[derive(Default)]
pub(crate) struct Encoder {
    /// What could not be encoded, and why; each reason once.
    pub problems: Vec<String>,
}

impl Encoder {
    /// Encodes the PNG sequence of a video among the products as `NAME.mp4`.
    ///
    /// # Errors
    /// When the file cannot be moved into place.
    pub fn encode(&mut self, products: &Path, name: &str, images_per_s: f64) -> Result<()> {
        let target = products.join(format!("{name}.mp4"));
        durable::write_by(&target, |draft| match encode_to(draft, &products.join(name), images_per_s) {
            Ok(()) => true,
            Err(problem) => {
                if !self.problems.contains(&problem) {
                    self.problems.push(problem);
                }
                false
            }
        })
    }
}

/// Encodes the images of a folder as one file; the error says why not.
fn encode_to(target: &Path, images: &Path, images_per_s: f64) -> std::result::Result<(), String> {
    let failed = |what: String| {
        let name = images.file_name().unwrap_or_default().to_string_lossy();
        format!("ffmpeg could not make {name}.mp4: {what}")
    };
    let ended = Command::new("ffmpeg")
        .args(["-y", "-loglevel", "error", "-framerate", &format!("{images_per_s:.4}"), "-i"])
        .arg(images.join("%04d.png"))
        // Players need even sides and half-resolution chroma.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-pix_fmt", "yuv420p"])
        // The temporary file's name does not say the format.
        .args(["-f", "mp4"])
        .arg(target)
        .stdin(Stdio::null())
        .output();
    match ended {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => Err(failed(String::from_utf8_lossy(&output.stderr).trim().to_owned())),
        Err(error) if error.kind() == ErrorKind::NotFound => Err("ffmpeg is not installed, so there are only PNG sequences and no video files: install it and run `raysweep process`".into()),
        Err(error) => Err(failed(error.to_string())),
    }
}
