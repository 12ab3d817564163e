//! The same stages in NumPy, SciPy and OpenCV, timed by `tests/python/peers_dots.py`.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use ndarray::{Array, Array1, Array2, Array4};
use ndarray_npy::write_npy;
use raysweep_transport::dots::calibrate::{Centroids, Footprints};
use raysweep_transport::dots::product::{column_energies, pattern_weights};
use serde::Deserialize;

use super::Figure;
use super::scene::{BACKGROUND, DOTS, NOISE};
use super::stages::{Columns, OURS, case};

/// Frames that the program denoises.
const FRAMES: usize = 32;

#[derive(Deserialize)]
struct Peer {
    stage: String,
    method: String,
    seconds: f64,
}

/// Times all peers on the columns used for raysweep's figures, and on frames of the same scene.
pub fn time(python: &Path, columns: &Columns, ours: &[Figure]) -> Result<Vec<Figure>, Box<dyn Error>> {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("bench-dots");
    std::fs::create_dir_all(&folder)?;
    write(&folder, columns)?;
    let program = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/python/peers_dots.py");
    let started = Command::new(python).arg(program).arg(&folder).stderr(Stdio::inherit()).output();
    let output = started.map_err(|error| format!("cannot start {}: {error}", python.display()))?;
    if !output.status.success() {
        return Err(format!("peers_dots.py ended with {}; its message stands above", output.status).into());
    }
    let case = case(1024, 2);
    let lines = output.stdout.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
    lines
        .map(|line| {
            let Peer { stage, method, seconds } = serde_json::from_slice(line)?;
            let same =
                |figure: &&Figure| figure.stage == stage && figure.case == case && figure.method == OURS;
            let own = ours.iter().find(same).or_else(|| ours.iter().find(|figure| figure.stage == stage));
            let own = own.ok_or_else(|| format!("peers_dots.py times `{stage}`, which raysweep does not"))?;
            Ok(Figure {
                bench: "dots",
                case: case.clone(),
                frames_per_second: own.frames_per_second.map(|_| 1.0 / seconds),
                times_read: seconds / own.seconds * own.times_read,
                ratio: seconds / own.seconds,
                stage,
                method,
                seconds,
            })
        })
        .collect()
}

fn write(folder: &Path, columns: &Columns) -> Result<(), Box<dyn Error>> {
    let Columns { scene, sensor, plane, batch, pattern, fundamental, mask, .. } = columns;
    let shape = scene.shape;
    let mut frames = Array::<u16, _>::zeros((FRAMES, shape.height(), shape.width()));
    let mut frame = vec![0; shape.pixels()];
    for (index, mut place) in frames.outer_iter_mut().enumerate() {
        scene.draw(index * 71 % DOTS, &mut frame)?;
        place.iter_mut().zip(&frame).for_each(|(place, &raw)| *place = raw);
    }
    write_npy(folder.join("frames.npy"), &frames)?;
    let hot: Vec<i64> = sensor.denoiser.correction().hot().iter().map(|&pixel| pixel.into()).collect();
    write_npy(folder.join("hot.npy"), &Array1::from(hot))?;
    for (name, batch) in [("plane", plane), ("scene", batch)] {
        let arrays = batch.arrays();
        let residual = (batch.dots(), shape.block_rows(), shape.block_columns(), 1);
        write_npy(
            folder.join(format!("{name}_word_offsets.npy")),
            &Array1::from(arrays.word_offsets.clone()),
        )?;
        write_npy(folder.join(format!("{name}_words.npy")), &Array1::from(arrays.words.clone()))?;
        write_npy(folder.join(format!("{name}_masks.npy")), &Array1::from(arrays.masks.clone()))?;
        write_npy(folder.join(format!("{name}_values.npy")), &Array1::from(arrays.values.clone()))?;
        let residual = Array4::from_shape_vec(residual, arrays.residual.clone())?;
        write_npy(folder.join(format!("{name}_residual.npy")), &residual)?;
    }
    let centroids = Centroids::new(plane, &Footprints::new(plane, 0.5)?)?;
    write_npy(folder.join("weights.npy"), &pattern_weights(&centroids, pattern.view())?)?;
    let xy = centroids.xy.iter().map(|xy| xy.unwrap_or([f64::NAN; 2])).collect::<Vec<_>>();
    write_npy(folder.join("centroids.npy"), &Array2::from(xy))?;
    write_npy(folder.join("energies.npy"), &Array1::from(column_energies(plane)))?;
    let lines = (0..DOTS).map(|dot| fundamental.epipolar_line(scene.centre(dot))).collect::<Vec<_>>();
    write_npy(folder.join("lines.npy"), &Array2::from(lines))?;
    let settings = serde_json::json!({
        "background": BACKGROUND,
        "noise": NOISE,
        "radius_px": scene.disc_radius_px(),
        "distance_px": mask.distance_px,
        "sigma_px": mask.sigma_px,
    });
    Ok(std::fs::write(folder.join("settings.json"), settings.to_string())?)
}
