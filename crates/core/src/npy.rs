//! The header of NumPy's `.npy` files (NEP 1): everything needed to find the frames in a file.

use std::io::{self, Read};

use py_literal::Value;

/// Type and shape of an array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NpyHeader {
    /// NumPy's name of the element type, such as `<u2`.
    pub dtype: String,
    /// Lengths of its axes, in C order.
    pub shape: Vec<usize>,
    /// Offset of its data.
    pub data_at: u64,
}

/// Maximum accepted header length.
const LONGEST_HEADER: usize = 1 << 16;

impl NpyHeader {
    /// Reads the header at the beginning of a file.
    ///
    /// # Errors
    /// An error of the file, or `InvalidData` with what is wrong.
    pub fn read(mut file: impl Read) -> io::Result<Self> {
        let bad = |what: &str| io::Error::new(io::ErrorKind::InvalidData, what.to_owned());
        let mut magic = [0; 8];
        file.read_exact(&mut magic)?;
        if &magic[..6] != b"\x93NUMPY" {
            return Err(bad("it does not begin as an .npy file"));
        }
        let length_bytes = if magic[6] == 1 { 2 } else { 4 };
        let mut length = [0; 4];
        file.read_exact(&mut length[..length_bytes])?;
        let length = u32::from_le_bytes(length) as usize;
        if length > LONGEST_HEADER {
            return Err(bad("its header has an unlikely length"));
        }
        let mut text = vec![0; length];
        file.read_exact(&mut text)?;
        let text =
            String::from_utf8(text).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))?;
        let Ok(Value::Dict(entries)) = text.trim().parse::<Value>() else {
            return Err(bad("its header is no Python dictionary"));
        };
        let entry = |key: &str| {
            let found = entries.iter().find(|(name, _)| name.as_string().is_some_and(|name| name == key));
            found.map(|(_, value)| value).ok_or_else(|| bad("its header lacks descr, fortran_order or shape"))
        };
        if entry("fortran_order")?.as_boolean() != Some(false) {
            return Err(bad("its axes are in Fortran order; save it with numpy.ascontiguousarray"));
        }
        let dtype = entry("descr")?.as_string().ok_or_else(|| bad("its elements are no plain numbers"))?;
        let shape = entry("shape")?.as_tuple().ok_or_else(|| bad("its shape is no tuple"))?;
        let length_of = |value: &Value| value.as_integer().and_then(|number| usize::try_from(number).ok());
        let shape: Option<Vec<usize>> = shape.iter().map(length_of).collect();
        Ok(Self {
            dtype: dtype.clone(),
            shape: shape.ok_or_else(|| bad("its shape holds what is no length"))?,
            data_at: (magic.len() + length_bytes + length) as u64,
        })
    }
}
