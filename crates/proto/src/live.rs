//! The layout of the live file: the newest images of a run, in memory that clients map.
//!
//! All numbers are little-endian. The file starts with a header ([`HEADER`]), then come slots of equal size, each with
//! one image behind a header of its own ([`SLOT`]). `docs/reference/socket.md` says what the fields mean.
//!
//! A reader takes the slot of the name with the largest sequence, copies it, and keeps the copy if the lock was even
//! and the same before and after and the checksum holds; otherwise it tries again.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a live file begins with.
pub const MAGIC: [u8; 8] = *b"RAYSLIVE";
/// The layout's version.
pub const VERSION: u32 = 1;
/// Bytes of the file's header.
pub const HEADER_BYTES: usize = 64;
/// Bytes of a slot's header.
pub const SLOT_HEADER_BYTES: usize = 128;
/// Most axes of an image.
pub const MAX_AXES: usize = 4;
/// Longest name of an image.
pub const NAME_BYTES: usize = 40;
/// Longest metadata of an image.
pub const METADATA_BYTES: usize = 4096 - SLOT_HEADER_BYTES;
/// The only type of pixels.
pub const DTYPE: [u8; 4] = *b"<f4\0";

/// A number or text of the layout.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LiveField {
    /// Its name.
    pub name: String,
    /// Bytes from the start of the header that it is in.
    pub offset: usize,
    /// Its type as NumPy writes it.
    pub dtype: String,
    /// How many of them.
    pub count: usize,
}

/// The layout of the live file, in `describe`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LiveLayout {
    /// What the file begins with.
    pub magic: String,
    /// The layout's version.
    pub version: u32,
    /// The file's header.
    pub header: Vec<LiveField>,
    /// A slot's header.
    pub slot: Vec<LiveField>,
}

/// Name, offset in the header, type, count.
pub type Field = (&'static str, usize, &'static str, usize);

/// The file's header.
pub const HEADER: [Field; 5] = [
    ("magic", 0, "|S8", 1),
    ("version", 8, "<u4", 1),
    ("slots", 12, "<u4", 1),
    ("first_slot", 16, "<u8", 1),
    ("slot_bytes", 24, "<u8", 1),
];

/// A slot's header.
pub const SLOT: [Field; 11] = [
    ("lock", 0, "<u8", 1),
    ("sequence", 8, "<u8", 1),
    ("host_ns", 16, "<i8", 1),
    ("data_offset", 24, "<u8", 1),
    ("metadata_offset", 32, "<u8", 1),
    ("metadata_bytes", 40, "<u4", 1),
    ("crc32", 44, "<u4", 1),
    ("dtype", 48, "|S4", 1),
    ("ndim", 52, "<u4", 1),
    ("shape", 56, "<u8", MAX_AXES),
    ("name", 88, "|S40", 1),
];

/// What `describe` says of the live file.
pub(crate) fn layout() -> LiveLayout {
    let fields = |fields: &[Field]| {
        let field = |&(name, offset, dtype, count): &Field| LiveField {
            name: name.into(),
            offset,
            dtype: dtype.into(),
            count,
        };
        fields.iter().map(field).collect()
    };
    LiveLayout {
        magic: String::from_utf8_lossy(&MAGIC).into_owned(),
        version: VERSION,
        header: fields(&HEADER),
        slot: fields(&SLOT),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_follow_each_other_and_fill_a_slots_header() {
        let bytes = |dtype: &str| dtype[2..].parse::<usize>().unwrap();
        for (fields, end) in [(&HEADER[..], 32), (&SLOT[..], SLOT_HEADER_BYTES)] {
            let after = fields.iter().fold(0, |after, &(name, offset, dtype, count)| {
                assert_eq!(offset, after, "{name}");
                after + count * bytes(dtype)
            });
            assert_eq!(after, end);
        }
    }
}
