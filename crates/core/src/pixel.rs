//! Pixel formats by their GenICam (PFNC 2.4) names and codes, and the plain way to unpack and pack them.

use serde::{Deserialize, Serialize};

/// How a camera packs its pixels. Names and codes are those of the GenICam Pixel Format Naming Convention.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum PixelFormat {
    /// 8 bits in a byte.
    Mono8,
    /// 10 bits in a little-endian 16-bit word.
    Mono10,
    /// 12 bits in a little-endian 16-bit word.
    Mono12,
    /// A little-endian 16-bit word.
    Mono16,
    /// Four 10-bit pixels in five bytes, least significant bits first, without gaps.
    Mono10p,
    /// Two 12-bit pixels in three bytes, least significant bits first, without gaps.
    Mono12p,
    /// Two 12-bit pixels in three bytes, GigE Vision's older order: high bytes outside, low nibbles in the middle.
    Mono12Packed,
    /// A Bayer mosaic (red top left), 12 bits in a little-endian 16-bit word.
    BayerRG12,
    /// The same mosaic packed like [`PixelFormat::Mono12p`].
    BayerRG12p,
    /// The same mosaic packed like [`PixelFormat::Mono12Packed`].
    BayerRG12Packed,
}

/// Why bytes could not be unpacked or pixels packed.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a {format:?} frame of {pixels} pixels has {expected} bytes, this one has {actual}: check the camera's region and pixel format"
)]
pub struct PixelError {
    format: PixelFormat,
    pixels: usize,
    expected: usize,
    actual: usize,
}

/// The bit layouts that the formats share.
enum Layout {
    Bytes,
    Words,
    Lsb10,
    Lsb12,
    Gev12,
}

impl PixelFormat {
    /// The 32-bit PFNC code.
    pub fn pfnc(self) -> u32 {
        match self {
            Self::Mono8 => 0x0108_0001,
            Self::Mono10 => 0x0110_0003,
            Self::Mono12 => 0x0110_0005,
            Self::Mono16 => 0x0110_0007,
            Self::Mono10p => 0x010A_0046,
            Self::Mono12p => 0x010C_0047,
            Self::Mono12Packed => 0x010C_0006,
            Self::BayerRG12 => 0x0110_0011,
            Self::BayerRG12p => 0x010C_0059,
            Self::BayerRG12Packed => 0x010C_002B,
        }
    }

    /// Significant bits of a pixel.
    pub fn bits(self) -> u32 {
        match self {
            Self::Mono8 => 8,
            Self::Mono10 | Self::Mono10p => 10,
            Self::Mono12
            | Self::Mono12p
            | Self::Mono12Packed
            | Self::BayerRG12
            | Self::BayerRG12p
            | Self::BayerRG12Packed => 12,
            Self::Mono16 => 16,
        }
    }

    /// The largest value of a pixel.
    pub fn max_value(self) -> u16 {
        u16::try_from((1_u32 << self.bits()) - 1).unwrap_or(u16::MAX)
    }

    /// Whether neighbouring pixels see different colours (a Bayer mosaic, red top left).
    pub fn is_mosaic(self) -> bool {
        matches!(self, Self::BayerRG12 | Self::BayerRG12p | Self::BayerRG12Packed)
    }

    fn layout(self) -> Layout {
        match self {
            Self::Mono8 => Layout::Bytes,
            Self::Mono10 | Self::Mono12 | Self::Mono16 | Self::BayerRG12 => Layout::Words,
            Self::Mono10p => Layout::Lsb10,
            Self::Mono12p | Self::BayerRG12p => Layout::Lsb12,
            Self::Mono12Packed | Self::BayerRG12Packed => Layout::Gev12,
        }
    }

    /// Bytes of a frame of `pixels` pixels; a packed frame ends with a whole byte.
    pub fn frame_bytes(self, pixels: usize) -> usize {
        match self.layout() {
            Layout::Bytes => pixels,
            Layout::Words => pixels * 2,
            Layout::Lsb10 => (pixels * 10).div_ceil(8),
            Layout::Lsb12 | Layout::Gev12 => (pixels * 12).div_ceil(8),
        }
    }

    fn checked(self, pixels: usize, actual: usize) -> Result<(), PixelError> {
        let expected = self.frame_bytes(pixels);
        if actual == expected { Ok(()) } else { Err(PixelError { format: self, pixels, expected, actual }) }
    }

    /// Unpacks a frame to one `u16` a pixel: the plain reference for every faster way.
    ///
    /// # Errors
    /// When `bytes` is not exactly a frame of `pixels.len()` pixels.
    pub fn unpack_into(self, bytes: &[u8], pixels: &mut [u16]) -> Result<(), PixelError> {
        self.checked(pixels.len(), bytes.len())?;
        match self.layout() {
            Layout::Bytes => pixels.iter_mut().zip(bytes).for_each(|(pixel, &byte)| *pixel = u16::from(byte)),
            Layout::Words => {
                for (pixel, word) in pixels.iter_mut().zip(bytes.as_chunks::<2>().0) {
                    *pixel = u16::from_le_bytes(*word);
                }
            }
            Layout::Lsb10 => unpack_lsb(10, bytes, pixels),
            Layout::Lsb12 => unpack_lsb(12, bytes, pixels),
            Layout::Gev12 => {
                for (index, pixel) in pixels.iter_mut().enumerate() {
                    let base = index / 2 * 3;
                    let middle = u16::from(bytes[base + 1]);
                    *pixel = if index % 2 == 0 {
                        u16::from(bytes[base]) << 4 | middle & 0xF
                    } else {
                        u16::from(bytes[base + 2]) << 4 | middle >> 4
                    };
                }
            }
        }
        Ok(())
    }

    /// Packs pixels into a frame, as a camera does; bits beyond [`PixelFormat::bits`] are cut off.
    ///
    /// # Errors
    /// When `bytes` is not exactly a frame of `pixels.len()` pixels.
    pub fn pack_into(self, pixels: &[u16], bytes: &mut [u8]) -> Result<(), PixelError> {
        self.checked(pixels.len(), bytes.len())?;
        match self.layout() {
            Layout::Bytes => bytes.iter_mut().zip(pixels).for_each(|(byte, &pixel)| *byte = pixel as u8),
            Layout::Words => {
                for (word, &pixel) in bytes.as_chunks_mut::<2>().0.iter_mut().zip(pixels) {
                    *word = (pixel & self.max_value()).to_le_bytes();
                }
            }
            Layout::Lsb10 => pack_lsb(10, pixels, bytes),
            Layout::Lsb12 => pack_lsb(12, pixels, bytes),
            Layout::Gev12 => {
                for (triple, pair) in bytes.chunks_mut(3).zip(pixels.chunks(2)) {
                    let (first, second) = (pair[0], pair.get(1).copied().unwrap_or(0));
                    triple[0] = (first >> 4) as u8;
                    triple[1] = (first & 0xF | (second & 0xF) << 4) as u8;
                    if let Some(last) = triple.get_mut(2) {
                        *last = (second >> 4) as u8;
                    }
                }
            }
        }
        Ok(())
    }
}

/// Pixel `i` occupies bits `i * bits ..` of the stream, counted from the least significant bit of byte 0.
fn unpack_lsb(bits: usize, bytes: &[u8], pixels: &mut [u16]) {
    let mask = (1_u32 << bits) - 1;
    for (index, pixel) in pixels.iter_mut().enumerate() {
        let (byte, shift) = (index * bits / 8, index * bits % 8);
        let word = u32::from(bytes[byte]) | u32::from(bytes[byte + 1]) << 8;
        *pixel = (word >> shift & mask) as u16;
    }
}

fn pack_lsb(bits: usize, pixels: &[u16], bytes: &mut [u8]) {
    bytes.fill(0);
    let mask = (1_u32 << bits) - 1;
    for (index, &pixel) in pixels.iter().enumerate() {
        let (byte, shift) = (index * bits / 8, index * bits % 8);
        let word = (u32::from(pixel) & mask) << shift;
        bytes[byte] |= word as u8;
        bytes[byte + 1] |= (word >> 8) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [PixelFormat; 10] = [
        PixelFormat::Mono8,
        PixelFormat::Mono10,
        PixelFormat::Mono12,
        PixelFormat::Mono16,
        PixelFormat::Mono10p,
        PixelFormat::Mono12p,
        PixelFormat::Mono12Packed,
        PixelFormat::BayerRG12,
        PixelFormat::BayerRG12p,
        PixelFormat::BayerRG12Packed,
    ];

    #[test]
    fn bit_orders_are_the_standards() {
        // Vectors worked by hand from PFNC's layout figures.
        let cases: [(PixelFormat, &[u8], &[u16]); 5] = [
            (PixelFormat::Mono12p, &[0xBC, 0x3A, 0x12], &[0xABC, 0x123]),
            (PixelFormat::Mono12Packed, &[0xAB, 0x3C, 0x12], &[0xABC, 0x123]),
            (PixelFormat::Mono10p, &[0xFF, 0x03, 0x00, 0xC0, 0xFF], &[0x3FF, 0, 0, 0x3FF]),
            (PixelFormat::Mono12, &[0xBC, 0x0A, 0x23, 0x01], &[0xABC, 0x123]),
            (PixelFormat::Mono12p, &[0xBC, 0x0A], &[0xABC]),
        ];
        for (format, bytes, expected) in cases {
            let mut pixels = vec![0; expected.len()];
            format.unpack_into(bytes, &mut pixels).unwrap();
            assert_eq!(pixels, expected, "{format:?}");
        }
    }

    #[test]
    fn codes_state_the_bits_that_a_pixel_occupies() {
        for format in ALL {
            let bits = format.pfnc() >> 16 & 0xFF;
            assert_eq!(format.frame_bytes(80) * 8, 80 * bits as usize, "{format:?}");
        }
    }

    #[test]
    fn unpacking_undoes_packing_at_every_length() {
        for format in ALL {
            for length in 1..40_usize {
                let pixels: Vec<u16> =
                    (0..length).map(|i| (i as u16).wrapping_mul(40_503) & format.max_value()).collect();
                let mut bytes = vec![0xA5; format.frame_bytes(length)];
                format.pack_into(&pixels, &mut bytes).unwrap();
                let mut back = vec![0; length];
                format.unpack_into(&bytes, &mut back).unwrap();
                assert_eq!(back, pixels, "{format:?} x {length}");
            }
        }
    }

    #[test]
    fn a_frame_of_the_wrong_size_is_refused() {
        let error = PixelFormat::Mono12p.unpack_into(&[0; 5], &mut [0; 4]).unwrap_err();
        assert!(error.to_string().contains("6 bytes"), "{error}");
    }
}
