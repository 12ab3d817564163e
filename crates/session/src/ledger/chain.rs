//! The checksums that chain the lines of a ledger.
//!
//! A line ends with `,"chain":"0123456789abcdef"}`: the first 16 hexadecimal digits of the SHA-256 of the predecessor's
//! 16 digits and of the line up to that comma. Where no line before has any, as in a new ledger and in those of
//! format 1, all bytes before the line take the place of the predecessor's digits. So a line that was changed, moved,
//! left out or taken from another ledger does not fit.

use sha2::{Digest, Sha256};

/// Between a line's entry and its checksum.
const KEY: &[u8] = b",\"chain\":\"";
/// After the checksum.
const END: &[u8] = b"\"}\n";
/// Hexadecimal digits of a checksum.
const DIGITS: usize = 16;

/// What the checksum of the next line covers of the lines before it.
#[derive(Debug, Clone)]
pub(super) struct Chain {
    before: Sha256,
    has_begun: bool,
}

/// Whether a line fits the lines before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fit {
    /// Its checksum is right.
    Fits,
    /// It has none, as all lines had before there was a chain.
    Unchained,
    /// Its checksum is wrong, or is missing where all lines have one.
    Broken,
}

impl Chain {
    /// The chain of an empty ledger.
    pub(super) fn new() -> Self {
        Self { before: Sha256::new(), has_begun: false }
    }

    /// Completes a line: an entry as JSON without its closing brace becomes a line with its checksum.
    pub(super) fn seal(&self, mut line: Vec<u8>) -> Vec<u8> {
        let digits = self.digits(&line);
        line.extend(KEY.iter().chain(&digits).chain(END));
        line
    }

    /// Checks the next line, and goes on from it.
    pub(super) fn follow(&mut self, line: &[u8]) -> Fit {
        let Some((entry, found)) = sealed(line) else {
            if self.has_begun {
                return Fit::Broken;
            }
            self.before.update(line);
            return Fit::Unchained;
        };
        let fits = self.digits(entry) == found;
        self.before = Sha256::new_with_prefix(found);
        self.has_begun = true;
        if fits { Fit::Fits } else { Fit::Broken }
    }

    fn digits(&self, entry: &[u8]) -> [u8; DIGITS] {
        let digest = self.before.clone().chain_update(entry).finalize();
        let hex = |at: usize| b"0123456789abcdef"[usize::from(digest[at / 2] >> (4 * (1 - at % 2)) & 15)];
        std::array::from_fn(hex)
    }
}

/// A line's entry without its closing brace, and its checksum, if it has one.
pub(super) fn sealed(line: &[u8]) -> Option<(&[u8], [u8; DIGITS])> {
    let (rest, digits) = line.strip_suffix(END)?.split_last_chunk::<DIGITS>()?;
    let is_hex = |digit: &u8| digit.is_ascii_digit() || (b'a'..=b'f').contains(digit);
    digits.iter().all(is_hex).then_some((rest.strip_suffix(KEY)?, *digits))
}
