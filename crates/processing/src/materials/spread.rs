//! Profiles of labelled regions side by side, and maps of how far light spreads. No training.

use std::fmt::Write as _;
use std::path::Path;

use ndarray::{Array1, Array2, Array3, Axis, s};
use rayon::prelude::*;
use raysweep_session::durable;
use raysweep_session::products::Products;
use raysweep_session::report::{Block, NoteLevel, Plot, Report, Section, Series, Table};
use raysweep_transport::plane::spread::SpreadProfile;
use serde::Serialize;
use serde_json::{Map, json};

use super::{Labelled, Labels, Transported, create_new, open};
use crate::report::named;
use crate::stored::ProcessError;

/// Parts of a region whose scatter gives the standard deviations.
const PARTS: usize = 5;
/// Side of the window whose mean profile a map judges; its rows are the parts.
const WINDOW_PX: usize = 3;

/// A value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Measured {
    /// The value.
    pub value: f64,
    /// Its standard deviation.
    pub sd: f64,
}

/// How light spreads in the pixels of a label.
#[derive(Debug, Clone, Serialize)]
pub struct RegionSpread {
    /// The session's folder.
    pub session: std::path::PathBuf,
    /// The label.
    pub label: String,
    /// Number of pixels.
    pub pixels: usize,
    /// Relative row u, share of the light at it, and the share's standard deviation.
    pub profile: Vec<(i64, Measured)>,
    /// Width of the band from which half of the light comes, in rows.
    pub effective_width_rows: Option<Measured>,
    /// Light from lower rows minus light from upper ones, as a share of both.
    pub asymmetry: Option<Measured>,
    /// Distance over which light in the medium falls to 1/e, by diffusion; only if the rows' size is known.
    pub decay_length_mm: Option<Measured>,
}

/// What is compared, and how.
#[derive(Debug, Clone, Copy)]
pub struct SpreadOptions {
    /// Replaces that of the sessions' plans.
    pub mm_per_row: Option<f64>,
    /// Of the media, below air.
    pub refractive_index: f64,
    /// Whether maps are made too.
    pub maps: bool,
}

/// Compares the profiles of labelled regions; writes tables, plots, maps and a page into the new folder `to`.
///
/// # Errors
/// When a file cannot be read or does not fit, or `to` exists or cannot be written.
pub fn compare(
    labelled: &[Labelled],
    options: SpreadOptions,
    to: &Path,
) -> Result<Vec<RegionSpread>, ProcessError> {
    if !(1.0..=3.0).contains(&options.refractive_index) {
        return Err(ProcessError::Config(format!(
            "--refractive-index {}: must be from 1 to 3; water and milk have 1.33, wax 1.45",
            options.refractive_index
        )));
    }
    let opened = open(labelled, options.mm_per_row)?;
    let mut regions = Vec::new();
    for (session, labels) in &opened {
        regions.extend(of_labels(session, labels, options.refractive_index)?);
    }
    create_new(to)?;
    durable::write(&to.join("profiles.csv"), csv(&regions, &opened).as_bytes())?;
    for (name, plot) in plots(&regions, &opened) {
        durable::write(&to.join(format!("{name}.svg")), plot.to_svg()?.as_bytes())?;
    }
    durable::write(&to.join("report.html"), page(&regions, &opened).to_html()?.as_bytes())?;
    if options.maps {
        for (session, _) in &opened {
            maps(session, options.refractive_index, to)?;
        }
    }
    Ok(regions)
}

/// Sums over the pixels of one part of a region, for each u.
#[derive(Clone)]
struct Sums {
    light: Array1<f64>,
    squares: Array1<f64>,
    pixels: Array1<f64>,
}

impl Sums {
    fn new(depth: usize) -> Self {
        let zeros = Array1::zeros(depth);
        Self { light: zeros.clone(), squares: zeros.clone(), pixels: zeros }
    }

    fn add(&mut self, profile: ndarray::ArrayView1<f32>) {
        for (u, light) in profile.iter().enumerate().filter(|(_, light)| light.is_finite()) {
            self.light[u] += f64::from(*light);
            self.squares[u] += f64::from(*light).powi(2);
            self.pixels[u] += 1.0;
        }
    }

    fn join(&mut self, other: &Self) {
        self.light += &other.light;
        self.squares += &other.squares;
        self.pixels += &other.pixels;
    }

    fn mean(&self) -> Array1<f32> {
        (&self.light / &self.pixels).mapv(|light| light as f32)
    }
}

fn of_labels(session: &Transported, labels: &Labels, index: f64) -> Result<Vec<RegionSpread>, ProcessError> {
    let depth = session.depth();
    let counts: Vec<usize> = (0..labels.names.len())
        .map(|name| labels.of_pixel.iter().filter(|label| **label == Some(name)).count())
        .collect();
    let mut parts = vec![vec![Sums::new(depth); PARTS]; labels.names.len()];
    let mut seen = vec![0; labels.names.len()];
    session.for_each_row(|t, row| {
        for (s, label) in labels.of_pixel.row(t).iter().enumerate() {
            let Some(label) = *label else { continue };
            parts[label][seen[label] * PARTS / counts[label]].add(row.index_axis(Axis(1), s));
            seen[label] += 1;
        }
    })?;
    let regions = labels.names.iter().zip(parts).zip(counts).map(|((name, parts), pixels)| {
        let mut all = Sums::new(depth);
        parts.iter().for_each(|part| all.join(part));
        let mean = all.mean();
        let means: Vec<_> = parts.iter().map(Sums::mean).collect();
        let measured = |of: &dyn Fn(SpreadProfile) -> Option<f64>| measured(session, &mean, &means, of);
        RegionSpread {
            session: session.dir.clone(),
            label: name.clone(),
            pixels,
            profile: shares(session, &all),
            effective_width_rows: measured(&|profile| profile.effective_width_rows()),
            asymmetry: measured(&|profile| profile.asymmetry()),
            decay_length_mm: session
                .mm_per_row
                .and_then(|mm| measured(&|profile| profile.decay(mm, index).map(|decay| decay.length_mm))),
        }
    });
    Ok(regions.collect())
}

/// A value of the mean profile, and the standard deviation of a mean of as many parts.
fn measured(
    session: &Transported,
    mean: &Array1<f32>,
    parts: &[Array1<f32>],
    of: &dyn Fn(SpreadProfile) -> Option<f64>,
) -> Option<Measured> {
    let of = |light: &Array1<f32>| of(SpreadProfile { light: light.view(), u_min: session.u_min() });
    let value = of(mean)?;
    let values: Vec<f64> = parts.iter().filter_map(of).collect();
    let count = values.len() as f64;
    if values.len() < 2 {
        return Some(Measured { value, sd: f64::NAN });
    }
    let middle = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - middle).powi(2)).sum::<f64>() / (count - 1.0);
    Some(Measured { value, sd: (variance / count).sqrt() })
}

/// The area-normalised profile of a region; standard deviations of the mean over its pixels, as if they were independent.
fn shares(session: &Transported, all: &Sums) -> Vec<(i64, Measured)> {
    let mean = &all.light / &all.pixels;
    let area: f64 = mean.iter().filter(|light| light.is_finite()).sum();
    let sd = |u: usize| {
        let pixels = all.pixels[u];
        let variance = (all.squares[u] / pixels - mean[u].powi(2)).max(0.0);
        (variance / (pixels - 1.0).max(1.0)).sqrt() / area
    };
    (session.u_min()..)
        .zip(mean.iter().enumerate())
        .filter(|(_, (_, light))| light.is_finite() && area > 0.0)
        .map(|(row, (u, light))| (row, Measured { value: light / area, sd: sd(u) }))
        .collect()
}

/// `session label`, short.
fn name_of(region: &RegionSpread, sessions: usize) -> String {
    let session = region.session.file_name().unwrap_or_default().to_string_lossy();
    if sessions > 1 { format!("{} ({session})", region.label) } else { region.label.clone() }
}

fn csv(regions: &[RegionSpread], opened: &[(Transported, Labels)]) -> String {
    let quoted = |name: &str| format!("\"{}\"", name.replace('"', "\"\""));
    let mut csv = "session,label,u_rows,u_us,u_mm,share,share_sd\n".to_owned();
    for region in regions {
        let session = opened.iter().map(|(session, _)| session).find(|session| session.dir == region.session);
        let row_time_us = session.and_then(|session| session.row_time_us);
        let mm_per_row = session.and_then(|session| session.mm_per_row);
        let name = region.session.file_name().unwrap_or_default().to_string_lossy();
        for (u, Measured { value, sd }) in &region.profile {
            let scaled = |row: Option<f64>| row.map_or_else(String::new, |row| (*u as f64 * row).to_string());
            let _ = writeln!(
                csv,
                "{},{},{u},{},{},{value},{sd}",
                quoted(&name),
                quoted(&region.label),
                scaled(row_time_us),
                scaled(mm_per_row)
            );
        }
    }
    csv
}

/// Profiles over rows, over the delay, and with a logarithmic axis of light.
fn plots(regions: &[RegionSpread], opened: &[(Transported, Labels)]) -> Vec<(&'static str, Plot)> {
    let plot = |title: &str, x: &str, y: &str, scale: &dyn Fn(&RegionSpread) -> Option<f64>, log: bool| {
        let y_of = |share: f64| if log { share.max(1e-6).log10() } else { share };
        let series = regions.iter().filter_map(|region| {
            let scale = scale(region)?;
            let points = region.profile.iter().map(|(u, share)| (*u as f64 * scale, y_of(share.value)));
            let band: Vec<_> = region
                .profile
                .iter()
                .map(|(u, share)| {
                    (*u as f64 * scale, y_of(share.value - share.sd), y_of(share.value + share.sd))
                })
                .collect();
            Some([Series::line(name_of(region, opened.len()), points.collect()), Series::band(&band)])
        });
        let series: Vec<_> = series.flatten().collect();
        Plot { title: title.into(), x_label: x.into(), y_label: y.into(), series, guides: Vec::new() }
    };
    let row_time = |region: &RegionSpread| {
        let session = opened.iter().find(|(session, _)| session.dir == region.session);
        session.and_then(|(session, _)| session.row_time_us)
    };
    vec![
        ("profiles-rows", plot("Profiles", "distance u, rows", "share of the light", &|_| Some(1.0), false)),
        ("profiles-us", plot("Profiles over the delay", "delay, µs", "share of the light", &row_time, false)),
        (
            "profiles-log",
            plot("Profiles, logarithm", "distance u, rows", "log10 of the share", &|_| Some(1.0), true),
        ),
    ]
}

fn page(regions: &[RegionSpread], opened: &[(Transported, Labels)]) -> Report {
    let cell = |measured: Option<Measured>| {
        measured.map_or("none".to_owned(), |Measured { value, sd }| format!("{value:.3} ± {sd:.3}"))
    };
    let rows = regions
        .iter()
        .map(|region| {
            vec![
                name_of(region, opened.len()),
                region.pixels.to_string(),
                cell(region.effective_width_rows),
                cell(region.asymmetry),
                cell(region.decay_length_mm),
            ]
        })
        .collect();
    let headers = ["label", "pixels", "effective width, rows", "asymmetry", "decay length, mm"];
    let table = Table { headers: headers.map(str::to_owned).to_vec(), rows };
    let plots =
        plots(regions, opened).into_iter().map(|(_, plot)| plot).filter(|plot| !plot.series.is_empty());
    let mut blocks = vec![Block::Plots(plots.collect()), Block::Table(table)];
    if opened.iter().any(|(session, _)| session.mm_per_row.is_none()) {
        let text = "A decay length needs the size of a row on the scene: sweep.mm_per_row in the plan, or --mm-per-row. The effective width is a width of the light, not a property of the material.";
        blocks.push(Block::Note(NoteLevel::Info, text.into()));
    }
    let intro = "The transport of each label's pixels, divided by its sum. Bands are standard deviations of the mean over the pixels; those in the table come from the scatter of five parts of each region.";
    let sections = vec![Section { title: "How light spreads".into(), intro: intro.into(), blocks }];
    let facts = named([("regions", regions.len().to_string()), ("sessions", opened.len().to_string())]);
    Report { title: "Profiles".into(), subtitle: String::new(), facts, sections }
}

/// Writes maps of width, asymmetry and decay length of a session, each with its standard deviation.
fn maps(session: &Transported, index: f64, to: &Path) -> Result<(), ProcessError> {
    let (rows, columns) = session.size;
    let margin = WINDOW_PX / 2;
    // The transport of the rows of a window: [row, u, s].
    let mut near: Vec<Array2<f32>> = Vec::new();
    let values: &[(&str, &str)] = match session.mm_per_row {
        Some(_) => &[("effective-width", "rows"), ("asymmetry", "1"), ("decay-length", "mm")],
        None => &[("effective-width", "rows"), ("asymmetry", "1")],
    };
    let mut found = Array3::from_elem((2 * values.len(), rows, columns), f32::NAN);
    let mut judge = |middle: usize, near: &[Array2<f32>]| {
        let line: Vec<Vec<f32>> = (0..columns)
            .into_par_iter()
            .map(|s| {
                let window = s.saturating_sub(margin)..(s + margin + 1).min(columns);
                let parts: Vec<Array1<f32>> = near
                    .iter()
                    .filter_map(|row| row.slice(s![.., window.clone()]).mean_axis(Axis(1)))
                    .collect();
                let mean = parts.iter().fold(Array1::zeros(session.depth()), |sum, part| sum + part)
                    / parts.len() as f32;
                let measured = |of: &dyn Fn(SpreadProfile) -> Option<f64>| {
                    measured(session, &mean, &parts, of)
                        .map_or([f32::NAN; 2], |measured| [measured.value as f32, measured.sd as f32])
                };
                let mut line = Vec::with_capacity(2 * values.len());
                line.extend(measured(&|profile| profile.effective_width_rows()));
                line.extend(measured(&|profile| profile.asymmetry()));
                if let Some(mm) = session.mm_per_row {
                    line.extend(measured(&|profile| profile.decay(mm, index).map(|decay| decay.length_mm)));
                }
                line
            })
            .collect();
        for (s, values) in line.iter().enumerate() {
            for (k, value) in values.iter().enumerate() {
                found[[k, middle, s]] = *value;
            }
        }
    };
    session.for_each_row(|t, row| {
        near.push(row.to_owned());
        if near.len() > WINDOW_PX {
            near.remove(0);
        }
        if t > 0 {
            judge(t - 1, &near);
        }
        if t + 1 == rows {
            judge(t, &near[near.len().saturating_sub(2)..]);
        }
    })?;
    let folder = to.join(session.dir.file_name().unwrap_or_default());
    durable::create_dir_all(&folder)?;
    let products = Products::new(&folder);
    for (k, (name, unit)) in values.iter().enumerate() {
        let metadata = Map::from_iter([
            ("unit".to_owned(), json!(unit)),
            ("axes".to_owned(), json!(["t", "s"])),
            ("window_px".to_owned(), json!(WINDOW_PX)),
            ("session".to_owned(), json!(session.dir)),
        ]);
        products.image(name, found.index_axis(Axis(0), 2 * k), &metadata)?;
        products.image(&format!("{name}-sd"), found.index_axis(Axis(0), 2 * k + 1), &metadata)?;
    }
    Ok(())
}
