//! Products in the formats of other programs.

use std::fmt::Write as _;
use std::fs::{File, FileType};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayD, ArrayView3, ArrayViewD, Axis, Ix3};
use raysweep_session::report::{Picture, ToneMap};
use raysweep_session::{Session, durable};
use serde_json::Value;
use tiff::encoder::{TiffEncoder, TiffValue, colortype};
use tiff::tags::Tag;
use zip::write::SimpleFileOptions;

use super::mat::{variable_name, write_header, write_variable};
use super::{ExportScope, copy, in_new_folder, is_real, listed, not_copied};
use crate::stored::ProcessError;

/// A format in which products can be exported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportFormat {
    /// OpenEXR, as in the session.
    Exr,
    /// NumPy, as in the session.
    Npy,
    /// PNG pictures with 8 bits and a tone map that the README states.
    Png,
    /// TIFF with 16 bits a sample, linear, with a scale that the README states; a page for each image of a sequence.
    Tiff16,
    /// TIFF with floating-point samples, in the product's unit; a page for each image of a sequence.
    Tiff32,
    /// One MAT-file (Level 5) with a variable for each product.
    Mat,
    /// An archive of what an export without a format copies.
    Zip,
}

impl ExportFormat {
    /// All formats.
    pub const ALL: [Self; 7] =
        [Self::Exr, Self::Npy, Self::Png, Self::Tiff16, Self::Tiff32, Self::Mat, Self::Zip];

    /// Its name, and what it is, in a few words.
    pub fn described(self) -> (&'static str, &'static str) {
        match self {
            Self::Exr => ("exr", "OpenEXR"),
            Self::Npy => ("npy", "NumPy"),
            Self::Png => ("png", "8-bit pictures, to look at"),
            Self::Tiff16 => ("tiff16", "TIFF with 16 bits a sample, linear, scaled"),
            Self::Tiff32 => ("tiff32", "TIFF with float samples, linear"),
            Self::Mat => ("mat", "One MATLAB file with a variable for each product"),
            Self::Zip => ("zip", "An archive of the plain copy"),
        }
    }
}

/// A product, as its JSON file describes it.
struct Described {
    name: String,
    axes: Vec<String>,
    units: String,
    about: String,
    text: String,
}

/// How a file was written, for the README.
struct Exported {
    file: String,
    scale: String,
}

/// Pixels of a picture that is as light as the tone map's white.
const PNG_PERCENT: f64 = 99.5;

/// Writes a session's products into the new folder `to` in a format, with a README of their axes and units; for
/// [`ExportFormat::Zip`], `to` is the new archive. Returns the number of files.
///
/// # Errors
/// When the session cannot be read, its results are damaged (unless `accept_damage`), or `to` cannot be written.
pub fn export_as(
    dir: &Path,
    to: &Path,
    accept_damage: bool,
    scope: ExportScope,
    format: ExportFormat,
) -> Result<usize, ProcessError> {
    if format == ExportFormat::Zip {
        return archive(dir, to, accept_damage, scope);
    }
    let session = Session::open(dir)?;
    if !accept_damage {
        super::check_sound(&session)?;
    }
    in_new_folder(&session, to, |to| export_into(&session, to, format))
}

fn export_into(session: &Session, to: &Path, format: ExportFormat) -> Result<usize, ProcessError> {
    let products = described(session)?;
    let mut readme = beginning(session, format);
    let mut mat = match format {
        ExportFormat::Mat => Some(MatFile::create(&to.join("products.mat"), session)?),
        _ => None,
    };
    for product in &products {
        let exported = match &mut mat {
            Some(mat) => mat.append(session, product)?,
            None => written(session, product, to, format)?,
        };
        let Described { name, axes, units, about, .. } = product;
        let axes = axes.join(", ");
        let said = match &exported {
            Some(Exported { file, scale }) => {
                format!("| `{file}` | `[{axes}]` | {units} | {scale} | {about} |")
            }
            None => format!("| `{name}` is not in this format | `[{axes}]` | {units} | | {about} |"),
        };
        let _ = writeln!(readme, "{}", said.replace('\n', " "));
    }
    if let Some(mat) = mat {
        mat.finish()?;
    }
    let path = to.join("README.md");
    std::fs::write(&path, readme).map_err(not_copied(&path))?;
    Ok(files_in(to))
}

/// A README of the axes and units of a session's own arrays, for a copy of them. What cannot be read is left out, if it is
/// accepted that results are damaged.
pub(super) fn readme_of_copy(session: &Session, accept_damage: bool) -> Result<String, ProcessError> {
    let products = match described(session) {
        Err(_) if accept_damage => Vec::new(),
        products => products?,
    };
    let mut readme = beginning(session, ExportFormat::Zip);
    for Described { name, axes, units, about, .. } in products {
        let row = format!("| `{name}.npy` | `[{}]` | {units} | 1 | {about} |", axes.join(", "));
        let _ = writeln!(readme, "{}", row.replace('\n', " "));
    }
    Ok(readme)
}

/// The number of files in a folder and those below it.
fn files_in(folder: &Path) -> usize {
    let below: usize = listed(folder, FileType::is_dir).iter().map(|inner| files_in(inner)).sum();
    below + listed(folder, FileType::is_file).len()
}

/// The products of a session, by name.
fn described(session: &Session) -> Result<Vec<Described>, ProcessError> {
    let mut products = Vec::new();
    let paths = session.products().files();
    for path in paths.iter().filter(|path| path.extension().is_some_and(|ending| ending == "json")) {
        let Some(name) = path.file_stem().and_then(|name| name.to_str()) else { continue };
        if !is_real(&path.with_extension("npy"), FileType::is_file) {
            continue;
        }
        let text = session.read_text(path)?;
        let value: Value = serde_json::from_str(&text)
            .map_err(|error| ProcessError::Config(format!("cannot read {}: {error}", path.display())))?;
        let said = |key: &str| value[key].as_str().unwrap_or_default().to_owned();
        let axes = value["axes"].as_array().map_or_else(Vec::new, |axes| {
            axes.iter().filter_map(|axis| axis.as_str().map(str::to_owned)).collect()
        });
        products.push(Described {
            name: name.to_owned(),
            axes,
            units: said("units"),
            about: said("about"),
            text,
        });
    }
    Ok(products)
}

fn beginning(session: &Session, format: ExportFormat) -> String {
    let name = session.dir().file_name().unwrap_or_default().to_string_lossy().into_owned();
    let what = match format {
        ExportFormat::Exr => "OpenEXR files, linear, in the units below. Images of a sequence are layers.",
        ExportFormat::Npy => {
            "NumPy arrays, float32, in the units below; `_mask.npy` (uint8) says what is known of each pixel."
        }
        ExportFormat::Png => {
            "PNG pictures with 8 bits, by the transfer function of sRGB (IEC 61966-2-1). For measurements take another format."
        }
        ExportFormat::Tiff16 => {
            "TIFF with 16 bits a sample, linear: value = code * scale. Values below 0 and values that are not numbers have code 0."
        }
        ExportFormat::Tiff32 => "TIFF with float32 samples, linear, in the units below.",
        ExportFormat::Mat => {
            "Arrays of type single in `products.mat` (Level 5), in the units below, with axes in this order."
        }
        ExportFormat::Zip => {
            "The session's own files. Of each NumPy array, the `.json` file beside it has all that is known of it."
        }
    };
    let more = match format {
        ExportFormat::Zip => "",
        ExportFormat::Npy => " The session has more: settings, the ledger.",
        _ => " The session has more: masks, settings, the ledger.",
    };
    format!(
        "# {name}\n\n{what} t is the camera row, top row first, s the camera column.{more}\n\n| file | axes | units | scale | content |\n| --- | --- | --- | --- | --- |\n"
    )
}

/// Writes a product in a format, unless that has no form for it.
fn written(
    session: &Session,
    product: &Described,
    to: &Path,
    format: ExportFormat,
) -> Result<Option<Exported>, ProcessError> {
    let name = &product.name;
    let own = |ending: &str| session.products_path().join(format!("{name}{ending}"));
    let copied = |ending: &str| {
        let target = to.join(format!("{name}{ending}"));
        copy(session, &own(ending), &target)
            .map(|()| Exported { file: format!("{name}{ending}"), scale: "1".into() })
    };
    if is_real(&own(".csv"), FileType::is_file) && format != ExportFormat::Npy {
        return copied(".csv").map(Some);
    }
    match format {
        ExportFormat::Npy => {
            if is_real(&own("_mask.npy"), FileType::is_file) {
                copied("_mask.npy")?;
            }
            copied(".npy").map(Some)
        }
        ExportFormat::Exr if is_real(&own(".exr"), FileType::is_file) => copied(".exr").map(Some),
        ExportFormat::Png | ExportFormat::Tiff16 | ExportFormat::Tiff32 => {
            let Some(images) = images(session, product)? else { return Ok(None) };
            match format {
                ExportFormat::Png => png(&images, name, to).map(Some),
                ExportFormat::Tiff16 => tiff16(&images, product, to).map(Some),
                _ => tiff32(&images, product, to).map(Some),
            }
        }
        ExportFormat::Exr | ExportFormat::Mat | ExportFormat::Zip => Ok(None),
    }
}

/// The images `[t, s, channels]` of an image or a sequence; `None` for volumes and tables.
fn images(session: &Session, product: &Described) -> Result<Option<Vec<ArrayD<f32>>>, ProcessError> {
    let axes: Vec<&str> = product.axes.iter().map(String::as_str).collect();
    let is_sequence = match axes[..] {
        ["t", "s"] | ["t", "s", _] => false,
        ["k", "t", "s"] | ["k", "t", "s", _] => true,
        _ => return Ok(None),
    };
    let array = session.products().read_array(&product.name)?;
    let with_channels = |image: ArrayViewD<'_, f32>| match image.ndim() {
        2 => image.insert_axis(Axis(2)).to_owned(),
        _ => image.to_owned(),
    };
    let images: Vec<ArrayD<f32>> = match is_sequence {
        true => array.outer_iter().map(with_channels).collect(),
        false => vec![with_channels(array.view())],
    };
    let are_images = images
        .iter()
        .all(|image| image.ndim() == 3 && [1, 3].contains(&image.shape()[2]) && !image.is_empty());
    Ok(Some(images).filter(|images| are_images && !images.is_empty()))
}

fn view(image: &ArrayD<f32>) -> Result<ArrayView3<'_, f32>, ProcessError> {
    image.view().into_dimensionality::<Ix3>().map_err(|error| ProcessError::Config(error.to_string()))
}

fn png(images: &[ArrayD<f32>], name: &str, to: &Path) -> Result<Exported, ProcessError> {
    let planes: Vec<Array2<f32>> = images
        .iter()
        .map(|image| Ok(view(image)?.mean_axis(Axis(2)).unwrap_or_default()))
        .collect::<Result<_, ProcessError>>()?;
    let views: Vec<_> = planes.iter().map(|plane| plane.view()).collect();
    let tone_map = ToneMap::percentile(&views, PNG_PERCENT);
    let write = |image: &ArrayD<f32>, path: &Path| {
        let bytes = Picture::unreduced(view(image)?, tone_map).to_png()?;
        std::fs::write(path, bytes).map_err(not_copied(path))
    };
    let scale = format!("white = {}", tone_map.white);
    if let [image] = images {
        write(image, &to.join(format!("{name}.png")))?;
        return Ok(Exported { file: format!("{name}.png"), scale });
    }
    let folder = to.join(name);
    std::fs::create_dir(&folder).map_err(not_copied(&folder))?;
    for (k, image) in images.iter().enumerate() {
        write(image, &folder.join(format!("{k:04}.png")))?;
    }
    Ok(Exported { file: format!("{name}/0000.png …"), scale })
}

fn tiff16(images: &[ArrayD<f32>], product: &Described, to: &Path) -> Result<Exported, ProcessError> {
    let largest = images.iter().flatten().copied().filter(|value| value.is_finite()).fold(0.0, f32::max);
    let scale = if largest > 0.0 { largest / f32::from(u16::MAX) } else { 1.0 };
    // NaN becomes 0.
    let code = |value: &f32| (value / scale).round().clamp(0.0, f32::from(u16::MAX)) as u16;
    let about = format!("value = code * {scale:e}\n{}", product.text);
    write_tiff::<u16, colortype::Gray16, colortype::RGB16>(images, product, to, &about, code)?;
    Ok(Exported { file: format!("{}.tiff", product.name), scale: format!("{scale:e}") })
}

fn tiff32(images: &[ArrayD<f32>], product: &Described, to: &Path) -> Result<Exported, ProcessError> {
    let value = |value: &f32| *value;
    write_tiff::<f32, colortype::Gray32Float, colortype::RGB32Float>(
        images,
        product,
        to,
        &product.text,
        value,
    )?;
    Ok(Exported { file: format!("{}.tiff", product.name), scale: "1".into() })
}

/// Writes images as pages of a TIFF file whose description is `about`.
fn write_tiff<T, Grey, Rgb>(
    images: &[ArrayD<f32>],
    product: &Described,
    to: &Path,
    about: &str,
    sample: impl Fn(&f32) -> T,
) -> Result<(), ProcessError>
where
    Grey: colortype::ColorType<Inner = T>,
    Rgb: colortype::ColorType<Inner = T>,
    [T]: TiffValue,
{
    let path = to.join(format!("{}.tiff", product.name));
    let failed = |error: tiff::TiffError| not_copied(&path)(io::Error::other(error));
    let file = File::create(&path).map_err(not_copied(&path))?;
    let mut encoder = TiffEncoder::new(BufWriter::new(file)).map_err(failed)?;
    // Descriptions are ASCII.
    let about: String = about.chars().map(|letter| if letter.is_ascii() { letter } else { '?' }).collect();
    for image in images {
        let image = view(image)?;
        let (rows, columns, channels) = image.dim();
        let samples: Vec<T> = image.iter().map(&sample).collect();
        let size = (columns as u32, rows as u32);
        macro_rules! page {
            ($colour:ty) => {{
                let mut page = encoder.new_image::<$colour>(size.0, size.1).map_err(failed)?;
                page.encoder().write_tag(Tag::ImageDescription, about.as_str()).map_err(failed)?;
                page.write_data(&samples).map_err(failed)?;
            }};
        }
        if channels == 3 { page!(Rgb) } else { page!(Grey) }
    }
    Ok(())
}

/// A MAT-file that is being written.
struct MatFile {
    file: BufWriter<File>,
    path: PathBuf,
    names: Vec<String>,
}

impl MatFile {
    fn create(path: &Path, session: &Session) -> Result<Self, ProcessError> {
        let mut file = BufWriter::new(File::create(path).map_err(not_copied(path))?);
        let name = session.dir().file_name().unwrap_or_default().to_string_lossy().into_owned();
        write_header(&mut file, &format!("raysweep session {name}")).map_err(not_copied(path))?;
        Ok(Self { file, path: path.to_owned(), names: Vec::new() })
    }

    fn append(&mut self, session: &Session, product: &Described) -> Result<Option<Exported>, ProcessError> {
        let array = session.products().read_array(&product.name)?;
        let name = variable_name(&product.name, &self.names);
        write_variable(&mut self.file, &name, &array.view()).map_err(not_copied(&self.path))?;
        self.names.push(name.clone());
        Ok(Some(Exported { file: name, scale: "1".into() }))
    }

    fn finish(mut self) -> Result<(), ProcessError> {
        self.file.flush().map_err(not_copied(&self.path))
    }
}

/// Copies a session into a new archive.
fn archive(dir: &Path, to: &Path, accept_damage: bool, scope: ExportScope) -> Result<usize, ProcessError> {
    super::check_new(&Session::open(dir)?, to, "file")?;
    let mut name = to.file_name().unwrap_or_default().to_owned();
    // Of this process: another may export the same session at the same time.
    name.push(format!(".{}.content", std::process::id()));
    durable::with_scratch_dir(&to.with_file_name(name), |scratch| {
        let folder = scratch.join("session");
        let files = super::export(dir, &folder, accept_damage, scope)?;
        let archive = scratch.join("session.zip");
        durable::write_with(&archive, |file| zip_folder(&folder, file))?;
        super::check_new(&Session::open(dir)?, to, "file")?;
        std::fs::rename(&archive, to).map_err(not_copied(to))?;
        Ok(files)
    })
}

fn zip_folder(folder: &Path, to: &mut File) -> io::Result<()> {
    let mut archive = zip::ZipWriter::new(BufWriter::new(to));
    let options = SimpleFileOptions::default().large_file(true);
    let mut folders = vec![folder.to_owned()];
    while let Some(inner) = folders.pop() {
        folders.extend(listed(&inner, FileType::is_dir));
        let mut paths = listed(&inner, FileType::is_file);
        paths.sort();
        for path in paths {
            let name = path.strip_prefix(folder).map_err(io::Error::other)?;
            archive.start_file_from_path(name, options).map_err(io::Error::other)?;
            io::copy(&mut File::open(&path)?, &mut archive)?;
        }
    }
    archive.finish().map_err(io::Error::other)?.flush()
}
