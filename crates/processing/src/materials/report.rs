//! Pages of maps and evaluations.

use ndarray::{Array2, Array3, s};
use raysweep_session::report::{Block, Picture, Report, Section, Table, ToneMap};

use super::{Evaluation, Judged, MaterialMap, MaterialModel, Told, Transported};
use crate::report::named;
use crate::stored::ProcessError;

/// Colours of the materials, by their names in tables (Okabe and Ito, distinguishable by most people). Linear RGB.
const COLOURS: [(&str, [f32; 3]); 7] = [
    ("orange", [0.791, 0.347, 0.0]),
    ("sky blue", [0.093, 0.456, 0.815]),
    ("green", [0.0, 0.342, 0.171]),
    ("yellow", [0.871, 0.776, 0.054]),
    ("blue", [0.0, 0.168, 0.445]),
    ("red", [0.665, 0.112, 0.0]),
    ("pink", [0.604, 0.191, 0.386]),
];
const UNKNOWN: (&str, [f32; 3]) = ("grey", [0.2; 3]);
const DARK: [f32; 3] = [0.0; 3];
const WHITE: ToneMap = ToneMap { white: 1.0 };

fn section(title: &str, intro: &str, blocks: Vec<Block>) -> Section {
    Section { title: title.into(), intro: intro.into(), blocks }
}

/// The materials in their colours.
pub(super) fn map(found: &Array2<Told>) -> Picture {
    let (rows, columns) = found.dim();
    let mut image = Array3::zeros((rows, columns, 3));
    for (place, found) in found.indexed_iter() {
        let colour = match *found {
            Told::Dark => DARK,
            Told::Unknown => UNKNOWN.1,
            Told::Material(material) => COLOURS[material % COLOURS.len()].1,
        };
        for (channel, value) in colour.into_iter().enumerate() {
            image[[place.0, place.1, channel]] = value;
        }
    }
    Picture::unreduced(image.view(), WHITE)
}

/// The page of a map.
pub(super) fn applied(
    session: &Transported,
    model: &MaterialModel,
    applied: &MaterialMap,
    map: Picture,
    window_px: usize,
) -> Report {
    let all = (session.size.0 * session.size.1) as f64;
    let row = |name: &str, colour: &str, pixels: usize| {
        vec![
            name.to_owned(),
            colour.to_owned(),
            pixels.to_string(),
            format!("{:.1} %", 100.0 * pixels as f64 / all),
        ]
    };
    let mut rows: Vec<_> = applied
        .materials
        .iter()
        .zip(COLOURS.iter().cycle())
        .map(|((name, pixels), (colour, _))| row(name, colour, *pixels))
        .collect();
    rows.push(row("unknown", UNKNOWN.0, applied.unknown));
    rows.push(row("too dark", "black", applied.dark));
    let headers = ["material", "colour", "pixels", "share"].map(str::to_owned).to_vec();
    let sections = vec![
        section(
            "Materials",
            "Unknown pixels are less like their nearest material than 98 % of the pixels on which the model was trained.",
            vec![Block::Pictures(vec![map]), Block::Table(Table { headers, rows })],
        ),
        trained(model),
    ];
    let facts = named([
        ("session", session.dir.display().to_string()),
        ("window", format!("{window_px} × {window_px} px")),
        ("unknown", applied.unknown.to_string()),
    ]);
    Report { title: "Materials".into(), subtitle: session.dir.display().to_string(), facts, sections }
}

/// What a model was trained on, and what its cross-validation found.
fn trained(model: &MaterialModel) -> Section {
    let mut headers = vec!["session".to_owned(), "labels".into()];
    headers.extend(model.materials.iter().cloned());
    let rows = model
        .trained_on
        .iter()
        .map(|on| {
            let pixels = on.pixels.iter().map(usize::to_string);
            [on.session.clone(), on.labels.clone()].into_iter().chain(pixels).collect()
        })
        .collect();
    let confusion = model.confusion.outer_iter().map(|row| row.to_vec()).collect();
    let judged = Judged { window_px: 1, at_edges: false, counts: confusion };
    let edges: Vec<_> = model.bins.edges.iter().map(|edge| format!("{edge:.3}")).collect();
    let facts = named([
        ("C", model.c.to_string()),
        ("gamma", model.gamma.to_string()),
        ("bins", format!("{} {}", edges.join(", "), model.bins.unit.name())),
    ]);
    section(
        "The model",
        "Shares of each material's pixels found as each by models trained without them.",
        vec![
            Block::Facts(facts),
            Block::Table(shares(&judged, &model.materials, &model.materials)),
            Block::Table(Table { headers, rows }),
        ],
    )
}

fn shares(judged: &Judged, truths: &[String], founds: &[String]) -> Table {
    let mut headers = vec!["true label".to_owned()];
    headers.extend(founds.iter().cloned());
    headers.push("pixels".into());
    let shares = judged.shares();
    let rows = truths
        .iter()
        .zip(shares.outer_iter())
        .zip(&judged.counts)
        .map(|((name, row), counts)| {
            let cells = row.iter().map(|share| format!("{share:.3}"));
            let pixels: usize = counts.iter().sum();
            std::iter::once(name.clone()).chain(cells).chain([pixels.to_string()]).collect()
        })
        .collect();
    Table { headers, rows }
}

/// Side of a cell in the picture of a confusion matrix.
const CELL_PX: usize = 24;

fn picture(judged: &Judged) -> Picture {
    let shares = judged.shares();
    let (rows, columns) = shares.dim();
    let mut image = Array2::zeros((rows * CELL_PX, columns * CELL_PX));
    for ((row, column), share) in shares.indexed_iter() {
        let cell = s![row * CELL_PX..(row + 1) * CELL_PX - 1, column * CELL_PX..(column + 1) * CELL_PX - 1];
        image.slice_mut(cell).fill(0.02 + 0.98 * *share as f32);
    }
    Picture::grey(image.view(), WHITE)
        .with_caption("rows: true label; columns: found, the last unknown; white: 1")
}

/// The page of an evaluation.
pub(super) fn evaluated(model: &MaterialModel, evaluation: &Evaluation) -> Report {
    let truths: Vec<_> = evaluation.materials.iter().chain(&evaluation.strangers).cloned().collect();
    let founds: Vec<_> = evaluation.materials.iter().cloned().chain(["unknown".to_owned()]).collect();
    let mut sections: Vec<_> = evaluation
        .judged
        .iter()
        .map(|judged| {
            let intro = match judged.at_edges {
                false => "",
                true => {
                    "Pixels within 3 px of another label: light from beyond the border is in their profiles."
                }
            };
            let blocks =
                vec![Block::Table(shares(judged, &truths, &founds)), Block::Pictures(vec![picture(judged)])];
            section(&format!("Found, {}", judged.name()), intro, blocks)
        })
        .collect();
    sections.push(trained(model));
    let worst = evaluation.worst(1).map_or("none".into(), |worst| format!("{worst:.3}"));
    let facts = named([
        ("materials", evaluation.materials.len().to_string()),
        ("worst of the diagonal, single pixels", worst),
    ]);
    Report { title: "Evaluation of a material model".into(), subtitle: String::new(), facts, sections }
}

impl Evaluation {
    /// The smallest share of a material's pixels away from edges that were found, among the labelled ones.
    pub fn worst(&self, window_px: usize) -> Option<f64> {
        let judged = self.judged.iter().find(|judged| judged.window_px == window_px && !judged.at_edges)?;
        let shares = judged.shares();
        let found = (0..self.materials.len())
            .filter(|&material| judged.counts[material].iter().sum::<usize>() > 0)
            .map(|material| shares[[material, material]]);
        found.min_by(f64::total_cmp)
    }

    /// Tables of all kinds of pixels, as text.
    pub fn table(&self) -> String {
        let width =
            self.materials.iter().chain(&self.strangers).map(|name| name.chars().count()).max().unwrap_or(0);
        let mut lines = vec![format!("rows: true label; columns: {}, unknown", self.materials.join(", "))];
        for judged in &self.judged {
            lines.push(judged.name());
            for (name, row) in self.materials.iter().chain(&self.strangers).zip(judged.shares().outer_iter())
            {
                let cells: Vec<_> = row.iter().map(|share| format!("{share:5.2}")).collect();
                lines.push(format!("  {name:width$} {}", cells.join(" ")));
            }
        }
        lines.join("\n")
    }
}

/// Readable JSON.
pub(super) fn json_bytes(value: &impl serde::Serialize) -> Result<Vec<u8>, ProcessError> {
    let mut json = serde_json::to_vec_pretty(value)
        .map_err(|error| ProcessError::Config(format!("the result cannot be written: {error}")))?;
    json.push(b'\n');
    Ok(json)
}
