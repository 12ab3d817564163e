//! Pictures of a sequence, for programs that do not read linear images.

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayView4, Axis, s};

use super::Products;
use crate::durable::{self, DraftDir};
use crate::report::{Picture, ToneMap};
use crate::{Error, Result};

/// White level of all pictures: this percentile of the pixels of all images.
const PERCENTILE: f64 = 99.5;
/// Pixels between two images of a contact sheet.
const GAP_PX: usize = 2;

impl Products {
    /// Writes a picture of each image `[k, t, s, channels]` of a sequence, `NAME/0000.png` and so on, and
    /// `NAME/contact_sheet.png`, which shows them all, small, row by row. All have one tone map (sRGB transfer function).
    ///
    /// # Errors
    /// [`Error::Shape`] if there are no images; otherwise as [`Products::image`].
    pub(super) fn write_pictures(&self, name: &str, values: ArrayView4<f32>) -> Result<()> {
        if values.is_empty() {
            let what = format!("sequence `{name}`");
            let (found, allowed) = (values.shape().to_vec(), "[k, t, s, channels], not empty".into());
            return Err(Error::Shape { what, found, allowed });
        }
        let images: Vec<ArrayView3<f32>> = values.outer_iter().collect();
        let planes: Vec<ArrayView2<f32>> = images.iter().flat_map(|image| image.axis_iter(Axis(2))).collect();
        let tone_map = ToneMap::percentile(&planes, PERCENTILE);
        // Refuses names that are paths.
        let folder = self.path(name, "npy")?.with_extension("");
        durable::create_dir_within(self.dir())?;
        let folder = DraftDir::create(&folder)?;
        let write =
            |file: String, picture: &Picture| durable::write(&folder.path().join(file), &picture.to_png()?);
        for (k, image) in images.iter().enumerate() {
            write(format!("{k:04}.png"), &Picture::unreduced(*image, tone_map))?;
        }
        let sheet = contact_sheet(&images);
        write("contact_sheet.png".into(), &Picture::unreduced(sheet.view(), tone_map))?;
        folder.commit()
    }
}

/// Images `[t, s, channels]` of one size side by side, as many in a row as there are rows, each as small as a thumbnail.
fn contact_sheet(images: &[ArrayView3<f32>]) -> Array3<f32> {
    let small = |image: &ArrayView3<f32>| image.axis_iter(Axis(2)).map(Picture::reduced).collect();
    let small: Vec<Vec<Array2<f32>>> = images.iter().map(small).collect();
    let first = small.first().map_or(&[][..], Vec::as_slice);
    let (rows, columns) = first.first().map_or((0, 0), Array2::dim);
    let across = (1..).find(|across| across * across >= small.len()).unwrap_or(1);
    let down = small.len().div_ceil(across);
    let size = (down * (rows + GAP_PX) - GAP_PX, across * (columns + GAP_PX) - GAP_PX, first.len());
    let mut sheet = Array3::zeros(size);
    for (k, planes) in small.iter().enumerate() {
        let (top, left) = (k / across * (rows + GAP_PX), k % across * (columns + GAP_PX));
        for (channel, plane) in planes.iter().enumerate() {
            sheet.slice_mut(s![top..top + rows, left..left + columns, channel]).assign(plane);
        }
    }
    sheet
}

#[cfg(test)]
mod tests {
    use ndarray::Array4;

    use super::*;

    fn size_of(path: &std::path::Path) -> (u32, u32) {
        let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
        png::Decoder::new(file).read_info().unwrap().info().size()
    }

    #[test]
    fn a_sequence_has_a_picture_for_each_image_and_a_sheet_of_all() {
        let dir = tempfile::tempdir().unwrap();
        let products = Products::new(dir.path());
        let values =
            Array4::from_shape_fn((5, 4, 6, 3), |(k, t, s, c)| (100 * k + 20 * t + 3 * s + c) as f32);
        products.write_pictures("line", values.view()).unwrap();
        let file = |name: &str| dir.path().join("line").join(name);
        assert_eq!(size_of(&file("0004.png")), (6, 4));
        assert!(!file("0005.png").exists());
        // Three in a row, with gaps of two pixels.
        assert_eq!(size_of(&file("contact_sheet.png")), (22, 10));
        let images: Vec<_> = values.outer_iter().collect();
        let sheet = contact_sheet(&images);
        assert_eq!(sheet.slice(s![6.., 8..14, ..]), values.index_axis(Axis(0), 4));
        assert_eq!(sheet.slice(s![6.., 16.., ..]).sum(), 0.0, "there is no sixth image");
        assert!(products.write_pictures("line", values.slice(s![..0, .., .., ..])).is_err());
    }
}
