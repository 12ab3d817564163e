//! Images under many pictures: direct and global light from shifted checkerboards, and the images under all others.

mod images;
mod report;
mod task;

use std::ops::Range;
use std::sync::Arc;

use ndarray::{Array2, Array3, ArrayView2, Axis};
use raysweep_config::RigFile;
use raysweep_config::plan::{PatternPlan, PatternsPlan};
use raysweep_core::{Mosaic, Pattern};
use raysweep_pipeline::mask;
use raysweep_session::ledger::State;
use raysweep_session::report::{Picture, ToneMap};
use raysweep_session::{Result, Session, durable};
use raysweep_transport::plane::separation::{CheckerboardSums, Separated, SeparatedSettings, separate};
use serde_json::json;

pub(crate) use self::images::{LitImage, PictureImages};
use self::task::{EPIPOLAR, REGULAR};
pub use self::task::{PatternsTask, PictureSetting};
use crate::plane::colour::{Values, axes, in_colour, mask_in_colour, sequence_in_colour};
use crate::plane::manifest;
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// Images of each product under pictures in the report.
const SHOWN: usize = 8;
/// White in pictures: this percentile of the pixels.
const PERCENTILE: f64 = 99.5;
/// Light of the projector's black as a share of its white, beyond which it is taken for an error.
const MOST_BLACK: f64 = 0.5;

/// Direct and global light by one series of checkerboards.
struct SeparatedSeries {
    /// What the names of its products end with, if the plan has several series.
    suffix: String,
    separation: SeparatedSettings,
    /// Pixels that saturated under some picture, `[t, s]`.
    is_clipped: Array2<bool>,
    size_px: u32,
}

/// What was made of a session.
pub struct PatternProducts {
    series: Vec<SeparatedSeries>,
    /// Some images under other pictures.
    captured: Vec<Picture>,
    /// Light of the projector's black as a share of its white; `None`: not measured.
    black: Option<f64>,
    /// What could not be made, and why.
    problems: Vec<String>,
    /// What makes the products worse than they look.
    shortcomings: Vec<String>,
}

impl PatternProducts {
    /// Makes and writes them.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn make(session: &Session, state: &State, task: &PatternsTask) -> Result<Self> {
        let stack = session.stack()?;
        let images = PictureImages::new(task, state, &stack);
        let (black, mut problems) = (black(&images), state.left_out());
        let (mut all_series, mut captured) = (Vec::new(), Vec::new());
        let boards = task.series().iter().filter(|(_, plan, _)| is_checkerboard(plan)).count();
        for (name, plan, pictures) in task.series() {
            let PatternPlan::Checkerboard { size_px, .. } = *plan else {
                match write_captured(session, &images, &name, pictures)? {
                    Ok(shown) => captured.extend(shown),
                    Err(problem) => problems.push(format!("{name}: {problem}")),
                }
                continue;
            };
            match separated(&images, size_px, pictures, black.unwrap_or(0.0)) {
                Ok((separation, is_clipped)) => {
                    let suffix = if boards > 1 {
                        format!("-{}", name.trim_start_matches("checkerboard-"))
                    } else {
                        String::new()
                    };
                    let series = SeparatedSeries { suffix, separation, is_clipped, size_px };
                    write_separated(session, task, &series, black)?;
                    all_series.push(series);
                }
                Err(problem) => problems.push(format!("direct and global light by {name}: {problem}")),
            }
        }
        let shortcomings = shortcomings(&all_series, black, boards);
        Ok(Self { series: all_series, captured, black, problems, shortcomings })
    }

    /// What could not be made, and what makes the products worse than they look.
    pub fn warnings(&self) -> impl Iterator<Item = &String> {
        self.shortcomings.iter().chain(&self.problems)
    }

    /// Writes report and manifest.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn write_report(
        &self,
        session: &Session,
        state: &State,
        task: &PatternsTask,
        rig: &RigFile,
    ) -> Result<()> {
        let page = report::make(session, state, task, self).to_html()?;
        durable::write(&session.report_path(), page.as_bytes())?;
        manifest::write(session, state, &task.task, rig)
    }
}

fn is_checkerboard(plan: &PatternPlan) -> bool {
    matches!(plan, PatternPlan::Checkerboard { .. })
}

/// The projector's black, if the plan has a black and a white picture: total light of the first setting's images.
fn black(images: &PictureImages<'_>) -> Option<f64> {
    let total = |plan: PatternPlan| {
        let LitImage { light, .. } = images.image(images.task.picture_of(&plan)?, 0).ok()?;
        Some(light.iter().map(|&light| f64::from(light)).filter(|light| light.is_finite()).sum::<f64>())
    };
    let (black, white) = (total(PatternPlan::Black {})?, total(PatternPlan::White {})?);
    let share = (black / white).max(0.0);
    (share < MOST_BLACK).then_some(share)
}

/// Separates the light of all settings; returns also where a frame saturated.
fn separated(
    images: &PictureImages<'_>,
    size_px: u32,
    pictures: Range<usize>,
    black: f64,
) -> std::result::Result<(SeparatedSettings, Array2<bool>), String> {
    let task = images.task;
    let size = (task.task.geometry.height, task.task.geometry.width);
    let mut is_clipped = Array2::from_elem(size, false);
    let (mut settings, mut dark_images) = (Vec::new(), f64::INFINITY);
    for setting in 0..task.settings().len() {
        let mut sums = CheckerboardSums::new(size_px, size);
        for picture in pictures.clone() {
            let Pattern::Checkerboard { shift_px, .. } = task.pictures[picture] else { continue };
            let LitImage { light, clipped, frames } = images.image(picture, setting)?;
            sums.add(shift_px, light.view()).map_err(|error| error.to_string())?;
            if let Some(clipped) = clipped {
                is_clipped.zip_mut_with(&clipped, |is_clipped, &frames| *is_clipped |= frames > 0);
            }
            let (_, dark_frames) = images.dark(setting)?;
            dark_images = f64::min(dark_images, f64::from(dark_frames) / f64::from(frames));
        }
        settings.push(sums);
    }
    let separation = separate(&settings, black, dark_images).map_err(|error| error.to_string())?;
    Ok((separation, is_clipped))
}

/// What makes the products worse than they look.
fn shortcomings(all_series: &[SeparatedSeries], black: Option<f64>, boards: usize) -> Vec<String> {
    let mut warnings = Vec::new();
    if black.is_none() && boards > 0 {
        warnings.push("the projector's black is not measured, and is taken for dark: add a [[pattern]] of kind \"white\" and one of kind \"black\"".to_owned());
    }
    for SeparatedSeries { separation, is_clipped, size_px, .. } in all_series {
        let share = |marked: &Array2<bool>| {
            marked.iter().filter(|marked| **marked).count() as f64 / marked.len().max(1) as f64
        };
        let blur_px = separation.blur_px.map(|[x, y]| x.max(y));
        if blur_px.is_none() {
            warnings.push(format!(
                "no part of the image is bright enough to tell how sharp squares of {size_px} pixels are: they were taken for sharp, and direct light may be too low; average more frames"
            ));
        }
        if let Some(blur_px) = blur_px.filter(|blur_px| 2.0 * blur_px > f64::from(*size_px)) {
            warnings.push(format!(
                "each pixel sees a mean over about {blur_px:.0} pixels of the projector, more than half of a square of {size_px}: direct light may be too low by more than is corrected; focus the projector, or take larger squares"
            ));
        }
        let spread = share(&separation.is_spread);
        if spread > 0.01 {
            let mut lengths: Vec<f32> = separation
                .spread_px
                .iter()
                .zip(&separation.is_spread)
                .filter(|(_, is)| **is)
                .map(|(px, _)| *px)
                .collect();
            lengths.sort_by(f32::total_cmp);
            let length_px = lengths.get(lengths.len() / 2).copied().unwrap_or_default();
            let wanted_px = length_px.max(4.0);
            let then = match blur_px {
                Some(blur_px) if 2.0 * blur_px > f64::from(wanted_px) => {
                    "squares small enough to tell it apart are not resolved here; a sweep separates it by rows".into()
                }
                _ => format!("squares of {wanted_px:.0} pixels or less would tell it apart"),
            };
            warnings.push(format!(
                "in {:.0} % of the pixels, light spreads over about {length_px:.0} pixels of the projector, so that squares of {size_px} take some of it for direct: it is an upper bound there, which the mask marks; {then}",
                100.0 * spread
            ));
        }
        let clipped = share(is_clipped);
        if clipped > 0.0 {
            warnings.push(format!("{:.2} % of the pixels saturate under some pictures of the {size_px}-pixel squares; the mask marks them: take shorter exposures or less light", 100.0 * clipped));
        }
    }
    warnings
}

/// Writes direct and global light of a series.
fn write_separated(
    session: &Session,
    task: &PatternsTask,
    series: &SeparatedSeries,
    black: Option<f64>,
) -> Result<()> {
    let SeparatedSeries { suffix, separation, is_clipped, size_px } = series;
    let mosaic = task.task.mosaic;
    let bits = mask_bits(separation, is_clipped);
    // What is neither light nor its error has no colour.
    let write = |name: &str, about: &str, values: Option<Values>, image: ArrayView2<f32>| {
        let mosaic = if values.is_some() { mosaic } else { Mosaic::Mono };
        let image = in_colour(image, mosaic, values.unwrap_or(Values::Errors));
        let bits = mask_in_colour(bits.clone(), mosaic);
        let mut metadata = task.task.metadata();
        if values.is_none() {
            metadata.insert("units".into(), json!("projector pixels"));
        }
        metadata.insert("axes".into(), json!(axes(mosaic)));
        metadata.insert("about".into(), json!(about));
        metadata.insert(
            "checkerboard".into(),
            json!({ "size_px": size_px, "blur_px_xy": separation.blur_px, "black": black }),
        );
        metadata.insert("mask".into(), json!({ "measured": mask::MEASURED, "bound only": mask::BOUND_ONLY }));
        session.products().masked_image(name, image.view(), bits.view(), &metadata)
    };
    for (setting, light) in task.settings().iter().zip(&separation.settings) {
        let prefix = prefix(setting);
        let of = if setting.name == REGULAR {
            "all rows".to_owned()
        } else {
            format!(
                "the rows seen at a delay of {} us with an exposure of {} us",
                setting.delay_us, setting.exposure_us
            )
        };
        let Separated { direct, direct_sd, global, global_sd } = light;
        for (kind, image, sd) in [("direct", direct, direct_sd), ("global", global, global_sd)] {
            let about = format!("{kind} light of {of}");
            write(&format!("{prefix}{kind}{suffix}"), &about, Some(Values::Light), image.view())?;
            let about = format!("standard deviation of the {kind} light of {of}");
            write(&format!("{prefix}{kind}{suffix}-sd"), &about, Some(Values::Errors), sd.view())?;
        }
    }
    if let Some([image, sd]) = non_epipolar(task, separation) {
        write(
            &format!("non-epipolar{suffix}"),
            "light of all rows minus that of the epipolar image",
            Some(Values::Light),
            image.view(),
        )?;
        write(
            &format!("non-epipolar{suffix}-sd"),
            "standard deviation of the non-epipolar light",
            Some(Values::Errors),
            sd.view(),
        )?;
    }
    write(
        &format!("spread{suffix}"),
        "distance in projector pixels over which light spreads in the scene; 0: none is seen, NaN: too dark to tell",
        None,
        separation.spread_px.view(),
    )
}

/// What the names of a setting's products begin with.
fn prefix(setting: &PictureSetting) -> String {
    if setting.name == REGULAR { String::new() } else { format!("{}-", setting.name) }
}

/// All light but that of the epipolar image, and its standard deviation.
fn non_epipolar(task: &PatternsTask, separation: &SeparatedSettings) -> Option<[Array2<f32>; 2]> {
    let of = |name: &str| {
        let at = task.settings().iter().position(|setting| setting.name == name)?;
        separation.settings.get(at)
    };
    let (regular, epipolar) = (of(REGULAR)?, of(EPIPOLAR)?);
    let total = |light: &Separated| &light.direct + &light.global;
    // That of a total is below that of the global light, which has the error of the direct light too.
    let variance =
        |light: &Separated| &light.global_sd * &light.global_sd - &light.direct_sd * &light.direct_sd;
    let sd = (variance(regular) + variance(epipolar)).mapv(|variance| variance.max(0.0).sqrt());
    Some([total(regular) - total(epipolar), sd])
}

fn mask_bits(separation: &SeparatedSettings, is_clipped: &Array2<bool>) -> Array2<u8> {
    let mut bits = is_clipped.mapv(|is_clipped| if is_clipped { mask::BOUND_ONLY } else { mask::MEASURED });
    bits.zip_mut_with(&separation.is_spread, |bits, is_spread| {
        if *is_spread {
            *bits = mask::BOUND_ONLY;
        }
    });
    bits
}

/// Writes the images under the pictures of a series as they were taken, one product for each setting; returns pictures of
/// some. The inner error says what keeps them from being used.
fn write_captured(
    session: &Session,
    images: &PictureImages<'_>,
    name: &str,
    pictures: Range<usize>,
) -> Result<std::result::Result<Vec<Picture>, String>> {
    let task = images.task;
    let (height, width) = (task.task.geometry.height, task.task.geometry.width);
    let mut drawn = Vec::new();
    for (index, setting) in task.settings().iter().enumerate() {
        let mut cube = Array3::zeros((pictures.len(), height, width));
        let mut bits = Array2::from_elem((height, width), mask::MEASURED);
        for (mut image, picture) in cube.axis_iter_mut(Axis(0)).zip(pictures.clone()) {
            let LitImage { light, clipped, .. } = match images.image(picture, index) {
                Ok(lit) => lit,
                Err(problem) => return Ok(Err(problem)),
            };
            image.assign(&light);
            if let Some(clipped) = clipped {
                bits.zip_mut_with(&clipped, |bits, &frames| {
                    *bits = if frames > 0 { mask::BOUND_ONLY } else { *bits };
                });
            }
        }
        let (mosaic, product) = (task.task.mosaic, format!("{name}-{}", setting.name));
        let bits = mask_in_colour(bits, mosaic);
        let shown: Vec<String> = pictures.clone().map(|picture| task.pictures[picture].to_string()).collect();
        let images = sequence_in_colour(cube.view(), mosaic);
        let planes: Vec<_> = images
            .outer_iter()
            .flat_map(|image| {
                (0..image.len_of(Axis(2))).map(move |channel| image.index_axis_move(Axis(2), channel))
            })
            .collect();
        let white = ToneMap::percentile(&planes, PERCENTILE);
        for k in (0..shown.len()).step_by(shown.len().div_ceil(SHOWN)) {
            let caption = format!("{product}: {}", shown[k]);
            drawn.push(Picture::coloured(images.index_axis(Axis(0), k), white).with_caption(caption));
        }
        let mut metadata = task.task.metadata();
        metadata.insert("mask".into(), json!({ "measured": mask::MEASURED, "bound only": mask::BOUND_ONLY }));
        let about = format!(
            "light at a delay of {} us with an exposure of {} us",
            setting.delay_us, setting.exposure_us
        );
        if let [only] = &shown[..] {
            metadata.insert("axes".into(), json!(axes(mosaic)));
            metadata.insert("about".into(), json!(format!("{about}, under {only}")));
            let image = images.index_axis(Axis(0), 0);
            session.products().masked_image(&product, image, bits.view(), &metadata)?;
        } else {
            let layers: Vec<String> = (0..shown.len()).map(|k| format!("k{k:04}")).collect();
            metadata.insert("axes".into(), json!([&["k"], axes(mosaic)].concat()));
            metadata.insert("about".into(), json!(about));
            metadata.insert("k".into(), json!({ "is": "picture", "at": shown }));
            metadata.insert("layers".into(), json!(layers));
            session.products().masked_sequence(&product, images.view(), &layers, bits.view(), &metadata)?;
        }
    }
    Ok(Ok(drawn))
}

/// Makes the products of stored images again.
///
/// # Errors
/// When products are asked for, or the session cannot be written.
pub fn process(
    stored: &Stored<'_>,
    patterns: PatternsPlan,
    asked: &Asked,
) -> std::result::Result<Processed, ProcessError> {
    let Stored { session, state, plan, .. } = stored;
    if !asked.products.is_empty() {
        let message =
            "a session of kind \"patterns\" has the products of its pictures alone: leave --product out";
        return Err(ProcessError::Product(message.into()));
    }
    let rig = stored.plane_rig()?;
    let shape = state.session.shape;
    let mut task =
        PatternsTask::new(plan, patterns, &stored.known(&rig)?).map_err(|error| stored.in_plan(&error))?;
    stored.check_points(task.contents(), &task.task)?;
    Arc::make_mut(&mut task.task).left_out = state.left_out();
    let products = PatternProducts::make(session, state, &task)?;
    products.write_report(session, state, &task, &rig)?;
    let (report, points) = (session.report_path(), shape.points());
    Ok(Processed { report, stored: state.stored_points(), points, problems: products.problems })
}
