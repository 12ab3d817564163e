//! What the fuzz targets share.

use raysweep_drivers::serial::wire::{LONGEST_REPLY, Parsed, Receiver};

/// Feeds bytes from a controller to a parser of its replies, in chunks; the first byte of each chunk is its length. No
/// bytes may accumulate.
pub fn feed<R>(data: &[u8], parse: impl Fn(&[u8]) -> Parsed<R>) {
    let mut receiver = Receiver::default();
    let mut rest = data;
    while let [length, after @ ..] = rest {
        let (piece, later) = after.split_at(after.len().min(usize::from(*length)));
        receiver.push(piece);
        while receiver.next(&parse).is_some() {}
        assert!(receiver.waiting_bytes() < LONGEST_REPLY);
        rest = later;
    }
}
