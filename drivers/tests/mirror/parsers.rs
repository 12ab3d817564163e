//! The parsers of replies with 10 million bytes of seeded noise, and with replies between noise.

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use raysweep_drivers::mirror::playzerx::protocol::{Reply, parse_response};
use raysweep_drivers::mirror::{MtiReply, OptotuneReply, parse_mti, parse_optotune};
use raysweep_drivers::serial::wire::{LONGEST_REPLY, Parsed, Receiver};

const BYTES: usize = 10_000_000;

struct Noise(Xoshiro256PlusPlus);

impl Noise {
    /// Uniform bytes, or bytes that occur in replies: these get further into a parser.
    fn byte(&mut self, alphabet: &[u8]) -> u8 {
        let random = self.0.next_u64();
        if random & 0x300 == 0 { random as u8 } else { alphabet[(random >> 16) as usize % alphabet.len()] }
    }
}

/// Feeds noise in pieces of every size; every byte must be accounted for, and no bytes may accumulate.
fn survives<R>(parse: impl Fn(&[u8]) -> Parsed<R> + Copy, alphabet: &[u8], length: impl Fn(&R) -> usize) {
    let mut noise = Noise(Xoshiro256PlusPlus::seed_from_u64(alphabet.len() as u64));
    let mut receiver = Receiver::default();
    let (mut pushed, mut in_replies) = (0_usize, 0_usize);
    while pushed < BYTES {
        let piece: Vec<u8> =
            (0..1 + noise.0.next_u64() as usize % 40).map(|_| noise.byte(alphabet)).collect();
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
}

/// Replies with garbage in between: all replies are found, all garbage is counted.
fn finds<R: PartialEq + std::fmt::Debug>(
    parse: impl Fn(&[u8]) -> Parsed<R> + Copy,
    replies: &[(&[u8], R)],
    garbage: &[u8],
) {
    let mut noise = Noise(Xoshiro256PlusPlus::seed_from_u64(99));
    let mut receiver = Receiver::default();
    let mut garbage_bytes = 0;
    for round in 0..20_000 {
        let count = noise.0.next_u64() as usize % 8;
        let mut bytes: Vec<u8> =
            (0..count).map(|_| garbage[noise.0.next_u64() as usize % garbage.len()]).collect();
        garbage_bytes += bytes.len() as u64;
        let (reply_bytes, reply) = &replies[round % replies.len()];
        bytes.extend_from_slice(reply_bytes);
        for byte in &bytes[..bytes.len() - 1] {
            receiver.push(&[*byte]);
            assert_eq!(receiver.next(parse), None, "round {round}: a reply came before its end");
        }
        receiver.push(&bytes[bytes.len() - 1..]);
        assert_eq!(receiver.next(parse).as_ref(), Some(reply), "round {round}");
        assert_eq!(receiver.garbage_bytes(), garbage_bytes, "round {round}");
    }
}

#[test]
fn playzerx() {
    survives(parse_response, b"pl-ok\ninfo\nXYM\x00\x01", |reply| match reply {
        Reply::Alive | Reply::Left(_) => 6,
        Reply::Info { device, firmware, format } => device.len() + firmware.len() + format.len() + 11,
    });
    finds(
        parse_response,
        &[
            (b"pl-ok\n", Reply::Alive),
            (b"pl-\x34\x12\x00", Reply::Left(0x1234)),
            (
                b"pl-info\nA\nB\nXYM\n",
                Reply::Info { device: "A".into(), firmware: "B".into(), format: "XYM".into() },
            ),
        ],
        b"\x00\xFFlo-k\n",
    );
}

#[test]
fn mti() {
    survives(parse_mti, b"MTI-OK\r\nERR Device ", |reply| match reply {
        MtiReply::Done => 7,
        MtiReply::Refused(why) => why.len() + 8,
        MtiReply::Device(model) => model.len() + 12,
    });
    finds(
        parse_mti,
        &[(b"MTI-OK\r\n", MtiReply::Done), (b"MTI-ERR Bad\r\n", MtiReply::Refused("Bad".into()))],
        b"\x00\xFFTOK-\x80",
    );
}

#[test]
fn optotune() {
    survives(parse_optotune, b"OKNOLU\r\n", |_| 3);
    finds(
        parse_optotune,
        &[(b"OK\r\n", OptotuneReply::Ok), (b"OU\r\n", OptotuneReply::TooHigh)],
        b"\x00\xFF\x80",
    );
}
