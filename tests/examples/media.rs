//! Renders `tests/data/media_*.npz`: containers of turbid media on a grey card, under each projector row. By hand, when
//! the media change: `cargo run --release -p raysweep-tests --example media -- tests/data`.

use std::fs::File;
use std::path::Path;
use std::thread;

use ndarray::{Array3, s};
use ndarray_npy::NpzWriter;
use raysweep_tests::monte_carlo::{Container, Medium, follow};

/// Reduced scattering and absorption per mm in red light. Milk from Narasimhan et al., "Acquiring Scattering Properties
/// of Participating Media by Dilution" (2006), ketchup from Jensen et al., "A Practical Model for Subsurface Light
/// Transport" (2001). Soap and toothpaste are invented: nobody seems to have published theirs.
const LOWFAT_MILK: (f64, f64) = (0.89187, 0.002875);
const REDUCED_MILK: (f64, f64) = (2.4858, 0.0025556);
const REGULAR_MILK: (f64, f64) = (4.5513, 0.0015333);
const SOAP: (f64, f64) = (8.0, 0.01);
const TOOTHPASTE: (f64, f64) = (3.5, 0.35);
const KETCHUP: (f64, f64) = (0.18, 0.061);
/// What the decay length is tested with.
const SLAB: (f64, f64) = (2.0, 0.2);

const MM_PER_COLUMN: f64 = 0.5;
/// Light of the card, and of every medium: a camera's gain would make them equal.
const CARD: f32 = 0.4;
/// Smallest difference that is stored.
const STEP: f32 = 1.0 / (1 << 17) as f32;

struct View {
    name: &'static str,
    rows: usize,
    columns: usize,
    mm_per_row: f64,
    direction: [f64; 2],
    wall_albedo: f64,
    depth_mm: f64,
    /// Rows and columns of each container.
    size_px: [usize; 2],
    first_row: usize,
    media: &'static [(f64, f64)],
    packets_per_pixel: u64,
}

const VIEWS: [View; 4] = [
    View {
        name: "media_first",
        rows: 48,
        columns: 112,
        mm_per_row: 0.25,
        direction: [0.0, 0.0],
        wall_albedo: 0.7,
        depth_mm: 8.0,
        size_px: [40, 20],
        first_row: 4,
        media: &[LOWFAT_MILK, REDUCED_MILK, REGULAR_MILK, SOAP, TOOTHPASTE],
        packets_per_pixel: 3_000,
    },
    View {
        name: "media_second",
        rows: 48,
        columns: 112,
        mm_per_row: 0.3,
        direction: [0.0, 0.2],
        wall_albedo: 0.5,
        depth_mm: 6.0,
        size_px: [36, 18],
        first_row: 7,
        media: &[SOAP, REGULAR_MILK, LOWFAT_MILK, TOOTHPASTE, REDUCED_MILK],
        packets_per_pixel: 3_000,
    },
    View {
        name: "media_third",
        rows: 48,
        columns: 132,
        mm_per_row: 0.27,
        direction: [0.1, -0.15],
        wall_albedo: 0.8,
        depth_mm: 10.0,
        size_px: [38, 20],
        first_row: 5,
        media: &[TOOTHPASTE, LOWFAT_MILK, SOAP, REDUCED_MILK, KETCHUP, REGULAR_MILK],
        packets_per_pixel: 3_000,
    },
    View {
        name: "media_slab",
        rows: 80,
        columns: 32,
        mm_per_row: 0.25,
        direction: [0.0, 0.0],
        wall_albedo: 0.0,
        depth_mm: 30.0,
        size_px: [76, 28],
        first_row: 2,
        media: &[SLAB],
        packets_per_pixel: 4_000,
    },
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args().nth(1).ok_or("usage: media FOLDER")?;
    for view in VIEWS {
        let path = Path::new(&folder).join(view.name).with_extension("npz");
        let mut file = NpzWriter::new_compressed(File::create(&path)?);
        file.add_array("T", &view.render())?;
        file.finish()?;
        println!("{}", path.display());
    }
    Ok(())
}

impl View {
    /// `[v, t, s]`: the image under each projector row.
    fn render(&self) -> Array3<f32> {
        let mut transport = Array3::zeros((self.rows, self.rows, self.columns));
        for row in 0..self.rows {
            transport.slice_mut(s![row, row, ..]).fill(CARD);
        }
        let rendered: Vec<_> = thread::scope(|scope| {
            let threads: Vec<_> =
                (0..self.media.len()).map(|at| scope.spawn(move || self.medium(at))).collect();
            threads.into_iter().filter_map(|thread| thread.join().ok()).collect()
        });
        let [rows, columns] = self.size_px;
        for (at, light) in rendered.iter().enumerate() {
            let (first_row, first) = (self.first_row, self.first_column(at));
            let (rows, columns) = (first_row..first_row + rows, first..first + columns);
            transport.slice_mut(s![rows.clone(), rows, columns]).assign(light);
        }
        transport.mapv_inplace(|light| (light / STEP).round() * STEP);
        transport
    }

    fn first_column(&self, at: usize) -> usize {
        1 + at * (self.size_px[1] + 2)
    }

    fn medium(&self, at: usize) -> Array3<f32> {
        let (scattering, absorption) = self.media[at];
        let [rows, columns] = self.size_px;
        let container = Container {
            size_mm: [columns as f64 * MM_PER_COLUMN, rows as f64 * self.mm_per_row, self.depth_mm],
            wall_albedo: self.wall_albedo,
        };
        let mut light = Array3::<f32>::zeros((rows, rows, columns));
        let packets = self.packets_per_pixel * (rows * columns) as u64;
        let row = |y_mm: f64| ((y_mm / self.mm_per_row) as usize).min(rows - 1);
        let medium = Medium::of_reduced(scattering, absorption);
        follow(medium, container, self.direction, packets, 1 + at as u64, |entry_mm, exit| {
            let column = ((exit.at_mm[0] / MM_PER_COLUMN) as usize).min(columns - 1);
            light[[row(entry_mm[1]), row(exit.at_mm[1]), column]] += exit.light as f32;
        });
        let mean = light.sum() / (rows * columns) as f32;
        light * (CARD / mean)
    }
}
