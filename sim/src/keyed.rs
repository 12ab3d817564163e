//! Random numbers that depend only on their purpose, never on when or where they are drawn.

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};

/// What a random number is used for.
#[derive(Debug, Clone, Copy)]
pub enum Purpose {
    /// Temporal noise of one row of one frame.
    Noise = 1,
    /// Offsets, gains and hot pixels of the sensor.
    Pattern,
    /// One period of the VSYNC line.
    Line,
    /// Whether a frame is lost in transit.
    Drop,
    /// How many frames late settings take effect.
    Late,
    /// The phase of ambient flicker.
    Flicker,
    /// Kinks of the row table.
    RowTable,
    /// Faults of one packet, or one frame, on the wire.
    Wire,
    /// Repeatability error of a mirror movement.
    MirrorRepeat,
    /// Faults of a mirror's controller and its serial line.
    MirrorWire,
    /// Offsets of the sensor's columns.
    Columns,
    /// Faults of one frame of the dot rig.
    DotFrame,
}

/// Returns a generator for `purpose` under the rig's `seed`; each `key` has its own stream.
pub fn keyed(seed: u64, purpose: Purpose, key: &[u64]) -> Xoshiro256PlusPlus {
    let mixed = key.iter().fold(mix(seed) ^ purpose as u64, |state, &part| mix(state) ^ part);
    Xoshiro256PlusPlus::seed_from_u64(mix(mixed))
}

/// SplitMix64's output function: a bijection, so different keys stay different.
fn mix(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Returns a number in 0..1.
pub fn uniform(random: &mut Xoshiro256PlusPlus) -> f64 {
    (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}
