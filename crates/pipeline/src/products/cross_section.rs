//! Product `cross-section`: a row or a column of the regular, the captured epipolar and the sharpened epipolar image.

use ndarray::{Array2, Array3, ArrayView2, Axis, s};
use raysweep_transport::plane::Transport;
use serde::Deserialize;

use super::band::Width;
use super::planned::{Planned, shown};
use crate::product::{CrossSection, Product};
use crate::schedule::{Schedule, SweepGeometry};
use crate::stack::SweepStack;

/// Options of `cross-section`, as given in a plan.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CrossSectionTable {
    row: Option<usize>,
    column: Option<usize>,
    /// Exposure of the captured image; if omitted, the shortest.
    exposure_us: Option<f64>,
}

/// Where the images are cut, and which of them was captured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SectionLine {
    line: Line,
    planned: Planned,
    /// The plan's delay nearest to 0.
    delay_us: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Line {
    Row(usize),
    Column(usize),
}

impl CrossSectionTable {
    /// The options, if they are valid for the plan and its camera.
    pub(super) fn check(
        self,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<SectionLine, (&'static str, String)> {
        let (rows, columns) = (geometry.height, geometry.width);
        let line = match (self.row, self.column) {
            (Some(row), None) if row < rows => Line::Row(row),
            (None, Some(column)) if column < columns => Line::Column(column),
            (Some(row), None) => return Err(("row", format!("row = {row}: the camera has {rows} rows"))),
            (None, Some(column)) => {
                return Err(("column", format!("column = {column}: the camera has {columns} columns")));
            }
            _ => return Err(("row", "give either row or column, counted from 0".into())),
        };
        let planned = Planned::new(schedule, self.exposure_us)?;
        let delay_us = planned.nearest_delay_us(schedule, 0.0);
        Ok(SectionLine { line, planned, delay_us })
    }
}

impl SectionLine {
    pub(super) fn default_name(self) -> String {
        match self.line {
            Line::Row(row) => format!("cross_section_t{row}"),
            Line::Column(column) => format!("cross_section_s{column}"),
        }
    }

    /// The part within the camera rows starting at `first_row`, to which stack and transport belong; `None` if there is
    /// none.
    pub(super) fn make(
        self,
        name: String,
        first_row: usize,
        stack: &SweepStack,
        transport: &Transport,
    ) -> Result<Option<Product>, String> {
        let Self { line, planned: Planned { exposure_us, .. }, delay_us } = self;
        let n = self.planned.image_at(stack, delay_us)?;
        let own_rows = Width::default().of(stack.one_band);
        // Of what saturates, only a bound is known.
        let known = |image: ArrayView2<'_, f32>, is_known: Option<ArrayView2<'_, bool>>| {
            let mut image = image.to_owned();
            if let Some(is_known) = is_known {
                image.zip_mut_with(&is_known, |light, is_known| {
                    *light = if *is_known { *light } else { f32::NAN };
                });
            }
            image
        };
        let valid = stack.valid.as_ref().map(|valid| valid.index_axis(Axis(0), n));
        let captured = known(stack.images.index_axis(Axis(0), n), valid);
        let is_told = Array2::from_shape_fn(captured.dim(), |(t, s)| {
            let is_measured = |valid: &Array3<bool>| valid.slice(s![.., t, s]).iter().any(|valid| *valid);
            stack.valid.as_ref().is_none_or(is_measured) && !transport.is_bound([t, s], own_rows.range())
        });
        let sharpened = known(transport.epipolar(own_rows.rows()).view(), Some(is_told.view()));
        let regular = stack
            .regular
            .as_ref()
            .map(|image| known(image.view(), stack.regular_valid.as_ref().map(|valid| valid.view())));
        let cut = |image: ArrayView2<'_, f32>| -> Option<Vec<f64>> {
            let line = match line {
                Line::Row(row) => {
                    let row = row.checked_sub(first_row).filter(|row| *row < image.nrows())?;
                    image.row(row).to_vec()
                }
                Line::Column(column) => image.column(column).to_vec(),
            };
            Some(line.into_iter().map(f64::from).collect())
        };
        let curves = [
            ("regular", regular.as_ref().map(|image| image.view())),
            ("captured", Some(captured.view())),
            ("sharpened", Some(sharpened.view())),
        ];
        let curves = curves.into_iter().filter_map(|(curve, image)| Some((curve, cut(image?)?)));
        let curves: Vec<(&'static str, Vec<f64>)> = curves.collect();
        let (along, place) = match line {
            Line::Row(row) => ("s", format!("row t = {row}")),
            Line::Column(column) => ("t", format!("column s = {column}")),
        };
        Ok((!curves.is_empty()).then(|| {
            let own = match own_rows.rows() {
                1 => "the pixel's own projector row".to_owned(),
                rows => format!("{rows} projector rows about the pixel's own, which nothing tells apart"),
            };
            let about = format!(
                "{place} of the regular image, of that captured at a delay of {} µs and an exposure of {exposure_us} µs, and of the sharpened epipolar image, light from {own}; NaN where a sample saturates or is not measured",
                shown(delay_us)
            );
            Product::CrossSection(CrossSection { name, about, along, curves })
        }))
    }
}
