//! Watches the VSYNC line and takes frames beside it, as a run does, to tell how well the rig keeps time.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use raysweep_core::{
    Camera, CameraSettings, DeviceError, DeviceErrorKind, Edge, FramePool, FrameStamp, LossCause, SettingsId,
    Vsync, VsyncStats, us_from_ns,
};
use raysweep_pipeline::{EdgeTracker, Found, Line};

use crate::devices::priority;
use crate::rig::Pace;

/// Time for which the line is watched at least, on its own clock.
const WATCHED_NS: i64 = 2_000_000_000;
/// Frames taken with each setting.
const FRAMES: usize = 40;
/// A device that delivers nothing for this long is given up.
const PATIENCE: Duration = Duration::from_secs(2);
const POLL: Duration = Duration::from_millis(50);
/// Bounds of what is watched in all: a line may have any pace.
const MOST_EDGES: usize = 4096;
const MOST_TIME: Duration = Duration::from_secs(20);
/// More ids missing in a row mean that the camera's count began anew.
const MOST_LOST: u64 = 1000;

/// What was seen of the line.
#[derive(Debug, Default)]
pub(super) struct SeenLine {
    /// All edges, in order.
    pub edges: Vec<Edge>,
    pub stats: VsyncStats,
    /// Times of the edges that come from the projector.
    true_ns: Vec<i64>,
    pub error: Option<DeviceError>,
}

/// Frames with one setting.
#[derive(Debug)]
pub(super) struct FrameSeries {
    /// The setting as the camera adopted it.
    pub settings: CameraSettings,
    pub stamps: Vec<FrameStamp>,
    /// Frames that the camera counted, and that did not arrive.
    pub lost: BTreeMap<LossCause, u64>,
}

/// What was seen of a camera.
#[derive(Debug, Default)]
pub(super) struct SeenFrames {
    pub series: Vec<FrameSeries>,
    /// Whether it was told to end before all had come.
    pub is_cut_short: bool,
    pub error: Option<DeviceError>,
}

/// Watches the line, if there is a watcher, while a camera takes frames with each of the settings, if there is a
/// camera. Ends early when `go_on` says no.
pub(super) fn watch(
    vsync: Option<Box<dyn Vsync>>,
    camera: Option<(Box<dyn Camera>, Vec<CameraSettings>)>,
    line: Line,
    pace: Pace,
    go_on: &(dyn Fn() -> bool + Sync),
) -> (SeenLine, SeenFrames) {
    let began = Instant::now();
    let is_done = AtomicBool::new(camera.is_none());
    let may_go_on = || go_on() && began.elapsed() < MOST_TIME;
    thread::scope(|scope| {
        let watched = vsync.map(|mut vsync| {
            let (is_done, may_go_on) = (&is_done, &may_go_on);
            scope.spawn(move || {
                if pace == Pace::Devices {
                    priority::for_device("vsync");
                }
                watch_line(&mut *vsync, line, || may_go_on() && !is_done.load(Ordering::Relaxed), may_go_on)
            })
        });
        let frames = camera.map(|(mut camera, settings)| {
            let frames = take(&mut *camera, &settings, &may_go_on);
            // A simulated clock stands still as long as a device neither waits nor is gone.
            drop(camera);
            frames
        });
        is_done.store(true, Ordering::Relaxed);
        let panicked = |_panic| {
            let what = "the watcher's thread panicked; the log has its message";
            let error = Some(DeviceError::new("vsync", DeviceErrorKind::Disconnected, what));
            SeenLine { error, ..SeenLine::default() }
        };
        let line = watched.map(|thread| thread.join().unwrap_or_else(panicked));
        (line.unwrap_or_default(), frames.unwrap_or_default())
    })
}

/// Watches the line while it is needed, and long enough to judge it.
fn watch_line(
    vsync: &mut dyn Vsync,
    line: Line,
    is_needed: impl Fn() -> bool,
    may_go_on: impl Fn() -> bool,
) -> SeenLine {
    let mut seen = SeenLine::default();
    let mut tracker = EdgeTracker::new(line);
    let mut waited = Duration::ZERO;
    let is_enough = |edges: &[Edge], waited: Duration| {
        let span_ns = edges.first().zip(edges.last()).map_or(0, |(first, last)| last.host_ns - first.host_ns);
        span_ns >= WATCHED_NS || waited >= PATIENCE
    };
    while seen.edges.len() < MOST_EDGES && may_go_on() && (is_needed() || !is_enough(&seen.edges, waited)) {
        match vsync.next_edge(POLL) {
            Ok(Some(edge)) => {
                waited = Duration::ZERO;
                tracker.push(edge);
                seen.edges.push(edge);
                if let Found::True(edge) = tracker.near(edge.host_ns, 0) {
                    seen.true_ns.push(edge.host_ns);
                }
            }
            Ok(None) => waited += POLL,
            Err(error) => {
                seen.error = Some(error);
                break;
            }
        }
    }
    seen.stats = tracker.stats();
    seen
}

/// Takes frames with each of the settings.
fn take(camera: &mut dyn Camera, settings: &[CameraSettings], may_go_on: &dyn Fn() -> bool) -> SeenFrames {
    let mut seen = SeenFrames::default();
    seen.error = take_into(&mut seen.series, camera, settings, may_go_on).err();
    seen.is_cut_short = !may_go_on();
    if let Err(error) = camera.disarm() {
        seen.error.get_or_insert(error);
    }
    seen
}

fn take_into(
    series: &mut Vec<FrameSeries>,
    camera: &mut dyn Camera,
    settings: &[CameraSettings],
    may_go_on: &dyn Fn() -> bool,
) -> Result<(), DeviceError> {
    let capabilities = camera.capabilities();
    let pixels = capabilities.width * capabilities.height;
    let mut buffer = FramePool::new(1, capabilities.format.frame_bytes(pixels)).take();
    for (point, settings) in (0..).zip(settings) {
        let applied = camera.configure(SettingsId { point, attempt: 0 }, settings)?;
        if point == 0 {
            camera.arm()?;
        }
        let mut taken = FrameSeries { settings: applied.actual, stamps: Vec::new(), lost: BTreeMap::new() };
        let (mut waited, mut newest) = (Duration::ZERO, None);
        while taken.stamps.len() < FRAMES && waited < PATIENCE && may_go_on() {
            let Some(stamp) = camera.next_frame(&mut buffer, POLL)? else {
                waited += POLL;
                continue;
            };
            waited = Duration::ZERO;
            let missing = newest.map_or(0..0, |newest: u64| newest + 1..stamp.seq);
            if missing.end.saturating_sub(missing.start) < MOST_LOST {
                missing.for_each(|seq| *taken.lost.entry(camera.loss_of(seq)).or_default() += 1);
            }
            newest = Some(stamp.seq);
            if stamp.seq >= applied.first_frame.certain() {
                taken.stamps.push(stamp);
            }
        }
        series.push(taken);
    }
    Ok(())
}

impl SeenLine {
    /// Median time between edges, whatever their cause.
    pub fn spacing_us(&self) -> Option<f64> {
        let spacings = self.edges.windows(2).map(|pair| us_from_ns(pair[1].host_ns - pair[0].host_ns));
        median(spacings.collect())
    }

    /// How long after an edge of the projector the exposure of row 0 began, modulo the period; none for a frame
    /// before the first edge.
    fn phase_us(&self, stamp: &FrameStamp) -> Option<f64> {
        let next = self.true_ns.partition_point(|&edge_ns| edge_ns <= stamp.exposure_start_ns);
        let edge_ns = self.true_ns[..next].last()?;
        Some(us_from_ns(stamp.exposure_start_ns - edge_ns).rem_euclid(self.stats.period_us))
    }

    /// How far the exposures of a series began from where their trigger's edge, the camera's latency and its delay put
    /// them: within half a period to either side.
    pub fn errors_us(&self, series: &FrameSeries, latency_us: f64) -> Vec<f64> {
        let expected_us = latency_us + series.settings.trigger_delay_us;
        let phases = series.stamps.iter().filter_map(|stamp| self.phase_us(stamp));
        phases.map(|phase_us| wrapped(phase_us - expected_us, self.stats.period_us)).collect()
    }
}

/// A time within half a period to either side.
fn wrapped(us: f64, period_us: f64) -> f64 {
    us - (us / period_us).round() * period_us
}

/// The median, if there is any value.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use raysweep_core::Shutter;

    use super::*;

    const PERIOD_NS: i64 = 16_666_667;

    fn line(count: i64) -> SeenLine {
        let true_ns: Vec<i64> = (0..count).map(|edge| edge * PERIOD_NS).collect();
        let edges = true_ns.iter().map(|&host_ns| Edge { seq: 0, host_ns }).collect();
        let stats = VsyncStats { period_us: us_from_ns(PERIOD_NS), ..VsyncStats::default() };
        SeenLine { edges, stats, true_ns, error: None }
    }

    fn series(delay_us: f64, starts_ns: &[i64]) -> FrameSeries {
        let stamp = |&exposure_start_ns| FrameStamp {
            seq: 0,
            device_ns: 0,
            exposure_start_ns,
            host_ns: 0,
            exposure_us: None,
        };
        let settings =
            CameraSettings { shutter: Shutter::Rolling, exposure_us: 600.0, trigger_delay_us: delay_us };
        FrameSeries { settings, stamps: starts_ns.iter().map(stamp).collect(), lost: BTreeMap::new() }
    }

    #[test]
    fn exposures_are_held_against_edges_also_where_the_delay_exceeds_a_period() {
        let line = line(10);
        let at = |edge: i64, after_us: i64| edge * PERIOD_NS + after_us * 1000;
        let near = |found: &[f64], expected: f64| found.iter().all(|us| (us - expected).abs() < 0.01);
        let found = line.errors_us(&series(2000.0, &[at(1, 2008), at(3, 2008)]), 8.0);
        assert!(found.len() == 2 && near(&found, 0.0), "{found:?}");
        // 20 ms after its edge, and 5 us early.
        let found = line.errors_us(&series(19_992.0, &[at(2, 19_995)]), 8.0);
        assert!(near(&found, -5.0), "{found:?}");
        assert!(line.errors_us(&series(0.0, &[-1]), 8.0).is_empty(), "before the first edge");
        assert!((line.spacing_us().unwrap() - 16_666.667).abs() < 1e-6);
    }
}
