//! `[[product]]` of a plan, and the same on the command line.

use raysweep_pipeline::{ProductSpec, Schedule, SweepGeometry};
use serde::Deserialize;
use serde_json::{Map, Value};

use super::ConfigError;

/// One `[[product]]`: its kind, its name, and the options that the kind itself reads.
#[derive(Debug, Clone, Deserialize)]
pub struct ProductTable {
    /// The kind of product.
    pub kind: String,
    /// Names its files; left out: the kind and its options do.
    pub name: Option<String>,
    /// Everything else in its table.
    #[serde(flatten)]
    pub options: Map<String, Value>,
}

/// What stands in an argument, as a document, so that errors can point into it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Argument {
    product: Vec<ProductTable>,
}

impl ProductTable {
    /// Options have passed through a form without NaN and infinity, in which these are null; TOML has no null.
    pub(super) fn check(&self, text: &str, index: usize) -> Result<(), ConfigError> {
        match self.options.iter().find(|(_, value)| value.is_null()) {
            Some((key, _)) => {
                let message = format!("product {}: {key} is not a finite number", self.kind);
                Err(ConfigError::at(text, &["product", &index.to_string(), key], message))
            }
            None => Ok(()),
        }
    }

    /// Appends the product that the table asks for to others. `text` is the document in which it is product `index`.
    ///
    /// # Errors
    /// With the place in `text`, for options that this plan on this rig cannot have, and for a name that another has.
    pub fn append_to(
        &self,
        specs: &mut Vec<ProductSpec>,
        text: &str,
        index: usize,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<(), ConfigError> {
        let index = index.to_string();
        let refused = |path: &[String], message: String| {
            let path: Vec<&str> =
                ["product", &index].into_iter().chain(path.iter().map(String::as_str)).collect();
            ConfigError::at(text, &path, message)
        };
        let spec = ProductSpec::new(&self.kind, self.name.as_deref(), &self.options, schedule, geometry)
            .map_err(|error| refused(&error.path, error.to_string()))?;
        if specs.iter().any(|other| other.name() == spec.name()) {
            let message = format!(
                "product {}: two products are named {:?} and would overwrite each other: give one another name",
                self.kind,
                spec.name()
            );
            return Err(refused(&["name".into()], message));
        }
        specs.push(spec);
        Ok(())
    }
}

/// Appends what a command line argument asks for: the keys of a `[[product]]` with commas between them.
///
/// # Errors
/// As [`ProductTable::append_to`], with the argument's text.
pub fn append_argument(
    specs: &mut Vec<ProductSpec>,
    argument: &str,
    schedule: &Schedule,
    geometry: &SweepGeometry,
) -> Result<(), String> {
    let text = format!("product = [{{ {argument} }}]");
    let append = |specs: &mut Vec<ProductSpec>| {
        let Argument { product } = toml::from_str(&text).map_err(|error| ConfigError::parse(&error))?;
        for (index, table) in product.iter().enumerate() {
            table.check(&text, index)?;
            table.append_to(specs, &text, index, schedule, geometry)?;
        }
        Ok(())
    };
    append(specs).map_err(|error: ConfigError| error.render("--product", &text))
}
