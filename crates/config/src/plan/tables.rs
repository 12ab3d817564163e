//! `[[stage]]` and `[[product]]`: a name or kind, and options that whoever makes it reads.

use serde::Deserialize;
use serde_json::{Map, Value};

use crate::document::Document;
use crate::{ConfigError, Places};

/// One `[[stage]]`: its name and the options that the stage itself reads.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct StageTable {
    /// The name it is registered by.
    pub name: String,
    /// Everything else in its table.
    #[serde(flatten)]
    pub options: Map<String, Value>,
}

/// One `[[product]]`: its kind, its name, and the options that the kind itself reads.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct ProductTable {
    /// The kind of product.
    pub kind: String,
    /// Names its files; left out: the kind and its options do.
    pub name: Option<String>,
    /// Everything else in its table.
    #[serde(flatten)]
    pub options: Map<String, Value>,
}

/// Options have passed through a form without NaN and infinity, in which these are null; TOML has no null.
fn not_finite(options: &Map<String, Value>) -> Option<&str> {
    options.iter().find(|(_, value)| value.is_null()).map(|(key, _)| key.as_str())
}

pub(super) fn check_stages<'a>(stages: impl Iterator<Item = &'a StageTable>, document: &mut Document<'_>) {
    for (index, StageTable { name, options }) in stages.enumerate() {
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

/// The products that a command line argument asks for, the keys of a `[[product]]` with commas between them; and the
/// document that the argument stands for, with its places, so that errors can point into it.
///
/// # Errors
/// The document beside what is wrong with it.
pub fn products_of_argument(
    argument: &str,
) -> Result<(Vec<ProductTable>, Places, String), (ConfigError, String)> {
    let text = format!("product = [{{ {argument} }}]");
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
