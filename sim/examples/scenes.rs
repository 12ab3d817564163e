//! Renders the built-in scenes to PNG for viewing, and writes their ground truth as `.npz` files for rig files:
//! `cargo run -p raysweep-sim --example scenes -- FOLDER [ROWS COLUMNS SEED]`.
//!
//! One colour image per scene, left to right: floodlit, direct (v = t), |v - t| > 2 (four times brighter), and a
//! projected checkerboard. Times printed to standard output are for one mono scene.

use std::error::Error;
use std::fs::File;
use std::path::Path;
use std::time::Instant;

use ndarray::{Array2, Array3, Axis, concatenate};
use raysweep_sim::scene::{BUILTIN_NAMES, Scene, SceneSize};

const ZOOM: usize = 3;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, numbers @ ..] = arguments.as_slice() else {
        return Err("usage: scenes FOLDER [ROWS COLUMNS SEED]".into());
    };
    let numbers = numbers.iter().map(|n| n.parse()).collect::<Result<Vec<usize>, _>>()?;
    let number = |k: usize, default| numbers.get(k).copied().unwrap_or(default);
    let size = SceneSize { rows: number(0, 128), columns: number(1, 128) };
    std::fs::create_dir_all(folder)?;
    for name in BUILTIN_NAMES {
        let start = Instant::now();
        let mono = Scene::builtin(name, size, number(2, 1) as u64)?;
        println!("{name}: {:.2} s, brightest floodlit pixel {:.2}", start.elapsed().as_secs_f64(), {
            mono.transport.sum_axis(Axis(0)).fold(0.0_f32, |a, &b| a.max(b))
        });
        mono.save(&Path::new(folder).join(format!("{name}.npz")))?;
        drop(mono);
        let scene = Scene::builtin_rgb(name, size, number(2, 1) as u64)?;
        write_png(&Path::new(folder).join(format!("{name}.png")), &overview(&scene)?)?;
    }
    Ok(())
}

fn overview(scene: &Scene) -> Result<Array3<f32>, Box<dyn Error>> {
    let near = |u: usize| {
        let mut image = Array3::zeros((scene.size().0, scene.size().1, scene.channels()));
        for ((v, t, s, c), value) in scene.transport.indexed_iter() {
            if v.abs_diff(t) <= u {
                image[[t, s, c]] += value;
            }
        }
        image
    };
    let flood = scene.transport.sum_axis(Axis(0));
    let far = 4.0 * (&flood - &near(2));
    let board = Array2::from_shape_fn((scene.rows(), 2 * scene.size().1), |(row, column)| {
        f32::from((row / 12 + column / 24) % 2 == 0)
    });
    let start = Instant::now();
    let checkered = scene.render(board.view(), &scene.full_window())?;
    println!("  checkerboard in colour: {:.3} s", start.elapsed().as_secs_f64());
    Ok(concatenate(Axis(1), &[flood.view(), near(0).view(), far.view(), checkered.view()])?)
}

fn write_png(path: &Path, image: &Array3<f32>) -> Result<(), Box<dyn Error>> {
    let (rows, columns, _) = image.dim();
    let mut encoder = png::Encoder::new(File::create(path)?, (columns * ZOOM) as u32, (rows * ZOOM) as u32);
    encoder.set_color(png::ColorType::Rgb);
    let zoomed =
        Array3::from_shape_fn((rows * ZOOM, columns * ZOOM, 3), |(y, x, c)| image[[y / ZOOM, x / ZOOM, c]]);
    let bytes: Vec<u8> = zoomed.iter().map(|v| (255.0 * v.clamp(0.0, 1.0).powf(1.0 / 2.2)) as u8).collect();
    encoder.write_header()?.write_image_data(&bytes)?;
    Ok(())
}
