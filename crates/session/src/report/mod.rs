//! `report.html`: one self-contained page without scripts or network access. Pictures are PNG, plots are SVG,
//! and colours follow the reader's light or dark preference.
//!
//! The model is generic: the plane-rig and dot-rig code put their content into [`Section`]s.

mod contact_sheet;
mod picture;
mod plot;
mod style;

use maud::{DOCTYPE, Markup, PreEscaped, html};

pub use contact_sheet::ContactSheet;
pub use picture::{Marker, Picture, ToneMap, ToneSamples};
pub use plot::{Guide, Plot, Series, SeriesStyle};

use crate::Result;

const STYLE: &str = include_str!("style.css");

/// A page.
#[derive(Debug, Clone, Default)]
pub struct Report {
    /// The page's heading.
    pub title: String,
    /// The line below it.
    pub subtitle: String,
    /// Key and value of the most important facts, shown in a band below the title.
    pub facts: Vec<(String, String)>,
    /// Sections, in order.
    pub sections: Vec<Section>,
}

/// A part of the page with its own heading.
#[derive(Debug, Clone, Default)]
pub struct Section {
    /// The heading.
    pub title: String,
    /// One or two sentences about the content; may be empty.
    pub intro: String,
    /// Content, in order.
    pub blocks: Vec<Block>,
}

/// A part of a section.
#[derive(Debug, Clone)]
pub enum Block {
    /// Pairs of key and value.
    Facts(Vec<(String, String)>),
    /// A table.
    Table(Table),
    /// Pictures side by side.
    Pictures(Vec<Picture>),
    /// Small pictures in a grid over two settings.
    ContactSheet(ContactSheet),
    /// Plots side by side.
    Plots(Vec<Plot>),
    /// A remark.
    Note(NoteLevel, String),
}

/// A table; the first column names the row.
#[derive(Debug, Clone, Default)]
pub struct Table {
    /// One header per column.
    pub headers: Vec<String>,
    /// One cell per column.
    pub rows: Vec<Vec<String>>,
}

/// Severity of a remark.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoteLevel {
    /// Information.
    Info,
    /// The result may be worse than it looks.
    Warning,
    /// Something is missing or wrong.
    Error,
}

impl Report {
    /// Renders the page as HTML; the same report gives the same bytes. All texts are escaped.
    ///
    /// # Errors
    /// [`crate::Error::Codec`] if a picture or a plot cannot be drawn.
    pub fn to_html(&self) -> Result<String> {
        let mut sections = Vec::new();
        for section in &self.sections {
            sections.push(section.to_markup()?);
        }
        let page = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    meta name="color-scheme" content="light dark";
                    title { (self.title) }
                    style { (PreEscaped(STYLE)) }
                }
                body {
                    header {
                        h1 { (self.title) }
                        p.subtitle { (self.subtitle) }
                        (facts("band", &self.facts))
                    }
                    main { @for section in &sections { (section) } }
                }
            }
        };
        Ok(page.into_string())
    }
}

impl Section {
    fn to_markup(&self) -> Result<Markup> {
        let mut blocks = Vec::new();
        for block in &self.blocks {
            blocks.push(block.to_markup()?);
        }
        Ok(html! {
            section {
                h2 { (self.title) }
                @if !self.intro.is_empty() { p.intro { (self.intro) } }
                @for block in &blocks { (block) }
            }
        })
    }
}

impl Block {
    fn to_markup(&self) -> Result<Markup> {
        Ok(match self {
            Block::Facts(pairs) => facts("facts", pairs),
            Block::Table(table) => table.to_markup(),
            Block::Pictures(pictures) => {
                let figures = pictures.iter().map(Picture::to_figure).collect::<Result<Vec<_>>>()?;
                html! { div.pictures { @for figure in &figures { (figure) } } }
            }
            Block::ContactSheet(sheet) => sheet.to_markup()?,
            Block::Plots(plots) => {
                let figures = plots.iter().map(Plot::to_figure).collect::<Result<Vec<_>>>()?;
                html! { div.plots { @for figure in &figures { (figure) } } }
            }
            Block::Note(level, text) => {
                let class = match level {
                    NoteLevel::Info => "note info",
                    NoteLevel::Warning => "note warning",
                    NoteLevel::Error => "note error",
                };
                html! { p class=(class) { (text) } }
            }
        })
    }
}

impl Table {
    fn to_markup(&self) -> Markup {
        html! {
            div.scroll {
                table {
                    thead { tr { @for header in &self.headers { th scope="col" { (header) } } } }
                    tbody {
                        @for row in &self.rows { tr { @for cell in row { td { (cell) } } } }
                    }
                }
            }
        }
    }
}

fn facts(class: &str, pairs: &[(String, String)]) -> Markup {
    html! {
        @if !pairs.is_empty() {
            dl class=(class) {
                @for (key, value) in pairs { div { dt { (key) } dd { (value) } } }
            }
        }
    }
}

#[cfg(test)]
mod tests;
