#![no_main]

use libfuzzer_sys::fuzz_target;
use raysweep_drivers::mirror::playzerx::protocol::parse_response;

fuzz_target!(|data: &[u8]| raysweep_fuzz::feed(data, parse_response));
