//! Finds edges in a stream of samples.

/// Samples processed together: the compiler turns each chunk into a few vector instructions.
const CHUNK: usize = 64;

/// Finds changes of inputs. Keeps the last sample, so that changes between blocks are found.
#[derive(Debug, Clone)]
pub struct Scanner {
    mask: u8,
    /// The last sample; `None` before the first, which is never a change.
    last: Option<u8>,
    /// Number of samples so far.
    samples: u64,
}

impl Scanner {
    /// Watches the inputs in `mask`.
    pub fn new(mask: u8) -> Self {
        Self { mask, last: None, samples: 0 }
    }

    /// Number of samples so far.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Scans a block and calls `change` with the sample's number from the start, the new levels, and the changed
    /// inputs.
    pub fn scan(&mut self, block: &[u8], mut change: impl FnMut(u64, u8, u8)) {
        let Some(&first) = block.first() else { return };
        let mut last = self.last.unwrap_or(first);
        let mut sample = self.samples;
        for chunk in block.chunks(CHUNK) {
            let differs = chunk.iter().fold(0, |bits, level| bits | (level ^ last)) & self.mask != 0;
            if differs {
                for (offset, &level) in chunk.iter().enumerate() {
                    let changed = (level ^ last) & self.mask;
                    if changed != 0 {
                        change(sample + offset as u64, level, changed);
                        last = level;
                    }
                }
            }
            sample += chunk.len() as u64;
        }
        self.samples = sample;
        self.last = Some(last);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn changes_are_those_of_one_sample_after_the_other(
            runs in prop::collection::vec((any::<u8>(), 1..200_usize), 1..40),
            cuts in prop::collection::vec(1..300_usize, 1..20),
            mask in any::<u8>(),
        ) {
            let stream: Vec<u8> = runs.iter().flat_map(|&(level, len)| std::iter::repeat_n(level, len)).collect();
            let expected: Vec<_> = stream
                .windows(2)
                .enumerate()
                .map(|(k, pair)| (k as u64 + 1, pair[1] & mask, (pair[0] ^ pair[1]) & mask))
                .filter(|(_, _, changed)| *changed != 0)
                .collect();
            let mut scanner = Scanner::new(mask);
            let mut seen = Vec::new();
            let mut rest = &stream[..];
            for &cut in cuts.iter().cycle() {
                let (block, later) = rest.split_at(cut.min(rest.len()));
                scanner.scan(block, |sample, levels, changed| seen.push((sample, levels & mask, changed)));
                rest = later;
                if rest.is_empty() {
                    break;
                }
            }
            prop_assert_eq!(seen, expected);
            prop_assert_eq!(scanner.samples(), stream.len() as u64);
        }
    }
}
