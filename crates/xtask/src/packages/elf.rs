//! ELF file headers.

/// Length of the header up to and including the machine type.
pub const HEADER: usize = 20;

/// Whether a file with this header is a 64-bit little-endian ELF file for the current machine.
pub fn is_for_this_machine(header: &[u8]) -> bool {
    let machine: Option<u16> = match std::env::consts::ARCH {
        "x86_64" => Some(62),
        "aarch64" => Some(183),
        // The package list is not made for other architectures: accept any.
        _ => None,
    };
    let Some(found) = header.get(18..HEADER) else { return false };
    header.starts_with(b"\x7fELF\x02\x01") && machine.is_none_or(|machine| found == machine.to_le_bytes())
}

/// The header of the current executable.
#[cfg(test)]
pub fn own_header() -> [u8; HEADER] {
    let own = std::fs::read(std::env::current_exe().unwrap()).unwrap();
    own[..HEADER].try_into().unwrap()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_machines_are_told_apart() {
        let own = own_header();
        assert!(is_for_this_machine(&own));
        assert!(!is_for_this_machine(&own[..19]), "cut off");
        // 32 bit; big-endian; RISC-V.
        for (at, byte) in [(4, 1), (5, 2), (18, 243)] {
            let mut other = own;
            other[at] = byte;
            assert!(!is_for_this_machine(&other), "{at}");
        }
    }
}
