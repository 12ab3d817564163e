use super::*;
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};

/// Vectors worked out by hand from the figures of PFNC 2.4, GigE Vision 2.0 (pixel payload formats) and MIPI CSI-2 as
/// documented by V4L2 (Y10P, Y12P): each bit of the first pixels is where the figure shows it.
#[test]
fn bit_orders_are_the_standards() {
    let cases: [(&str, &[u8], &[u16]); 18] = [
        ("Mono8", &[0xAB, 0x01], &[0xAB, 0x01]),
        ("Mono10", &[0xBC, 0x02, 0x23, 0x01], &[0x2BC, 0x123]),
        ("Mono12", &[0xBC, 0x0A, 0x23, 0x01], &[0xABC, 0x123]),
        ("Mono16", &[0xBC, 0x9A, 0x23, 0x01], &[0x9ABC, 0x0123]),
        ("Mono12p", &[0xBC, 0x3A, 0x12], &[0xABC, 0x123]),
        ("Mono12p", &[0xBC, 0x0A], &[0xABC]),
        ("Mono12Packed", &[0xAB, 0x3C, 0x12], &[0xABC, 0x123]),
        ("Mono12Packed", &[0xAB, 0x0C], &[0xABC]),
        ("Mono12g24", &[0xAB, 0x12, 0x3C], &[0xABC, 0x123]),
        ("Mono10p", &[0xFF, 0x03, 0x00, 0xC0, 0xFF], &[0x3FF, 0, 0, 0x3FF]),
        // 1, 2, 4, 8 in ten bits each: ...1 | ...10 | ...100 | ...1000 from bit 0 on.
        ("Mono10p", &[0x01, 0x08, 0x40, 0x00, 0x02], &[1, 2, 4, 8]),
        ("Mono10p", &[0x00, 0x00, 0xF0, 0x3F], &[0, 0, 0x3FF]),
        // Bits 2, 3, 6 and 7 of the middle byte are unused.
        ("Mono10Packed", &[0xAB, 0xDE, 0x12], &[0x2AE, 0x049]),
        ("Mono10Packed", &[0xAB, 0x02], &[0x2AE]),
        ("Mono10g40", &[0xAA, 0x55, 0xFF, 0x00, 0b11_10_01_00], &[0x2A8, 0x155, 0x3FE, 0x003]),
        ("BayerGB12p", &[0xBC, 0x3A, 0x12], &[0xABC, 0x123]),
        ("BayerBG12Packed", &[0xAB, 0x3C, 0x12], &[0xABC, 0x123]),
        ("BayerGR10g40", &[0x00, 0x00, 0x00, 0xFF, 0b01_00_00_10], &[2, 0, 0, 0x3FD]),
    ];
    for (name, bytes, expected) in cases {
        let format: PixelFormat = name.parse().unwrap();
        for unpack in [PixelFormat::unpack_plain, PixelFormat::unpack_into] {
            let mut pixels = vec![0; expected.len()];
            unpack(format, bytes, &mut pixels).unwrap();
            assert_eq!(pixels, expected, "{format}");
        }
    }
}

/// Bytes without a pattern that could hide a wrong shuffle.
fn noise(length: usize) -> Vec<u8> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    (0..length).map(|_| random.next_u64() as u8).collect()
}

#[test]
fn every_level_gives_the_plain_pixels_at_every_length_and_alignment() {
    for packing in Packing::ALL {
        let format = PixelFormat::new(Mosaic::Mono, packing);
        let lengths = (0..=150).chain(1020..1030).chain([5000]);
        for length in lengths {
            let size = format.frame_bytes(length);
            let data = noise(size + 32);
            for offset in (0..32).step_by(if length > 40 { 7 } else { 1 }) {
                let bytes = &data[offset..offset + size];
                let mut plain = vec![0; length];
                format.unpack_plain(bytes, &mut plain).unwrap();
                for &level in UnpackLevel::available() {
                    // The alignment of the pixels varies too; memory next to them must not change.
                    let mut pixels = vec![0xA5A5; length + 16];
                    let start = offset % 16;
                    format.unpack_with(level, bytes, &mut pixels[start..start + length]).unwrap();
                    assert_eq!(
                        pixels[start..start + length],
                        plain,
                        "{format} x {length} + {offset}, {level:?}"
                    );
                    let beside = pixels[..start].iter().chain(&pixels[start + length..]);
                    assert!(beside.copied().all(|pixel| pixel == 0xA5A5), "{format} x {length}, {level:?}");
                }
                let mut sums: Vec<u32> = (0..length as u32).collect();
                format.add_to(bytes, &mut sums).unwrap();
                for ((sum, pixel), before) in sums.iter().zip(&plain).zip(0..) {
                    assert_eq!(*sum, u32::from(*pixel) + before, "{format} x {length} + {offset}");
                }
            }
        }
    }
}

#[test]
fn unpacking_undoes_packing_at_every_length() {
    for format in PixelFormat::all() {
        for length in 1..40_usize {
            let pixels: Vec<u16> =
                (0..length).map(|i| (i as u16).wrapping_mul(40_503) & format.max_value()).collect();
            let mut bytes = vec![0xA5; format.frame_bytes(length)];
            format.pack_into(&pixels, &mut bytes).unwrap();
            let mut back = vec![0; length];
            format.unpack_plain(&bytes, &mut back).unwrap();
            assert_eq!(back, pixels, "{format} x {length}");
        }
    }
}

/// The codes from the header of a GigE Vision library, a few from each row and column of the table.
#[test]
fn names_and_codes_are_the_conventions() {
    let cases = [
        ("Mono8", 0x0108_0001),
        ("Mono10", 0x0110_0003),
        ("Mono10Packed", 0x010C_0004),
        ("Mono12", 0x0110_0005),
        ("Mono12Packed", 0x010C_0006),
        ("Mono16", 0x0110_0007),
        ("Mono10p", 0x010A_0046),
        ("Mono12p", 0x010C_0047),
        ("BayerGR8", 0x0108_0008),
        ("BayerRG8", 0x0108_0009),
        ("BayerGB8", 0x0108_000A),
        ("BayerBG8", 0x0108_000B),
        ("BayerGR10", 0x0110_000C),
        ("BayerBG10", 0x0110_000F),
        ("BayerRG12", 0x0110_0011),
        ("BayerGB12", 0x0110_0012),
        ("BayerGR10Packed", 0x010C_0026),
        ("BayerBG10Packed", 0x010C_0029),
        ("BayerRG12Packed", 0x010C_002B),
        ("BayerBG12Packed", 0x010C_002D),
        ("BayerGR16", 0x0110_002E),
        ("BayerGB16", 0x0110_0030),
        ("BayerBG10p", 0x010A_0052),
        ("BayerGB10p", 0x010A_0054),
        ("BayerGR10p", 0x010A_0056),
        ("BayerRG10p", 0x010A_0058),
        ("BayerBG12p", 0x010C_0053),
        ("BayerGB12p", 0x010C_0055),
        ("BayerGR12p", 0x010C_0057),
        ("BayerRG12p", 0x010C_0059),
    ];
    for (name, code) in cases {
        let format = PixelFormat::from_pfnc(code).unwrap();
        assert_eq!((format.to_string().as_str(), format.pfnc()), (name, Some(code)));
    }
    let mut codes: Vec<u32> = PixelFormat::all().filter_map(PixelFormat::pfnc).collect();
    codes.sort_unstable();
    codes.dedup();
    assert_eq!(codes.len(), 40, "each format has a code of its own");
    assert_eq!(PixelFormat::Mono10g40.pfnc(), None);
}

#[test]
fn codes_state_the_bits_that_a_pixel_occupies() {
    for format in PixelFormat::all() {
        if let Some(code) = format.pfnc() {
            assert_eq!(format.frame_bytes(80) * 8, 80 * (code >> 16 & 0xFF) as usize, "{format}");
        }
    }
}

#[test]
fn names_come_back_and_others_are_refused() {
    for format in PixelFormat::all() {
        assert_eq!(format.to_string().parse(), Ok(format));
    }
    for name in ["", "Mono", "Mono13", "mono8", "BayerRG", "RGB8", "Mono12pp", "BayerRGMono8"] {
        let error = name.parse::<PixelFormat>().unwrap_err();
        assert!(error.to_string().contains(&format!("{name:?}")), "{error}");
    }
}

#[test]
fn a_frame_of_the_wrong_size_is_refused() {
    let error = PixelFormat::Mono12p.unpack_into(&[0; 5], &mut [0; 4]).unwrap_err();
    assert!(error.to_string().contains("6 bytes"), "{error}");
    let mut sums = [7; 4];
    PixelFormat::Mono12p.add_to(&[0xFF; 7], &mut sums).unwrap_err();
    let mut reached = sums;
    PixelFormat::Mono12p.add_counting(&[0xFF; 7], &mut sums, 1, &mut reached).unwrap_err();
    assert_eq!(sums, [7; 4]);
}

#[test]
fn pixels_at_the_limit_are_counted_while_they_are_added() {
    let pixels: Vec<u16> = (0..5000).map(|n| (n * 37 % 4096) as u16).collect();
    for format in [PixelFormat::Mono12p, PixelFormat::Mono16] {
        let mut bytes = vec![0; format.frame_bytes(pixels.len())];
        format.pack_into(&pixels, &mut bytes).unwrap();
        let [mut sums, mut plain, mut reached] = [(); 3].map(|()| vec![0; pixels.len()]);
        for _ in 0..3 {
            format.add_to(&bytes, &mut plain).unwrap();
            assert!(format.add_counting(&bytes, &mut sums, 4000, &mut reached).unwrap());
        }
        assert_eq!(sums, plain);
        let expected: Vec<u32> = pixels.iter().map(|&pixel| if pixel >= 4000 { 3 } else { 0 }).collect();
        assert_eq!(reached, expected);
        assert!(!format.add_counting(&bytes, &mut sums, 4096, &mut reached).unwrap());
    }
}
