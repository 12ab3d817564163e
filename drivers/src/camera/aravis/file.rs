//! A camera's features as a text file: one `Name=Value` per line, in an order in which they can be set again.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::sync::Arc;

use aravis::glib::object::{Cast, IsA, ObjectExt};
use aravis::prelude::*;
use aravis::{Gc, GcAccessMode, GcCategory, GcCommand, GcEnumeration, GcFeatureNode, GcNode, GcSelector};
use raysweep_core::{Clock, DeviceError, DeviceErrorKind};

use super::library::{Device, Health};

/// A line of a feature file that the camera rejected.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct RefusedLine {
    /// The line.
    pub line: String,
    /// The reason.
    pub reason: String,
}

/// Features that depend on the network and this host, or that the camera stores itself, are not part of its settings.
const LEFT_OUT: [&str; 4] = ["Gev", "TLParamsLocked", "UserSet", "File"];

/// Reads all settings of a camera, given by address or name, as the text of a feature file.
///
/// # Errors
/// `Disconnected` if it does not answer, `Busy` if another program holds it.
pub fn save_features(camera: &str) -> Result<String, DeviceError> {
    let device = open(camera)?;
    let genicam = genicam(&device)?;
    let mut file = format!("# Features of {}, saved by `raysweep camera save`\n", device.model());
    let mut names = Vec::new();
    walk(&genicam, "Root", &mut names);
    let selected: BTreeSet<String> = names
        .iter()
        .filter_map(|name| selected_by(&genicam, name))
        .flatten()
        .map(|node| name_of(&node))
        .collect();
    for name in names.iter().filter(|name| !selected.contains(*name)) {
        write_feature(&genicam, name, &mut file);
    }
    Ok(file)
}

/// Sets a camera, given by address or name, from the text of a feature file. Returns how many lines it accepted and
/// which it rejected.
///
/// # Errors
/// `Disconnected` if it does not answer, `Busy` if another program holds it, `OutOfRange` for a malformed line.
pub fn load_features(camera: &str, text: &str) -> Result<(usize, Vec<RefusedLine>), DeviceError> {
    let mut lines = Vec::new();
    for (number, line) in text.lines().enumerate().map(|(index, line)| (index + 1, line.trim())) {
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let Some((name, value)) = line.split_once('=') else {
            let what = format!("line {number} of the feature file is {line:?}: each line is Name=Value");
            return Err(DeviceError::new("camera", DeviceErrorKind::OutOfRange, what));
        };
        lines.push((name.trim(), value.trim()));
    }
    let device = open(camera)?;
    let genicam = genicam(&device)?;
    let mut refused = Vec::new();
    // Some values are accepted only after others further down are set.
    for _ in 0..2 {
        refused.clear();
        for &(name, value) in &lines {
            if let Err(reason) = set(&genicam, name, value) {
                refused.push(RefusedLine { line: format!("{name}={value}"), reason });
            }
        }
        if refused.is_empty() {
            break;
        }
    }
    Ok((lines.len() - refused.len(), refused))
}

fn open(camera: &str) -> Result<Device, DeviceError> {
    Device::open(camera, Arc::new(Health::new(Clock::real())))
}

fn genicam(device: &Device) -> Result<Gc, DeviceError> {
    device
        .genicam()
        .ok_or_else(|| DeviceError::new("camera", DeviceErrorKind::Unsupported, "has no GenICam description"))
}

/// Collects the names of all features in the order of the camera's description.
fn walk(genicam: &Gc, name: &str, names: &mut Vec<String>) {
    let Some(node) = genicam.node(name) else { return };
    match node.downcast_ref::<GcCategory>() {
        Some(category) => {
            category.features().iter().for_each(|feature| walk(genicam, feature.as_str(), names));
        }
        None if names.iter().any(|known| known == name) => {}
        None => names.push(name.to_owned()),
    }
}

fn selected_by(genicam: &Gc, name: &str) -> Option<Vec<GcFeatureNode>> {
    let node = genicam.node(name)?;
    let selector = node.dynamic_cast_ref::<GcSelector>()?;
    selector.is_selector().then(|| selector.selected_features())
}

fn name_of(node: &impl IsA<GcFeatureNode>) -> String {
    node.as_ref().name().map(String::from).unwrap_or_default()
}

/// The feature, if it is writable with the present settings.
fn writable(genicam: &Gc, name: &str) -> Option<GcFeatureNode> {
    if LEFT_OUT.iter().any(|left_out| name.starts_with(left_out)) {
        return None;
    }
    let node = genicam.node(name)?;
    if node.is::<GcCommand>() {
        return None;
    }
    let feature = node.downcast::<GcFeatureNode>().ok()?;
    let usable = feature.is_implemented().unwrap_or(false)
        && feature.is_available().unwrap_or(false)
        && feature.actual_access_mode() == GcAccessMode::Rw;
    usable.then_some(feature)
}

fn write_feature(genicam: &Gc, name: &str, file: &mut String) {
    let Some(feature) = writable(genicam, name) else { return };
    let mut line = |name: &str, value: &str| {
        // Writing to a string cannot fail.
        let _ = writeln!(file, "{name}={value}");
    };
    let Ok(value) = feature.value_as_string() else { return };
    let entries = entries_of(feature.upcast_ref());
    let (Some(mut selected), Some(entries)) = (selected_by(genicam, name), entries) else {
        line(name, &value);
        return;
    };
    // The trigger mode goes last: some cameras accept no other trigger settings while they wait for triggers.
    selected.sort_by_key(|node| name_of(node).ends_with("Mode"));
    for entry in entries {
        if feature.set_value_from_string(&entry).is_err() {
            continue;
        }
        line(name, &entry);
        for selected in selected.iter().filter_map(|node| writable(genicam, &name_of(node))) {
            if let Ok(value) = selected.value_as_string() {
                line(&name_of(&selected), &value);
            }
        }
    }
    line(name, &value);
    if let Err(error) = feature.set_value_from_string(&value) {
        tracing::warn!(%error, name, "selector not put back");
    }
}

fn entries_of(node: &GcNode) -> Option<Vec<String>> {
    let entries = node.downcast_ref::<GcEnumeration>()?.dup_available_string_values().ok()?;
    Some(entries.into_iter().map(String::from).collect())
}

fn set(genicam: &Gc, name: &str, value: &str) -> Result<(), String> {
    let feature = writable(genicam, name).ok_or("cannot be written on this camera, as it is set now")?;
    feature.set_value_from_string(value).map_err(|error| error.to_string())?;
    let read = feature.value_as_string().map_err(|error| error.to_string())?;
    if is_same(value, &read) { Ok(()) } else { Err(format!("reads {read} afterwards")) }
}

/// Whether two values are equal, as text or as numbers at the camera's precision.
fn is_same(a: &str, b: &str) -> bool {
    match (a.parse::<f64>(), b.parse::<f64>()) {
        (Ok(a), Ok(b)) => (a - b).abs() <= 1e-6 * a.abs().max(b.abs()),
        _ => a == b,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_the_same_to_a_cameras_precision() {
        assert!(is_same("600", "600.0000001") && is_same("Rolling", "Rolling") && is_same("0", "0.0"));
        assert!(!is_same("600", "600.5") && !is_same("Rolling", "Global") && !is_same("1", "On"));
    }

    #[test]
    fn a_line_that_is_none_is_refused_before_any_camera_is_touched() {
        let error = load_features("127.0.0.9", "# comment\n\nWidth 128\n").unwrap_err();
        assert!(error.to_string().contains("line 3"), "{error}");
    }
}
