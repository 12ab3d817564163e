#![no_main]
//! A reader of bytes from outside, the one that `READER` names: see `daemon/tests/bytes/bodies.rs`.

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;

#[path = "../../daemon/tests/bytes/bodies.rs"]
mod bodies;

static READER: LazyLock<bodies::Body> = LazyLock::new(|| {
    let wanted = std::env::var("READER").unwrap_or_default();
    let found = bodies::BODIES.into_iter().find(|(name, _)| *name == wanted);
    let names = || bodies::BODIES.map(|(name, _)| name).join(", ");
    found.unwrap_or_else(|| panic!("READER=\"{wanted}\": expected one of {}", names())).1
});

fuzz_target!(|data: &[u8]| {
    // An error is an answer.
    let _ = READER(data);
});
