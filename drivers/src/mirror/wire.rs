//! Bytes as they come from a controller: cut into replies, and what is none counted as garbage.

/// What the bytes at hand begin with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parsed<R> {
    /// A reply in the first `used` bytes.
    Reply {
        /// It.
        reply: R,
        /// Its bytes; at least 1.
        used: usize,
    },
    /// The first `used` bytes belong to no reply.
    Garbage {
        /// How many; at least 1.
        used: usize,
    },
    /// More bytes are needed; never said of [`LONGEST_REPLY`] bytes or more.
    Incomplete,
}

/// No reply of any controller is longer.
pub const LONGEST_REPLY: usize = 256;

/// Collects what a controller says. It never holds more than one reply that is not yet whole and the bytes pushed last.
#[derive(Debug, Default)]
pub struct Receiver {
    bytes: Vec<u8>,
    garbage_bytes: u64,
}

impl Receiver {
    /// Takes bytes off the wire.
    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    /// The next reply that is whole; `None` when more bytes are needed.
    pub fn next<R>(&mut self, parse: impl Fn(&[u8]) -> Parsed<R>) -> Option<R> {
        let mut start = 0;
        let reply = loop {
            match parse(&self.bytes[start..]) {
                Parsed::Reply { reply, used } => {
                    start += used;
                    break Some(reply);
                }
                Parsed::Garbage { used } => {
                    start += used;
                    self.garbage_bytes += used as u64;
                }
                Parsed::Incomplete => break None,
            }
        };
        self.bytes.drain(..start);
        reply
    }

    /// Bytes so far that belonged to no reply.
    pub fn garbage_bytes(&self) -> u64 {
        self.garbage_bytes
    }

    /// Bytes that wait for more.
    pub fn waiting_bytes(&self) -> usize {
        self.bytes.len()
    }
}

/// A line that ends with CR LF or LF, without its end, and how many bytes it takes with it. `Err` is how many bytes
/// cannot begin a line; `Ok(None)` asks for more.
pub(super) fn line(bytes: &[u8]) -> Result<Option<(&str, usize)>, usize> {
    let end = bytes.iter().take(LONGEST_REPLY).position(|byte| *byte == b'\n');
    let shown = &bytes[..end.unwrap_or(bytes.len().min(LONGEST_REPLY))];
    let text = shown.strip_suffix(b"\r").unwrap_or(shown);
    // Whatever came before a byte that no line has is no line either.
    if let Some(bad) = text.iter().rposition(|byte| !(b' '..=b'~').contains(byte)) {
        return Err(bad + 1);
    }
    match (end, std::str::from_utf8(text)) {
        (Some(end), Ok(text)) => Ok(Some((text, end + 1))),
        (None, _) if bytes.len() >= LONGEST_REPLY => Err(LONGEST_REPLY),
        _ => Ok(None),
    }
}
