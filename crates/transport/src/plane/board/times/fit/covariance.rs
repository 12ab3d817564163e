//! What the fit states of its errors.

use nalgebra::{DMatrix, DVector};
use ndarray::s;
use rayon::prelude::*;

use super::super::super::images::{PICTURES, near_rows};
use super::super::error::TimesError;
use super::super::model::{BoardSamples, Sums};
use super::Fit;
use super::normal::{FrameNormal, Normal, Sparse};

/// Share of the variance beside offset and slope that the modes may leave unexplained.
const MODES_REST: f64 = 0.01;
/// How much more a sweep may bend beyond the rows seen: the time by which it is early in its middle, as a share of it.
const BEND: f64 = 0.02;

/// What a camera row shows of the unknowns in one frame.
struct RowSample {
    /// Index among the frames used.
    frame: usize,
    edges: [Sparse; 2],
    sums: Sums,
    groups: Vec<GroupSample>,
}

/// What a group of columns adds to the right side of the normal equations by residuals of 1 on the opening and on the
/// closing edge, and its residuals if each of the pictures of its response were brighter by all of its light.
struct GroupSample {
    opening: f64,
    closing: f64,
    residuals: [f64; PICTURES],
}

/// The samples of all camera rows, and how the jitter of each frame goes with the unknowns, `[unknown, frame]`.
struct Samples {
    rows: Vec<Vec<RowSample>>,
    jitters: DMatrix<f64>,
}

impl Samples {
    /// What each cell adds to the right side of the normal equations, `[unknown, row * groups + group]`, if one picture
    /// of its response were brighter by all of its light.
    fn scores(&self, groups: usize, picture: usize) -> DMatrix<f64> {
        let (unknowns, frames) = self.jitters.shape();
        let mut scores = DMatrix::zeros(unknowns, self.rows.len() * groups);
        let mut by_jitter = DMatrix::zeros(frames, self.rows.len() * groups);
        for (row, samples) in self.rows.iter().enumerate() {
            for sample in samples {
                for (group, of_group) in sample.groups.iter().enumerate() {
                    let cell = row * groups + group;
                    let residual = of_group.residuals[picture];
                    let mut scores = scores.column_mut(cell);
                    for (edge, weight) in sample.edges.iter().zip([-of_group.opening, of_group.closing]) {
                        edge.entries().iter().for_each(|&(a, x)| scores[a] += weight * residual * x);
                        by_jitter[(sample.frame, cell)] -= weight * residual;
                    }
                }
            }
        }
        scores - &self.jitters * by_jitter
    }
}

impl Fit<'_> {
    /// Covariance of the unknowns. `free` frees the differences between exposures.
    ///
    /// Residuals are not independent: the brightness of a drawn row is wrong in all columns and all frames, and the
    /// response of a few columns over many rows. The inverse of the normal matrix alone would be several times too
    /// small. So the scatter of the scores is that of whole camera rows, and what is known of the errors of responses is
    /// added: residuals hardly show them, because the fit gives way to them. Jitters and priors are independent and
    /// enter as they are. A camera row draws the table towards its own error, the more the nearer it is to an end, so
    /// its scores are those at the unknowns that the other rows give (the jackknife: CR3 of Bell and McCaffrey 2002).
    pub(super) fn covariance(&self, free: bool) -> Result<DMatrix<f64>, TimesError> {
        let Normal { matrix, frames, .. } = self.normal(free);
        let count = self.unknowns.len();
        // The differences between exposures are only judged, five standard deviations beyond a limit.
        let groups = if free { 0 } else { self.columns.groups() };
        let samples = self.samples(&frames, groups);
        let mut scatter = self.scatter_of_responses(&samples, groups);
        scatter += &samples.jitters * samples.jitters.transpose() * self.jitter_prior_us.powi(-2);
        let mut right = DVector::zeros(count);
        self.add_priors(&mut scatter, &mut right, free);
        let inverse = matrix.clone().cholesky().ok_or(TimesError::Undetermined)?.inverse();
        let mut covariance = &inverse * scatter * &inverse;
        let change = |samples: &Vec<RowSample>| {
            let (others, score) = without_row(&matrix, &frames, samples);
            others.cholesky().map_or_else(|| &inverse * &score, |others| others.solve(&score))
        };
        let rows = samples.rows.par_iter().filter(|samples| !samples.is_empty());
        let changes: Vec<DVector<f64>> = rows.map(change).collect();
        changes.iter().for_each(|change| covariance.ger(1.0, change, change, 1.0));
        Ok((&covariance + covariance.transpose()) / 2.0)
    }

    fn samples(&self, frames: &[FrameNormal], groups: usize) -> Samples {
        let sweep = self.sweep();
        let comparison = self.comparison(&sweep);
        let mut jitters = DMatrix::zeros(self.unknowns.len(), frames.len());
        let mut rows: Vec<Vec<RowSample>> = (0..self.columns.rows()).map(|_| Vec::new()).collect();
        for (index, own) in frames.iter().enumerate() {
            let frame = &self.frames[own.frame];
            let late = (self.late_us[own.frame], self.longer_us(own.frame));
            jitters.set_column(index, &(&own.mixed / own.weight));
            comparison.visit(frame, late, BoardSamples::OnEdges, |row, opening, closing, sums| {
                let of_group = |group| {
                    let sums = comparison.compare(frame, row, group..group + 1, (opening, closing), false);
                    let [before, until] =
                        [opening, closing].map(|edge| self.columns.errors_before(row, group, edge.drawn()));
                    let residuals = std::array::from_fn(|picture| before[picture] - until[picture]);
                    GroupSample { opening: sums.opening, closing: sums.closing, residuals }
                };
                rows[row].push(RowSample {
                    frame: index,
                    edges: self.edges(own.frame, row, opening, closing),
                    sums: *sums,
                    groups: (0..groups).map(of_group).collect(),
                });
            });
        }
        Samples { rows, jitters }
    }

    /// The scatter of the scores that comes from the noise of the pictures of rows, from which each response is averaged
    /// over the pixels near it.
    fn scatter_of_responses(&self, samples: &Samples, groups: usize) -> DMatrix<f64> {
        let (rows, unknowns) = (self.columns.rows(), self.unknowns.len());
        let mut scatter = DMatrix::zeros(unknowns, unknowns);
        if groups == 0 {
            return scatter;
        }
        // What pixels of variance 1 in a camera row's columns of one group add to the covariance of all groups.
        let of_variance_1 = |row: usize| -> Vec<DMatrix<f64>> {
            let shares = self.columns.column_shares(row);
            let of_group = |group: usize| {
                let shares = shares.slice(s![.., self.columns.columns_of(group)]);
                let products = shares.dot(&shares.t());
                DMatrix::from_fn(groups, groups, |a, b| products[[a, b]])
            };
            (0..groups).map(of_group).collect()
        };
        let of_variance_1: Vec<Vec<DMatrix<f64>>> = (0..rows).map(of_variance_1).collect();
        for picture in 0..PICTURES {
            let of_responses = samples.scores(groups, picture);
            let mut of_pixels = DMatrix::zeros(unknowns, rows * groups);
            let mut with_variance = of_pixels.clone();
            for row in 0..rows {
                let mut sum = of_pixels.columns_mut(row * groups, groups);
                for other in near_rows(row, rows) {
                    sum += of_responses.columns(other * groups, groups) / near_rows(other, rows).len() as f64;
                }
                let mut covariance = DMatrix::zeros(groups, groups);
                for (group, of_variance_1) in of_variance_1[row].iter().enumerate() {
                    covariance += of_variance_1 * self.columns.picture_variance(row, group, picture);
                }
                with_variance.columns_mut(row * groups, groups).copy_from(&(&sum * covariance));
            }
            scatter += of_pixels * with_variance.transpose();
        }
        scatter
    }

    /// Modes of the covariance of the row starts, `[mode, row]`, and the standard deviations of the row starts.
    pub(super) fn modes(
        &self,
        covariance: &DMatrix<f64>,
    ) -> Result<(ndarray::Array2<f64>, Vec<f64>), TimesError> {
        let rows = self.nominal.projector_rows + 1;
        let count = self.table.coefficients;
        let root = covariance.view((0, 0), (count, count)).clone_owned();
        let root = root.cholesky().ok_or(TimesError::Undetermined)?.l();
        let mut factor = DMatrix::zeros(rows, count);
        for row in 0..rows {
            let (first, weights) = self.table.weights(row);
            for (index, weight) in weights.iter().enumerate() {
                for column in 0..=first + index {
                    factor[(row, column)] += weight * root[(first + index, column)];
                }
            }
        }
        // The covariance is factor * factor'. What its mean and its slope over the rows seen explain, is split off.
        let seen = self.columns.seen_rows();
        let length = seen.len() as f64 + 1.0;
        let offset = DVector::from_fn(rows, |row, _| f64::from(row >= seen.start && row <= seen.end));
        let middle = (seen.start + seen.end) as f64 / 2.0;
        let slope = DVector::from_fn(rows, |row, _| offset[row] * (row as f64 - middle) / length);
        let mut modes: Vec<DVector<f64>> = Vec::new();
        let whole = factor.clone();
        for direction in [offset, slope] {
            let along = factor.tr_mul(&direction);
            let along = &along / along.norm().max(f64::MIN_POSITIVE);
            let mode = &factor * &along;
            factor.ger(-1.0, &mode, &along, 1.0);
            modes.push(mode);
        }
        // Beyond the rows seen, the sweep may bend: early by a share of the sweep in its middle is this curvature.
        let curvature_us = 8.0 * BEND * self.nominal.row_time_us / self.nominal.projector_rows as f64;
        let bend = |away: usize| curvature_us * (away as f64).powi(2) / 2.0;
        modes.push(DVector::from_fn(rows, |row, _| bend(seen.start.saturating_sub(row))));
        modes.push(DVector::from_fn(rows, |row, _| bend(row.saturating_sub(seen.end))));
        let variance =
            |row: usize| whole.row(row).norm_squared() + modes[2][row].powi(2) + modes[3][row].powi(2);
        let sd_us = (0..rows).map(|row| variance(row).sqrt()).collect();
        // Beyond the rows seen, the largest modes would be those of the extrapolation, which the bend covers.
        let inside = factor.rows(seen.start, seen.len() + 1).clone_owned();
        let eigen = inside.tr_mul(&inside).symmetric_eigen();
        let mut order: Vec<usize> = (0..count).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let mut rest: f64 = eigen.eigenvalues.iter().sum();
        let enough = MODES_REST * rest;
        for index in order {
            if rest <= enough {
                break;
            }
            rest -= eigen.eigenvalues[index];
            modes.push(&factor * eigen.eigenvectors.column(index));
        }
        let modes = ndarray::Array2::from_shape_fn((modes.len(), rows), |(mode, row)| modes[mode][row]);
        Ok((modes, sd_us))
    }
}

/// The normal matrix without the samples of one camera row, and how far that row draws the others' normal equations:
/// the jitters of its frames are found again without it, too, because few rows tell a frame with two borders its jitter.
fn without_row(
    matrix: &DMatrix<f64>,
    frames: &[FrameNormal],
    samples: &[RowSample],
) -> (DMatrix<f64>, DVector<f64>) {
    let count = matrix.nrows();
    let (mut row, mut score) = (DMatrix::zeros(count, count), DVector::zeros(count));
    let mut with = DMatrix::zeros(count, samples.len());
    let mut without = DMatrix::zeros(count, samples.len());
    for (index, RowSample { frame, edges, sums, .. }) in samples.iter().enumerate() {
        let mut own = FrameNormal { frame: *frame, mixed: DVector::zeros(count), weight: 0.0, right: 0.0 };
        own.add(edges, sums, &mut row, &mut score);
        let FrameNormal { mixed, weight, .. } = &frames[*frame];
        let (others_mixed, others_weight) = (mixed - &own.mixed, weight - own.weight);
        score.axpy(-own.right / others_weight, &others_mixed, 1.0);
        with.set_column(index, &(mixed / weight.sqrt()));
        without.set_column(index, &(others_mixed / others_weight.sqrt()));
    }
    (matrix - row + &with * with.transpose() - &without * without.transpose(), score)
}
