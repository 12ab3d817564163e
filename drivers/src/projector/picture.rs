//! Renders patterns as pixels.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use png::{ColorType, Decoder, Transformations};
use raysweep_core::{Pattern, PatternError};

/// Why a pattern cannot be rendered for the projector.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The pattern does not fit the projector.
    #[error(transparent)]
    Pattern(#[from] PatternError),
    /// The file cannot be opened.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The file is not a valid PNG.
    #[error("{} is not a PNG picture: {source}", path.display())]
    Png {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: png::DecodingError,
    },
    /// A picture whose size differs from the projector's.
    #[error("{} has {}x{} pixels, the projector {}x{}: give a picture of that size", path.display(), given.0, given.1, size.0, size.1)]
    Size {
        /// The file.
        path: PathBuf,
        /// Columns and rows of the picture.
        given: (usize, usize),
        /// Columns and rows of the projector.
        size: (usize, usize),
    },
}

/// Red, green and blue codes of each pixel, row by row. A code is proportional to the weight, with 255 for weight 1.
pub fn render(pattern: &Pattern, (columns, rows): (usize, usize)) -> Result<Vec<[u8; 3]>, PictureError> {
    let code = |weight: f32| [(weight * 255.0).round() as u8; 3];
    match (pattern.pixel_weights((columns, rows))?, pattern) {
        (Some(weights), _) => Ok(weights.into_iter().map(code).collect()),
        (None, Pattern::Image(path)) => read_png(path, (columns, rows)),
        // All other patterns have weights.
        (None, _) => Ok(vec![[0; 3]; columns * rows]),
    }
}

fn read_png(path: &Path, size: (usize, usize)) -> Result<Vec<[u8; 3]>, PictureError> {
    let file = File::open(path).map_err(|source| PictureError::Read { path: path.to_owned(), source })?;
    let broken = |source| PictureError::Png { path: path.to_owned(), source };
    let mut decoder = Decoder::new(BufReader::new(file));
    decoder.set_transformations(Transformations::EXPAND | Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(broken)?;
    let given = (reader.info().width as usize, reader.info().height as usize);
    if given != size {
        return Err(PictureError::Size { path: path.to_owned(), given, size });
    }
    // At most four bytes per pixel, for a picture of the projector's size.
    let mut bytes = vec![0; reader.output_buffer_size().unwrap_or(4 * size.0 * size.1)];
    let info = reader.next_frame(&mut bytes).map_err(broken)?;
    let bytes = &bytes[..info.buffer_size()];
    Ok(match info.color_type {
        ColorType::Grayscale => bytes.iter().map(|&grey| [grey; 3]).collect(),
        ColorType::GrayscaleAlpha => bytes.as_chunks::<2>().0.iter().map(|pixel| [pixel[0]; 3]).collect(),
        ColorType::Rgba => bytes.as_chunks::<4>().0.iter().map(|&[r, g, b, _]| [r, g, b]).collect(),
        // Palettes are expanded to RGB.
        ColorType::Rgb | ColorType::Indexed => bytes.as_chunks::<3>().0.to_vec(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const BLACK: [u8; 3] = [0; 3];
    const WHITE: [u8; 3] = [255; 3];

    #[test]
    fn rows_are_lit_by_their_weights() {
        let pixels = render(&Pattern::Rows(vec![0.0, 0.2, 1.0]), (2, 3)).unwrap();
        assert_eq!(pixels, [BLACK, BLACK, [51; 3], [51; 3], WHITE, WHITE]);
        let pixels = render(&Pattern::Line { row: 1 }, (1, 3)).unwrap();
        assert_eq!(pixels, [BLACK, WHITE, BLACK]);
        let pixels = render(&Pattern::SparseColumns { phase: 1, period: 2 }, (3, 2)).unwrap();
        assert_eq!(pixels, [BLACK, WHITE, BLACK, BLACK, WHITE, BLACK]);
    }

    #[test]
    fn a_board_shifted_is_the_board_moved() {
        let board = |shift_px| {
            let pixels = render(&Pattern::Checkerboard { cell_px: 2, shift_px }, (6, 4)).unwrap();
            let picture: String =
                pixels.iter().map(|pixel| if *pixel == WHITE { '#' } else { '.' }).collect();
            picture
        };
        assert_eq!(board((0, 0)), "##..####..##..##....##..".to_owned());
        assert_eq!(board((1, 0)), ".##..#.##..##..##.#..##.".to_owned());
        assert_eq!(board((0, 1)), "..##..##..####..##..##..".to_owned());
        assert_eq!(board((4, 4)), board((0, 0)));
        assert_eq!(board((u32::MAX, 3)), board((3, 3)), "a shift of 2^32 - 1 is one of 3 over a period of 4");
    }

    #[test]
    fn pictures_come_as_they_are_and_only_in_size() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture.png");
        for (colour, data, expected) in [
            (ColorType::Grayscale, vec![0, 7], [[0; 3], [7; 3]]),
            (ColorType::Rgb, vec![1, 2, 3, 4, 5, 6], [[1, 2, 3], [4, 5, 6]]),
            (ColorType::Rgba, vec![1, 2, 3, 0, 4, 5, 6, 9], [[1, 2, 3], [4, 5, 6]]),
        ] {
            let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 2, 1);
            encoder.set_color(colour);
            encoder.write_header().unwrap().write_image_data(&data).unwrap();
            assert_eq!(render(&Pattern::Image(path.clone()), (2, 1)).unwrap(), expected);
        }
        let error = render(&Pattern::Image(path.clone()), (1280, 720)).unwrap_err().to_string();
        assert!(error.contains("2x1 pixels, the projector 1280x720"), "{error}");
        std::fs::write(&path, b"no picture").unwrap();
        assert!(matches!(render(&Pattern::Image(path), (2, 1)), Err(PictureError::Png { .. })));
        let missing = Pattern::Image(folder.path().join("missing.png"));
        assert!(matches!(render(&missing, (2, 1)), Err(PictureError::Read { .. })));
    }
}
