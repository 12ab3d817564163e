//! What each pixel shows, as a person has marked it.

use std::io::BufReader;
use std::path::Path;

use ndarray::Array2;
use raysweep_core::io_text;
use raysweep_session::input;
use serde::Deserialize;

use crate::stored::ProcessError;

const LARGEST_FILE_BYTES: u64 = 1 << 20;

/// A file of labels, TOML.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct LabelFile {
    /// An 8-bit grey or palette PNG of the camera's size, relative to this file; its values are those of `[values]`.
    image: Option<std::path::PathBuf>,
    /// Value in the image to name.
    #[serde(default)]
    values: std::collections::BTreeMap<String, String>,
    /// Rectangles, which are drawn over the image.
    #[serde(default)]
    region: Vec<RegionTable>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RegionTable {
    label: String,
    /// `[t0, t1, s0, s1]`, half open.
    region: [usize; 4],
}

/// The label of each pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct Labels {
    /// The labels' names, in the order in which they first occur.
    pub names: Vec<String>,
    /// `[t, s]`, index into `names`; `None`: not labelled.
    pub of_pixel: Array2<Option<usize>>,
}

impl Labels {
    /// Reads a file of labels for images of `size` (rows, columns).
    ///
    /// # Errors
    /// When a file cannot be read or is of another size, or a region is outside of the image or empty.
    pub fn read(path: &Path, size: (usize, usize)) -> Result<Self, ProcessError> {
        let text = input::read_text(path, LARGEST_FILE_BYTES)
            .map_err(|error| ProcessError::Config(format!("cannot read {}: {error}", path.display())))?;
        let wrong = |what: String| ProcessError::Config(format!("{}: {what}", path.display()));
        let file: LabelFile = toml::from_str(&text).map_err(|error| wrong(error.to_string()))?;
        let mut labels = Self { names: Vec::new(), of_pixel: Array2::from_elem(size, None) };
        if let Some(image) = &file.image {
            let image = path.parent().unwrap_or(Path::new("")).join(image);
            let values = read_png(&image, size)?;
            let mut of_value = [None; 256];
            for (value, name) in &file.values {
                let at: u8 = value.parse().ok().filter(|value| *value > 0).ok_or_else(|| {
                    wrong(format!("values.{value}: keys are the image's values, 1 to 255; 0 is not labelled"))
                })?;
                of_value[usize::from(at)] = Some(labels.index(name));
            }
            if let Some(unnamed) =
                values.iter().find(|&&value| value > 0 && of_value[usize::from(value)].is_none())
            {
                return Err(wrong(format!(
                    "values: {} has pixels of value {unnamed}; name it here ({unnamed} = \"...\"), or make it 0",
                    image.display()
                )));
            }
            labels.of_pixel = values.mapv(|value| of_value[usize::from(value)]);
        } else if !file.values.is_empty() {
            return Err(wrong(
                "values: names values of an image, but there is none; give image = \"...\"".into(),
            ));
        }
        for RegionTable { label, region } in &file.region {
            let [t0, t1, s0, s1] = *region;
            if t0 >= t1 || t1 > size.0 || s0 >= s1 || s1 > size.1 {
                return Err(wrong(format!(
                    "region {region:?} of `{label}`: give [t0, t1, s0, s1] with t0 < t1 and s0 < s1, t1 and s1 not included; the image has {} rows and {} columns",
                    size.0, size.1
                )));
            }
            let label = labels.index(label);
            labels.of_pixel.slice_mut(ndarray::s![t0..t1, s0..s1]).fill(Some(label));
        }
        if labels.of_pixel.iter().all(Option::is_none) {
            return Err(wrong(
                "no pixel is labelled; give [[region]] tables with label and region, or an image".into(),
            ));
        }
        Ok(labels)
    }

    fn index(&mut self, name: &str) -> usize {
        self.names.iter().position(|known| known == name).unwrap_or_else(|| {
            self.names.push(name.to_owned());
            self.names.len() - 1
        })
    }

    /// Whether a pixel within `margin_px` of another one has another label, or none.
    pub fn is_at_an_edge(&self, (t, s): (usize, usize), margin_px: usize) -> bool {
        let (rows, columns) = self.of_pixel.dim();
        let around = self.of_pixel.slice(ndarray::s![
            t.saturating_sub(margin_px)..(t + margin_px + 1).min(rows),
            s.saturating_sub(margin_px)..(s + margin_px + 1).min(columns)
        ]);
        around.iter().any(|label| *label != self.of_pixel[[t, s]])
    }
}

/// The values of an 8-bit image with one channel.
fn read_png(path: &Path, size: (usize, usize)) -> Result<Array2<u8>, ProcessError> {
    let wrong = |what: String| ProcessError::Config(format!("{}: {what}", path.display()));
    let file = input::open(path, u64::MAX).map_err(|error| wrong(io_text(&error)))?;
    let mut decoder = png::Decoder::new_with_limits(BufReader::new(file), png::Limits { bytes: 1 << 28 });
    decoder.set_transformations(png::Transformations::IDENTITY);
    let mut reader = decoder.read_info().map_err(|error| wrong(error.to_string()))?;
    let info = reader.info();
    let (rows, columns) = (info.height as usize, info.width as usize);
    if (rows, columns) != size {
        return Err(wrong(format!(
            "has {rows} rows and {columns} columns, the session's images have {} and {}; labels are drawn on an image of the session",
            size.0, size.1
        )));
    }
    if info.bit_depth != png::BitDepth::Eight
        || !matches!(info.color_type, png::ColorType::Grayscale | png::ColorType::Indexed)
    {
        return Err(wrong(format!(
            "has {:?} pixels of {:?} bits; save it as 8-bit grey or with a palette",
            info.color_type, info.bit_depth as u8
        )));
    }
    let mut values = vec![0; rows * columns];
    reader.next_frame(&mut values).map_err(|error| wrong(error.to_string()))?;
    Array2::from_shape_vec(size, values).map_err(|error| wrong(error.to_string()))
}
