//! Products by their names in plans: a `[[product]]` table is validated before anything moves.

use std::ops::RangeInclusive;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use super::band::{Band, Width};
use super::bands::Bands;
use super::captured::{Captured, CapturedTable};
use super::cross_section::{CrossSectionTable, SectionLine};
use super::profile::{ProfileOptions, ProfileTable};
use super::relight::{BeamName, Relight, RowPattern};
use super::uncertainty::LightOf;
use crate::schedule::{Schedule, SweepGeometry};
use raysweep_core::decoding_message_beside;

/// Why a product is invalid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("product {kind}: {what}")]
pub struct ProductError {
    /// The kind that the plan names.
    pub kind: String,
    /// Keys and indices that lead to the option within the product's table.
    pub path: Vec<String>,
    /// Field, value, and the allowed values.
    pub what: String,
}

/// A valid product, which can be computed from every sweep of its plan.
#[derive(Debug, Clone, PartialEq)]
pub struct ProductSpec {
    pub(super) name: String,
    pub(super) kind: ProductKind,
}

/// A kind of product, with its options.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum ProductKind {
    Regular,
    Epipolar(Width),
    NonEpipolar(Width),
    Band(Band),
    Bands(Bands),
    Captured(Captured),
    CrossSection(SectionLine),
    Relight(Relight),
    DelayProfile(ProfileOptions),
    Uncertainty(LightOf),
    PriorBias(LightOf),
}

impl ProductKind {
    /// The relit image that it is, or whose light it judges.
    pub(super) fn relit(&self) -> Option<&Relight> {
        match self {
            Self::Relight(relight)
            | Self::Uncertainty(LightOf::Relit(relight))
            | Self::PriorBias(LightOf::Relit(relight)) => Some(relight),
            _ => None,
        }
    }

    /// The relative rows whose light it tells apart; `i32::MIN` and `i32::MAX`: as far as the sweep reaches.
    pub(super) fn rows(&self) -> Vec<RangeInclusive<i32>> {
        match self {
            Self::Regular | Self::Captured(_) | Self::CrossSection(_) | Self::DelayProfile(_) => Vec::new(),
            Self::Bands(bands) => vec![bands.range()],
            Self::Epipolar(width) => vec![width.range()],
            Self::NonEpipolar(width) => {
                let own = width.range();
                vec![i32::MIN..=*own.start() - 1, *own.end() + 1..=i32::MAX]
            }
            Self::Band(band) => band.open_ranges(),
            Self::Uncertainty(of) | Self::PriorBias(of) => of.rows(),
            Self::Relight(_) => vec![i32::MIN..=i32::MAX],
        }
    }

    /// Whether it shows parts of its rows apart.
    pub(super) fn tells_each_band(&self) -> bool {
        matches!(self, Self::Bands(_))
    }
}

/// The kinds by their names in plans.
const KINDS: &str = "epipolar, non-epipolar, band, bands, regular, captured, relight, delay-profile, cross-section, uncertainty, prior-bias";

/// The file name of the transport itself, which products must not use.
const TAKEN_NAME: &str = "transport";

/// Longest name; with its extension it is a valid file name on every file system.
const MAX_NAME: usize = 64;

/// `kind = "regular"` has no options.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoOptions {}

/// The option of `relight` beside its pattern.
#[derive(Default, Deserialize)]
#[serde(default)]
struct BeamOption {
    beam: BeamName,
}

impl ProductSpec {
    /// The product described by a plan's table: its kind, its name if it has one, and all other keys.
    ///
    /// # Errors
    /// The option that is invalid for this plan on this rig.
    pub fn new(
        kind: &str,
        name: Option<&str>,
        options: &Map<String, Value>,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<Self, ProductError> {
        let refused = |path: Vec<String>, what: String| ProductError { kind: kind.into(), path, what };
        let one = |(field, what): (&str, String)| refused(vec![field.into()], what);
        let made = match kind {
            "regular" => {
                let NoOptions {} = parse(kind, options)?;
                ProductKind::Regular
            }
            "epipolar" => ProductKind::Epipolar(parse::<Width>(kind, options)?.check().map_err(one)?),
            "non-epipolar" => ProductKind::NonEpipolar(parse::<Width>(kind, options)?.check().map_err(one)?),
            "band" => ProductKind::Band(parse::<Band>(kind, options)?.check().map_err(one)?),
            "bands" => ProductKind::Bands(parse::<Bands>(kind, options)?.check().map_err(one)?),
            "captured" => {
                let table: CapturedTable = parse(kind, options)?;
                ProductKind::Captured(table.check(schedule).map_err(one)?)
            }
            "cross-section" => {
                let table: CrossSectionTable = parse(kind, options)?;
                ProductKind::CrossSection(table.check(schedule, geometry).map_err(one)?)
            }
            "uncertainty" => ProductKind::Uncertainty(light_of(kind, options, geometry)?),
            "prior-bias" => ProductKind::PriorBias(light_of(kind, options, geometry)?),
            "relight" => ProductKind::Relight(relight(kind, options, geometry)?),
            "delay-profile" => {
                let table: ProfileTable = parse(kind, options)?;
                ProductKind::DelayProfile(table.check(schedule, geometry).map_err(one)?)
            }
            _ => {
                return Err(refused(vec!["kind".into()], format!("kind = {kind:?}: must be one of {KINDS}")));
            }
        };
        let name = match name {
            Some(name) => checked_name(name).map_err(|what| refused(vec!["name".into()], what))?,
            None => made.default_name(),
        };
        Ok(Self { name, kind: made })
    }

    /// The products that are made if a plan names none.
    pub fn defaults() -> Vec<Self> {
        let spec = |name: &str, kind| Self { name: name.into(), kind };
        vec![
            spec("regular", ProductKind::Regular),
            spec("epipolar", ProductKind::Epipolar(Width::default())),
            spec("non_epipolar", ProductKind::NonEpipolar(Width::default())),
            spec("short_range", ProductKind::Band(Band::new(1, Some(10)))),
            spec("long_range", ProductKind::Band(Band::new(11, None))),
            spec("uncertainty", ProductKind::Uncertainty(LightOf::Band(Band::new(0, Some(0))))),
        ]
    }

    /// The name of its files, without extension.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Why it would be 0 everywhere: it asks only for rows that a sweep of this reach (first and last u) does not see.
    pub fn beyond(&self, (first, last): (i32, i32)) -> Option<String> {
        let what = match &self.kind {
            ProductKind::Epipolar(width) | ProductKind::NonEpipolar(width) => width.beyond(first, last),
            ProductKind::Band(band) => band.beyond(first, last),
            ProductKind::Bands(bands) => bands.beyond(first, last),
            ProductKind::Uncertainty(of) | ProductKind::PriorBias(of) => of.beyond(first, last),
            ProductKind::Regular
            | ProductKind::Captured(_)
            | ProductKind::CrossSection(_)
            | ProductKind::Relight(_)
            | ProductKind::DelayProfile(_) => None,
        }?;
        Some(format!("product {}: {what}", self.name))
    }

    /// Whether it judges the light of another product, for which the noise must be known.
    pub fn needs_noise(&self) -> bool {
        matches!(self.kind, ProductKind::Uncertainty(_) | ProductKind::PriorBias(_))
    }

    /// Why it cannot be made of a film's cycles, if it cannot.
    pub fn not_of_a_film(&self) -> Option<String> {
        let what = match &self.kind {
            ProductKind::Epipolar(_)
            | ProductKind::NonEpipolar(_)
            | ProductKind::Band(_)
            | ProductKind::Uncertainty(_)
            | ProductKind::PriorBias(_) => return None,
            ProductKind::Relight(relight) if !relight.is_sequence() => return None,
            ProductKind::Relight(_) => {
                "line gives a sequence of images, and a film has one for each cycle: use rows or stripes"
            }
            ProductKind::Bands(_) => {
                "gives a sequence of images, and a film has one for each cycle: use band"
            }
            ProductKind::Regular
            | ProductKind::Captured(_)
            | ProductKind::CrossSection(_)
            | ProductKind::DelayProfile(_) => {
                "needs the images of a sweep: a film's products are epipolar, non-epipolar, band, relight, uncertainty and prior-bias"
            }
        };
        Some(format!("product {}: {what}", self.name))
    }

    /// The number of its images on this rig.
    pub fn images(&self, geometry: &SweepGeometry) -> usize {
        match &self.kind {
            ProductKind::Relight(pattern) => pattern.images(geometry),
            ProductKind::Bands(bands) => bands.images(),
            ProductKind::Captured(captured) => captured.images(),
            ProductKind::CrossSection(_) | ProductKind::DelayProfile(_) => 0,
            ProductKind::Regular
            | ProductKind::Epipolar(_)
            | ProductKind::NonEpipolar(_)
            | ProductKind::Band(_)
            | ProductKind::Uncertainty(_)
            | ProductKind::PriorBias(_) => 1,
        }
    }
}

impl ProductKind {
    fn default_name(&self) -> String {
        match self {
            Self::Regular => "regular".into(),
            Self::Epipolar(width) => width.named("epipolar"),
            Self::NonEpipolar(width) => width.named("non_epipolar"),
            Self::Band(band) => band.default_name(),
            Self::Bands(bands) => bands.default_name(),
            Self::Captured(captured) => captured.default_name(),
            Self::CrossSection(cut) => cut.default_name(),
            Self::Relight(_) => "relight".into(),
            Self::DelayProfile(options) => options.default_name(),
            Self::Uncertainty(of) => format!("uncertainty_{}", of.default_name()),
            Self::PriorBias(of) => format!("prior_bias_{}", of.default_name()),
        }
    }
}

fn relight(
    kind: &str,
    options: &Map<String, Value>,
    geometry: &SweepGeometry,
) -> Result<Relight, ProductError> {
    let refused = |(path, what)| ProductError { kind: kind.into(), path, what };
    let (beam, pattern): (Map<_, _>, Map<_, _>) =
        options.clone().into_iter().partition(|(key, _)| key == "beam");
    if pattern.len() != 1 {
        return Err(refused((Vec::new(), "give exactly one of rows, stripes and line".to_owned())));
    }
    let BeamOption { beam } = parse(kind, &beam)?;
    let relight = Relight::new(parse::<RowPattern>(kind, &pattern)?, beam);
    relight.check(geometry).map_err(refused)?;
    Ok(relight)
}

/// The options of `uncertainty` and `prior-bias`: those of `band`, or of `relight`.
fn light_of(
    kind: &str,
    options: &Map<String, Value>,
    geometry: &SweepGeometry,
) -> Result<LightOf, ProductError> {
    let refused = |path: Vec<String>, what: String| ProductError { kind: kind.into(), path, what };
    if options.contains_key("line") {
        let what = "line: gives a sequence of images; give rows or stripes, or from_rows".to_owned();
        return Err(refused(vec!["line".into()], what));
    }
    let has = |keys: &[&str]| keys.iter().filter(|key| options.contains_key(**key)).count();
    if has(&["rows", "stripes", "beam"]) > 0 {
        if has(&["rows", "stripes"]) != 1 || has(&["from_rows", "to_rows", "side"]) > 0 {
            let what = "give either from_rows, perhaps with to_rows and side, or one of rows and stripes, perhaps with \
                        beam";
            return Err(refused(Vec::new(), what.to_owned()));
        }
        return relight(kind, options, geometry).map(LightOf::Relit);
    }
    let band = parse::<Band>(kind, options)?.check();
    band.map(LightOf::Band).map_err(|(field, what)| refused(vec![field.into()], what))
}

fn parse<T: DeserializeOwned>(kind: &str, options: &Map<String, Value>) -> Result<T, ProductError> {
    serde_path_to_error::deserialize(Value::Object(options.clone())).map_err(|error| {
        use serde_path_to_error::Segment;
        let key = |segment: &Segment| match segment {
            Segment::Seq { index } => Some(index.to_string()),
            Segment::Map { key } => Some(key.clone()),
            Segment::Enum { .. } | Segment::Unknown => None,
        };
        let path: Vec<String> = error.path().iter().filter_map(key).collect();
        let what = decoding_message_beside(&error.inner().to_string(), "table", "name");
        let what = if path.is_empty() { what } else { format!("{}: {what}", path.join(".")) };
        ProductError { kind: kind.into(), path, what }
    })
}

/// A name becomes a file name and must not contain a path.
fn checked_name(name: &str) -> Result<String, String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
    if name.is_empty() || name.len() > MAX_NAME || !name.chars().all(plain) {
        return Err(format!(
            "name = {name:?}: must have 1 to {MAX_NAME} letters, digits, `-` and `_`, because files are named after it"
        ));
    }
    if name == TAKEN_NAME {
        return Err(format!("name = {name:?}: reserved for the light transport; choose another name"));
    }
    if name.ends_with("_mask") {
        return Err(format!(
            "name = {name:?}: names that end in _mask are those of masks; choose another name"
        ));
    }
    Ok(name.into())
}
