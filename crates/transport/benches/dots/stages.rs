//! Times of the stages.

use std::error::Error;
use std::hint::black_box;
use std::time::Instant;

use ndarray::{Array2, Array3};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;
use raysweep_transport::dots::calibrate::{Centroids, Confusion, Footprints, Fundamental, PointSpreads};
use raysweep_transport::dots::product::{
    EpipolarMask, MaskRule, column_energies, compensate, coverage, dual, epipolar, floodlit, pattern_weights,
    relight, shadow_dot, shadow_neighbours,
};
use raysweep_transport::dots::{
    Background, Batch, BatchArrays, Correction, DenoiseSettings, Denoiser, NoiseFloor, Observation, Region,
    Sampling, SparseColumn, SyncSettings, Synchroniser,
};

use super::Figure;
use super::scene::{BACKGROUND, DOTS, Drawn, NOISE, Scene};

/// The method's name in figures.
pub const OURS: &str = "raysweep";

const THREADS: [usize; 2] = [1, 2];
const REPETITIONS: usize = 9;

/// Total size of the distinct frames, larger than the caches. A batch cycles through them.
const BYTES_OF_FRAMES: usize = 256 << 20;

/// Hot pixels of a sensor, one in ten thousand.
const HOT_SHARE: usize = 10_000;

pub fn case(size: usize, threads: usize) -> String {
    format!("{size}x{size}, {threads} thread{}", if threads == 1 { "" } else { "s" })
}

/// What is needed to denoise a scene's frames.
pub struct Sensor {
    pub denoiser: Denoiser,
    pub background: Background,
    pub floor: NoiseFloor,
}

impl Sensor {
    pub fn new(scene: &Scene) -> Result<Self, Box<dyn Error>> {
        let shape = scene.shape;
        let mut random = Xoshiro256PlusPlus::seed_from_u64(2);
        let gain =
            Array3::from_shape_fn((shape.height(), shape.width(), 1), |(row, ..)| 0.9 + 1e-4 * row as f32);
        let hot: Vec<(usize, usize)> = (0..shape.pixels() / HOT_SHARE)
            .map(|_| random.next_u64() as usize % shape.pixels())
            .map(|pixel| (pixel / shape.width(), pixel % shape.width()))
            .collect();
        let correction = Correction::new(shape, gain.view(), &hot, Sampling::Full)?;
        let background = Background::new(&correction, &vec![BACKGROUND as f32; shape.pixels()])?;
        let settings = DenoiseSettings { radius_px: scene.disc_radius_px(), ..DenoiseSettings::default() };
        let floor = NoiseFloor { mean: 0.3, sigma: NOISE };
        Ok(Self { denoiser: Denoiser::new(correction, settings)?, background, floor })
    }
}

/// Minimum seconds of each task. The tasks take turns, so that a slow moment of the machine affects all of them.
fn least<const N: usize>(mut tasks: [&mut (dyn FnMut() + Send); N]) -> [f64; N] {
    let mut least = [f64::INFINITY; N];
    for _ in 0..REPETITIONS {
        for (task, least) in tasks.iter_mut().zip(&mut least) {
            let began = Instant::now();
            task();
            *least = began.elapsed().as_secs_f64().min(*least);
        }
    }
    least
}

/// A plain read: every 16 bits are loaded once, with the widest instructions.
fn read(values: &[u16]) -> u16 {
    pulp::Arch::new().dispatch(|| values.iter().fold(0, |seen, value| seen ^ value))
}

fn pool(threads: usize) -> Result<rayon::ThreadPool, rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build()
}

/// Synchronising and denoising of frames of one size, in seconds per frame.
pub fn of_frames(size: usize) -> Result<Vec<Figure>, Box<dyn Error>> {
    let scene = Scene::new(size)?;
    let sensor = Sensor::new(&scene)?;
    let pixels = scene.shape.pixels();
    let count = BYTES_OF_FRAMES / (2 * pixels);
    let mut memory = vec![0; count * pixels];
    for (index, frame) in memory.chunks_exact_mut(pixels).enumerate() {
        scene.draw(index * 37 % DOTS, frame)?;
    }
    let frames: Vec<&[u16]> = memory.chunks_exact(pixels).collect();
    let region = Region { rows: 0..size / 16, columns: size - size / 16..size };
    let sync =
        SyncSettings { frames_per_batch: DOTS as u32, trailing_index: DOTS as u32 - 1, threshold: 1 << 20 };

    let mut figures = Vec::new();
    for threads in THREADS {
        let pool = pool(threads)?;
        let mut plain = || {
            let seen = frames.par_iter().map(|frame| read(frame)).reduce(|| 0, |a, b| a ^ b);
            black_box(seen);
        };
        let mut synchronise = || {
            let Ok(mut synchroniser) = Synchroniser::new(sync) else { return };
            for (id, frame) in frames.iter().enumerate() {
                if let Ok(seen) = Observation::new(id as u64, frame, scene.shape, &region, 4095) {
                    black_box(synchroniser.push(seen));
                }
            }
        };
        // As during acquisition: columns are handed on, and their memory is reused.
        let mut denoise = || {
            let Sensor { denoiser, background, floor } = &sensor;
            frames.par_chunks(16).for_each_init(
                || (denoiser.scratch(), SparseColumn::default()),
                |(scratch, column), frames| {
                    for frame in frames {
                        black_box(denoiser.column(frame, background, *floor, scratch, column).is_ok());
                    }
                },
            );
        };
        let seconds = pool.install(|| least([&mut plain, &mut synchronise, &mut denoise]));
        let [plain, synchronise, denoise] = seconds.map(|seconds| seconds / count as f64);
        let mut figure = |stage: &str, seconds: f64| {
            figures.push(Figure {
                bench: "dots",
                case: case(size, threads),
                stage: stage.to_owned(),
                method: OURS.to_owned(),
                seconds,
                times_read: seconds / plain,
                ratio: 1.0,
                frames_per_second: Some(1.0 / seconds),
            });
        };
        figure("plain read", plain);
        if threads == 1 {
            figure("b synchronise", synchronise);
        }
        figure("a+c correct and denoise", denoise);
    }
    Ok(figures)
}

/// Columns of a batch and of its calibration plane, and the other inputs of the products.
pub struct Columns {
    pub scene: Scene,
    pub sensor: Sensor,
    pub plane: Batch,
    pub batch: Batch,
    pub pattern: Array3<f32>,
    pub fundamental: Fundamental,
    pub mirror: Vec<Option<[f64; 2]>>,
    pub mask: EpipolarMask,
}

impl Columns {
    pub fn new() -> Result<Self, Box<dyn Error>> {
        let scene = Scene::new(1024)?;
        let sensor = Sensor::new(&scene)?;
        let denoise = |draw: fn(&Scene, usize, &mut [u16]) -> Drawn| {
            let (mut scratch, mut column) = (sensor.denoiser.scratch(), SparseColumn::default());
            let (mut frame, mut arrays) = (vec![0; scene.shape.pixels()], BatchArrays::default());
            for dot in 0..DOTS {
                draw(&scene, dot, &mut frame)?;
                sensor.denoiser.column(
                    &frame,
                    &sensor.background,
                    sensor.floor,
                    &mut scratch,
                    &mut column,
                )?;
                arrays.push(&column);
            }
            Ok::<_, Box<dyn Error>>(Batch::new(scene.shape, arrays)?)
        };
        let plane = denoise(Scene::draw_plane)?;
        let batch = denoise(Scene::draw)?;
        let pattern = Array3::from_shape_fn((256, 256, 3), |(row, column, colour)| {
            ((row / 32 + column / 32 + colour) % 3) as f32
        });
        // Lines through the dots at a slope of 0.3: l = (0.3, -1, y - 0.3 x) for m = (x, y).
        let fundamental = Fundamental::from_rows([[0.0, 0.0, -0.3], [0.0, 0.0, 1.0], [0.3, -1.0, 0.0]]);
        let mirror = (0..DOTS).map(|dot| Some(scene.centre(dot))).collect();
        let mask = EpipolarMask { distance_px: 19.0, sigma_px: 2.0, rule: MaskRule::Plateau };
        Ok(Self { scene, sensor, plane, batch, pattern, fundamental, mirror, mask })
    }
}

/// Products of a batch's columns, in seconds per batch.
pub fn of_columns(columns: &Columns) -> Result<Vec<Figure>, Box<dyn Error>> {
    let Columns { plane, batch, pattern, fundamental, mirror, mask, .. } = columns;
    let footprints = Footprints::new(plane, 0.5)?;
    let confusion = Confusion::new(&footprints);
    let centroids = Centroids::new(plane, &footprints)?;
    let energies = column_energies(plane);
    let cover = coverage(&PointSpreads::new(plane, &centroids)?);
    let weights: Array2<f32> = pattern_weights(&centroids, pattern.view())?;
    let light = floodlit(batch);
    let arrays = batch.arrays();
    // As many bytes as the batch has, as 16-bit values.
    let bytes: Vec<u16> = (0..batch.bytes() / 2).map(|at| at as u16).collect();
    eprintln!("{} bytes a dot, {:?}", batch.bytes() / batch.dots(), batch.counts());
    eprintln!("{:.2} discs a frame", f64::from(arrays.discs.iter().sum::<u32>()) / batch.dots() as f64);

    let mut figures = Vec::new();
    for threads in THREADS {
        let pool = pool(threads)?;
        let mut read_columns = || {
            black_box(bytes.par_chunks(1 << 16).map(read).reduce(|| 0, |a, b| a ^ b));
        };
        let mut confuse = || {
            black_box(Footprints::new(plane, 0.5).map(|footprints| Confusion::new(&footprints)).is_ok());
        };
        let mut flood = || {
            black_box(floodlit(batch));
        };
        let mut relit = || {
            black_box(relight(batch, weights.view()).is_ok());
        };
        let mut shadow = || {
            black_box(shadow_dot(batch, &light).is_ok());
        };
        let mut neighbours = || {
            black_box(shadow_neighbours(batch, &light, &confusion).is_ok());
        };
        let mut lines = || {
            black_box(epipolar(batch, &light, fundamental, mirror, mask).is_ok());
        };
        let mut mirrored = || {
            black_box(dual(batch, &centroids, &energies, (1024, 1024)).is_ok());
        };
        let mut even = || {
            black_box(compensate(&light, &cover).is_ok());
        };
        let seconds = pool.install(|| {
            least([
                &mut read_columns,
                &mut confuse,
                &mut flood,
                &mut relit,
                &mut shadow,
                &mut neighbours,
                &mut lines,
                &mut mirrored,
                &mut even,
            ])
        });
        for (stage, seconds_of) in STAGES.iter().zip(seconds) {
            figures.push(Figure {
                bench: "dots",
                case: case(1024, threads),
                stage: (*stage).to_owned(),
                method: OURS.to_owned(),
                seconds: seconds_of,
                times_read: seconds_of / seconds[0],
                ratio: 1.0,
                frames_per_second: None,
            });
        }
    }
    Ok(figures)
}

const STAGES: [&str; 9] = [
    "plain read of columns",
    "d confusion",
    "f floodlit",
    "f relight RGB",
    "g shadow dot",
    "g shadow neighbours",
    "h epipolar mask",
    "i dual",
    "j overlap",
];
