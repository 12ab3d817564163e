#![no_main]
//! Feeds samples of an analyser in blocks; the first byte of each block is its length. The changes must be those
//! between successive samples.

use libfuzzer_sys::fuzz_target;
use raysweep_drivers::vsync::fx2lafw::scan::Scanner;

fuzz_target!(|data: &[u8]| {
    let Some((&mask, mut rest)) = data.split_first() else { return };
    let mut scanner = Scanner::new(mask);
    let (mut last, mut samples) = (None, 0_u64);
    while let [length, after @ ..] = rest {
        let (block, later) = after.split_at(after.len().min(usize::from(*length)));
        let mut seen = Vec::new();
        scanner.scan(block, |sample, levels, changed| seen.push((sample, levels & mask, changed)));
        let mut expected = Vec::new();
        for &level in block {
            let changed = last.map_or(0, |last: u8| (level ^ last) & mask);
            if changed != 0 {
                expected.push((samples, level & mask, changed));
            }
            last = Some(level);
            samples += 1;
        }
        assert_eq!(seen, expected);
        rest = later;
    }
});
