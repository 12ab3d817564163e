//! Deterministic mutations of bytes.

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::Rng;

/// Numbers at which readers fail.
const NUMBERS: [&str; 12] = [
    "0",
    "-1",
    "1e308",
    "-1e308",
    "1e-320",
    "nan",
    "255",
    "65536",
    "4294967296",
    "18446744073709551615",
    "9223372036854775807",
    "99999999999999999999999",
];

/// Changes bytes in one to three ways; `others` are other examples of the same kind.
pub fn mutated(random: &mut Xoshiro256PlusPlus, example: &[u8], others: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = example.to_vec();
    for _ in 0..=below(random, 3) {
        change(random, &mut bytes, others);
    }
    bytes
}

fn below(random: &mut Xoshiro256PlusPlus, limit: usize) -> usize {
    (random.next_u64() % limit.max(1) as u64) as usize
}

fn change(random: &mut Xoshiro256PlusPlus, bytes: &mut Vec<u8>, others: &[Vec<u8>]) {
    let at = below(random, bytes.len());
    let to = at + below(random, (bytes.len() - at).min(64));
    match below(random, 8) {
        0 if !bytes.is_empty() => bytes[at] ^= 1 << below(random, 8),
        1 if !bytes.is_empty() => bytes[at] = [0, 0x7f, 0x80, 0xff][below(random, 4)],
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(at..to)),
        4 => {
            let twice = bytes[at..to].to_vec();
            bytes.splice(at..at, twice);
        }
        5 => {
            let other = &others[below(random, others.len())];
            let from = below(random, other.len());
            bytes.splice(at..to, other[from..other.len().min(from + 64)].iter().copied());
        }
        6 => {
            // Eight bytes as a huge number.
            let number = [u64::MAX, 1 << 63, 1 << 32, 1 << 40][below(random, 4)].to_le_bytes();
            let end = bytes.len().min(at + 8);
            bytes[at..end].copy_from_slice(&number[..end - at]);
        }
        _ => replace_number(random, bytes, at),
    }
}

/// Replaces the first number in the text after a place.
fn replace_number(random: &mut Xoshiro256PlusPlus, bytes: &mut Vec<u8>, at: usize) {
    let Some(start) = bytes[at..].iter().position(u8::is_ascii_digit) else { return };
    let start = at + start;
    let digits = bytes[start..].iter().take_while(|byte| byte.is_ascii_digit() || **byte == b'.').count();
    let number = NUMBERS[below(random, NUMBERS.len())];
    bytes.splice(start..start + digits, number.bytes());
}
