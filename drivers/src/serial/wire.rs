//! Splits the bytes from a controller into replies, and counts all other bytes as garbage.

/// Result of parsing the received bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parsed<R> {
    /// A reply in the first `used` bytes.
    Reply {
        /// The reply.
        reply: R,
        /// Length of the reply in bytes; at least 1.
        used: usize,
    },
    /// The first `used` bytes belong to no reply.
    Garbage {
        /// Number of bytes; at least 1.
        used: usize,
    },
    /// More bytes are needed; never returned for [`LONGEST_REPLY`] bytes or more.
    Incomplete,
}

/// Maximum length of a reply from any controller.
pub const LONGEST_REPLY: usize = 256;

/// Collects the bytes from a controller. It holds at most one incomplete reply and the bytes pushed last.
#[derive(Debug, Default)]
pub struct Receiver {
    bytes: Vec<u8>,
    garbage_bytes: u64,
}

impl Receiver {
    /// Appends received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    /// The next complete reply; `None` if more bytes are needed.
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

    /// Number of bytes so far that belonged to no reply.
    pub fn garbage_bytes(&self) -> u64 {
        self.garbage_bytes
    }

    /// Number of bytes that wait for more.
    pub fn waiting_bytes(&self) -> usize {
        self.bytes.len()
    }
}

/// Parses a reply that is a line, at the start of `bytes`. `reply_of` gets the line without its CR LF or LF; for a line
/// that is no reply, it returns where in it a reply may begin, if anywhere after garbage.
pub(crate) fn parse_line<R>(
    bytes: &[u8],
    reply_of: impl FnOnce(&str) -> Result<R, Option<usize>>,
) -> Parsed<R> {
    let end = bytes.iter().take(LONGEST_REPLY).position(|byte| *byte == b'\n');
    let shown = &bytes[..end.unwrap_or(bytes.len().min(LONGEST_REPLY))];
    let text = shown.strip_suffix(b"\r").unwrap_or(shown);
    // A byte that cannot occur in a line invalidates everything before it.
    if let Some(bad) = text.iter().rposition(|byte| !(b' '..=b'~').contains(byte)) {
        return Parsed::Garbage { used: bad + 1 };
    }
    match (end, std::str::from_utf8(text)) {
        (Some(end), Ok(text)) => match reply_of(text) {
            Ok(reply) => Parsed::Reply { reply, used: end + 1 },
            Err(start) => Parsed::Garbage { used: start.unwrap_or(end + 1) },
        },
        (None, _) if bytes.len() >= LONGEST_REPLY => Parsed::Garbage { used: LONGEST_REPLY },
        _ => Parsed::Incomplete,
    }
}
