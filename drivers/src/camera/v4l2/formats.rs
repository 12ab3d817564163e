//! V4L2's four-character codes of pixel formats.

use raysweep_core::{Mosaic, Packing, PixelFormat};

/// The four-character code of a format (`linux/videodev2.h`), if V4L2 has one.
pub fn fourcc(format: PixelFormat) -> Option<[u8; 4]> {
    // In the order of the mosaics: none, GR, RG, GB, BG.
    let codes: [&[u8; 4]; 5] = match format.packing {
        Packing::Bits8 => [b"GREY", b"GRBG", b"RGGB", b"GBRG", b"BA81"],
        Packing::Bits10 => [b"Y10 ", b"BA10", b"RG10", b"GB10", b"BG10"],
        Packing::Bits12 => [b"Y12 ", b"BA12", b"RG12", b"GB12", b"BG12"],
        Packing::Bits16 => [b"Y16 ", b"GR16", b"RG16", b"GB16", b"BYR2"],
        Packing::Bits10g40 => [b"Y10P", b"pgAA", b"pRAA", b"pGAA", b"pBAA"],
        Packing::Bits12g24 => [b"Y12P", b"pgCC", b"pRCC", b"pGCC", b"pBCC"],
        Packing::Bits10p | Packing::Bits12p | Packing::Bits10Packed | Packing::Bits12Packed => return None,
    };
    let order = [Mosaic::Mono, Mosaic::BayerGR, Mosaic::BayerRG, Mosaic::BayerGB, Mosaic::BayerBG];
    order.into_iter().zip(codes).find(|(mosaic, _)| *mosaic == format.mosaic).map(|(_, code)| *code)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_the_kernels() {
        let cases = [
            ("Mono8", b"GREY"),
            ("Mono10", b"Y10 "),
            ("Mono12g24", b"Y12P"),
            ("BayerBG8", b"BA81"),
            ("BayerGR10", b"BA10"),
            ("BayerGB12", b"GB12"),
            ("BayerRG12g24", b"pRCC"),
            ("BayerGR10g40", b"pgAA"),
            ("BayerGB10g40", b"pGAA"),
            ("BayerBG16", b"BYR2"),
        ];
        for (name, code) in cases {
            assert_eq!(fourcc(name.parse().unwrap()), Some(*code), "{name}");
        }
        // The bit layout of GenICam's packed formats differs from MIPI's.
        assert_eq!(fourcc(PixelFormat::Mono12p), None);
        let mut codes: Vec<_> = PixelFormat::all().filter_map(fourcc).collect();
        codes.sort_unstable();
        codes.dedup();
        assert_eq!(codes.len(), 30, "each format has a code of its own");
    }
}
