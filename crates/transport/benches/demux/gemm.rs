use std::hint::black_box;
use std::time::Instant;

use ndarray::{Array2, LinalgScalar};

/// Matrices of this size reach the machine's peak, and those of two threads fit into any cache.
const SIZE: usize = 512;
const REPETITIONS: usize = 60;

/// Peak floating-point operations per second in products of large matrices, with all threads.
pub struct Peak {
    pub f32_flops: f64,
    pub f64_flops: f64,
}

/// Measures with the library that the solver's own products use, with AVX-512 if the CPU has it.
pub fn peak() -> Peak {
    Peak { f32_flops: of(0.5_f32), f64_flops: of(0.5_f64) }
}

fn of<T: LinalgScalar + Send + Sync>(value: T) -> f64 {
    let matrix = Array2::from_elem((SIZE, SIZE), value);
    let fastest_s = (0..REPETITIONS)
        .map(|_| {
            let began = Instant::now();
            rayon::broadcast(|_| black_box(matrix.dot(&matrix)));
            began.elapsed().as_secs_f64()
        })
        .fold(f64::INFINITY, f64::min);
    2.0 * (SIZE as f64).powi(3) * rayon::current_num_threads() as f64 / fastest_s
}
