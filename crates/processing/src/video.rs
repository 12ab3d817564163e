//! Video files from the pictures of products.

use std::ffi::OsStr;
use std::io::{ErrorKind, Read};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use raysweep_session::{Result, durable};

/// Longer than a video takes, and each of its images.
const LIMIT: Duration = Duration::from_secs(300);
const LIMIT_OF_IMAGE: Duration = Duration::from_secs(1);
/// Most of its messages that are told.
const MOST_SAID_BYTES: u64 = 1 << 16;
/// How often it is looked whether ffmpeg has ended.
const LOOK: Duration = Duration::from_millis(20);

/// Encodes PNG sequences as video files, where ffmpeg is installed.
#[derive(Default)]
pub(crate) struct Encoder {
    /// What could not be encoded, and why; each reason once.
    pub problems: Vec<String>,
}

impl Encoder {
    /// Encodes the PNG sequence of a video among the products as `NAME.mp4`; breaks it off soon after `go_on` returns false.
    ///
    /// # Errors
    /// When the file cannot be moved into place, or an older one cannot be removed.
    pub fn encode(
        &mut self,
        products: &Path,
        name: &str,
        images_per_s: f64,
        go_on: &dyn Fn() -> bool,
    ) -> Result<()> {
        let target = products.join(format!("{name}.mp4"));
        // If this one fails, nobody shall take an older one for it.
        durable::remove(&target)?;
        durable::write_by(&target, |draft| {
            match encode_to(draft, &products.join(name), images_per_s, go_on) {
                Ok(()) => true,
                Err(problem) => {
                    if !self.problems.contains(&problem) {
                        self.problems.push(problem);
                    }
                    false
                }
            }
        })
    }
}

/// Encodes the images of a folder as one file; the error says why not.
fn encode_to(
    target: &Path,
    images: &Path,
    images_per_s: f64,
    go_on: &dyn Fn() -> bool,
) -> std::result::Result<(), String> {
    encode_by("ffmpeg".as_ref(), target, images, images_per_s, go_on)
}

/// [`encode_to`] by a program that takes ffmpeg's arguments.
fn encode_by(
    ffmpeg: &OsStr,
    target: &Path,
    images: &Path,
    images_per_s: f64,
    go_on: &dyn Fn() -> bool,
) -> std::result::Result<(), String> {
    let failed = |what: String| {
        let name = images.file_name().unwrap_or_default().to_string_lossy();
        format!("ffmpeg could not make {name}.mp4: {what}")
    };
    let target = std::path::absolute(target).map_err(|error| failed(error.to_string()))?;
    let started = Command::new(ffmpeg)
        // A path would be taken for a pattern or an option.
        .current_dir(images)
        .args(["-y", "-loglevel", "error", "-framerate", &format!("{images_per_s:.4}"), "-i", "%04d.png"])
        // Players need even sides and half-resolution chroma.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-pix_fmt", "yuv420p"])
        // The temporary file's name does not say the format.
        .args(["-f", "mp4"])
        .arg(format!("file:{}", target.display()))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn();
    let mut ffmpeg = match started {
        Ok(ffmpeg) => ffmpeg,
        Err(error) if error.kind() == ErrorKind::NotFound => {
            return Err("ffmpeg is not installed, so there are only PNG sequences and no video files: install it and run `raysweep process`".into());
        }
        Err(error) => return Err(failed(error.to_string())),
    };
    // Read all the while: a full pipe would hold it up.
    let said = ffmpeg.stderr.take().map(|stderr| {
        std::thread::spawn(move || {
            let mut said = Vec::new();
            let mut stderr = stderr.take(MOST_SAID_BYTES);
            let _ = stderr.read_to_end(&mut said);
            let _ = std::io::copy(&mut stderr.into_inner(), &mut std::io::sink());
            String::from_utf8_lossy(&said).trim().to_owned()
        })
    });
    let files = std::fs::read_dir(images).map_or(0, Iterator::count);
    let limit = LIMIT + LIMIT_OF_IMAGE * u32::try_from(files).unwrap_or(u32::MAX);
    let began = Instant::now();
    let ended = loop {
        match ffmpeg.try_wait() {
            Ok(None) if !go_on() => break Err("broken off".to_owned()),
            Ok(None) if began.elapsed() > limit => break Err(format!("it took more than {limit:?}")),
            Ok(None) => std::thread::sleep(LOOK),
            Ok(Some(status)) => break Ok(status),
            Err(error) => break Err(error.to_string()),
        }
    };
    // Nothing is left of it if it has ended.
    let _ = ffmpeg.kill();
    let _ = ffmpeg.wait();
    match ended {
        Ok(status) if status.success() => Ok(()),
        Ok(_) => Err(failed(said.and_then(|said| said.join().ok()).unwrap_or_default())),
        Err(why) => Err(failed(why)),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_program_that_hangs_is_broken_off() {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("sleeps");
        std::fs::write(&program, "#!/bin/sh\nexec sleep 1000\n").unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
        let looks = std::cell::Cell::new(0);
        let go_on = || {
            looks.set(looks.get() + 1);
            looks.get() < 3
        };
        let said = encode_by(program.as_os_str(), &folder.path().join("x.mp4"), folder.path(), 1.0, &go_on);
        assert!(said.unwrap_err().ends_with("broken off"));
    }
}
