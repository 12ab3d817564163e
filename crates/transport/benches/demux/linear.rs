//! The solver's linear algebra beside nalgebra's, on one thread.

use std::error::Error;
use std::hint::black_box;
use std::time::Instant;

use nalgebra::{Cholesky, DMatrix, DVector};
use ndarray::{Array2, ArrayView2, Axis, s};
use raysweep_transport::plane::linear::{Quadratic, invert, minimise_free};
use raysweep_transport::plane::{Demux, Prior, RowModel, SimdLevel};

use super::scene::Case;

/// Rounds of which the fastest counts; own code and nalgebra take turns, so that both see the same machine.
const ROUNDS: usize = 40;

/// The seconds of a task, by own code and by nalgebra.
pub struct Compared {
    pub task: String,
    pub seconds: f64,
    pub nalgebra_seconds: f64,
    /// Largest difference of the two results relative to the largest entry.
    pub difference: f64,
}

/// Compares on the case's middle camera row: the inverse of its `H`, and the minima of its pixels once their free rows
/// are known.
pub fn compare(case: &Case, prior: Prior) -> Result<[Compared; 2], Box<dyn Error>> {
    let row = case.timing.camera_rows() / 2;
    let demux = Demux::new(case.timing.clone(), case.settings.clone(), prior)?;
    let transport = demux.solve_rows(&[row], case.stack.slice(s![.., row..=row, ..]), None, &|| true)?;
    let model = RowModel::new(&case.timing, &case.settings, &demux.reach(), row);
    let quadratic = Quadratic::new(model.weights.view(), &model.slots, &prior)?;
    let samples = case.stack.slice(s![.., row, ..]).mapv(f64::from);
    let linear = quadratic.linear(model.weights.view(), samples.t());
    let free = transport.t.slice(s![.., 0, ..]).t().mapv(|light| light > 0.0);
    // Of the others the solver computes the rows that are 0, which are fewer.
    let pixels: Vec<usize> = (0..free.nrows())
        .filter(|&pixel| 2 * free.row(pixel).iter().filter(|free| **free).count() < model.slots.len())
        .collect();
    let (linear, free) = (linear.select(Axis(0), &pixels), free.select(Axis(0), &pixels));
    Ok([inverses(&quadratic)?, minima(&quadratic, &linear, free.view())])
}

fn inverses(quadratic: &Quadratic) -> Result<Compared, Box<dyn Error>> {
    let n = quadratic.slots();
    let h: Vec<f64> = quadratic.h().iter().copied().collect();
    let own = || {
        let mut matrix = h.clone();
        invert(&mut matrix, n).ok().map(|()| matrix)
    };
    let other = || Cholesky::new(DMatrix::from_column_slice(n, n, &h)).map(|factor| factor.inverse());
    let (seconds, nalgebra_seconds) = take_turns(own, other);
    let (Some(own), Some(other)) = (own(), other()) else { return Err("H is not positive definite".into()) };
    let lower = (0..n).flat_map(|i| (0..=i).map(move |j| (i, j)));
    let difference = difference(lower.map(|(i, j)| (own[i * n + j], other[(i, j)])));
    Ok(Compared { task: format!("inverse of H, {n} rows"), seconds, nalgebra_seconds, difference })
}

/// Own code with all that belongs to a step: it also computes `H^-1 c` and the gradient in the rows that are not free.
fn minima(quadratic: &Quadratic, linear: &Array2<f64>, free: ArrayView2<bool>) -> Compared {
    let own = || minimise_free(SimdLevel::best(), quadratic, linear.clone(), free);
    let h = quadratic.h();
    let other = || {
        let mut minima = Array2::zeros(linear.dim());
        for ((mut minimum, free), c) in minima.rows_mut().into_iter().zip(free.rows()).zip(linear.rows()) {
            let rows: Vec<usize> = (0..free.len()).filter(|&slot| free[slot]).collect();
            let matrix = DMatrix::from_fn(rows.len(), rows.len(), |i, j| h[[rows[i], rows[j]]]);
            let mut x = DVector::from_iterator(rows.len(), rows.iter().map(|&slot| c[slot]));
            if let Some(factor) = Cholesky::new(matrix) {
                factor.solve_mut(&mut x);
            }
            rows.iter().zip(x.iter()).for_each(|(&slot, x)| minimum[slot] = *x);
        }
        minima
    };
    let (seconds, nalgebra_seconds) = take_turns(own, other);
    let difference = difference(own().into_iter().zip(other()));
    let mean = free.iter().filter(|free| **free).count() as f64 / free.nrows() as f64;
    let task = format!("{} systems of {mean:.0} rows, {}", free.nrows(), SimdLevel::best().name());
    Compared { task, seconds, nalgebra_seconds, difference }
}

/// The least seconds of each.
fn take_turns<A, B>(own: impl Fn() -> A, other: impl Fn() -> B) -> (f64, f64) {
    let (mut own_s, mut other_s) = (f64::INFINITY, f64::INFINITY);
    for _ in 0..ROUNDS {
        own_s = own_s.min(seconds(&own));
        other_s = other_s.min(seconds(&other));
    }
    (own_s, other_s)
}

fn seconds<T>(task: impl Fn() -> T) -> f64 {
    let began = Instant::now();
    black_box(task());
    began.elapsed().as_secs_f64()
}

fn difference(pairs: impl Iterator<Item = (f64, f64)>) -> f64 {
    let (most, largest) = pairs.fold((0.0_f64, 0.0_f64), |(most, largest), (own, other)| {
        (most.max((own - other).abs()), largest.max(own.abs()))
    });
    most / largest
}
