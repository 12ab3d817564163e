//! Requirements for every mirror driver, whether its controller is simulated, behind the kernel's drivers, or in a
//! lab. Dark throughout: no sample has light.

use std::time::{Duration, Instant};

use raysweep_core::{DeviceErrorKind, MechanicalDeg, Mirror, MirrorLimits, MirrorPath, MirrorProgress, Tilt};

// A guest has less time than other machines.
use crate::HUNG;

/// How often the path is played to its end.
pub const BATCHES: u32 = 2;

/// How long a path takes that is cut short: long enough for a busy host.
const COURSE_S: f64 = 20.0;

/// A dark closed path around the origin, at most 20 turns per second.
fn turn(amplitude_deg: f64, rate_hz: f64, limits: &MirrorLimits) -> MirrorPath {
    let samples = (rate_hz / 20.0).ceil().max(100.0) as usize;
    let amplitude = Tilt::new(amplitude_deg, amplitude_deg / 2.0);
    MirrorPath::lissajous(amplitude, [1, 1], samples, rate_hz, limits).unwrap().with_light(|_| 0)
}

/// Feeds until `enough` returns true.
fn feed(mirror: &mut dyn Mirror, enough: impl Fn(&MirrorProgress) -> bool) -> MirrorProgress {
    let began = Instant::now();
    let mut last = (0, 0);
    loop {
        let progress = mirror.feed().unwrap();
        assert!(progress.played <= progress.sent && progress.sent <= progress.total, "{progress:?}");
        assert!(last.0 <= progress.played && last.1 <= progress.sent, "{progress:?} after {last:?}");
        if enough(&progress) {
            return progress;
        }
        last = (progress.played, progress.sent);
        assert!(began.elapsed() < HUNG, "{progress:?}: does the controller play?");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Checks a parked mirror against everything that [`Mirror`] promises and leaves it parked. Returns the path, which
/// it played [`BATCHES`] times, at `fastest_hz` or a fifth of what the controller can do, whichever is less.
pub fn mirror_conforms(mirror: &mut dyn Mirror, fastest_hz: f64) -> MirrorPath {
    let capabilities = mirror.capabilities().clone();
    let limits = capabilities.limits;
    let (low_hz, high_hz) = capabilities.rate_hz.clone().into_inner();
    assert!(!capabilities.model.is_empty() && capabilities.fifo_samples > 0, "{capabilities:?}");
    assert!(0.0 < low_hz && low_hz < high_hz, "{capabilities:?}");

    // Nothing is loaded, nothing is playing, and a parked mirror can be parked.
    let kind = |result: Result<(), raysweep_core::DeviceError>| result.unwrap_err().kind;
    assert_eq!(kind(mirror.start(1)), DeviceErrorKind::NotReady);
    assert_eq!(kind(mirror.feed().map(drop)), DeviceErrorKind::NotReady);
    mirror.park().unwrap();

    // Paths beyond the limits of the mirror or its controller are refused.
    let rate_hz = (high_hz / 5.0).min(fastest_hz).floor().max(low_hz);
    let amplitude_deg = limits.max_tilt.0 / 4.0;
    let wide = MirrorLimits { max_tilt: MechanicalDeg(2.0 * limits.max_tilt.0), ..limits };
    let too_wide = turn(1.2 * limits.max_tilt.0, rate_hz, &wide);
    assert_eq!(kind(mirror.load(&too_wide).map(drop)), DeviceErrorKind::OutOfRange);
    let too_fast = turn(amplitude_deg / 10.0, 2.0 * high_hz.ceil(), &limits);
    assert_eq!(kind(mirror.load(&too_fast).map(drop)), DeviceErrorKind::OutOfRange);
    assert_eq!(kind(mirror.start(1)), DeviceErrorKind::NotReady, "a path that was refused is not loaded");

    // A path is played to its end, the requested number of times.
    let path = turn(amplitude_deg, rate_hz, &limits);
    let actual_hz = mirror.load(&path).unwrap();
    assert!((actual_hz / rate_hz - 1.0).abs() < 0.03, "{actual_hz} for {rate_hz}");
    assert_eq!(kind(mirror.start(0)), DeviceErrorKind::OutOfRange);
    mirror.start(BATCHES).unwrap();
    let end = feed(mirror, |progress| progress.parked);
    let total = path.points().len() as u64 * u64::from(BATCHES);
    assert_eq!((end.played, end.total), (total, total));
    assert_eq!(kind(mirror.feed().map(drop)), DeviceErrorKind::NotReady);
    assert_eq!(kind(mirror.start(1)), DeviceErrorKind::NotReady, "each start needs a load");

    // It can be parked during a path, twice, and before a path is started; afterwards it can be used again.
    mirror.load(&path).unwrap();
    mirror.start((COURSE_S * rate_hz / path.points().len() as f64) as u32).unwrap();
    let amid = feed(mirror, |progress| progress.played > 0);
    assert!(!amid.parked, "{amid:?}");
    mirror.park().unwrap();
    mirror.park().unwrap();
    assert_eq!(kind(mirror.feed().map(drop)), DeviceErrorKind::NotReady);
    mirror.load(&path).unwrap();
    mirror.park().unwrap();
    path
}
