#![no_main]

use libfuzzer_sys::fuzz_target;
use raysweep_drivers::vsync::triggerbox::protocol::parse_reply;

fuzz_target!(|data: &[u8]| raysweep_fuzz::feed(data, parse_reply));
