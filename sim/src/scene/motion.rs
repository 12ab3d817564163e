//! Moving scenes, which swing back and forth like a pendulum.

use raysweep_core::ns_from_us;

use super::error::SceneError;
use super::names::MOVING_NAMES;
use super::size::{MAX_ENTRIES, SceneSize};
use super::{MONO, Scene};

/// Number of key positions, from one end of the swing to the other, in which a moving scene is computed.
const KEYS: usize = 16;

/// Maps time to the key positions of a scene. A scene at rest has one.
#[derive(Debug, Clone, Copy)]
pub struct SceneMotion {
    keys: usize,
    /// Full period, there and back.
    period_ns: i64,
}

impl SceneMotion {
    /// A motion over `keys` positions with a full period of `period_s`.
    pub fn new(keys: usize, period_s: f64) -> Self {
        Self { keys, period_ns: ns_from_us(period_s * 1e6).max(1) }
    }

    /// The key position at a time of the devices' clock.
    pub fn key(&self, time_ns: i64) -> usize {
        let phase = time_ns.rem_euclid(self.period_ns) as f64 / self.period_ns as f64;
        let way = 1.0 - (2.0 * phase - 1.0).abs();
        ((way * self.keys as f64) as usize).min(self.keys - 1)
    }
}

impl Scene {
    /// Computes a built-in scene in mono at each of its key positions, from one end of its swing to the other: one for
    /// [`BUILTIN_NAMES`](super::BUILTIN_NAMES), several for [`MOVING_NAMES`].
    ///
    /// # Errors
    /// [`SceneError::UnknownName`], [`SceneError::Size`], [`SceneError::MovingSize`].
    pub fn key_positions(name: &str, size: SceneSize, seed: u64) -> Result<Vec<Self>, SceneError> {
        if !MOVING_NAMES.contains(&name) {
            return Self::builtin(name, size, seed).map(|scene| vec![scene]);
        }
        let SceneSize { rows, columns } = size;
        if rows.saturating_mul(rows).saturating_mul(columns).saturating_mul(KEYS) > MAX_ENTRIES {
            return Err(SceneError::MovingSize { rows, columns, keys: KEYS });
        }
        // Key positions are equally spaced in time: the motion is slow at the ends of the swing and fast in the middle.
        let swing = |key: usize| -(std::f64::consts::PI * (key as f64 + 0.5) / KEYS as f64).cos();
        (0..KEYS).map(|key| Self::compute(name, size, MONO, seed, swing(key))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motion_goes_there_and_back_through_every_key() {
        let motion = SceneMotion::new(4, 8.0);
        let keys: Vec<usize> =
            (0..16).map(|second| motion.key(second * 1_000_000_000 + 500_000_000)).collect();
        assert_eq!(keys, [0, 1, 2, 3, 3, 2, 1, 0, 0, 1, 2, 3, 3, 2, 1, 0]);
        assert_eq!(motion.key(-500_000_000), 0, "clocks may read anything");
        assert_eq!(SceneMotion::new(1, 4.0).key(1_234_567), 0);
    }

    #[test]
    fn what_moves_is_elsewhere_at_the_other_end_and_what_does_not_is_the_same() {
        let size = SceneSize { rows: 24, columns: 32 };
        for name in MOVING_NAMES {
            let keys = Scene::key_positions(name, size, 3).unwrap();
            assert_eq!(keys.len(), KEYS);
            let (first, last) = (&keys[0].transport, &keys[KEYS - 1].transport);
            let largest = |a: &ndarray::Array4<f32>| a.iter().fold(0.0_f32, |most, x| x.abs().max(most));
            assert!(largest(&(first - last)) > 0.1 * largest(first), "{name} moves");
            assert_eq!(first[[0, 0, 0, 0]], last[[0, 0, 0, 0]], "the page of {name} hangs still");
        }
        assert_eq!(Scene::key_positions("slab", size, 3).unwrap().len(), 1);
        let large = SceneSize { rows: 720, columns: 1280 };
        let refused = Scene::key_positions("pendulum", large, 3).unwrap_err().to_string();
        assert!(refused.contains("720 rows x 1280 columns") && refused.contains("moving"), "{refused}");
    }
}
