//! Layouts of pixels in memory, and their reference implementations, which process pixel by pixel.

/// The layout of a frame's pixels in memory, whatever their mosaic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Packing {
    /// 8 bits in a byte.
    Bits8,
    /// 10 bits in a little-endian 16-bit word.
    Bits10,
    /// 12 bits in a little-endian 16-bit word.
    Bits12,
    /// A little-endian 16-bit word.
    Bits16,
    /// Four 10-bit pixels in five bytes, least significant bits first, without gaps.
    Bits10p,
    /// Two 12-bit pixels in three bytes, least significant bits first, without gaps.
    Bits12p,
    /// Two 10-bit pixels in three bytes as in GigE Vision 1: the outer bytes hold their high bits; the middle byte
    /// holds the low bits of the first at bit 0, those of the second at bit 4.
    Bits10Packed,
    /// Two 12-bit pixels in three bytes as in GigE Vision 1: the same with four low bits each.
    Bits12Packed,
    /// MIPI CSI-2's RAW10, V4L2's Y10P: the high bytes of four pixels, then a byte with their low bits, the first
    /// pixel's at bit 0. The name follows PFNC's rule for groups (10 bits, grouped in 40).
    Bits10g40,
    /// MIPI CSI-2's RAW12, V4L2's Y12P: the high bytes of two pixels, then a byte with their low bits.
    Bits12g24,
}

impl Packing {
    /// All packings.
    pub const ALL: [Self; 10] = [
        Self::Bits8,
        Self::Bits10,
        Self::Bits12,
        Self::Bits16,
        Self::Bits10p,
        Self::Bits12p,
        Self::Bits10Packed,
        Self::Bits12Packed,
        Self::Bits10g40,
        Self::Bits12g24,
    ];

    /// Significant bits of a pixel.
    pub fn bits(self) -> u32 {
        match self {
            Self::Bits8 => 8,
            Self::Bits10 | Self::Bits10p | Self::Bits10Packed | Self::Bits10g40 => 10,
            Self::Bits12 | Self::Bits12p | Self::Bits12Packed | Self::Bits12g24 => 12,
            Self::Bits16 => 16,
        }
    }

    /// The largest value of a pixel.
    pub fn max_value(self) -> u16 {
        u16::MAX >> (16 - self.bits())
    }

    /// Bits that a pixel occupies in memory, on average.
    pub fn occupied_bits(self) -> u32 {
        match self {
            Self::Bits8 => 8,
            Self::Bits10 | Self::Bits12 | Self::Bits16 => 16,
            Self::Bits10p | Self::Bits10g40 => 10,
            Self::Bits12p | Self::Bits10Packed | Self::Bits12Packed | Self::Bits12g24 => 12,
        }
    }

    /// Bytes of `pixels` pixels, padded to a whole byte, or to a whole group if pixels are packed in groups.
    pub(super) fn bytes(self, pixels: usize) -> usize {
        match self {
            Self::Bits10g40 => pixels.div_ceil(4) * 5,
            Self::Bits12g24 => pixels.div_ceil(2) * 3,
            _ => (pixels * self.occupied_bits() as usize).div_ceil(8),
        }
    }

    pub(super) fn suffix(self) -> &'static str {
        match self {
            Self::Bits8 => "8",
            Self::Bits10 => "10",
            Self::Bits12 => "12",
            Self::Bits16 => "16",
            Self::Bits10p => "10p",
            Self::Bits12p => "12p",
            Self::Bits10Packed => "10Packed",
            Self::Bits12Packed => "12Packed",
            Self::Bits10g40 => "10g40",
            Self::Bits12g24 => "12g24",
        }
    }

    /// `bytes` must hold exactly as many pixels as `pixels`.
    pub(super) fn unpack(self, bytes: &[u8], pixels: &mut [u16]) {
        match self {
            Self::Bits8 => pixels.iter_mut().zip(bytes).for_each(|(pixel, &byte)| *pixel = u16::from(byte)),
            Self::Bits10 | Self::Bits12 | Self::Bits16 => {
                for (pixel, word) in pixels.iter_mut().zip(bytes.as_chunks::<2>().0) {
                    *pixel = u16::from_le_bytes(*word);
                }
            }
            Self::Bits10p => unpack_stream(10, bytes, pixels),
            Self::Bits12p => unpack_stream(12, bytes, pixels),
            Self::Bits10Packed => unpack_gige(10, bytes, pixels),
            Self::Bits12Packed => unpack_gige(12, bytes, pixels),
            Self::Bits10g40 => unpack_mipi(10, bytes, pixels),
            Self::Bits12g24 => unpack_mipi(12, bytes, pixels),
        }
    }

    /// `bytes` must have room for exactly these pixels.
    pub(super) fn pack(self, pixels: &[u16], bytes: &mut [u8]) {
        match self {
            Self::Bits8 => bytes.iter_mut().zip(pixels).for_each(|(byte, &pixel)| *byte = pixel as u8),
            Self::Bits10 | Self::Bits12 | Self::Bits16 => {
                for (word, &pixel) in bytes.as_chunks_mut::<2>().0.iter_mut().zip(pixels) {
                    *word = (pixel & self.max_value()).to_le_bytes();
                }
            }
            Self::Bits10p => pack_stream(10, pixels, bytes),
            Self::Bits12p => pack_stream(12, pixels, bytes),
            Self::Bits10Packed => pack_gige(10, pixels, bytes),
            Self::Bits12Packed => pack_gige(12, pixels, bytes),
            Self::Bits10g40 => pack_mipi(10, pixels, bytes),
            Self::Bits12g24 => pack_mipi(12, pixels, bytes),
        }
    }
}

/// Pixel `i` occupies bits `i * bits ..` of the stream, counted from the least significant bit of byte 0.
fn unpack_stream(bits: usize, bytes: &[u8], pixels: &mut [u16]) {
    let mask = (1_u32 << bits) - 1;
    for (index, pixel) in pixels.iter_mut().enumerate() {
        let (byte, shift) = (index * bits / 8, index * bits % 8);
        let word = u32::from(bytes[byte]) | u32::from(bytes[byte + 1]) << 8;
        *pixel = (word >> shift & mask) as u16;
    }
}

fn pack_stream(bits: usize, pixels: &[u16], bytes: &mut [u8]) {
    bytes.fill(0);
    let mask = (1_u32 << bits) - 1;
    for (index, &pixel) in pixels.iter().enumerate() {
        let (byte, shift) = (index * bits / 8, index * bits % 8);
        let word = (u32::from(pixel) & mask) << shift;
        bytes[byte] |= word as u8;
        bytes[byte + 1] |= (word >> 8) as u8;
    }
}

/// Location of pixel `index` in GigE Vision 1: its high byte, the byte with its low bits, and the first bit of these.
fn gige_place(index: usize) -> (usize, usize, u32) {
    let group = index / 2 * 3;
    if index.is_multiple_of(2) { (group, group + 1, 0) } else { (group + 2, group + 1, 4) }
}

/// The same for MIPI CSI-2: each pixel has `low_bits` low bits, and a group has as many pixels as fill a byte with
/// them.
fn mipi_place(low_bits: usize, index: usize) -> (usize, usize, u32) {
    let pixels = 8 / low_bits;
    let (group, within) = (index / pixels * (pixels + 1), index % pixels);
    (group + within, group + pixels, (within * low_bits) as u32)
}

fn unpack_gige(bits: u32, bytes: &[u8], pixels: &mut [u16]) {
    unpack_grouped(bits - 8, bytes, pixels, gige_place);
}

fn pack_gige(bits: u32, pixels: &[u16], bytes: &mut [u8]) {
    pack_grouped(bits - 8, pixels, bytes, gige_place);
}

fn unpack_mipi(bits: u32, bytes: &[u8], pixels: &mut [u16]) {
    unpack_grouped(bits - 8, bytes, pixels, |index| mipi_place(bits as usize - 8, index));
}

fn pack_mipi(bits: u32, pixels: &[u16], bytes: &mut [u8]) {
    pack_grouped(bits - 8, pixels, bytes, |index| mipi_place(bits as usize - 8, index));
}

fn unpack_grouped(
    low_bits: u32,
    bytes: &[u8],
    pixels: &mut [u16],
    place: impl Fn(usize) -> (usize, usize, u32),
) {
    let mask = (1 << low_bits) - 1;
    for (index, pixel) in pixels.iter_mut().enumerate() {
        let (high, low, shift) = place(index);
        *pixel = u16::from(bytes[high]) << low_bits | u16::from(bytes[low]) >> shift & mask;
    }
}

fn pack_grouped(
    low_bits: u32,
    pixels: &[u16],
    bytes: &mut [u8],
    place: impl Fn(usize) -> (usize, usize, u32),
) {
    bytes.fill(0);
    let mask = (1 << low_bits) - 1;
    for (index, &pixel) in pixels.iter().enumerate() {
        let (high, low, shift) = place(index);
        bytes[high] = (pixel >> low_bits) as u8;
        bytes[low] |= ((pixel & mask) << shift) as u8;
    }
}
