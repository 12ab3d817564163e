//! Solver for the linear systems of pivoting with few settings and many rows, as in a film.
//!
//! The dense part of `H = A'A + alpha D'D` then has low rank: `D` links each row to one before it and one after it,
//! so `K = alpha D'D` is tridiagonal, and `A` has few rows. With `v = A x` as additional unknowns, the rows are
//! eliminated along their chains. What remains is a dense system with one unknown for each setting and for each row
//! without which `K` would be singular: one end of each chain, and the rows that no difference links to others.

use aligned_vec::{AVec, avec};
use ndarray::ArrayView2;
use pulp::Simd;

use super::quadratic::RIDGE;

/// The parts of `H` for this solver.
#[derive(Debug, Clone)]
pub(super) struct Narrow {
    settings: usize,
    slots: usize,
    /// `[slots][settings]`
    weights: Vec<f64>,
    /// First slot along the chains that a setting sees; only the slots from there on affect its column.
    first_seen: Vec<usize>,
    chain: Vec<Joint>,
    border: Vec<Border>,
}

/// A slot that is eliminated, in the order of elimination.
#[derive(Debug, Clone, Copy)]
struct Joint {
    slot: usize,
    /// Negated off-diagonal of `K` to the joint before: 0 at the start of a chain.
    before: f64,
    /// Negated off-diagonal of `K` to the slot after, which may be in the border.
    after: f64,
    /// Negated off-diagonal of `K` to the joint after: 0 if the slot after is in the border.
    joint_after: f64,
    ridge: f64,
}

/// A slot that is not eliminated.
#[derive(Debug, Clone, Copy)]
struct Border {
    slot: usize,
    /// Diagonal of `K`.
    diagonal: f64,
    /// Position in the chain of the only joint linked to it, and the negated off-diagonal to this joint.
    neighbour: Option<(usize, f64)>,
}

impl Narrow {
    /// The parts, or `None` unless `D` links the slots into chains and there are so few settings that this solver is
    /// the faster one. `links` are the entries of each row of `D` other than 0; `diagonal` is that of `H` without its
    /// ridge.
    pub fn new<L: AsRef<[(usize, f64)]>>(
        weights: ArrayView2<f64>,
        links: &[L],
        alpha: f64,
        diagonal: &[f64],
    ) -> Option<Self> {
        let (settings, slots) = weights.dim();
        let mut before = vec![0.0; slots];
        let mut after: Vec<Option<(usize, f64)>> = vec![None; slots];
        let mut has_before = vec![false; slots];
        for link in links {
            let &[(low, a), (high, b)] = link.as_ref() else { return None };
            if a != -b || after[low].is_some() || has_before[high] {
                return None;
            }
            let joint = alpha * a * a;
            (before[high], has_before[high]) = (joint, joint > 0.0);
            after[low] = (joint > 0.0).then_some((high, joint));
        }
        let ridge = |slot: usize| RIDGE * diagonal[slot];
        let mut chain: Vec<Joint> = Vec::new();
        let mut border = Vec::new();
        let mut places = vec![None; slots];
        for slot in 0..slots {
            match after[slot] {
                Some((next, joint)) => {
                    // The slot before it must be the joint before it.
                    let last = chain.last().and_then(|joint: &Joint| after[joint.slot]);
                    if has_before[slot] && last.is_none_or(|(next, _)| next != slot) {
                        return None;
                    }
                    let joint_after = if after[next].is_some() { joint } else { 0.0 };
                    places[slot] = Some(chain.len());
                    chain.push(Joint {
                        slot,
                        before: before[slot],
                        after: joint,
                        joint_after,
                        ridge: ridge(slot),
                    });
                }
                None => {
                    let seen = diagonal[slot] > 0.0;
                    let own = if seen { before[slot] + ridge(slot) } else { 1.0 };
                    border.push(Border { slot, diagonal: own, neighbour: None });
                }
            }
        }
        // Here each step takes about half the square of the number of unknowns for each slot. Factoring H takes a
        // third of the cube of the number of free slots, which are about half of all slots.
        if 3 * (settings + border.len()) > slots {
            return None;
        }
        for border in &mut border {
            let neighbour = (0..slots).find(|&low| after[low].is_some_and(|(high, _)| high == border.slot));
            border.neighbour = neighbour.and_then(|low| Some((places[low]?, before[border.slot])));
        }
        let seen = |setting: usize| {
            let first = chain.iter().position(|joint| weights[[setting, joint.slot]] != 0.0);
            first.unwrap_or(chain.len())
        };
        let first_seen = (0..settings).map(seen).collect();
        let weights = weights.t().iter().copied().collect();
        Some(Self { settings, slots, weights, first_seen, chain, border })
    }

    /// Number of unknowns that remain after the chains are eliminated.
    fn unknowns(&self) -> usize {
        self.settings + self.border.len()
    }

    fn weights_of(&self, slot: usize) -> &[f64] {
        &self.weights[slot * self.settings..(slot + 1) * self.settings]
    }
}

/// Memory for the systems of all lanes; arrays interleave the lanes' values.
pub(super) struct NarrowWork<'a, S: Simd> {
    simd: S,
    narrow: &'a Narrow,
    /// 1 for free slots, 0 for the others, `[slots]`.
    masks: AVec<f64>,
    /// `[slots]`
    c: AVec<f64>,
    /// The minimiser in free slots and half the gradient in the others, `[slots]`.
    y: AVec<f64>,
    /// For each joint: the factor that carries the elimination on from the joint before, and 1 / pivot if it is free,
    /// else 0.
    carries: AVec<f64>,
    reciprocals: AVec<f64>,
    /// The columns' entries at the joint being eliminated: settings, border, right-hand side.
    columns: AVec<f64>,
    /// Lower triangle, row by row; its last row is the right-hand side.
    system: AVec<f64>,
    /// `v = A x`, then the border's `x`.
    unknowns: AVec<f64>,
    /// Right-hand side of each joint after the unknowns are computed.
    known: AVec<f64>,
}

impl<'a, S: Simd> NarrowWork<'a, S> {
    #[inline(always)]
    pub fn new(simd: S, narrow: &'a Narrow) -> Self {
        let zeros = |length: usize| avec![0.0; length * S::F64_LANES];
        let columns = narrow.unknowns() + 1;
        Self {
            simd,
            narrow,
            masks: zeros(narrow.slots),
            c: zeros(narrow.slots),
            y: zeros(narrow.slots),
            carries: zeros(narrow.chain.len()),
            reciprocals: zeros(narrow.chain.len()),
            columns: zeros(columns),
            system: zeros(columns * (columns + 1) / 2),
            unknowns: zeros(columns),
            known: zeros(narrow.chain.len()),
        }
    }

    /// Computes the minimiser in the free slots and half the gradient in the others. Each lane gives 1 for each free
    /// slot and 0 for the others, and `-c`.
    #[inline(always)]
    pub fn solve<'p>(&mut self, lanes: impl Iterator<Item = (&'p [f64], &'p [f64])>) {
        for (lane, (free, slope)) in lanes.enumerate() {
            for (slot, (&free, &slope)) in free.iter().zip(slope).enumerate() {
                self.masks[slot * S::F64_LANES + lane] = free;
                self.c[slot * S::F64_LANES + lane] = -slope;
            }
        }
        self.eliminate();
        self.solve_system();
        self.substitute();
    }

    /// Copies a lane's solution to `y`.
    #[inline(always)]
    pub fn take(&self, lane: usize, y: &mut [f64]) {
        y.iter_mut().zip(self.y.iter().skip(lane).step_by(S::F64_LANES)).for_each(|(to, y)| *to = *y);
    }

    /// Eliminates the joints and builds the system. All terms of a pivot are positive, so that no digits cancel.
    #[inline(always)]
    fn eliminate(&mut self) {
        let (simd, narrow) = (self.simd, self.narrow);
        let (settings, size) = (narrow.settings, narrow.unknowns());
        let masks = S::as_simd_f64s(&self.masks).0;
        let c = S::as_simd_f64s(&self.c).0;
        let carries = S::as_mut_simd_f64s(&mut self.carries).0;
        let reciprocals = S::as_mut_simd_f64s(&mut self.reciprocals).0;
        let columns = S::as_mut_simd_f64s(&mut self.columns).0;
        let system = S::as_mut_simd_f64s(&mut self.system).0;
        let zero = simd.splat_f64s(0.0);
        system.fill(zero);
        columns.fill(zero);
        // `ground` of the joint before divided by its pivot; 1 if that joint is fixed.
        let mut held = simd.splat_f64s(1.0);
        for (place, joint) in narrow.chain.iter().enumerate() {
            let mask = masks[joint.slot];
            let before = simd.splat_f64s(joint.before);
            let ground = simd.mul_add_e_f64s(before, held, simd.splat_f64s(joint.ridge));
            let pivot = simd.add_f64s(ground, simd.splat_f64s(joint.after));
            let reciprocal = simd.div_f64s(simd.splat_f64s(1.0), pivot);
            let carry = match place {
                0 => zero,
                _ => simd.mul_f64s(before, reciprocals[place - 1]),
            };
            let masked = simd.mul_f64s(mask, reciprocal);
            (carries[place], reciprocals[place]) = (carry, masked);
            held = simd.add_f64s(simd.mul_f64s(ground, masked), simd.sub_f64s(simd.splat_f64s(1.0), mask));

            for (column, &weight) in columns.iter_mut().zip(narrow.weights_of(joint.slot)) {
                *column = simd.mul_add_e_f64s(carry, *column, simd.splat_f64s(weight));
            }
            for (column, border) in columns[settings..size].iter_mut().zip(&narrow.border) {
                let entry = border.neighbour.filter(|(neighbour, _)| *neighbour == place);
                let entry = simd.splat_f64s(entry.map_or(0.0, |(_, weight)| -weight));
                *column = simd.mul_add_e_f64s(carry, *column, entry);
            }
            columns[size] = simd.mul_add_e_f64s(carry, columns[size], c[joint.slot]);

            for row in 0..=size {
                if row < settings && place < narrow.first_seen[row] {
                    continue;
                }
                let start = row * (row + 1) / 2;
                let factor = simd.mul_f64s(columns[row], masked);
                for (sum, &column) in system[start..=start + row].iter_mut().zip(&*columns) {
                    *sum = simd.mul_add_e_f64s(factor, column, *sum);
                }
            }
        }
    }

    /// Solves for `v` and the border. The settings' part is positive definite and the border's, after it, negative
    /// definite, so that the factorisation needs no pivoting.
    #[inline(always)]
    fn solve_system(&mut self) {
        let (simd, narrow) = (self.simd, self.narrow);
        let (settings, size) = (narrow.settings, narrow.unknowns());
        let masks = S::as_simd_f64s(&self.masks).0;
        let c = S::as_simd_f64s(&self.c).0;
        let system = S::as_mut_simd_f64s(&mut self.system).0;
        let unknowns = S::as_mut_simd_f64s(&mut self.unknowns).0;
        let one = simd.splat_f64s(1.0);
        let row = |row: usize| row * (row + 1) / 2;
        for setting in 0..settings {
            let diagonal = &mut system[row(setting) + setting];
            *diagonal = simd.add_f64s(*diagonal, one);
        }
        for (k, border) in narrow.border.iter().enumerate() {
            let at = settings + k;
            let mask = masks[border.slot];
            for (entry, &weight) in system[row(at)..].iter_mut().zip(narrow.weights_of(border.slot)) {
                *entry = simd.mul_f64s(mask, simd.sub_f64s(*entry, simd.splat_f64s(weight)));
            }
            for (entry, other) in system[row(at) + settings..].iter_mut().zip(&narrow.border[..k]) {
                *entry = simd.mul_f64s(simd.mul_f64s(mask, masks[other.slot]), *entry);
            }
            // A fixed slot of the border gets an equation of its own that sets it to 0.
            let diagonal = &mut system[row(at) + at];
            let own = simd.sub_f64s(*diagonal, simd.splat_f64s(border.diagonal));
            *diagonal = simd.sub_f64s(simd.mul_f64s(mask, own), simd.sub_f64s(one, mask));
            let rhs = &mut system[row(size) + at];
            *rhs = simd.mul_f64s(mask, simd.sub_f64s(*rhs, c[border.slot]));
        }
        // L D L', with 1 / D in `unknowns`; the last row is the right-hand side and becomes D^-1 L^-1 of it.
        for i in 0..=size {
            for j in 0..i.min(size) {
                let mut value = system[row(i) + j];
                for k in 0..j {
                    // The entries of row i are still multiplied by D.
                    value = simd.negate_mul_add_e_f64s(system[row(i) + k], system[row(j) + k], value);
                }
                system[row(i) + j] = value;
            }
            let mut diagonal = system[row(i) + i];
            for j in 0..i.min(size) {
                let scaled = simd.mul_f64s(system[row(i) + j], unknowns[j]);
                diagonal = simd.negate_mul_add_e_f64s(scaled, system[row(i) + j], diagonal);
                system[row(i) + j] = scaled;
            }
            unknowns[i] = simd.div_f64s(one, diagonal);
        }
        for i in (0..size).rev() {
            let mut value = system[row(size) + i];
            for j in i + 1..size {
                value = simd.negate_mul_add_e_f64s(system[row(j) + i], unknowns[j], value);
            }
            unknowns[i] = value;
        }
    }

    /// Substitutes the unknowns back into the chains.
    #[inline(always)]
    fn substitute(&mut self) {
        let (simd, narrow) = (self.simd, self.narrow);
        let settings = narrow.settings;
        let masks = S::as_simd_f64s(&self.masks).0;
        let c = S::as_simd_f64s(&self.c).0;
        let y = S::as_mut_simd_f64s(&mut self.y).0;
        let carries = S::as_simd_f64s(&self.carries).0;
        let reciprocals = S::as_simd_f64s(&self.reciprocals).0;
        let unknowns = S::as_simd_f64s(&self.unknowns).0;
        let known = S::as_mut_simd_f64s(&mut self.known).0;
        let zero = simd.splat_f64s(0.0);
        for (known, joint) in known.iter_mut().zip(&narrow.chain) {
            *known = balance(simd, c[joint.slot], narrow.weights_of(joint.slot), unknowns);
        }
        for (border, &x) in narrow.border.iter().zip(&unknowns[settings..]) {
            if let Some((place, weight)) = border.neighbour {
                known[place] = simd.mul_add_e_f64s(simd.splat_f64s(weight), x, known[place]);
            }
        }
        // Forward along the chains in `y`, then back.
        let mut forward = zero;
        for (place, joint) in narrow.chain.iter().enumerate() {
            forward = simd.mul_add_e_f64s(carries[place], forward, known[place]);
            y[joint.slot] = forward;
        }
        let mut after = zero;
        for (place, joint) in narrow.chain.iter().enumerate().rev() {
            let pull = simd.mul_f64s(simd.splat_f64s(joint.joint_after), after);
            after = simd.mul_f64s(reciprocals[place], simd.add_f64s(y[joint.slot], pull));
            y[joint.slot] = after;
        }
        // The gradient of the other slots; a free slot keeps its value.
        let mut before = zero;
        for (place, joint) in narrow.chain.iter().enumerate() {
            let x = y[joint.slot];
            let x_after = match narrow.chain.get(place + 1) {
                Some(next) if joint.joint_after > 0.0 => y[next.slot],
                _ => zero,
            };
            let pull = simd.mul_add_e_f64s(simd.splat_f64s(joint.before), before, known[place]);
            let pull = simd.mul_add_e_f64s(simd.splat_f64s(joint.joint_after), x_after, pull);
            let fixed = simd.sub_f64s(simd.splat_f64s(1.0), masks[joint.slot]);
            y[joint.slot] = simd.negate_mul_add_e_f64s(fixed, pull, x);
            before = x;
        }
        for (border, &x) in narrow.border.iter().zip(&unknowns[settings..]) {
            let mut pull = balance(simd, c[border.slot], narrow.weights_of(border.slot), unknowns);
            if let Some((place, weight)) = border.neighbour {
                let joint = narrow.chain[place].slot;
                let x = simd.mul_f64s(masks[joint], y[joint]);
                pull = simd.mul_add_e_f64s(simd.splat_f64s(weight), x, pull);
            }
            let fixed = simd.sub_f64s(simd.splat_f64s(1.0), masks[border.slot]);
            y[border.slot] = simd.negate_mul_add_e_f64s(fixed, pull, x);
        }
    }
}

/// `c - A'v` of one slot, the part that `K` must balance.
#[inline(always)]
fn balance<S: Simd>(simd: S, c: S::f64s, weights: &[f64], v: &[S::f64s]) -> S::f64s {
    let mut left = c;
    for (&weight, &v) in weights.iter().zip(v) {
        if weight != 0.0 {
            left = simd.negate_mul_add_e_f64s(simd.splat_f64s(weight), v, left);
        }
    }
    left
}
