//! Area-normalised profiles: how the light of a pixel falls off with its distance from the illuminated row.

use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, ArrayView1, Axis, s};
use raysweep_config::{Plan, Procedure};
use raysweep_session::{STRIP_ROWS, Session, transport};
use serde::{Deserialize, Serialize};

use crate::stored::ProcessError;

/// In what distances are counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DistanceUnit {
    /// Projector rows: only sessions of the same working distance can be compared.
    Rows,
    /// Millimetres on the scene.
    Mm,
}

/// Distances from the illuminated row between which light is summed, on both sides.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bins {
    /// Of the edges.
    pub unit: DistanceUnit,
    /// From 0 on, ascending.
    pub edges: Vec<f64>,
}

/// Edges of the bins in units of the coarsest row; wider where there is less light.
const EDGES_ROWS: [f64; 13] = [0.0, 0.5, 1.5, 2.5, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 56.0];
/// Fewer bins tell too little of a profile.
const LEAST_BINS: usize = 4;
/// A pixel with less light than this share of the brightest percentile is dark: its profile is noise.
const DARK: f32 = 0.02;

/// A sweep with its transport.
#[derive(Debug, Clone)]
pub struct Transported {
    /// The session's folder.
    pub dir: PathBuf,
    /// Rows and columns.
    pub size: (usize, usize),
    /// Size of a projector row on the scene, if it is known.
    pub mm_per_row: Option<f64>,
    /// Time from one projector row to the next.
    pub row_time_us: Option<f64>,
    path: PathBuf,
    u_min: i64,
    depth: usize,
}

/// The profiles of a session's pixels.
#[derive(Debug, Clone)]
pub struct Profiles {
    /// `[t, s, bin]`: shares of the pixel's light, which add up to 1; NaN if it is dark or not known.
    pub shares: Array3<f32>,
    /// Whether the pixel is dark: `[t, s]`.
    pub is_dark: Array2<bool>,
}

impl Transported {
    /// Opens a sweep; `mm_per_row` replaces that of its plan.
    ///
    /// # Errors
    /// When it is no sweep, or has no transport.
    pub fn open(dir: &Path, mm_per_row: Option<f64>) -> Result<Self, ProcessError> {
        let session = Session::open(dir)?;
        let wrong = |what: String| ProcessError::Config(format!("{}: {what}", dir.display()));
        let plan_path = session.plan_path();
        let text = session.read_text(&plan_path)?;
        let plan = Plan::parse_stored(&text)
            .map_err(|error| ProcessError::Config(error.render(&plan_path.display().to_string(), &text)))?;
        let Procedure::Sweep(own) = plan.procedure else {
            return Err(wrong(
                "is no sweep: materials are told by the transport of a sweep (kind = \"sweep\")".into(),
            ));
        };
        let path = session.transport_path();
        if !path.is_dir() {
            return Err(wrong(
                "has no transport.zarr; `raysweep process` makes it once the sweep is complete".into(),
            ));
        }
        let ([depth, rows, columns], attributes) = transport::describe(&path)?;
        let u_min = attributes.get("u_min").and_then(serde_json::Value::as_i64).ok_or_else(|| {
            wrong("transport.zarr does not say its u_min; `raysweep process` makes it again".into())
        })?;
        Ok(Self {
            dir: dir.to_owned(),
            size: (rows, columns),
            mm_per_row: mm_per_row.or(own.mm_per_row),
            row_time_us: attributes.get("row_time_us").and_then(serde_json::Value::as_f64),
            path,
            u_min,
            depth,
        })
    }

    /// The first relative row of the transport.
    pub(super) fn u_min(&self) -> i64 {
        self.u_min
    }

    /// Number of relative rows.
    pub(super) fn depth(&self) -> usize {
        self.depth
    }

    /// Calls `see` with each camera row `t` and its transport `[u, s]`, with NaN where the projector has no row.
    pub(super) fn for_each_row(
        &self,
        mut see: impl FnMut(usize, ndarray::ArrayView2<f32>),
    ) -> Result<(), ProcessError> {
        let rows = self.size.0;
        for first in (0..rows).step_by(STRIP_ROWS) {
            let end = (first + STRIP_ROWS).min(rows);
            let mut strip = transport::read_rows(&self.path, first..end)?;
            for t in first..end {
                for (mut plane, u) in strip.outer_iter_mut().zip(self.u_min..) {
                    if !(0..rows as i64).contains(&(t as i64 + u)) {
                        plane.row_mut(t - first).fill(f32::NAN);
                    }
                }
                see(t, strip.index_axis(Axis(1), t - first));
            }
        }
        Ok(())
    }

    /// Rows to both sides that the transport has.
    fn reach_rows(&self) -> f64 {
        let u_max = self.u_min + self.depth as i64 - 1;
        (-self.u_min).min(u_max).max(0) as f64 + 0.5
    }

    /// Rows that every pixel has on one side at least.
    fn known_rows(&self) -> f64 {
        self.reach_rows().min((self.size.0 / 2) as f64 + 0.5)
    }

    /// Size of a row in a unit.
    ///
    /// # Errors
    /// When it is not known.
    fn row(&self, unit: DistanceUnit) -> Result<f64, ProcessError> {
        match (unit, self.mm_per_row) {
            (DistanceUnit::Rows, _) => Ok(1.0),
            (DistanceUnit::Mm, Some(mm)) => Ok(mm),
            (DistanceUnit::Mm, None) => Err(ProcessError::Config(format!(
                "{}: its distances are not known in mm; give sweep.mm_per_row in the plan, or --mm-per-row",
                self.dir.display()
            ))),
        }
    }

    /// The profiles of all pixels, of the mean light of `window_px` x `window_px` pixels around each.
    ///
    /// # Errors
    /// When the transport cannot be read or does not reach as far as the bins.
    pub fn profiles(&self, bins: &Bins, window_px: usize) -> Result<Profiles, ProcessError> {
        let row = self.row(bins.unit)?;
        let end = bins.edges.last().copied().unwrap_or_default();
        if end > self.reach_rows() * row * (1.0 + 1e-9) {
            return Err(ProcessError::Config(format!(
                "{}: its transport reaches {:.3} {} from the illuminated row, the model needs {end:.3}: sweep longer delays",
                self.dir.display(),
                self.reach_rows() * row,
                bins.unit.name()
            )));
        }
        let (rows, columns) = self.size;
        let mut shares = Array3::from_elem((rows, columns, bins.edges.len() - 1), f32::NAN);
        let mut light = Array2::zeros(self.size);
        let margin = window_px / 2;
        for first in (0..rows).step_by(STRIP_ROWS) {
            let end = (first + STRIP_ROWS).min(rows);
            let around = first.saturating_sub(margin)..(end + margin).min(rows);
            let strip = transport::read_rows(&self.path, around.clone())?;
            for t in first..end {
                for s in 0..columns {
                    let window = strip.slice(s![
                        ..,
                        t.saturating_sub(margin).max(around.start) - around.start
                            ..(t + margin + 1).min(around.end) - around.start,
                        s.saturating_sub(margin)..(s + margin + 1).min(columns)
                    ]);
                    let pixels = (window.len() / self.depth) as f32;
                    let mean = window.sum_axis(Axis(2)).sum_axis(Axis(1)) / pixels;
                    light[[t, s]] = mean.sum();
                    if let Some(found) = self.binned(mean.view(), t, bins, row) {
                        shares.slice_mut(s![t, s, ..]).assign(&found);
                    }
                }
            }
        }
        let mut sorted: Vec<f32> = light.iter().copied().filter(|light| light.is_finite()).collect();
        sorted.sort_by(f32::total_cmp);
        let bright = sorted.get(sorted.len() * 99 / 100).copied().unwrap_or_default();
        let is_dark = light.mapv(|light| light.is_nan() || light <= DARK * bright);
        for (place, _) in is_dark.indexed_iter().filter(|(_, is_dark)| **is_dark) {
            shares.slice_mut(s![place.0, place.1, ..]).fill(f32::NAN);
        }
        Ok(Profiles { shares, is_dark })
    }

    /// Shares of light within the bins; `None` if there is none, or if rows beyond the projector would have to be known
    /// on both sides.
    fn binned(
        &self,
        profile: ArrayView1<f32>,
        t: usize,
        bins: &Bins,
        row: f64,
    ) -> Option<ndarray::Array1<f32>> {
        let side = |sign: i64, from: f64, to: f64| {
            let (mut sum, mut k) = (0.0, 0_i64);
            loop {
                let low = ((k as f64 - 0.5) * row).max(0.0);
                let high = (k as f64 + 0.5) * row;
                if low >= to - 1e-9 * row {
                    return Some(sum);
                }
                let covered = high.min(to) - low.max(from);
                if covered > 0.0 {
                    let v = t as i64 + sign * k;
                    if !(0..self.size.0 as i64).contains(&v) {
                        return None;
                    }
                    let light = profile.get(usize::try_from(sign * k - self.u_min).ok()?)?;
                    sum += f64::from(*light) * covered / row;
                }
                k += 1;
            }
        };
        let sums: Option<Vec<f64>> = bins
            .edges
            .windows(2)
            .map(|edges| match (side(1, edges[0], edges[1]), side(-1, edges[0], edges[1])) {
                (Some(below), Some(above)) => Some(below + above),
                // Beyond the projector's first or last row nothing was lit; the profile is taken to be symmetric.
                (Some(one), None) | (None, Some(one)) => Some(2.0 * one),
                (None, None) => None,
            })
            .collect();
        let sums = sums?;
        let area: f64 = sums.iter().sum();
        (area > 0.0).then(|| sums.iter().map(|sum| (sum / area) as f32).collect())
    }
}

impl DistanceUnit {
    /// Its name in texts.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rows => "rows",
            Self::Mm => "mm",
        }
    }
}

impl Bins {
    /// Whether they ascend from 0 and are no more than a model ever has: a file may say anything.
    pub(super) fn are_sound(&self) -> bool {
        let ascend = self.edges.windows(2).all(|edges| edges[0] < edges[1]);
        ascend && self.edges.first() == Some(&0.0) && self.edges.len() <= EDGES_ROWS.len()
    }

    /// Bins that all of these sessions can fill: in mm if all of them know their rows' size.
    ///
    /// # Errors
    /// When the shortest transport has too few rows.
    pub fn of(sessions: &[Transported]) -> Result<Self, ProcessError> {
        let in_mm: Option<Vec<f64>> = sessions.iter().map(|session| session.mm_per_row).collect();
        let (unit, rows) = match in_mm {
            Some(rows) => (DistanceUnit::Mm, rows),
            None => (DistanceUnit::Rows, vec![1.0; sessions.len()]),
        };
        let coarsest = rows.iter().copied().fold(0.0, f64::max);
        let reach = sessions.iter().zip(&rows).map(|(session, row)| session.known_rows() * row);
        let reach = reach.fold(f64::INFINITY, f64::min) * (1.0 + 1e-9);
        let edges: Vec<f64> =
            EDGES_ROWS.iter().map(|edge| edge * coarsest).take_while(|edge| *edge <= reach).collect();
        if edges.len() <= LEAST_BINS {
            return Err(ProcessError::Config(format!(
                "the shortest transport reaches {reach:.3} {} from the illuminated row, which is too little to tell materials: sweep delays of at least {} rows to each side",
                unit.name(),
                EDGES_ROWS[LEAST_BINS]
            )));
        }
        Ok(Self { unit, edges })
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array1;

    use super::*;

    const ROWS: usize = 101;

    fn session(mm_per_row: f64) -> Transported {
        Transported {
            dir: PathBuf::new(),
            size: (ROWS, 1),
            mm_per_row: Some(mm_per_row),
            row_time_us: None,
            path: PathBuf::new(),
            u_min: -50,
            depth: ROWS,
        }
    }

    /// Light exp(-|x|) of one mm, summed over rows of this size.
    fn exponential(mm_per_row: f64) -> Array1<f32> {
        let below = |x: f64| if x < 0.0 { 0.5 * x.exp() } else { 1.0 - 0.5 * (-x).exp() };
        (-50..=50)
            .map(|u| {
                (below((f64::from(u) + 0.5) * mm_per_row) - below((f64::from(u) - 0.5) * mm_per_row)) as f32
            })
            .collect()
    }

    fn binned(mm_per_row: f64, light: &Array1<f32>, t: usize, bins: &Bins) -> Option<Array1<f32>> {
        session(mm_per_row).binned(light.view(), t, bins, mm_per_row)
    }

    #[test]
    fn shares_add_up_and_depend_on_neither_brightness_nor_distance() {
        let bins = Bins { unit: DistanceUnit::Mm, edges: vec![0.0, 0.15, 0.45, 1.05, 2.4, 4.5] };
        let near = binned(0.1, &exponential(0.1), 50, &bins).unwrap();
        assert!((near.sum() - 1.0).abs() < 1e-6, "{near}");
        let bright = binned(0.1, &(7.0 * exponential(0.1)), 50, &bins).unwrap();
        let far = binned(0.3, &exponential(0.3), 50, &bins).unwrap();
        for ((near, bright), far) in near.iter().zip(&bright).zip(&far) {
            assert!((near - bright).abs() < 1e-6, "{near} {bright}");
            assert!((near / far - 1.0).abs() < 0.02, "{near} {far}");
        }
    }

    #[test]
    fn one_side_stands_for_both_where_the_projector_ends() {
        let bins = Bins { unit: DistanceUnit::Rows, edges: vec![0.0, 0.5, 3.5, 20.5] };
        let light = exponential(0.3);
        let middle = binned(1.0, &light, 50, &bins).unwrap();
        let mut cut = light.clone();
        // The pixel of row 4 has no rows further up than 4.
        cut.slice_mut(s![..46]).fill(0.0);
        let edge = binned(1.0, &cut, 4, &bins).unwrap();
        assert!(middle.iter().zip(&edge).all(|(a, b)| (a - b).abs() < 1e-6), "{middle} {edge}");
        let wide = Bins { edges: vec![0.0, 0.5, 3.5, 60.5], ..bins };
        assert!(binned(1.0, &light, 50, &wide).is_none(), "no row is known so far away");
    }
}
