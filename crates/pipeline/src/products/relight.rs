//! Product `relight`: the scene lit by a pattern of projector rows.

use ndarray::{Array1, Array2, Array3, Axis};
use raysweep_transport::plane::{PlaneError, RelitBeam, RelitUnknowns, RowTiming, Transport, relight_rows};
use serde::Deserialize;

use super::band::reach_of;
use crate::product::Product;
use crate::schedule::SweepGeometry;

/// Options of `relight`: the brightness of each projector row, and how rows spread.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Relight {
    pattern: RowPattern,
    beam: RelitBeam,
}

/// The brightness of each projector row.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum RowPattern {
    /// Ranges of rows; where they overlap, their weights add up.
    Rows(Vec<Piece>),
    /// Stripes over the whole projector.
    Stripes(Stripes),
    /// A sequence of images: a line that moves from the first row seen by the camera to the last.
    Line(MovingLine),
}

/// Names of [`RelitBeam`] in plans.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum BeamName {
    #[default]
    AsLit,
    Ideal,
}

#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Piece {
    first: usize,
    /// Inclusive.
    last: usize,
    #[serde(default = "full_weight")]
    weight: f64,
}

fn full_weight() -> f64 {
    1.0
}

#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Stripes {
    period_rows: usize,
    lit_rows: usize,
    /// First lit row of the first whole stripe.
    #[serde(default)]
    phase_rows: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MovingLine {
    height_rows: usize,
    step_rows: usize,
}

impl MovingLine {
    /// The first lit row of each image: from the projector row of the camera's first row to that of its last.
    fn first_rows(self, timing: &RowTiming) -> Vec<usize> {
        let own_row = |t: usize| timing.relative_row(0, t).unsigned_abs() as usize;
        (own_row(0)..=own_row(timing.camera_rows() - 1)).step_by(self.step_rows).collect()
    }
}

impl Relight {
    pub(super) fn new(pattern: RowPattern, beam: BeamName) -> Self {
        let beam = match beam {
            BeamName::AsLit => RelitBeam::AsLit,
            BeamName::Ideal => RelitBeam::Ideal,
        };
        Self { pattern, beam }
    }

    /// Checks the options. An error consists of the keys and indices that lead to the invalid value, and the allowed
    /// values.
    pub(super) fn check(&self, geometry: &SweepGeometry) -> Result<(), (Vec<String>, String)> {
        let rows = geometry.raster.rows;
        let within = |path: &[&str], value: usize, lowest: usize, highest: usize, what: &str| {
            if (lowest..=highest).contains(&value) {
                return Ok(());
            }
            let message = format!("{} = {value}: must be from {lowest} to {highest}, {what}", path.join("."));
            Err((path.iter().map(|&key| key.to_owned()).collect::<Vec<_>>(), message))
        };
        match &self.pattern {
            RowPattern::Rows(pieces) => {
                if pieces.is_empty() {
                    return Err((vec!["rows".into()], "rows is empty: give { first, last, weight }".into()));
                }
                for (index, piece) in pieces.iter().enumerate() {
                    let index = index.to_string();
                    within(&["rows", &index, "first"], piece.first, 0, rows - 1, "the projector's rows")?;
                    within(
                        &["rows", &index, "last"],
                        piece.last,
                        piece.first,
                        rows - 1,
                        "first to the projector's last row",
                    )?;
                    if !(piece.weight.is_finite() && piece.weight >= 0.0) {
                        let what = format!("rows.{index}.weight = {}: must be 0 or more", piece.weight);
                        return Err((vec!["rows".into(), index, "weight".into()], what));
                    }
                }
            }
            RowPattern::Stripes(stripes) => {
                let Stripes { period_rows, lit_rows, phase_rows } = *stripes;
                within(&["stripes", "period_rows"], period_rows, 1, rows, "the projector's rows")?;
                within(&["stripes", "lit_rows"], lit_rows, 1, period_rows, "the period")?;
                within(&["stripes", "phase_rows"], phase_rows, 0, period_rows - 1, "less than the period")?;
            }
            RowPattern::Line(line) => {
                within(&["line", "height_rows"], line.height_rows, 1, rows, "the projector's rows")?;
                within(&["line", "step_rows"], line.step_rows, 1, rows, "the projector's rows")?;
            }
        }
        Ok(())
    }

    /// Whether it is more than one image.
    pub(super) fn is_sequence(&self) -> bool {
        matches!(self.pattern, RowPattern::Line(_))
    }

    /// The number of its images.
    pub(super) fn images(&self, geometry: &SweepGeometry) -> usize {
        match &self.pattern {
            RowPattern::Rows(_) | RowPattern::Stripes(_) => 1,
            RowPattern::Line(line) => geometry.height.div_ceil(line.step_rows),
        }
    }

    /// Computes the product for the camera rows starting at `first_row`, to which the transport belongs.
    pub(super) fn make(
        &self,
        name: String,
        timing: &RowTiming,
        first_row: usize,
        transport: &Transport,
        mask: Array2<u8>,
    ) -> Result<Product, PlaneError> {
        let rows = timing.projector_rows();
        let reach = reach_of(transport);
        let under =
            |weights: &Array1<f64>| relight_rows(timing, first_row, transport, weights.view(), self.beam);
        let (says, weights) = match self.weights(rows) {
            Ok(of_rows) => of_rows,
            Err(line) => {
                let tops = line.first_rows(timing);
                let (_, height, width) = transport.t.dim();
                let mut images = Array3::zeros((tops.len(), height, width));
                for (mut image, &top) in images.axis_iter_mut(Axis(0)).zip(&tops) {
                    let lit = top..top + line.height_rows;
                    let weights =
                        Array1::from_shape_fn(rows, |row| if lit.contains(&row) { 1.0 } else { 0.0 });
                    image.assign(&under(&weights)?);
                }
                return Ok(Product::Sequence {
                    name,
                    about: format!(
                        "relit by a line of {} rows that moves down the projector; {reach}",
                        line.height_rows
                    ),
                    axis: "first lit projector row".into(),
                    at: tops.into_iter().map(|top| top as f64).collect(),
                    images,
                    mask,
                });
            }
        };
        let about = format!("{says}; {reach}");
        Ok(Product::Image { name, about, is_light: true, image: under(&weights)?, mask })
    }

    /// The pattern as text, and the brightness of each of the projector's rows; or the line of a sequence.
    pub(super) fn weights(&self, rows: usize) -> Result<(String, Array1<f64>), MovingLine> {
        match &self.pattern {
            RowPattern::Rows(pieces) => {
                let mut weights = Array1::zeros(rows);
                for piece in pieces {
                    weights
                        .iter_mut()
                        .take(piece.last + 1)
                        .skip(piece.first)
                        .for_each(|w| *w += piece.weight);
                }
                let lit = weights.iter().filter(|&&weight| weight > 0.0).count();
                Ok((format!("relit by {lit} of the projector's {rows} rows"), weights))
            }
            RowPattern::Stripes(Stripes { period_rows, lit_rows, phase_rows }) => {
                let lit =
                    |row: usize| (row % period_rows + period_rows - phase_rows) % period_rows < *lit_rows;
                let says = format!("relit by stripes of {lit_rows} rows, {period_rows} rows apart");
                Ok((says, Array1::from_shape_fn(rows, |row| if lit(row) { 1.0 } else { 0.0 })))
            }
            RowPattern::Line(line) => Err(*line),
        }
    }

    /// What is not known of its light; of a sequence, of the light of any image.
    pub(super) fn unknowns(
        &self,
        timing: &RowTiming,
        first_row: usize,
        transport: &Transport,
    ) -> Result<RelitUnknowns, PlaneError> {
        let weights = self.weights(timing.projector_rows()).map_or_else(
            |line| {
                let tops = line.first_rows(timing);
                let lit = |row: usize| tops.iter().any(|top| (*top..top + line.height_rows).contains(&row));
                Array1::from_shape_fn(timing.projector_rows(), |row| f64::from(u8::from(lit(row))))
            },
            |(_, weights)| weights,
        );
        RelitUnknowns::of(timing, first_row, transport, weights.view(), self.beam)
    }

    pub(super) fn beam(&self) -> RelitBeam {
        self.beam
    }
}
