//! Floats of 16, 32 or 64 bits in a file, read in memory that grows with what the file holds. `ndarray-npy` does not
//! read the first, and allocates what a header claims, which ends the process if there is not so much memory.

use std::io::Read;

use half::f16;
use ndarray_npy::{ReadDataError, ReadableElement};
use py_literal::Value;

/// An element of one of these types, converted to float32.
pub(crate) struct StoredFloat(pub f32);

/// Converts an element's bytes.
fn convert<const WIDTH: usize>(data: &[u8], of: impl Fn([u8; WIDTH]) -> f32) -> Vec<StoredFloat> {
    let (elements, _) = data.as_chunks();
    elements.iter().map(|&bytes| StoredFloat(of(bytes))).collect()
}

impl ReadableElement for StoredFloat {
    fn read_to_end_exact_vec<R: Read>(
        mut reader: R,
        type_desc: &Value,
        len: usize,
    ) -> Result<Vec<Self>, ReadDataError> {
        let wrong = || ReadDataError::WrongDescriptor(type_desc.clone());
        let descriptor = type_desc.as_string().ok_or_else(wrong)?.as_str();
        let width = match descriptor {
            "<f2" => 2,
            "<f4" | ">f4" => 4,
            "<f8" | ">f8" => 8,
            _ => return Err(wrong()),
        };
        let bytes = (len as u64).checked_mul(width).ok_or(ReadDataError::MissingData)?;
        let mut data = Vec::new();
        reader.by_ref().take(bytes).read_to_end(&mut data)?;
        if (data.len() as u64) < bytes {
            return Err(ReadDataError::MissingData);
        }
        match std::io::copy(&mut reader, &mut std::io::sink())? {
            0 => {}
            extra => return Err(ReadDataError::ExtraBytes(extra as usize)),
        }
        Ok(match descriptor {
            "<f2" => convert(&data, |bytes| f16::from_le_bytes(bytes).to_f32()),
            "<f4" => convert(&data, f32::from_le_bytes),
            ">f4" => convert(&data, f32::from_be_bytes),
            "<f8" => convert(&data, |bytes| f64::from_le_bytes(bytes) as f32),
            _ => convert(&data, |bytes| f64::from_be_bytes(bytes) as f32),
        })
    }
}
