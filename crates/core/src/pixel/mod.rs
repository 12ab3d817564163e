//! Pixel formats by their GenICam (PFNC 2.4) names and codes.

mod packing;
mod unpack;

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

pub use self::packing::Packing;
pub use self::unpack::UnpackLevel;

/// What a pixel sees: all light, or one colour of a Bayer mosaic, which is named by the first two pixels of its first
/// row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mosaic {
    /// No mosaic.
    Mono,
    /// Green, red; below them blue, green.
    BayerGR,
    /// Red, green; below them green, blue.
    BayerRG,
    /// Green, blue; below them red, green.
    BayerGB,
    /// Blue, green; below them green, red.
    BayerBG,
}

impl Mosaic {
    /// All mosaics.
    pub const ALL: [Self; 5] = [Self::Mono, Self::BayerGR, Self::BayerRG, Self::BayerGB, Self::BayerBG];

    /// Number of colours of its demosaiced images.
    pub fn channels(self) -> usize {
        if self.red().is_some() { 3 } else { 1 }
    }

    /// Column and row (0 or 1) of the red pixel in the mosaic's 2 x 2 cell; `None` for [`Mosaic::Mono`].
    pub fn red(self) -> Option<(usize, usize)> {
        match self {
            Self::Mono => None,
            Self::BayerRG => Some((0, 0)),
            Self::BayerGR => Some((1, 0)),
            Self::BayerGB => Some((0, 1)),
            Self::BayerBG => Some((1, 1)),
        }
    }

    fn prefix(self) -> &'static str {
        match self {
            Self::Mono => "Mono",
            Self::BayerGR => "BayerGR",
            Self::BayerRG => "BayerRG",
            Self::BayerGB => "BayerGB",
            Self::BayerBG => "BayerBG",
        }
    }
}

/// How a camera delivers its pixels: every mosaic in every packing. Files and messages use the names of the GenICam
/// Pixel Format Naming Convention.
#[derive(Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct PixelFormat {
    /// The colours that its pixels see.
    pub mosaic: Mosaic,
    /// The layout of its pixels in memory.
    pub packing: Packing,
}

/// The formats that code refers to by name.
#[allow(non_upper_case_globals, reason = "the names are the convention's")]
#[allow(missing_docs, reason = "mosaic and packing say it")]
impl PixelFormat {
    pub const Mono8: Self = Self::new(Mosaic::Mono, Packing::Bits8);
    pub const Mono10: Self = Self::new(Mosaic::Mono, Packing::Bits10);
    pub const Mono12: Self = Self::new(Mosaic::Mono, Packing::Bits12);
    pub const Mono16: Self = Self::new(Mosaic::Mono, Packing::Bits16);
    pub const Mono10p: Self = Self::new(Mosaic::Mono, Packing::Bits10p);
    pub const Mono12p: Self = Self::new(Mosaic::Mono, Packing::Bits12p);
    pub const Mono10Packed: Self = Self::new(Mosaic::Mono, Packing::Bits10Packed);
    pub const Mono12Packed: Self = Self::new(Mosaic::Mono, Packing::Bits12Packed);
    pub const Mono10g40: Self = Self::new(Mosaic::Mono, Packing::Bits10g40);
    pub const Mono12g24: Self = Self::new(Mosaic::Mono, Packing::Bits12g24);
    pub const BayerRG12: Self = Self::new(Mosaic::BayerRG, Packing::Bits12);
    pub const BayerRG12p: Self = Self::new(Mosaic::BayerRG, Packing::Bits12p);
    pub const BayerRG12Packed: Self = Self::new(Mosaic::BayerRG, Packing::Bits12Packed);
}

/// Why bytes could not be unpacked or pixels packed.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a {format} frame of {pixels} pixels has {expected} bytes, this one has {actual}: check the camera's region and pixel format"
)]
pub struct PixelError {
    format: PixelFormat,
    pixels: usize,
    expected: usize,
    actual: usize,
}

/// A name that is not the name of a pixel format.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "no pixel format is called {0:?}: give Mono, BayerGR, BayerRG, BayerGB or BayerBG, then 8, 10, 12, 16, 10p, 12p, 10Packed, 12Packed, 10g40 or 12g24, as in Mono12p"
)]
pub struct UnknownPixelFormat(String);

impl PixelFormat {
    /// The pixel format with this mosaic and packing.
    pub const fn new(mosaic: Mosaic, packing: Packing) -> Self {
        Self { mosaic, packing }
    }

    /// All formats.
    pub fn all() -> impl Iterator<Item = Self> {
        Mosaic::ALL
            .into_iter()
            .flat_map(|mosaic| Packing::ALL.into_iter().map(move |packing| Self::new(mosaic, packing)))
    }

    /// The format with a 32-bit PFNC code.
    pub fn from_pfnc(code: u32) -> Option<Self> {
        Self::all().find(|format| format.pfnc() == Some(code))
    }

    /// The 32-bit PFNC code; `None` for the packings of MIPI CSI-2, which have none.
    pub fn pfnc(self) -> Option<u32> {
        const MONOCHROME: u32 = 0x0100_0000;
        // PFNC numbers of the mosaics, in the order of `Mosaic`.
        let numbers: [u32; 5] = match self.packing {
            Packing::Bits8 => [0x01, 0x08, 0x09, 0x0A, 0x0B],
            Packing::Bits10 => [0x03, 0x0C, 0x0D, 0x0E, 0x0F],
            Packing::Bits12 => [0x05, 0x10, 0x11, 0x12, 0x13],
            Packing::Bits16 => [0x07, 0x2E, 0x2F, 0x30, 0x31],
            Packing::Bits10p => [0x46, 0x56, 0x58, 0x54, 0x52],
            Packing::Bits12p => [0x47, 0x57, 0x59, 0x55, 0x53],
            Packing::Bits10Packed => [0x04, 0x26, 0x27, 0x28, 0x29],
            Packing::Bits12Packed => [0x06, 0x2A, 0x2B, 0x2C, 0x2D],
            Packing::Bits10g40 | Packing::Bits12g24 => return None,
        };
        Some(MONOCHROME | self.packing.occupied_bits() << 16 | numbers[self.mosaic as usize])
    }

    /// Significant bits of a pixel.
    pub fn bits(self) -> u32 {
        self.packing.bits()
    }

    /// The largest value of a pixel.
    pub fn max_value(self) -> u16 {
        self.packing.max_value()
    }

    /// Bytes in a frame of `pixels` pixels. A packed frame is padded to a whole byte, or to a whole group if it is
    /// packed in groups.
    pub fn frame_bytes(self, pixels: usize) -> usize {
        self.packing.bytes(pixels)
    }

    fn checked(self, pixels: usize, actual: usize) -> Result<(), PixelError> {
        let expected = self.frame_bytes(pixels);
        if actual == expected { Ok(()) } else { Err(PixelError { format: self, pixels, expected, actual }) }
    }

    /// Unpacks a frame to one `u16` per pixel with the fastest instructions of this machine.
    ///
    /// # Errors
    /// If `bytes` is not exactly a frame of `pixels.len()` pixels.
    pub fn unpack_into(self, bytes: &[u8], pixels: &mut [u16]) -> Result<(), PixelError> {
        self.unpack_with(UnpackLevel::best(), bytes, pixels)
    }

    /// Unpacks a frame with the given instruction level; all levels give the same pixels.
    ///
    /// # Errors
    /// If `bytes` is not exactly a frame of `pixels.len()` pixels.
    pub fn unpack_with(self, level: UnpackLevel, bytes: &[u8], pixels: &mut [u16]) -> Result<(), PixelError> {
        self.checked(pixels.len(), bytes.len())?;
        unpack::unpack(level, self.packing, bytes, pixels);
        Ok(())
    }

    /// Unpacks a frame pixel by pixel, as the packing is defined: the reference for all faster implementations.
    ///
    /// # Errors
    /// If `bytes` is not exactly a frame of `pixels.len()` pixels.
    pub fn unpack_plain(self, bytes: &[u8], pixels: &mut [u16]) -> Result<(), PixelError> {
        self.checked(pixels.len(), bytes.len())?;
        self.packing.unpack(bytes, pixels);
        Ok(())
    }

    /// Adds a frame's pixels to `sums`, without writing the unpacked frame to memory.
    ///
    /// # Errors
    /// If `bytes` is not exactly a frame of `sums.len()` pixels; `sums` is then unchanged.
    pub fn add_to(self, bytes: &[u8], sums: &mut [u32]) -> Result<(), PixelError> {
        self.checked(sums.len(), bytes.len())?;
        unpack::add(UnpackLevel::best(), self.packing, bytes, sums);
        Ok(())
    }

    /// [`Self::add_to`] that also adds 1 to `reached`, as long as `sums`, for each pixel of at least `limit_dn`. Returns
    /// whether there is such a pixel.
    ///
    /// # Errors
    /// If `bytes` is not exactly a frame of `sums.len()` and `reached.len()` pixels; both are then unchanged.
    pub fn add_counting(
        self,
        bytes: &[u8],
        sums: &mut [u32],
        limit_dn: u16,
        reached: &mut [u32],
    ) -> Result<bool, PixelError> {
        self.checked(sums.len(), bytes.len())?;
        self.checked(reached.len(), bytes.len())?;
        Ok(unpack::add_counting(UnpackLevel::best(), self.packing, bytes, sums, (limit_dn, reached)))
    }

    /// Packs pixels into a frame, as a camera does; bits beyond [`PixelFormat::bits`] are cut off.
    ///
    /// # Errors
    /// If `bytes` is not exactly a frame of `pixels.len()` pixels.
    pub fn pack_into(self, pixels: &[u16], bytes: &mut [u8]) -> Result<(), PixelError> {
        self.checked(pixels.len(), bytes.len())?;
        self.packing.pack(pixels, bytes);
        Ok(())
    }
}

impl fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.mosaic.prefix(), self.packing.suffix())
    }
}

impl fmt::Debug for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for PixelFormat {
    type Err = UnknownPixelFormat;

    fn from_str(name: &str) -> Result<Self, UnknownPixelFormat> {
        let named = |format: &Self| {
            name.strip_prefix(format.mosaic.prefix()).is_some_and(|suffix| suffix == format.packing.suffix())
        };
        Self::all().find(named).ok_or_else(|| UnknownPixelFormat(name.to_owned()))
    }
}

impl TryFrom<String> for PixelFormat {
    type Error = UnknownPixelFormat;

    fn try_from(name: String) -> Result<Self, UnknownPixelFormat> {
        name.parse()
    }
}

impl From<PixelFormat> for String {
    fn from(format: PixelFormat) -> Self {
        format.to_string()
    }
}

#[cfg(test)]
mod tests;
