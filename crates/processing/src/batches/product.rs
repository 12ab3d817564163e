//! The products of batches: one video each, with an image per batch of the scene.

use std::path::PathBuf;

use ndarray::{Array3, Array4, ArrayView3, Axis};
use raysweep_config::plan::products_of_argument;
use raysweep_config::{BatchesPlan, ConfigError, Plan, ProductTable};
use raysweep_core::decoding_message_beside;
use raysweep_transport::dots::product::{
    EpipolarMask, MaskRule, REFERENCE_WIDTH_PX, compensate, dual, epipolar, floodlit, pattern_weights,
    relight, shadow_dot, shadow_neighbours,
};
use raysweep_transport::dots::{Batch, FrameShape};
use serde::Deserialize;
use serde_json::Value;

use super::calibration::Calibration;
use super::task::DotTask;

/// A `[[product]]` of a plan of batches.
#[derive(Debug, Clone, PartialEq)]
pub struct DotSpec {
    /// Base name of its files.
    pub name: String,
    kind: Kind,
}

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    Floodlit,
    Relight(Lighting),
    DirectGlobal(Separation),
    Dual(DualSize),
}

/// For kinds without options.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoOptions {}

/// Options of `relight`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Lighting {
    /// A built-in pattern.
    pattern: Pattern,
    /// A PNG or NPY file, used instead of `pattern`.
    image: Option<PathBuf>,
}

impl Default for Lighting {
    fn default() -> Self {
        Self { pattern: Pattern::Sweep, image: None }
    }
}

/// Built-in lighting patterns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Pattern {
    /// All dots.
    White,
    /// A warm bar that moves from left to right over the video, on a dim blue background.
    Sweep,
    /// Red and blue squares, eight across.
    Checks,
}

/// Options of `direct-global`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Separation {
    method: Method,
    /// `epipolar`: the paper's d_thresh, in pixels of a frame that is 1024 wide; default: the radius of a dot.
    distance_px: Option<f64>,
    /// `epipolar`: softness beyond it, in the same pixels.
    sigma_px: f64,
    /// `epipolar`: use the mask exactly as the paper prints it.
    printed: bool,
    /// Divide the direct light by how strongly the dots together cover each pixel.
    compensate: bool,
}

impl Default for Separation {
    fn default() -> Self {
        Self {
            method: Method::Neighbours,
            distance_px: None,
            sigma_px: 2.0,
            printed: false,
            compensate: false,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Method {
    /// Extremes over the images that each lack one dot.
    Naive,
    /// As naive, but without all dots that share pixels of the plane with the brightest one.
    Neighbours,
    /// By distance from the dot's epipolar line.
    Epipolar,
}

impl Method {
    fn name(self) -> &'static str {
        match self {
            Self::Naive => "naive",
            Self::Neighbours => "neighbours",
            Self::Epipolar => "epipolar",
        }
    }
}

/// Options of `dual`.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct DualSize {
    /// Height and width; default: about one pixel per dot.
    size_px: Option<[usize; 2]>,
}

/// One image of the scene: what all products of it share.
pub(super) struct SceneBatches<'a> {
    /// The calibration; `None` without planes.
    pub calibration: Option<&'a Calibration>,
    /// Index of the image, from 0, and number of images.
    pub image: (usize, usize),
    /// For each dot of the batch, whether it shows the scene.
    pub seen: &'a [bool],
    /// Sum of all dots.
    pub light: &'a Array3<f32>,
}

const NO_PLANE: &str =
    "it needs a calibration plane: add [[batches.calibration]], and check that its batches are stored";

impl DotSpec {
    /// The products that the plan names; by default, those that its calibration allows.
    ///
    /// # Errors
    /// With the position in the plan's text.
    pub fn all(plan: &Plan, batches: &BatchesPlan) -> Result<Vec<Self>, ConfigError> {
        let Some(tables) = &plan.products else { return Ok(Self::defaults(batches.calibration.len())) };
        let mut specs: Vec<Self> = Vec::new();
        for (index, table) in tables.iter().enumerate() {
            let refused = |key: &str, message: String| {
                plan.places.error(&["product", &index.to_string(), key], message)
            };
            let spec = Self::new(table).map_err(|message| refused("kind", message))?;
            if specs.iter().any(|other| other.name == spec.name) {
                let message = format!(
                    "product {}: two products are named {:?} and would overwrite each other: give one of them another `name`",
                    table.kind, spec.name
                );
                // A name that is not in the file follows from the kind.
                return Err(refused(if table.name.is_some() { "name" } else { "kind" }, message));
            }
            specs.push(spec);
        }
        Ok(specs)
    }

    /// Parses a command line argument that asks for products: the keys of a `[[product]]`, separated by commas.
    ///
    /// # Errors
    /// What is wrong with the argument.
    pub fn of_argument(argument: &str) -> Result<Vec<Self>, String> {
        let (tables, _, _) =
            products_of_argument(argument).map_err(|(error, text)| error.render("--product", &text))?;
        tables.iter().map(Self::new).collect()
    }

    fn defaults(planes: usize) -> Vec<Self> {
        let epipolar = Separation { method: Method::Epipolar, ..Separation::default() };
        let kinds = [
            (0, "floodlit", Kind::Floodlit),
            (1, "relit", Kind::Relight(Lighting::default())),
            (1, "neighbours", Kind::DirectGlobal(Separation::default())),
            (1, "dual", Kind::Dual(DualSize::default())),
            (2, "epipolar", Kind::DirectGlobal(epipolar)),
        ];
        let possible = kinds.into_iter().filter(|(needed, ..)| *needed <= planes);
        possible.map(|(_, name, kind)| Self { name: name.into(), kind }).collect()
    }

    fn new(table: &ProductTable) -> Result<Self, String> {
        let ProductTable { kind: kind_name, name, options } = table;
        fn read<T: for<'a> Deserialize<'a>>(kind: &str, options: Value) -> Result<T, String> {
            let plain =
                |error: serde_json::Error| decoding_message_beside(&error.to_string(), "table", "name");
            serde_json::from_value(options).map_err(|error| format!("product {kind}: {}", plain(error)))
        }
        let options = Value::Object(options.clone());
        let (kind, default_name) = match kind_name.as_str() {
            "floodlit" => {
                read::<NoOptions>(kind_name, options)?;
                (Kind::Floodlit, "floodlit")
            }
            "relight" => (Kind::Relight(read(kind_name, options)?), "relit"),
            "direct-global" => {
                let separation: Separation = read(kind_name, options)?;
                let Separation { distance_px, sigma_px, .. } = separation;
                let lengths = [("distance_px", distance_px.unwrap_or(0.0)), ("sigma_px", sigma_px)];
                for (key, value) in lengths {
                    if !(0.0..=1024.0).contains(&value) {
                        return Err(format!(
                            "product {kind_name}: {key} = {value}: must be from 0 to 1024 pixels"
                        ));
                    }
                }
                let name = separation.method.name();
                (Kind::DirectGlobal(separation), name)
            }
            "dual" => {
                let size: DualSize = read(kind_name, options)?;
                if let Some(sides) =
                    size.size_px.filter(|sides| sides.iter().any(|side| !(1..=8192).contains(side)))
                {
                    return Err(format!(
                        "product {kind_name}: size_px = {sides:?}: each side must be from 1 to 8192 pixels"
                    ));
                }
                (Kind::Dual(size), "dual")
            }
            _ => {
                return Err(format!(
                    "product kind = {kind_name:?}: must be floodlit, relight, direct-global or dual for batches"
                ));
            }
        };
        let name = name.clone().unwrap_or_else(|| default_name.into());
        let is_plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        if name.is_empty() || !name.chars().all(is_plain) {
            return Err(format!(
                "product {kind_name}: name = {name:?}: must have only letters, digits, `-` and `_`"
            ));
        }
        Ok(Self { name, kind })
    }

    /// File of its lighting pattern, if it has one.
    pub fn pattern_file(&self) -> Option<&PathBuf> {
        match &self.kind {
            Kind::Relight(lighting) => lighting.image.as_ref(),
            _ => None,
        }
    }

    /// Number of values in one image of each of its videos.
    pub(super) fn values(&self, task: &DotTask) -> u64 {
        let pixels = task.shape.pixels() as u64;
        match &self.kind {
            Kind::Floodlit => pixels,
            // A pattern may have colours.
            Kind::Relight(_) => 3 * pixels,
            Kind::DirectGlobal(_) => 2 * pixels,
            Kind::Dual(DualSize { size_px }) => {
                let dots = task.batches.dots as usize;
                size_px
                    .unwrap_or_else(|| size_of_dots(task.shape, dots))
                    .iter()
                    .map(|&side| side as u64)
                    .product()
            }
        }
    }

    /// Names and descriptions of its videos.
    pub fn videos(&self) -> Vec<(String, String)> {
        let name = &self.name;
        match &self.kind {
            Kind::Floodlit => vec![(name.clone(), "all dots lit; camera counts".into())],
            Kind::Relight(Lighting { image: Some(_), .. }) => {
                vec![(name.clone(), "lit by the pattern of its file; camera counts".into())]
            }
            Kind::Relight(Lighting { pattern, .. }) => {
                vec![(name.clone(), format!("lit by the pattern {pattern:?}; camera counts").to_lowercase())]
            }
            Kind::DirectGlobal(Separation { method, compensate, .. }) => {
                let even = if *compensate { ", over the dots' coverage" } else { "" };
                let about =
                    |what: &str| format!("{what} light, by the method {}; camera counts", method.name());
                vec![
                    (format!("{name}-direct"), about("direct") + even),
                    (format!("{name}-global"), about("global")),
                ]
            }
            Kind::Dual(_) => {
                vec![(
                    name.clone(),
                    "as the mirror would see it, lit from the camera; 1 = the calibration plane".into(),
                )]
            }
        }
    }

    /// Computes one image of each of its videos, `[t, s, channels]`.
    ///
    /// # Errors
    /// When the calibration does not allow it.
    pub(super) fn draw(
        &self,
        batch: &Batch,
        scene: &SceneBatches,
        patterns: Option<&Array4<f32>>,
    ) -> Result<Vec<Array3<f32>>, String> {
        let calibrated = || scene.calibration.ok_or_else(|| NO_PLANE.to_owned());
        let told = |error: raysweep_transport::dots::DotsError| error.to_string();
        match &self.kind {
            Kind::Floodlit => Ok(vec![scene.light.clone()]),
            Kind::Relight(Lighting { pattern, .. }) => {
                let centroids = &calibrated()?.places;
                let (image, images) = scene.image;
                let drawn;
                let pattern: ArrayView3<f32> = match patterns {
                    Some(patterns) => patterns.index_axis(Axis(0), image % patterns.len_of(Axis(0))),
                    None => {
                        drawn = pattern.draw(image, images);
                        drawn.view()
                    }
                };
                let weights = pattern_weights(centroids, pattern).map_err(told)?;
                Ok(vec![relight(batch, weights.view()).map_err(told)?])
            }
            Kind::DirectGlobal(options) => {
                let separation = match options.method {
                    Method::Naive => shadow_dot(batch, scene.light),
                    Method::Neighbours => shadow_neighbours(batch, scene.light, &calibrated()?.confusion),
                    Method::Epipolar => {
                        let calibration = calibrated()?;
                        let fundamental = &calibration.epipolar.as_ref().map_err(Clone::clone)?.fundamental;
                        let rule = if options.printed { MaskRule::Printed } else { MaskRule::Plateau };
                        let Separation { distance_px, sigma_px, .. } = *options;
                        let measured_px = || {
                            let radius_px = calibration
                                .radius_px
                                .ok_or("no dot on the plane is in one piece, so the radius of a dot is unknown: give distance_px")?;
                            Ok::<_, String>(radius_px * REFERENCE_WIDTH_PX / batch.shape().width() as f64)
                        };
                        let distance_px = distance_px.map_or_else(measured_px, Ok)?;
                        let mask = EpipolarMask { distance_px, sigma_px, rule };
                        epipolar(batch, scene.light, fundamental, &calibration.places.xy, &mask)
                    }
                };
                let separation = separation.map_err(told)?;
                let direct = match options.compensate {
                    true => compensate(&separation.direct, &calibrated()?.coverage).map_err(told)?,
                    false => separation.direct,
                };
                Ok(vec![direct, separation.global])
            }
            Kind::Dual(DualSize { size_px }) => {
                let calibration = calibrated()?;
                let mut centroids = calibration.centroids.clone();
                // A lost dot is as dark as a dot that hit nothing: interpolate it instead of showing it.
                let lost = centroids.xy.iter_mut().zip(scene.seen).filter(|(_, seen)| !**seen);
                lost.for_each(|(xy, _)| *xy = None);
                let [height, width] = size_px.unwrap_or_else(|| size_of_dots(batch.shape(), batch.dots()));
                let made = dual(batch, &centroids, &calibration.energies, (height, width)).map_err(told)?;
                Ok(vec![made.image])
            }
        }
    }
}

/// Height and width of an image with about one pixel per dot.
fn size_of_dots(shape: FrameShape, dots: usize) -> [usize; 2] {
    let pitch = (shape.pixels() as f64 / dots as f64).sqrt().max(1.0);
    [shape.height(), shape.width()].map(|side| ((side as f64 / pitch).round() as usize).max(1))
}

impl Pattern {
    /// Draws the pattern for an image of the video, `[row, column, channels]`.
    fn draw(self, image: usize, images: usize) -> Array3<f32> {
        const SIDE: usize = 64;
        match self {
            Self::White => Array3::ones((1, 1, 1)),
            Self::Checks => Array3::from_shape_fn((SIDE, SIDE, 3), |(row, column, colour)| {
                let is_red = (row / 8 + column / 8) % 2 == 0;
                if colour == if is_red { 0 } else { 2 } { 1.0 } else { 0.1 }
            }),
            Self::Sweep => {
                let middle = (image as f32 + 0.5) / images as f32 * SIDE as f32;
                let (warm, blue) = ([1.0, 0.8, 0.5], [0.02, 0.04, 0.1]);
                Array3::from_shape_fn((SIDE, SIDE, 3), |(_, column, colour)| {
                    let distance = (column as f32 + 0.5 - middle) / 6.0;
                    blue[colour] + warm[colour] * (-0.5 * distance * distance).exp()
                })
            }
        }
    }
}

/// Sum of all light in a batch.
pub(super) fn light_of(batch: &Batch) -> Array3<f32> {
    floodlit(batch)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn specs(text: &str) -> Result<Vec<DotSpec>, ConfigError> {
        let text = format!("kind = \"batches\"\n{text}");
        let plan = Plan::parse(&text)?;
        let raysweep_config::Procedure::Batches(batches) = plan.procedure.clone() else { panic!("{plan:?}") };
        DotSpec::all(&plan, &batches)
    }

    #[test]
    fn products_are_read_with_their_defaults_and_refused_with_their_place() {
        let names = |specs: Vec<DotSpec>| specs.into_iter().map(|spec| spec.name).collect::<Vec<_>>();
        assert_eq!(names(specs("").unwrap()), ["floodlit", "relit", "neighbours", "dual"]);
        let two = "[[product]]\nkind = \"direct-global\"\nmethod = \"epipolar\"\nsigma_px = 0\n[[product]]\nkind = \"relight\"\npattern = \"checks\"";
        assert_eq!(names(specs(two).unwrap()), ["epipolar", "relit"]);
        let cases = [
            ("kind = \"band\"", "product.0.kind"),
            ("kind = \"dual\"\nsize_px = [0, 4]", "product.0.kind"),
            ("kind = \"direct-global\"\nmethod = \"guess\"", "product.0.kind"),
            ("kind = \"direct-global\"\ndistance_px = -1", "product.0.kind"),
            ("kind = \"floodlit\"\nname = \"a/b\"", "product.0.kind"),
            ("kind = \"floodlit\"\npixels = 3", "product.0.kind"),
            ("kind = \"dual\"\n[[product]]\nkind = \"dual\"", "product.1.kind"),
        ];
        let mut shown = String::new();
        for (product, field) in cases {
            let error = specs(&format!("[[product]]\n{product}")).unwrap_err();
            assert_eq!(error.first().field.as_deref(), Some(field), "{product:?}: {error}");
            assert!(error.first().span.is_some(), "{product:?} has no place");
            shown.push_str(&format!("{product}\n{error}\n\n"));
        }
        insta::assert_snapshot!(shown);
        assert_eq!(DotSpec::of_argument("kind = \"dual\", name = \"d\"").unwrap()[0].name, "d");
    }
}
