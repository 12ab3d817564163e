//! Seeded noise for parsers of replies.

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use raysweep_drivers::serial::wire::{LONGEST_REPLY, Parsed, Receiver};

const BYTES: usize = 10_000_000;

/// Feeds noise in pieces of every size: uniform bytes, and bytes of `alphabet`, which occur in replies and get further
/// into a parser. No bytes may accumulate. Returns the number of bytes pushed, the number of those in replies, which
/// have this `length` at least, and the receiver.
pub fn survives<R>(
    parse: impl Fn(&[u8]) -> Parsed<R> + Copy,
    alphabet: &[u8],
    length: impl Fn(&R) -> usize,
) -> (usize, usize, Receiver) {
    let mut noise = Xoshiro256PlusPlus::seed_from_u64(alphabet.len() as u64);
    let mut receiver = Receiver::default();
    let (mut pushed, mut in_replies) = (0, 0);
    while pushed < BYTES {
        let bytes = 1 + noise.next_u64() as usize % 40;
        let mut byte = || match noise.next_u64() {
            random if random & 0x300 == 0 => random as u8,
            random => alphabet[(random >> 16) as usize % alphabet.len()],
        };
        let piece: Vec<u8> = (0..bytes).map(|_| byte()).collect();
        receiver.push(&piece);
        pushed += piece.len();
        while let Some(reply) = receiver.next(parse) {
            in_replies += length(&reply);
        }
        assert!(receiver.waiting_bytes() < LONGEST_REPLY, "{} bytes wait", receiver.waiting_bytes());
        let accounted = in_replies + receiver.garbage_bytes() as usize + receiver.waiting_bytes();
        assert!(accounted <= pushed);
    }
    assert!(receiver.garbage_bytes() > 0);
    (pushed, in_replies, receiver)
}
