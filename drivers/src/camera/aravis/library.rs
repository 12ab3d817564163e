//! Interface to libaravis: finding and opening cameras, their features and their clock.

use std::ffi::{CStr, c_uint};
use std::net::IpAddr;
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use aravis::glib;
use aravis::glib::object::Cast;
use aravis::prelude::*;
use aravis::{Aravis, Camera, ChunkParser, GcFeatureNode, GvDevice};
use raysweep_core::{Clock, DeviceError, DeviceErrorKind, RoundTrip};

use super::features::{FeatureError, Features, Result, first_present};

/// A camera that answered.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct FoundCamera {
    /// Its name in a rig file: `camera.aravis.name`.
    pub name: String,
    /// Manufacturer.
    pub vendor: String,
    /// Model name.
    pub model: String,
    /// Its location: an IP address (`camera.aravis.address`) or a place on the USB.
    pub address: String,
    /// GigEVision or USB3Vision.
    pub protocol: String,
}

/// The library has one list of devices and one parser of camera descriptions per process. Two cameras that open at
/// once would share the parser's state (libaravis issue 159), so whatever lists, opens or parses holds this lock.
static LIBRARY: Mutex<Option<Aravis>> = Mutex::new(None);

fn library() -> MutexGuard<'static, Option<Aravis>> {
    LIBRARY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The version of libaravis that this process has loaded.
#[allow(unsafe_code, reason = "the bindings lack these functions of C")]
pub fn version() -> String {
    // SAFETY: as libaravis' arvmisc.h declares them; they take nothing and return constants.
    unsafe extern "C" {
        safe fn arv_get_major_version() -> c_uint;
        safe fn arv_get_minor_version() -> c_uint;
        safe fn arv_get_micro_version() -> c_uint;
    }
    format!("{}.{}.{}", arv_get_major_version(), arv_get_minor_version(), arv_get_micro_version())
}

/// Searches all networks and the USB for cameras; takes about a second.
pub fn discover() -> Vec<FoundCamera> {
    let mut library = library();
    if library.is_none() {
        *library = Aravis::initialize().ok();
    }
    let devices = library.as_ref().map(Aravis::get_device_list).unwrap_or_default();
    let text = |text: &CStr| text.to_string_lossy().into_owned();
    let found = devices.iter().map(|device| FoundCamera {
        name: text(&device.id),
        vendor: text(&device.vendor),
        model: text(&device.model),
        address: text(&device.address),
        protocol: text(&device.protocol),
    });
    found.collect()
}

/// When a camera last answered on its control channel and last delivered a frame; shared by the two threads.
pub struct Health {
    clock: Clock,
    answered_ns: AtomicI64,
    gave_frame_ns: AtomicI64,
}

impl Health {
    pub fn new(clock: Clock) -> Self {
        let now_ns = clock.now_ns();
        Self { clock, answered_ns: AtomicI64::new(now_ns), gave_frame_ns: AtomicI64::new(i64::MIN) }
    }

    /// Records that a frame was taken.
    pub fn gave_frame(&self, host_ns: i64) {
        self.gave_frame_ns.store(host_ns, Ordering::Relaxed);
    }

    pub fn gave_frame_within(&self, time: Duration) -> bool {
        let ago_ns = self.clock.now_ns().saturating_sub(self.gave_frame_ns.load(Ordering::Relaxed));
        u128::try_from(ago_ns).is_ok_and(|ago_ns| ago_ns < time.as_nanos())
    }

    pub fn answered(&self) {
        self.answered_ns.store(self.clock.now_ns(), Ordering::Relaxed);
    }

    /// Records that the camera is gone.
    pub fn gone(&self) {
        self.answered_ns.store(i64::MIN, Ordering::Relaxed);
    }

    pub fn answered_ns(&self) -> i64 {
        self.answered_ns.load(Ordering::Relaxed)
    }
}

/// An open camera that this process controls.
pub struct Device {
    pub camera: Camera,
    device: aravis::Device,
    health: Arc<Health>,
}

impl Device {
    /// Opens a camera by its address or name.
    ///
    /// # Errors
    /// `Disconnected` if it does not answer, `Busy` if another program controls it.
    pub fn open(named: &str, health: Arc<Health>) -> std::result::Result<Self, DeviceError> {
        if named.parse::<IpAddr>().is_err() {
            // Without the list, finding a name takes ten times as long.
            discover();
        }
        let no_camera = |what: String| DeviceError::new("camera", DeviceErrorKind::Disconnected, what);
        let opening = library();
        let camera = Camera::new(Some(named));
        drop(opening);
        let camera = camera.map_err(|error| {
            no_camera(format!(
                "no camera answers at {named}: {error}; is it powered and on this network? `raysweep devices` lists those that answer"
            ))
        })?;
        let device = camera
            .device()
            .ok_or_else(|| no_camera(format!("{named} is no device that libaravis can open")))?;
        if device.downcast_ref::<GvDevice>().is_some_and(|device| !device.is_controller()) {
            let what = format!(
                "{named} is controlled by another program: raysweepd holds it while a run is in progress; a program that was killed frees it within 3 s"
            );
            return Err(DeviceError::new("camera", DeviceErrorKind::Busy, what));
        }
        // Off by default: out-of-range values would reach the camera and come back as obscure protocol errors.
        device.set_range_check_policy(aravis::RangeCheckPolicy::Enable);
        health.answered();
        Ok(Self { camera, device, health })
    }

    /// Manufacturer, model and serial number.
    pub fn model(&self) -> String {
        let parts = [self.camera.vendor_name(), self.camera.model_name(), self.camera.device_serial_number()];
        parts.into_iter().filter_map(|part| part.ok().map(String::from)).collect::<Vec<_>>().join(" ")
    }

    /// What reads the chunk data of frames; parses the camera's description again.
    pub fn chunk_parser(&self) -> Option<ChunkParser> {
        let _parsing = library();
        self.camera.create_chunk_parser()
    }

    pub fn genicam(&self) -> Option<aravis::Gc> {
        self.device.genicam()
    }

    /// Reads anything to find out whether the camera is there.
    pub fn ping(&self) -> Result<()> {
        self.integer("Width").map(drop)
    }

    fn node(&self, name: &str) -> Option<GcFeatureNode> {
        self.device.feature(name)?.downcast::<GcFeatureNode>().ok()
    }

    /// Records that the camera has answered, even if with an error.
    fn answer<T>(&self, name: &str, result: std::result::Result<T, glib::Error>) -> Result<T> {
        let error = match result {
            Ok(value) => {
                self.health.answered();
                return Ok(value);
            }
            Err(error) => FeatureError::new(name, kind_of(&error), error.message()),
        };
        if !matches!(error.kind, DeviceErrorKind::Timeout | DeviceErrorKind::Disconnected) {
            self.health.answered();
        }
        Err(error)
    }
}

/// Converts an error of libaravis.
pub fn device_error(what: &str, error: &glib::Error) -> DeviceError {
    DeviceError::new("camera", kind_of(error), format!("{what}: {error}"))
}

fn kind_of(error: &glib::Error) -> DeviceErrorKind {
    use aravis::{DeviceError as Fault, GcError};
    match error.kind::<Fault>() {
        Some(Fault::Timeout) => return DeviceErrorKind::Timeout,
        Some(Fault::NotConnected | Fault::NotFound | Fault::TransferError) => {
            return DeviceErrorKind::Disconnected;
        }
        Some(Fault::NotController | Fault::ProtocolErrorAccessDenied | Fault::ProtocolErrorBusy) => {
            return DeviceErrorKind::Busy;
        }
        Some(Fault::FeatureNotFound) => return DeviceErrorKind::Unsupported,
        _ => {}
    }
    match error.kind::<GcError>() {
        Some(GcError::OutOfRange | GcError::EnumEntryNotFound) => DeviceErrorKind::OutOfRange,
        Some(GcError::NodeNotFound) => DeviceErrorKind::Unsupported,
        _ => DeviceErrorKind::Protocol,
    }
}

impl Features for Device {
    fn has(&self, name: &str) -> bool {
        // Queries the node itself: the bindings' shortcuts on the device discard the answer.
        self.node(name).is_some_and(|node| {
            node.is_implemented().unwrap_or(false) && node.is_available().unwrap_or(false)
        })
    }

    fn float(&self, name: &str) -> Result<f64> {
        self.answer(name, self.device.float_feature_value(name))
    }

    fn set_float(&self, name: &str, value: f64) -> Result<()> {
        self.answer(name, self.device.set_float_feature_value(name, value))
    }

    fn float_range(&self, name: &str) -> Result<RangeInclusive<f64>> {
        self.answer(name, self.device.float_feature_bounds(name)).map(|(low, high)| low..=high)
    }

    fn integer(&self, name: &str) -> Result<i64> {
        self.answer(name, self.device.integer_feature_value(name))
    }

    fn set_integer(&self, name: &str, value: i64) -> Result<()> {
        self.answer(name, self.device.set_integer_feature_value(name, value))
    }

    fn integer_range(&self, name: &str) -> Result<RangeInclusive<i64>> {
        self.answer(name, self.device.integer_feature_bounds(name)).map(|(low, high)| low..=high)
    }

    fn text(&self, name: &str) -> Result<String> {
        self.answer(name, self.device.string_feature_value(name)).map(String::from)
    }

    fn set_text(&self, name: &str, value: &str) -> Result<()> {
        self.answer(name, self.device.set_string_feature_value(name, value))
    }

    fn choices(&self, name: &str) -> Result<Vec<String>> {
        let choices = self.device.dup_available_enumeration_feature_values_as_strings(name);
        Ok(self.answer(name, choices)?.into_iter().map(String::from).collect())
    }

    fn boolean(&self, name: &str) -> Result<bool> {
        self.answer(name, self.device.boolean_feature_value(name))
    }

    fn set_boolean(&self, name: &str, value: bool) -> Result<()> {
        self.answer(name, self.device.set_boolean_feature_value(name, value))
    }

    fn execute(&self, name: &str) -> Result<()> {
        self.answer(name, self.device.execute_command(name))
    }

    fn set_line(&self, line: &str) -> Result<()> {
        let name = line.split('=').next().unwrap_or(line);
        self.answer(name, self.device.set_features_from_string(line))
    }
}

/// Reads a camera's clock.
#[derive(Debug, Clone, Copy)]
pub struct DeviceClock {
    latch: &'static str,
    value: &'static str,
    ticks_per_s: i64,
}

/// Times between two readings of a clock of unknown unit; longer if the host was too busy for a decision.
const CLOCK_LOOKS_MS: [u64; 5] = [20, 40, 80, 160, 320];
/// Maximum relative error of a clock's rate.
const CLOCK_ERROR: f64 = 0.1;

/// Whether a clock may count `ticks_per_s`, given two round trips that assume nanoseconds. Makes no assumption on how
/// a round trip divides into the way there and the way back.
fn may_have_unit(begin: RoundTrip, end: RoundTrip, ticks_per_s: i64) -> bool {
    let passed_ns = end.device_ns.saturating_sub(begin.device_ns) as f64 * 1e9 / ticks_per_s as f64;
    let shortest_ns = (end.request_ns - begin.receive_ns) as f64 * (1.0 - CLOCK_ERROR);
    let longest_ns = (end.receive_ns - begin.request_ns) as f64 * (1.0 + CLOCK_ERROR);
    (shortest_ns..longest_ns).contains(&passed_ns)
}

/// Clock readings in a row: each takes as much processor time as half a frame.
const ASKS: usize = 2;

impl DeviceClock {
    /// Determines how to read the camera's clock, and its unit; `None` if it cannot be read or stands still.
    pub fn probe(device: &Device, clock: &Clock) -> Option<Self> {
        let latch = first_present(device, &["TimestampLatch", "GevTimestampControlLatch"])?;
        let value = first_present(device, &["TimestampLatchValue", "GevTimestampValue"])?;
        let nanoseconds = Self { latch, value, ticks_per_s: 1_000_000_000 };
        // The standards disagree on whether the value is in ticks or nanoseconds, so its behaviour decides.
        let gige = device.device.downcast_ref::<GvDevice>();
        let stated = gige.and_then(|device| device.timestamp_tick_frequency().ok());
        let stated = stated.and_then(|hz| i64::try_from(hz).ok());
        let stated = stated.filter(|hz| *hz > 0 && *hz != nanoseconds.ticks_per_s);
        CLOCK_LOOKS_MS.into_iter().find_map(|look_ms| {
            let begin = nanoseconds.ask_once(device, clock).ok()?;
            thread::sleep(Duration::from_millis(look_ms));
            let end = nanoseconds.ask_once(device, clock).ok()?;
            let possible = [Some(nanoseconds.ticks_per_s), stated].into_iter().flatten();
            let mut possible = possible.filter(|&ticks_per_s| may_have_unit(begin, end, ticks_per_s));
            match (possible.next(), possible.next()) {
                (Some(ticks_per_s), None) => Some(Self { ticks_per_s, ..nanoseconds }),
                _ => None,
            }
        })
    }

    /// Reads the camera's clock several times in a row and returns the reading with the shortest round trip, which is
    /// the most accurate. The first one is slow if a processor was asleep.
    pub fn ask(&self, device: &Device, clock: &Clock) -> Result<RoundTrip> {
        let mut quickest = self.ask_once(device, clock)?;
        for _ in 1..ASKS {
            let trip = self.ask_once(device, clock)?;
            if trip.duration_ns() < quickest.duration_ns() {
                quickest = trip;
            }
        }
        Ok(quickest)
    }

    fn ask_once(&self, device: &Device, clock: &Clock) -> Result<RoundTrip> {
        let request_ns = clock.now_ns();
        device.execute(self.latch)?;
        let receive_ns = clock.now_ns();
        let ticks = i128::from(device.integer(self.value)?);
        let device_ns = ticks * 1_000_000_000 / i128::from(self.ticks_per_s);
        Ok(RoundTrip { request_ns, device_ns: device_ns.try_into().unwrap_or(i64::MAX), receive_ns })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clocks_unit_is_told_however_long_its_answers_travel() {
        const UNITS: [i64; 2] = [1_000_000_000, 125_000_000];
        let trip = |request_ns, there_ns, back_ns, ticks_per_s: i64| RoundTrip {
            request_ns,
            device_ns: (request_ns + there_ns) * ticks_per_s / 1_000_000_000,
            receive_ns: request_ns + there_ns + back_ns,
        };
        // Times there and back of two round trips, the second 20 ms after the first.
        let possible = |truth, [there, back]: [i64; 2], [there_again, back_again]: [i64; 2]| {
            let begin = trip(1_000_000_000, there, back, truth);
            let end = trip(begin.receive_ns + 20_000_000, there_again, back_again, truth);
            UNITS.map(|unit| may_have_unit(begin, end, unit))
        };
        let (quick, slow) = (50_000, 15_000_000);
        let ways = [[quick, quick], [slow, quick], [quick, slow], [slow, slow]];
        for (first, second) in ways.into_iter().flat_map(|first| ways.map(|second| (first, second))) {
            assert_eq!(possible(UNITS[0], first, second), [true, false], "{first:?} {second:?}");
            assert_eq!(possible(UNITS[1], first, second), [false, true], "{first:?} {second:?}");
        }
        let stalled = [900_000_000, quick];
        assert_eq!(possible(UNITS[1], stalled, stalled), [true, true], "a longer look is needed");
        let still = RoundTrip { request_ns: 0, device_ns: 7, receive_ns: quick };
        let later = RoundTrip { request_ns: 2 * quick, receive_ns: 3 * quick, ..still };
        assert!(!UNITS.into_iter().any(|unit| may_have_unit(still, later, unit)), "it stands still");
        let [least, most] = [i64::MIN, i64::MAX].map(|device_ns| RoundTrip { device_ns, ..still });
        assert!(!UNITS.into_iter().any(|unit| may_have_unit(least, most, unit)), "it says anything");
    }
}
