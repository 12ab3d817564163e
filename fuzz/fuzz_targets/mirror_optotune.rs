#![no_main]
//! Feeds bytes from a controller in chunks; the first byte of each chunk is its length.

use libfuzzer_sys::fuzz_target;
use raysweep_drivers::mirror::parse_optotune;
use raysweep_drivers::serial::wire::{LONGEST_REPLY, Receiver};

fuzz_target!(|data: &[u8]| {
    let mut receiver = Receiver::default();
    let mut rest = data;
    while let [length, after @ ..] = rest {
        let (piece, later) = after.split_at(after.len().min(usize::from(*length)));
        receiver.push(piece);
        while receiver.next(parse_optotune).is_some() {}
        assert!(receiver.waiting_bytes() < LONGEST_REPLY);
        rest = later;
    }
});
