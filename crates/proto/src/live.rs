//! The layout of the live file: the newest images of a run, in memory that clients map.
//!
//! All numbers are little-endian. The file consists of a header ([`HEADER`]) and slots of equal size. Each
//! slot holds one image after a header of its own ([`SLOT`]). `docs/reference/socket.md` explains the fields.
//!
//! A reader takes the slot with the wanted name and the largest sequence number and copies it. The copy is
//! valid if the lock was even and had the same value before and after, and the checksum matches; otherwise
//! the reader tries again.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// First bytes of a live file.
pub const MAGIC: [u8; 8] = *b"RAYSLIVE";
/// Version of the layout.
pub const VERSION: u32 = 1;
/// Size of the file header.
pub const HEADER_BYTES: usize = 64;
/// Size of a slot header.
pub const SLOT_HEADER_BYTES: usize = 128;
/// Maximum number of axes of an image.
pub const MAX_AXES: usize = 4;
/// Maximum bytes of an image's name.
pub const NAME_BYTES: usize = 40;
/// Maximum bytes of an image's metadata.
pub const METADATA_BYTES: usize = 4096 - SLOT_HEADER_BYTES;
/// The only pixel type.
pub const DTYPE: [u8; 4] = *b"<f4\0";

/// A number or text field of the layout.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LiveField {
    /// Its name.
    pub name: String,
    /// Offset in bytes from the start of its header.
    pub offset: usize,
    /// Its type in NumPy notation.
    pub dtype: String,
    /// Number of elements.
    pub count: usize,
}

/// The layout of the live file, as returned by `describe`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LiveLayout {
    /// First bytes of the file.
    pub magic: String,
    /// Version of the layout.
    pub version: u32,
    /// Fields of the file header.
    pub header: Vec<LiveField>,
    /// Fields of a slot header.
    pub slot: Vec<LiveField>,
}

/// Name, offset in the header, type, number of elements.
pub type Field = (&'static str, usize, &'static str, usize);

/// Fields of the file header.
pub const HEADER: [Field; 5] = [
    ("magic", 0, "|S8", 1),
    ("version", 8, "<u4", 1),
    ("slots", 12, "<u4", 1),
    ("first_slot", 16, "<u8", 1),
    ("slot_bytes", 24, "<u8", 1),
];

/// Fields of a slot header.
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

/// What `describe` returns about the live file.
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
