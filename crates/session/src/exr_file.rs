//! OpenEXR files: named 32-bit float channels, ZIP compression, text attributes. The same input gives the same bytes.

use std::io::Cursor;

use exr::meta::attribute::{AttributeValue, Text};
use exr::prelude::{
    AnyChannel, AnyChannels, Blocks, Compression, Encoding, FlatSamples, Image, Layer, LayerAttributes,
    LineOrder, Vec2, WritableImage,
};
use ndarray::ArrayView2;
use serde_json::{Map, Value};

use crate::{Error, Result};

/// Prefix of each attribute's name, so that none clashes with OpenEXR's own.
const ATTRIBUTE_PREFIX: &str = "raysweep.";
/// Bytes of magic number and version, which precede the attributes.
const PREAMBLE_BYTES: usize = 8;

/// Encodes channels `[row, column]` of one size. Strings in `metadata` become text attributes as they are;
/// other values are written as JSON text.
///
/// # Errors
/// [`Error::Codec`] for an empty image or an attribute name of more than 246 bytes.
pub(crate) fn encode(channels: &[(&str, ArrayView2<f32>)], metadata: &Map<String, Value>) -> Result<Vec<u8>> {
    let (rows, columns) = channels.first().map_or((0, 0), |(_, values)| values.dim());
    if rows == 0 || columns == 0 {
        return Err(Error::codec("encode", "an EXR image")(format!(
            "the image is empty: {rows} x {columns} pixels"
        )));
    }
    let mut attributes = LayerAttributes::default();
    for (name, value) in metadata {
        let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        attributes
            .other
            .insert(utf8(&format!("{ATTRIBUTE_PREFIX}{name}")), AttributeValue::Text(utf8(&text)));
    }
    let list = channels
        .iter()
        .map(|(name, values)| AnyChannel::new(*name, FlatSamples::F32(values.iter().copied().collect())))
        .collect();
    let encoding = Encoding {
        compression: Compression::ZIP16,
        blocks: Blocks::ScanLines,
        line_order: LineOrder::Increasing,
    };
    let layer = Layer::new(Vec2(columns, rows), attributes, encoding, AnyChannels::sort(list));
    let mut file = Cursor::new(Vec::new());
    Image::from_layer(layer)
        .write()
        .non_parallel()
        .to_buffered(&mut file)
        .map_err(Error::codec("encode", "an EXR image"))?;
    sort_attributes(file.into_inner())
}

/// Sorts the attributes: the library keeps them in a hash map and writes them in random order.
fn sort_attributes(file: Vec<u8>) -> Result<Vec<u8>> {
    let torn = || Error::codec("encode", "an EXR image")("its header is not as expected");
    let mut attributes = Vec::new();
    let mut rest = file.get(PREAMBLE_BYTES..).ok_or_else(torn)?;
    while *rest.first().ok_or_else(torn)? != 0 {
        let len = attribute_bytes(rest).ok_or_else(torn)?;
        let (attribute, after) = rest.split_at_checked(len).ok_or_else(torn)?;
        attributes.push(attribute);
        rest = after;
    }
    attributes.sort_unstable();
    Ok([&file[..PREAMBLE_BYTES], &attributes.concat(), rest].concat())
}

/// Length of the attribute at the start of `header`: name, 0, type, 0, length of the value as int32, value.
fn attribute_bytes(header: &[u8]) -> Option<usize> {
    let end_of_string =
        |from: usize| Some(from + header.get(from..)?.iter().position(|&byte| byte == 0)? + 1);
    let value_len_at = end_of_string(end_of_string(0)?)?;
    let value_at = value_len_at + 4;
    let value_len = i32::from_le_bytes(header.get(value_len_at..value_at)?.try_into().ok()?);
    Some(value_at + usize::try_from(value_len).ok()?)
}

/// Converts to UTF-8, which OpenEXR uses; the library's own conversion refuses characters beyond Latin-1.
fn utf8(text: &str) -> Text {
    Text::from_slice_unchecked(text.as_bytes())
}
