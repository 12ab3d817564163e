//! Texts for people: causes and sizes.

use std::fmt;
use std::io;

/// What the operating system says of a failure, without its number; text that is not UTF-8 is called that.
pub fn io_text(error: &io::Error) -> String {
    let text = error.to_string();
    if error.kind() == io::ErrorKind::InvalidData && text == "stream did not contain valid UTF-8" {
        return "it is not UTF-8 text".into();
    }
    match text.rsplit_once(" (os error ") {
        Some((cause, _)) => cause.into(),
        None => text,
    }
}

/// A number of bytes, such as `512 B`, `1.50 KiB` or `2.00 GiB`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size(pub u64);

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(bytes) = *self;
        let units = [("GiB", 30), ("MiB", 20), ("KiB", 10)];
        match units.into_iter().find(|(_, shift)| bytes >> shift > 0) {
            Some((unit, shift)) => write!(f, "{:.2} {unit}", bytes as f64 / (1u64 << shift) as f64),
            None => write!(f, "{bytes} B"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_have_no_numbers_and_sizes_have_units() {
        let missing = io::Error::from_raw_os_error(2);
        assert_eq!(io_text(&missing), "No such file or directory");
        assert_eq!(io_text(&io::Error::other("no luck")), "no luck");
        assert_eq!(
            [Size(512), Size(1536), Size(3 << 30)].map(|size| size.to_string()),
            ["512 B", "1.50 KiB", "3.00 GiB"]
        );
    }
}
