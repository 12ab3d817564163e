//! All pictures of a sweep at a glance.

use maud::{Markup, html};

use super::picture::Picture;
use super::style::short;
use crate::Result;

/// Small pictures in a grid over two settings, for example exposure (rows) over delay (columns).
#[derive(Debug, Clone, Default)]
pub struct ContactSheet {
    /// What varies along the columns, with its unit: `delay / µs`.
    pub column_title: String,
    /// One label per column.
    pub columns: Vec<String>,
    /// What varies along the rows, with its unit.
    pub row_title: String,
    /// One label per row.
    pub rows: Vec<String>,
    /// Row by row, one picture per column ([`Picture::thumbnail`], all with the same tone map); `None` for a
    /// missing point. The list may end early.
    pub pictures: Vec<Option<Picture>>,
}

impl ContactSheet {
    pub(super) fn to_markup(&self) -> Result<Markup> {
        let mut cells = Vec::new();
        for (row, row_label) in self.rows.iter().enumerate() {
            let mut line = Vec::new();
            for (column, column_label) in self.columns.iter().enumerate() {
                let alt = format!("{} {row_label}, {} {column_label}", self.row_title, self.column_title);
                line.push(match self.pictures.get(row * self.columns.len() + column) {
                    Some(Some(picture)) => html! { div.cell title=(alt) { (picture.to_img(&alt)?) } },
                    _ => html! { div.cell.missing title=(format!("{alt}: missing")) {} },
                });
            }
            cells.push(html! { div.row { (row_label) } @for cell in &line { (cell) } });
        }
        let scale = self.pictures.iter().flatten().next().map(Picture::tone_map);
        let missing = self.rows.len() * self.columns.len() - self.pictures.iter().flatten().count();
        Ok(html! {
            figure.sheet {
                div.scroll {
                    div.axis { (self.column_title) " →" }
                    div.grid style=(format!("--columns:{}", self.columns.len())) {
                        div.corner { (self.row_title) " ↓" }
                        @for label in &self.columns { div.column { (label) } }
                        @for line in &cells { (line) }
                    }
                }
                figcaption {
                    span.scale {
                        @if let Some(scale) = scale { "white = " (short(scale.white)) " in all pictures" }
                        @if missing > 0 { " · hatched: " (missing) " missing" }
                    }
                }
            }
        })
    }
}
