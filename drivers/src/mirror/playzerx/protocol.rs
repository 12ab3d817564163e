//! The PlayzerX serial protocol as published by Mirrorcle: frames 'p' 'l' command length data 0x0A, without checksum
//! or acknowledgement.

use raysweep_core::{MechanicalDeg, MirrorPoint};

use crate::serial::wire::Parsed;

/// FIFO size of a monochrome controller in samples: the maximum count of samples left.
pub const FIFO_SAMPLES: u32 = 125_000;
/// Bytes of a sample including its light.
pub const SAMPLE_BYTES: usize = 9;
/// The code of the origin.
const ORIGIN: u16 = 2048;
/// Codes from the origin to full scale.
const HALF_SCALE: f64 = 2047.0;
/// Maximum length of a line of the controller's description.
const LONGEST_LINE: usize = 64;
/// Zeros that complete any frame cut off in a write: no frame ends with a zero, so nothing moves.
pub const PADDING: [u8; 11] = [0; 11];

/// A sample in the controller's format: 12 bits per axis, 8 bits of light.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MirrorSample {
    /// 0..=4095; 2048 is the origin.
    pub x: u16,
    /// As `x`, for the other axis.
    pub y: u16,
    /// 0: off, 255: full.
    pub light: u8,
}

impl MirrorSample {
    /// Converts a point for a controller whose codes reach `full_scale` at -1 and +1. Values beyond that are clamped.
    pub fn of(point: MirrorPoint, full_scale: MechanicalDeg) -> Self {
        let code = |deg: f64| {
            let part = (deg / full_scale.0).clamp(-1.0, 1.0);
            (f64::from(ORIGIN) + (part * HALF_SCALE).round()) as u16
        };
        let [x, y] = point.tilt.deg().map(code);
        Self { x, y, light: point.light }
    }
}

/// A command to the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlayzerXCommand {
    /// Appends one sample with its light to the FIFO.
    Sample(MirrorSample),
    /// Sets the sample rate, 50..=50,000 samples per second.
    SetRate(u32),
    /// Sets the period in ms of unrequested reports of the samples left; 0: none.
    SetReport(u16),
    /// Empties the FIFO; the outputs keep their values.
    Clear,
    /// Requests a sign of life.
    Ping,
    /// Requests its description.
    Info,
    /// Requests the number of samples left.
    SamplesLeft,
    /// Restarts the controller, which ignores input for 2.5 s.
    Reset,
}

impl PlayzerXCommand {
    /// Appends the bytes of the command.
    pub fn to_bytes(self, out: &mut Vec<u8>) {
        let mut frame = |command: u8, data: &[u8]| {
            out.extend_from_slice(&[b'p', b'l', command, data.len() as u8 + 5]);
            out.extend_from_slice(data);
            out.push(b'\n');
        };
        match self {
            Self::Sample(MirrorSample { x, y, light }) => {
                let mixed = ((x >> 4) & 0xF0) as u8 | (y & 0x0F) as u8;
                frame(b'd', &[x as u8, mixed, (y >> 4) as u8, light]);
            }
            Self::SetRate(rate) => frame(b'r', &rate.to_le_bytes()[..3]),
            Self::SetReport(ms) => frame(b'u', &ms.to_le_bytes()),
            Self::Clear => frame(b'c', &[]),
            Self::Ping => frame(b'p', &[]),
            Self::Info => frame(b'n', &[]),
            Self::SamplesLeft => frame(b'g', &[]),
            Self::Reset => frame(b'b', &[0xEE]),
        }
    }
}

/// A reply from the controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PlayzerXReply {
    /// Answer to a ping.
    Alive,
    /// Its description.
    Info {
        /// The device's name.
        device: String,
        /// The firmware version.
        firmware: String,
        /// `XYM`, or `XYRGB` for a colour controller.
        format: String,
    },
    /// Samples left in its FIFO.
    Left(u32),
}

/// Parses the reply at the start of `bytes`.
pub fn parse_response(bytes: &[u8]) -> Parsed<PlayzerXReply> {
    const PREFIX: &[u8] = b"pl-";
    let begun = bytes.len().min(PREFIX.len());
    if bytes[..begun] != PREFIX[..begun] {
        // Everything up to the next byte that can begin a reply.
        let used = bytes.iter().skip(1).position(|byte| *byte == b'p').map_or(bytes.len(), |at| at + 1);
        return Parsed::Garbage { used };
    }
    let Some(said) = bytes.get(PREFIX.len()..).filter(|said| !said.is_empty()) else {
        return Parsed::Incomplete;
    };
    let begins_with = |text: &[u8]| {
        let common = said.len().min(text.len());
        said[..common] == text[..common]
    };
    // A 3-byte count is never one of these words: its last byte is at most 1 (125,000 is 0x01E848).
    if said.len() < 3 {
        return Parsed::Incomplete;
    }
    if begins_with(b"ok\n") {
        return Parsed::Reply { reply: PlayzerXReply::Alive, used: PREFIX.len() + 3 };
    }
    if begins_with(b"info\n") {
        return match said.len() {
            ..5 => Parsed::Incomplete,
            _ => description(&said[5..], PREFIX.len() + 5),
        };
    }
    match u32::from_le_bytes([said[0], said[1], said[2], 0]) {
        left @ 0..=FIFO_SAMPLES => Parsed::Reply { reply: PlayzerXReply::Left(left), used: PREFIX.len() + 3 },
        _ => Parsed::Garbage { used: PREFIX.len() },
    }
}

/// Parses the three lines after `pl-info`, which took `before` bytes.
fn description(mut bytes: &[u8], before: usize) -> Parsed<PlayzerXReply> {
    let mut lines = [const { String::new() }; 3];
    let mut used = before;
    for line in &mut lines {
        let end = bytes.iter().take(LONGEST_LINE).position(|byte| *byte == b'\n');
        let text = &bytes[..end.unwrap_or(bytes.len().min(LONGEST_LINE))];
        let printable = text.iter().all(|byte| (b' '..=b'~').contains(byte) || *byte == b'\r');
        match end {
            Some(end) if printable => {
                *line = String::from_utf8_lossy(text).trim().to_owned();
                bytes = &bytes[end + 1..];
                used += end + 1;
            }
            None if printable && bytes.len() < LONGEST_LINE => return Parsed::Incomplete,
            _ => return Parsed::Garbage { used: before },
        }
    }
    let [device, firmware, format] = lines;
    Parsed::Reply { reply: PlayzerXReply::Info { device, firmware, format }, used }
}

#[cfg(test)]
mod tests {
    use raysweep_core::Tilt;

    use super::*;

    fn bytes(command: PlayzerXCommand) -> Vec<u8> {
        let mut out = Vec::new();
        command.to_bytes(&mut out);
        out
    }

    #[test]
    fn commands_are_the_documented_bytes() {
        let sample = PlayzerXCommand::Sample(MirrorSample { x: 0xABC, y: 0x123, light: 0x7F });
        assert_eq!(bytes(sample), [b'p', b'l', b'd', 9, 0xBC, 0xA3, 0x12, 0x7F, 10]);
        assert_eq!(bytes(PlayzerXCommand::SetRate(39_000)), [b'p', b'l', b'r', 8, 0x58, 0x98, 0x00, 10]);
        assert_eq!(bytes(PlayzerXCommand::SetReport(1000)), [b'p', b'l', b'u', 7, 0xE8, 0x03, 10]);
        assert_eq!(bytes(PlayzerXCommand::Clear), b"plc\x05\n");
        assert_eq!(bytes(PlayzerXCommand::Ping), b"plp\x05\n");
        assert_eq!(bytes(PlayzerXCommand::Info), b"pln\x05\n");
        assert_eq!(bytes(PlayzerXCommand::SamplesLeft), b"plg\x05\n");
        assert_eq!(bytes(PlayzerXCommand::Reset), b"plb\x06\xEE\n");
    }

    #[test]
    fn the_origin_is_its_code_and_the_full_scale_is_symmetric() {
        let code = |deg: f64| {
            let tilt = Tilt::new(deg, -deg);
            let sample = MirrorSample::of(MirrorPoint { tilt, light: 1 }, MechanicalDeg(6.5));
            (sample.x, sample.y)
        };
        assert_eq!(code(0.0), (2048, 2048));
        assert_eq!(code(6.5), (4095, 1));
        assert_eq!(code(99.0), (4095, 1));
        assert_eq!(code(3.25), (2048 + 1024, 2048 - 1024));
    }

    #[test]
    fn replies_are_told_from_each_other_and_from_garbage() {
        let whole = |bytes: &[u8], reply: PlayzerXReply| {
            for cut in 0..bytes.len() {
                assert_eq!(parse_response(&bytes[..cut]).clone_kind(), "incomplete", "cut after {cut}");
            }
            assert_eq!(parse_response(bytes), Parsed::Reply { reply, used: bytes.len() });
        };
        whole(b"pl-ok\n", PlayzerXReply::Alive);
        whole(b"pl-\x48\xE8\x01", PlayzerXReply::Left(125_000));
        whole(b"pl-\x00\x00\x00", PlayzerXReply::Left(0));
        let info =
            PlayzerXReply::Info { device: "PX1-G".into(), firmware: "2.1".into(), format: "XYM".into() };
        whole(b"pl-info\nPX1-G\n2.1\nXYM\n", info);
        assert_eq!(parse_response(b"pl-\xFF\xFF\x7F"), Parsed::Garbage { used: 3 });
        assert_eq!(parse_response(b"xyzpl-ok\n"), Parsed::Garbage { used: 3 });
        assert_eq!(parse_response(b"ppl-ok\n"), Parsed::Garbage { used: 1 });
        assert_eq!(parse_response(b"pl-info\nPX\x80\n1\n2\n"), Parsed::Garbage { used: 8 });
    }

    impl<R> Parsed<R> {
        fn clone_kind(&self) -> &'static str {
            match self {
                Parsed::Incomplete => "incomplete",
                Parsed::Garbage { .. } => "garbage",
                Parsed::Reply { .. } => "reply",
            }
        }
    }
}
