//! The products that plans and command lines ask for, made from light transports.

use raysweep_config::plan::products_of_argument;
use raysweep_config::{ConfigError, Places, ProductTable};
use raysweep_pipeline::{ProductSpec, mask};
use serde_json::{Value, json};

use super::PlaneTask;

/// The products of a plan's `[[product]]` tables.
///
/// # Errors
/// With the position in the plan of the product that cannot be made, or would overwrite another.
pub(crate) fn planned_products(
    tables: &[ProductTable],
    task: &PlaneTask,
) -> Result<Vec<ProductSpec>, ConfigError> {
    let mut specs = Vec::new();
    for (index, table) in tables.iter().enumerate() {
        append_product(&mut specs, table, index, task, &|path, message| task.refuse(path, message))?;
    }
    Ok(specs)
}

/// Appends the products that a command line argument asks for: the keys of a `[[product]]`, separated by commas.
///
/// # Errors
/// What is wrong with the argument.
pub(crate) fn append_argument(
    specs: &mut Vec<ProductSpec>,
    argument: &str,
    task: &PlaneTask,
) -> Result<(), String> {
    let shown = |(error, text): (ConfigError, String)| error.render("--product", &text);
    let (tables, places, text): (_, Places, _) = products_of_argument(argument).map_err(shown)?;
    for (index, table) in tables.iter().enumerate() {
        append_product(specs, table, index, task, &|path, message| places.error(path, message))
            .map_err(|error| error.render("--product", &text))?;
    }
    Ok(())
}

/// Appends the product that a table asks for to the others. `refuse` makes an error about a value of the document in
/// which the product has the number `index`.
fn append_product(
    specs: &mut Vec<ProductSpec>,
    table: &ProductTable,
    index: usize,
    task: &PlaneTask,
    refuse: &dyn Fn(&[&str], String) -> ConfigError,
) -> Result<(), ConfigError> {
    let index = index.to_string();
    let refused = |path: &[String], message: String| {
        let path: Vec<&str> =
            ["product", &index].into_iter().chain(path.iter().map(String::as_str)).collect();
        refuse(&path, message)
    };
    let ProductTable { kind, name, options } = table;
    let spec = ProductSpec::new(kind, name.as_deref(), options, &task.schedule, &task.geometry)
        .map_err(|error| refused(&error.path, error.to_string()))?;
    if specs.iter().any(|other| other.name() == spec.name()) {
        let message = format!(
            "product {kind}: two products are named {:?} and would overwrite each other: give one of them another `name`",
            spec.name()
        );
        // A name that is not in the file follows from the kind.
        let path: &[String] = if name.is_some() { &["name".into()] } else { &[] };
        return Err(refused(path, message));
    }
    specs.push(spec);
    Ok(())
}

/// The bits of masks, as metadata say them.
pub(crate) fn mask_bits() -> Value {
    json!({
        "measured": mask::MEASURED,
        "bound only": mask::BOUND_ONLY,
        "hot pixel filled": mask::HOT_PIXEL_FILLED,
        "outside reach": mask::OUTSIDE_REACH,
        "no edge": mask::NO_EDGE,
    })
}
