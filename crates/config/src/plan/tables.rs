//! `[[stage]]` and `[[product]]`: a name or kind, with options that the stage or product reads itself.

use serde::Deserialize;
use serde_json::{Map, Value};

use crate::document::Document;
use crate::{ConfigError, ConfigMistake, Places};

/// The stage that combines the images of all points.
pub(super) const DEMUX: &str = "demux";

/// One `[[stage]]`: its name and the options that the stage itself reads.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct StageTable {
    /// The name under which the stage is registered.
    pub name: String,
    /// All other keys of its table.
    #[serde(flatten)]
    pub options: Map<String, Value>,
}

/// One `[[product]]`: its kind, its name, and the options that the kind itself reads.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct ProductTable {
    /// The kind of product.
    pub kind: String,
    /// Base name of its files; default: derived from the kind and options.
    pub name: Option<String>,
    /// All other keys of its table.
    #[serde(flatten)]
    pub options: Map<String, Value>,
}

/// Finds an option that is NaN or infinite: these have become null in conversion, which TOML itself does not have.
fn not_finite(options: &Map<String, Value>) -> Option<&str> {
    options.iter().find(|(_, value)| value.is_null()).map(|(key, _)| key.as_str())
}

pub(super) fn check_stages<'a>(stages: impl Iterator<Item = &'a StageTable>, document: &mut Document<'_>) {
    let mut has_demux = false;
    for (index, StageTable { name, options }) in stages.enumerate() {
        if has_demux && name != DEMUX {
            let message = format!(
                "stage {name} comes after {DEMUX}, which takes the images that stages have processed: put {DEMUX} last"
            );
            document.refuse_new(&["stage", &index.to_string(), "name"], message);
        }
        has_demux |= name == DEMUX;
        if let Some(key) = not_finite(options) {
            let message = format!("stage {name}: {key} is not a finite number");
            document.refuse(&["stage", &index.to_string(), key], message);
        }
    }
}

pub(super) fn check_products<'a>(
    products: impl Iterator<Item = &'a ProductTable>,
    document: &mut Document<'_>,
) {
    for (index, ProductTable { kind, options, .. }) in products.enumerate() {
        if let Some(key) = not_finite(options) {
            let message = format!("product {kind}: {key} is not a finite number");
            document.refuse(&["product", &index.to_string(), key], message);
        }
    }
}

/// The products that a command line argument asks for: the keys of a `[[product]]`, separated by commas. Also returns
/// the document that the argument represents, with the positions of its values, so that errors can point into it.
///
/// # Errors
/// The document and what is wrong with it.
pub fn products_of_argument(
    argument: &str,
) -> Result<(Vec<ProductTable>, Places, String), (ConfigError, String)> {
    let text = format!("product = [{{ {argument} }}]");
    if !argument.contains('=') {
        let message =
            format!("{argument:?} has no keys: write some, such as 'kind = \"epipolar\", width_rows = 5'");
        let span = text.find(argument).map(|start| start..start + argument.len());
        return Err((ConfigMistake { message, field: None, span }.into(), text));
    }
    let read = || {
        let mut document = Document::parse(&text)?;
        let products: Option<Vec<ProductTable>> = document.require("product", "the keys of a [[product]]");
        check_products(products.iter().flatten(), &mut document);
        document.refuse_others(&["product"]);
        let places = document.places().clone();
        document.finish(products.map(|products| (products, places)))
    };
    match read() {
        Ok((products, places)) => Ok((products, places, text)),
        Err(error) => Err((error, text)),
    }
}
