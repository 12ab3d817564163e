//! MATLAB's Level 5 MAT-files, after "MAT-File Format" (The MathWorks, R2019b): numeric arrays alone, not compressed.

use std::io::{self, Write};

use ndarray::ArrayViewD;

/// Data types of elements.
const INT8: u32 = 1;
const INT32: u32 = 5;
const UINT32: u32 = 6;
const SINGLE: u32 = 7;
const MATRIX: u32 = 14;
/// Class of an array of single-precision numbers.
const SINGLE_CLASS: u32 = 7;
/// Longest name of a variable that MATLAB reads.
const MAX_NAME: usize = 63;

/// Writes the header of a file.
///
/// # Errors
/// When it cannot be written.
pub(super) fn write_header(file: &mut impl Write, about: &str) -> io::Result<()> {
    let text = format!("MATLAB 5.0 MAT-file, {about}");
    let mut header: Vec<u8> =
        text.bytes().map(|byte| if byte.is_ascii() { byte } else { b'?' }).take(116).collect();
    header.resize(116, b' ');
    header.extend([0; 8]);
    header.extend(0x0100_u16.to_le_bytes());
    header.extend(b"IM");
    file.write_all(&header)
}

/// Writes an array as a variable of type `single` with the same axes.
///
/// # Errors
/// When it cannot be written, or has more than the 4 GB that the format allows.
pub(super) fn write_variable(
    file: &mut impl Write,
    name: &str,
    values: &ArrayViewD<'_, f32>,
) -> io::Result<()> {
    let axes = values.ndim().max(2);
    let [name_bytes, data_bytes] = [name.len(), 4 * values.len()];
    let padded = |bytes: usize| bytes.next_multiple_of(8);
    let total = 16 + 8 + padded(4 * axes) + 8 + padded(name_bytes) + 8 + padded(data_bytes);
    let too_large =
        |_| io::Error::other(format!("{name} has {data_bytes} bytes: MAT-files hold 4 GB in a variable"));
    let total = u32::try_from(total).map_err(too_large)?;
    let tag = |file: &mut dyn Write, kind: u32, bytes: u32| {
        file.write_all(&kind.to_le_bytes())?;
        file.write_all(&bytes.to_le_bytes())
    };
    tag(file, MATRIX, total)?;
    tag(file, UINT32, 8)?;
    file.write_all(&SINGLE_CLASS.to_le_bytes())?;
    file.write_all(&[0; 4])?;
    tag(file, INT32, 4 * axes as u32)?;
    let mut shape: Vec<i32> = values.shape().iter().map(|&length| length as i32).collect();
    // A MATLAB array has two axes or more.
    shape.resize(axes, 1);
    shape.iter().try_for_each(|length| file.write_all(&length.to_le_bytes()))?;
    file.write_all(&vec![0; padded(4 * axes) - 4 * axes])?;
    tag(file, INT8, name_bytes as u32)?;
    file.write_all(name.as_bytes())?;
    file.write_all(&vec![0; padded(name_bytes) - name_bytes])?;
    tag(file, SINGLE, data_bytes as u32)?;
    // The first axis changes fastest.
    let reversed = values.view().reversed_axes();
    reversed.iter().try_for_each(|value| file.write_all(&value.to_le_bytes()))?;
    file.write_all(&vec![0; padded(data_bytes) - data_bytes])
}

/// The name of a variable for a product, unlike those `taken`.
pub(super) fn variable_name(product: &str, taken: &[String]) -> String {
    let mut name: String =
        product.chars().map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '_' }).collect();
    if !name.starts_with(|first: char| first.is_ascii_alphabetic()) {
        name.insert_str(0, "p_");
    }
    name.truncate(MAX_NAME - 4);
    let mut unique = name.clone();
    let mut number = 2;
    while taken.contains(&unique) {
        unique = format!("{name}_{number}");
        number += 1;
    }
    unique
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variables_have_names_that_matlab_reads_and_no_two_the_same() {
        let taken = vec!["non_epipolar".to_owned()];
        assert_eq!(variable_name("non-epipolar", &taken), "non_epipolar_2");
        assert_eq!(variable_name("3rows", &[]), "p_3rows");
        assert_eq!(variable_name(&"a".repeat(100), &[]).len(), 59);
    }
}
