//! What a disk was told to write, in order, as QEMU's driver `blklogwrites` stores it (dm-log-writes): from it, the disk
//! after a power loss at any moment is made.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use crate::run::Done;

const SECTOR: u64 = 512;
const MAGIC: u64 = 0x006a_7366_7773_6872;
const FLUSH: u64 = 1;
const FUA: u64 = 2;
const DISCARD: u64 = 4;

/// A write, or a flush if it is empty.
pub struct LoggedWrite {
    /// Byte of the disk at which it begins.
    at: u64,
    bytes: Vec<u8>,
    flags: u64,
}

/// Reads a log.
pub fn read(path: &Path) -> Done<Vec<LoggedWrite>> {
    let failed = |what: &str| format!("{}: {what}", path.display());
    let file = File::open(path).map_err(|error| failed(&error.to_string()))?;
    let word = |at: u64| -> Done<u64> {
        let mut bytes = [0; 8];
        file.read_exact_at(&mut bytes, at).map_err(|error| failed(&error.to_string()))?;
        Ok(u64::from_le_bytes(bytes))
    };
    if word(0)? != MAGIC {
        return Err(failed("not a log of writes"));
    }
    let mut at = SECTOR;
    let mut entries = Vec::new();
    for _ in 0..word(16)? {
        let (sector, count, flags) = (word(at)?, word(at + 8)?, word(at + 16)?);
        at += SECTOR;
        let mut bytes = Vec::new();
        if flags & DISCARD == 0 {
            bytes.resize((count * SECTOR) as usize, 0);
            file.read_exact_at(&mut bytes, at).map_err(|error| failed(&error.to_string()))?;
            at += count * SECTOR;
        }
        entries.push(LoggedWrite { at: sector * SECTOR, bytes, flags });
    }
    Ok(entries)
}

/// Writes to `disk` what it would hold after a power loss before entry `end`: all until the last flush; of what was in
/// flight since, each write or not, by `random`; writes that bypass the cache always.
pub fn replay(disk: &Path, entries: &[LoggedWrite], end: usize, random: &mut ReplayRandom) -> Done {
    let failed = |error| format!("{}: {error}", disk.display());
    let file = File::options().write(true).open(disk).map_err(failed)?;
    let flushed = entries[..end].iter().rposition(|entry| entry.flags & FLUSH != 0).unwrap_or(0);
    for (index, entry) in entries[..end].iter().enumerate() {
        if index < flushed || entry.flags & FUA != 0 || random.number().is_multiple_of(2) {
            file.write_all_at(&entry.bytes, entry.at).map_err(failed)?;
        }
    }
    Ok(())
}

/// A generator of random numbers (xorshift64*), so that a seed gives the same power losses again.
pub struct ReplayRandom(u64);

impl ReplayRandom {
    /// With a seed other than 0.
    pub fn new(seed: u64) -> Self {
        Self(seed.max(1))
    }

    /// The next number.
    pub fn number(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 16
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(at: u64, byte: u8, flags: u64) -> LoggedWrite {
        let bytes = if flags & FLUSH != 0 { Vec::new() } else { vec![byte; SECTOR as usize] };
        LoggedWrite { at: at * SECTOR, bytes, flags }
    }

    #[test]
    fn what_was_flushed_is_kept_and_what_was_not_may_be_lost() {
        let folder = std::env::temp_dir().join(format!("raysweep-writes-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let disk = folder.join("disk");
        let entries = [
            entry(0, 1, 0),
            entry(0, 0, FLUSH),
            entry(1, 2, 0),
            entry(2, 3, FUA),
            entry(3, 4, 0),
            entry(0, 9, 0),
        ];
        let mut lost = [false; 4];
        for seed in 1..40 {
            std::fs::write(&disk, vec![0; 4 * SECTOR as usize]).unwrap();
            replay(&disk, &entries, 5, &mut ReplayRandom::new(seed)).unwrap();
            let bytes = std::fs::read(&disk).unwrap();
            let sectors: Vec<u8> = bytes.chunks(SECTOR as usize).map(|sector| sector[0]).collect();
            assert!(sectors[0] == 1 && sectors[2] == 3, "{sectors:?}");
            sectors.iter().enumerate().for_each(|(index, &byte)| lost[index] |= byte == 0);
        }
        assert_eq!(lost, [false, true, false, true]);
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_log_is_read_as_qemu_writes_it() {
        let path = std::env::temp_dir().join(format!("raysweep-log-{}", std::process::id()));
        let sector = |words: &[u64]| {
            let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
            bytes.resize(SECTOR as usize, 0);
            bytes
        };
        // Magic, version, number of entries; a write of sector 7; a flush.
        let log = [
            sector(&[MAGIC, 1, 2]),
            sector(&[7, 1, FUA, 0]),
            vec![5; SECTOR as usize],
            sector(&[0, 0, FLUSH, 0]),
        ];
        std::fs::write(&path, log.concat()).unwrap();
        let entries = read(&path).unwrap();
        let [write, flush] = entries.as_slice() else { panic!("{} entries", entries.len()) };
        assert_eq!((write.at, write.bytes[0], write.flags), (7 * SECTOR, 5, FUA));
        assert_eq!((flush.bytes.len(), flush.flags), (0, FLUSH));
        std::fs::write(&path, sector(&[1])).unwrap();
        assert!(read(&path).is_err());
        std::fs::remove_file(&path).unwrap();
    }
}
