//! The parsers of replies with 10 million bytes of seeded noise, and with replies between noise.

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use raysweep_drivers::mirror::playzerx::protocol::{PlayzerXReply, parse_response};
use raysweep_drivers::mirror::{MtiReply, OptotuneReply, parse_mti, parse_optotune};
use raysweep_drivers::serial::wire::{Parsed, Receiver};

use crate::noise::survives;

/// Replies with garbage in between: all replies are found, all garbage is counted.
fn finds<R: PartialEq + std::fmt::Debug>(
    parse: impl Fn(&[u8]) -> Parsed<R> + Copy,
    replies: &[(&[u8], R)],
    garbage: &[u8],
) {
    let mut noise = Xoshiro256PlusPlus::seed_from_u64(99);
    let mut receiver = Receiver::default();
    let mut garbage_bytes = 0;
    for round in 0..20_000 {
        let count = noise.next_u64() as usize % 8;
        let mut bytes: Vec<u8> =
            (0..count).map(|_| garbage[noise.next_u64() as usize % garbage.len()]).collect();
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
        PlayzerXReply::Alive | PlayzerXReply::Left(_) => 6,
        PlayzerXReply::Info { device, firmware, format } => device.len() + firmware.len() + format.len() + 11,
    });
    finds(
        parse_response,
        &[
            (b"pl-ok\n", PlayzerXReply::Alive),
            (b"pl-\x34\x12\x00", PlayzerXReply::Left(0x1234)),
            (
                b"pl-info\nA\nB\nXYM\n",
                PlayzerXReply::Info { device: "A".into(), firmware: "B".into(), format: "XYM".into() },
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
