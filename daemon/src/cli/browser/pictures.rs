//! Pictures as browsers take them: half-precision floats with a scale.

use std::path::Path;
use std::time::Duration;

use axum::http::header;
use axum::response::{IntoResponse, Response};
use half::f16;
use half::slice::HalfFloatSliceExt;
use ndarray::{ArrayViewD, Axis};
use serde_json::{Value, json};

use crate::live::LiveReader;

/// Between two looks for a newer live picture: 30 a second are shown at most.
pub(super) const PACE: Duration = Duration::from_millis(33);
/// Looks before the browser has to ask again.
pub(super) const LOOKS: u32 = 60;

/// Largest value after scaling: far from where half-precision floats end, and from where they lose digits.
const LARGEST: f32 = 1024.0;

/// Bytes: the length of a header (u32, little-endian), the header (JSON, padded with spaces to an even length), the
/// values (half-precision floats, little-endian, `[row, column]` or `[row, column, rgb]`), which the header's `scale`
/// multiplies.
pub(super) struct Encoded(Vec<u8>);

impl IntoResponse for Encoded {
    fn into_response(self) -> Response {
        ([(header::CONTENT_TYPE, "application/octet-stream")], self.0).into_response()
    }
}

impl Encoded {
    /// Encodes an image; `about` is an object, to which shape and scale are added.
    pub fn new(image: ArrayViewD<'_, f32>, mut about: Value) -> Self {
        let largest =
            image.iter().filter(|value| value.is_finite()).fold(0.0_f32, |most, value| most.max(value.abs()));
        // Where the smallest numbers end, all that is smaller is 0.
        let scale = if largest > 0.0 { (largest / LARGEST).max(f32::MIN_POSITIVE) } else { 1.0 };
        about["shape"] = json!(image.shape());
        about["scale"] = json!(scale);
        let mut head = about.to_string().into_bytes();
        head.resize(head.len().next_multiple_of(2), b' ');
        let values: Vec<f32> = image.iter().map(|value| value / scale).collect();
        let mut halves = vec![f16::ZERO; values.len()];
        halves.convert_from_f32_slice(&values);
        let mut bytes = Vec::with_capacity(4 + head.len() + 2 * halves.len());
        bytes.extend((head.len() as u32).to_le_bytes());
        bytes.extend(head);
        bytes.extend(halves.iter().flat_map(|half| half.to_le_bytes()));
        Self(bytes)
    }
}

fn open(file: Option<&Path>) -> Result<LiveReader, String> {
    let file = file.ok_or("the daemon has no live file")?;
    LiveReader::open(file).map_err(|error| error.to_string())
}

/// The names in the live file, `{name: sequence}`.
pub(super) fn names(file: Option<&Path>) -> Result<Value, String> {
    Ok(json!(open(file)?.names().map_err(|error| error.to_string())?))
}

/// The newest picture of a name, if it is newer than the one with the sequence number `after`.
pub(super) fn newest(file: Option<&Path>, name: &str, after: u64) -> Result<Option<Encoded>, String> {
    let reader = open(file)?;
    let told = |error: crate::live::LiveError| error.to_string();
    // Headers first: an old picture is not read again and again.
    if reader.names().map_err(told)?.get(name).is_none_or(|sequence| *sequence <= after) {
        return Ok(None);
    }
    let Some(newest) = reader.newest(name).map_err(told)? else { return Ok(None) };
    let mut image = newest.image.view();
    // A single colour channel is grey.
    if image.ndim() == 3 && image.len_of(Axis(2)) == 1 {
        image = image.index_axis_move(Axis(2), 0);
    }
    let about = json!({ "name": name, "sequence": newest.sequence, "about": newest.metadata });
    Ok(Some(Encoded::new(image, about)))
}

#[cfg(test)]
mod tests {
    use ndarray::array;

    use super::*;

    #[test]
    fn a_picture_is_a_header_and_halves_that_give_the_values_back() {
        let Encoded(tiny) = Encoded::new(array![[1e-44_f32]].into_dyn().view(), json!({}));
        assert!(!String::from_utf8_lossy(&tiny).contains("\"scale\":0.0"), "nothing divides by zero");
        let image = array![[0.0_f32, -2500.0, 1e-3], [f32::NAN, 100.0, 2047.5]].into_dyn();
        let Encoded(bytes) = Encoded::new(image.view(), json!({ "name": "epipolar" }));
        let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
        assert_eq!(length % 2, 0, "the values are aligned");
        let head: Value = serde_json::from_slice(&bytes[4..4 + length]).unwrap();
        assert_eq!((&head["shape"], &head["name"]), (&json!([2, 3]), &json!("epipolar")));
        let scale = head["scale"].as_f64().unwrap() as f32;
        let values =
            bytes[4 + length..].chunks(2).map(|pair| f16::from_le_bytes([pair[0], pair[1]]).to_f32() * scale);
        for (value, expected) in values.zip(&image) {
            let same = value.is_nan() && expected.is_nan();
            assert!(same || (value - expected).abs() <= 1e-3 * expected.abs() + 1e-6, "{value} {expected}");
        }
    }
}
