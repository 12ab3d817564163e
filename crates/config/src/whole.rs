//! Whole numbers whose range is part of the message when something else is given.

use std::fmt;

use serde::de::{Deserializer, Error, Unexpected, Visitor};

/// Reads a whole number. Numbers outside `LOW` to `HIGH` that fit into the type are left to the checks of the table.
///
/// # Errors
/// For anything else, with the range.
pub(crate) fn whole<'de, D: Deserializer<'de>, const LOW: u32, const HIGH: u32>(
    deserializer: D,
) -> Result<u32, D::Error> {
    deserializer.deserialize_u32(Whole::<LOW, HIGH>)
}

struct Whole<const LOW: u32, const HIGH: u32>;

impl<const LOW: u32, const HIGH: u32> Visitor<'_> for Whole<LOW, HIGH> {
    type Value = u32;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a whole number from {LOW} to {HIGH}")
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<u32, E> {
        u32::try_from(value).map_err(|_out_of_range| E::invalid_value(Unexpected::Signed(value), &self))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<u32, E> {
        u32::try_from(value).map_err(|_out_of_range| E::invalid_value(Unexpected::Unsigned(value), &self))
    }
}
