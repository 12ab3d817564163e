//! The devices: whether each opens, and how well camera, line and projector go together.

use std::path::Path;

use raysweep_config::plan::SweepPlan;
use raysweep_config::rig::aravis::TimestampAt;
use raysweep_config::rig::dots::DotCameraDriver;
use raysweep_config::rig::plane::{CameraDriver, ProjectorDriver};
use raysweep_config::rig::vsync::VsyncDriver;
use raysweep_core::{
    CameraCapabilities, CameraSettings, DeviceErrorKind, LossCause, Projector, Shutter, ns_from_us,
};
use raysweep_drivers::mirror::{MirrorReport, greet};
use raysweep_pipeline::Line;

use super::checkup::Checkup;
use super::network;
use super::timing::{FrameSeries, SeenFrames, SeenLine, median, watch};
use crate::mirror::state_file;
use crate::rig::{DotRig, OpenedEach, Rig, RigError};

/// Exposure of the frames that are taken, if the camera allows it.
const EXPOSURE_US: f64 = 600.0;
/// Change of the trigger delay, if the camera allows it.
const DELAY_STEP_US: f64 = 2000.0;
/// Frame rate at which a dot rig's camera is opened.
const DOT_RATE_HZ: f64 = 100.0;
/// Share of frames that must have an edge.
const MOST_FRAMES: f64 = 0.95;
/// Share of frames without which no sweep ends: repeated attempts at a point take up to three times its frames, so that
/// a third of them must be usable, and near that border a point succeeds only now and then.
const LEAST_FRAMES: f64 = 0.5;
/// Latencies that a rig file may state.
const LATENCIES_US: std::ops::RangeInclusive<f64> = 0.0..=1e6;

const CAMERA: &str = "camera";
const VSYNC: &str = "vsync";
const PROJECTOR: &str = "projector";
const EDGES: &str = "vsync edges";
const FRAMES: &str = "frames";
const TIES: &str = "frames and edges";
const DELAY: &str = "trigger delay";
/// What is needed to tell how frames and edges go together.
const NEEDED: &[&str] = &[CAMERA, VSYNC, EDGES, FRAMES];

/// Examines the devices of a plane rig.
pub(super) fn examine_plane(checkup: &mut Checkup, rig: &Rig, go_on: &(dyn Fn() -> bool + Sync)) {
    let OpenedEach { camera, vsync, projector, pace } = match rig.open_each() {
        Ok(opened) => opened,
        Err(error) => return checkup.failure("rig file", error.to_string(), "correct the rig file"),
    };
    let camera = camera.map(|(camera, ..)| camera);
    report_opened(checkup, CAMERA, camera.as_ref().map(|camera| described(camera.capabilities())));
    report_opened(checkup, VSYNC, vsync.as_ref().map(|_| opened(watcher(rig.file.vsync.driver))));
    let is_operated = rig.file.projector.driver == ProjectorDriver::External;
    let mut projector = projector.map(|(projector, _questions)| projector);
    report_opened(
        checkup,
        PROJECTOR,
        projector.as_ref().map(|_| match is_operated {
            true => "operated by a person; not examined".into(),
            false if rig.file.projector.driver == ProjectorDriver::Sim => opened(SIMULATED),
            false => opened("drm"),
        }),
    );
    // Light from here on would be light without permission, so the devices are examined in darkness.
    if let Some(projector) = projector.as_mut().ok().filter(|_| !is_operated) {
        blank(checkup, &mut **projector);
    }
    let (camera, vsync) = (camera.ok(), vsync.ok());
    let capabilities = camera.as_ref().map(|camera| camera.capabilities().clone());
    if let Some(capabilities) =
        capabilities.as_ref().filter(|_| rig.file.camera.driver == CameraDriver::Aravis)
    {
        network::examine_buffers(checkup, &rig.file.camera.aravis, frame_bytes(capabilities));
    }
    let section = &rig.file.vsync;
    let line = Line { period_ns: ns_from_us(section.period_us), gate_ns: ns_from_us(section.gate_us) };
    let has_vsync = vsync.is_some();
    let camera = camera.zip(capabilities.as_ref().map(settings_of));
    let (seen, frames) = watch(vsync, camera, line, pace, go_on);
    if has_vsync {
        examine_line(checkup, rig, &seen);
    }
    if let Some(capabilities) = &capabilities {
        examine_frames(checkup, rig, &frames, has_vsync && !seen.edges.is_empty());
        examine_ties(checkup, rig, capabilities, &seen, &frames);
        examine_delay(checkup, rig, capabilities, &seen, &frames);
    }
}

/// Examines the devices of a dot rig. Its frames need the mirror to move, so none are taken.
pub(super) fn examine_dots(checkup: &mut Checkup, rig: &DotRig, data: &Path) {
    match rig.open_camera(DOT_RATE_HZ) {
        Ok(Some(camera)) => {
            let capabilities = camera.capabilities();
            checkup.ok(CAMERA, described(capabilities));
            if rig.file.camera.driver == DotCameraDriver::Aravis {
                network::examine_buffers(checkup, &rig.file.camera.aravis, frame_bytes(capabilities));
            }
        }
        Ok(None) => checkup.ok(CAMERA, "simulated"),
        Err(error) => report_opened(checkup, CAMERA, Err::<String, _>(&error)),
    }
    examine_mirror(checkup, rig, data);
    let why = "the mirror's samples trigger the camera, and the mirror is not moved: `raysweep run` with a plan of kind \"response\" shows whether frames arrive";
    checkup.skipped(FRAMES, why);
}

fn examine_mirror(checkup: &mut Checkup, rig: &DotRig, data: &Path) {
    const MIRROR: &str = "mirror";
    const LIGHT: &str = "light";
    let Some(section) = rig.file.mirror.as_ref().filter(|_| rig.has_real_mirror()) else {
        return checkup.ok(MIRROR, "simulated");
    };
    let state = state_file(data);
    let guard = rig.light_guard(data);
    if state.exists() && !MirrorReport::read(&state, &guard).parked {
        let remedy = format!("`raysweep park --state {}`", state.display());
        checkup.failure(MIRROR, "it was left away from its origin", remedy);
    } else {
        match greet(section.driver, section.port.as_deref().unwrap_or(Path::new(""))) {
            Ok(model) => {
                let model = model.unwrap_or_default();
                checkup.ok(MIRROR, format!("{model} answers; it was not moved"));
            }
            Err(error) => report_opened(checkup, MIRROR, Err::<String, _>(&error.into())),
        }
    }
    match guard.permits() {
        Ok(()) => checkup.ok(LIGHT, "permitted: the interlock is closed, or an operator has armed the light"),
        Err(why) => {
            let remedy = match section.interlock {
                Some(_) => {
                    "close the enclosure: with an interlock, that alone decides; if it cannot be read, mend `mirror.interlock` first"
                }
                None => "make sure that it is safe, then `raysweep arm-light`",
            };
            checkup.warning(LIGHT, format!("not permitted: {why}"), remedy);
        }
    }
}

/// Reports whether a device could be opened.
fn report_opened(checkup: &mut Checkup, name: &str, opened: Result<String, &RigError>) {
    match opened {
        Ok(found) => checkup.ok(name, found),
        Err(error) => {
            let kind = if let RigError::Device(error) = error { Some(error.kind) } else { None };
            let remedy = match kind {
                Some(DeviceErrorKind::Busy) => {
                    "end the other program that has it open: `fuser -v PORT` or `lsof PORT` as root names it"
                }
                Some(DeviceErrorKind::NotReady) => {
                    "grant access to it as shown above, or do what it asks for"
                }
                Some(DeviceErrorKind::Disconnected | DeviceErrorKind::Timeout) => {
                    "check power and cable, and that the rig file names the right one: `raysweep setup` lists what answers"
                }
                Some(_) => "correct the rig file",
                None => "correct the rig file; docs/reference/rig.md lists its keys",
            };
            checkup.failure(name, error.to_string(), remedy);
        }
    }
}

fn blank(checkup: &mut Checkup, projector: &mut dyn Projector) {
    if let Err(error) = projector.blank() {
        checkup.failure(PROJECTOR, format!("cannot be made dark: {error}"), "switch it off by hand");
    }
}

const SIMULATED: &str = "simulated";

fn opened(driver: &str) -> String {
    format!("{driver}, open")
}

/// The watcher's name in rig files.
fn watcher(driver: VsyncDriver) -> &'static str {
    match driver {
        VsyncDriver::Sim => SIMULATED,
        VsyncDriver::ModemLine => "modemline",
        VsyncDriver::Pps => "pps",
        VsyncDriver::Fx2Lafw => "fx2lafw",
        VsyncDriver::TriggerBox => "triggerbox",
    }
}

fn described(camera: &CameraCapabilities) -> String {
    let CameraCapabilities { model, width, height, format, .. } = camera;
    format!("{model}, {width} x {height} {format:?}")
}

fn frame_bytes(camera: &CameraCapabilities) -> usize {
    camera.format.frame_bytes(camera.width * camera.height)
}

/// Two settings that differ by the trigger's delay alone, if the camera can delay it.
fn settings_of(camera: &CameraCapabilities) -> Vec<CameraSettings> {
    let (shortest_us, longest_us) = (camera.exposure_us.start(), camera.exposure_us.end());
    let exposure_us = EXPOSURE_US.clamp(*shortest_us, *longest_us);
    let (least_us, most_us) = (*camera.trigger_delay_us.start(), *camera.trigger_delay_us.end());
    let with = |trigger_delay_us| CameraSettings { shutter: Shutter::Rolling, exposure_us, trigger_delay_us };
    let mut settings = vec![with(least_us)];
    if most_us > least_us {
        settings.push(with((least_us + DELAY_STEP_US).min(most_us)));
    }
    settings
}

fn examine_line(checkup: &mut Checkup, rig: &Rig, line: &SeenLine) {
    let section = &rig.file.vsync;
    if let Some(error) = &line.error {
        let remedy = "check its cable; `raysweep doctor` again";
        return checkup.failure(EDGES, error.to_string(), remedy);
    }
    let stats = &line.stats;
    let Some(spacing_us) = line.spacing_us() else {
        let remedy = match section.driver {
            VsyncDriver::ModemLine => {
                "switch the projector on and let it show a picture; check that its VSYNC reaches the pin that vsync.modemline.line names, at RS-232 or TTL levels as the port needs"
            }
            VsyncDriver::Fx2Lafw => {
                "switch the projector on and let it show a picture; check that its VSYNC reaches the channel that vsync.fx2lafw.channels names, and that the grounds are joined"
            }
            _ => {
                "switch the projector on and let it show a picture; check the wire from its VSYNC to the watcher, and that the grounds are joined"
            }
        };
        return checkup.failure(EDGES, "no edge within 2 s", remedy);
    };
    let max_jitter_us = SweepPlan::default().max_jitter_us;
    let found = format!(
        "{} edges, period {:.2} us, jitter {:.1} us rms, {:.1} us at the 99th percentile, {} missed, {} false",
        stats.edges, stats.period_us, stats.jitter_us, stats.jitter_p99_us, stats.missed, stats.false_edges
    );
    if stats.edges < 2 || stats.false_edges > stats.edges {
        let found = format!(
            "edges come every {spacing_us:.1} us, but vsync.period_us = {}: they are taken for false",
            section.period_us
        );
        let remedy = format!(
            "set vsync.period_us = {spacing_us:.2}, if the projector runs at that rate; otherwise look for the second source of edges on the wire"
        );
        checkup.failure(EDGES, found, remedy);
    } else if stats.jitter_p99_us > max_jitter_us {
        let remedy = format!(
            "frames whose trigger is off by more than a plan's max_jitter_us, {max_jitter_us} by default, are lost: watch the line by a better device (fx2lafw or pps rather than a modem line), shorten the wire, or raise max_jitter_us and accept blurred delays"
        );
        checkup.warning(EDGES, found, remedy);
    } else if stats.missed + stats.false_edges > 0 {
        let remedy = "look at the line with an oscilloscope for slow edges, crosstalk and a missing ground; the triggers of these edges cost frames";
        checkup.warning(EDGES, found, remedy);
    } else {
        checkup.ok(EDGES, found);
    }
}

fn examine_frames(checkup: &mut Checkup, rig: &Rig, frames: &SeenFrames, has_edges: bool) {
    let taken: usize = frames.series.iter().map(|series| series.stamps.len()).sum();
    if let Some(error) = &frames.error {
        let remedy = "check the camera's power and cable; `raysweep doctor` again";
        return checkup.failure(FRAMES, format!("{taken} arrived, then: {error}"), remedy);
    }
    let is_whole = frames.series.iter().all(|series| !series.stamps.is_empty());
    if !is_whole && frames.is_cut_short {
        let found = format!("{taken} arrived until the examination ended, too few to judge the camera by");
        return checkup.failure(FRAMES, found, "`raysweep doctor` again");
    }
    let lost = losses(&frames.series);
    let text = lost.iter().map(|(cause, frames)| format!("{frames} lost ({cause})")).collect::<Vec<_>>();
    if !is_whole && lost.is_empty() {
        let file = &rig.file.camera;
        let setting = match file.driver {
            CameraDriver::Aravis => {
                format!("camera.aravis.trigger_source, which is {:?}", file.aravis.trigger_source)
            }
            _ => "camera.v4l2.controls, which must switch the external trigger on".into(),
        };
        let remedy = match has_edges {
            true => format!(
                "the line has edges, so look at the wire from the projector's VSYNC to the camera's trigger input, its level, and {setting}"
            ),
            false => "the line has no edges either: see above".into(),
        };
        return checkup.failure(FRAMES, format!("{taken} frames, and then none for 2 s: no trigger"), remedy);
    }
    let lost_frames: u64 = lost.iter().map(|(_, frames)| frames).sum();
    match lost.first() {
        Some((cause, _)) => {
            let found = format!("{taken} arrived, {}", text.join(", "));
            let remedy = match cause {
                LossCause::PacketsLost => {
                    "see network buffers and packet size above; check the cable and the switch, and that no other camera shares the link"
                }
                LossCause::DriverFull => "the host is too busy: see real-time priority above",
                _ => "check the cable and the bandwidth of the link",
            };
            if (taken as f64) < LEAST_FRAMES * (taken as f64 + lost_frames as f64) {
                checkup.failure(FRAMES, format!("{found}: too many for a sweep to end"), remedy);
            } else {
                checkup.warning(FRAMES, found, remedy);
            }
        }
        None => checkup.ok(FRAMES, format!("{taken} arrived, none lost")),
    }
}

/// Lost frames by cause, most frequent first.
fn losses(series: &[FrameSeries]) -> Vec<(LossCause, u64)> {
    let mut lost = std::collections::BTreeMap::new();
    for (&cause, &frames) in series.iter().flat_map(|series| &series.lost) {
        *lost.entry(cause).or_default() += frames;
    }
    let mut lost: Vec<(LossCause, u64)> = lost.into_iter().collect();
    lost.sort_by_key(|&(_, frames)| std::cmp::Reverse(frames));
    lost
}

/// Whether each frame has its edge.
fn examine_ties(
    checkup: &mut Checkup,
    rig: &Rig,
    camera: &CameraCapabilities,
    line: &SeenLine,
    SeenFrames { series, .. }: &SeenFrames,
) {
    let first = series.first().map(|first| (first, line.errors_us(first, camera.trigger_latency_us)));
    let Some((first, errors_us)) = first.filter(|(_, errors_us)| !errors_us.is_empty()) else {
        let remedy = "`raysweep doctor` again; if that does not help, the camera's time stamps do not follow this host's clock: the log says how they are made";
        return checkup.unexamined(TIES, NEEDED, "no frame is dated after the first edge", remedy);
    };
    let max_jitter_us = SweepPlan::default().max_jitter_us;
    // A frame that was taken before the first edge was seen proves nothing.
    let judged = errors_us.len();
    let tied = errors_us.iter().filter(|error_us| error_us.abs() <= max_jitter_us).count();
    let off_us = median(errors_us).unwrap_or_default();
    let found = format!(
        "{tied} of {judged} frames begin within {max_jitter_us} us of where their edge puts them; the median is {off_us:+.1} us off"
    );
    if tied as f64 >= MOST_FRAMES * judged as f64 {
        checkup.ok(TIES, found);
    } else if off_us.abs() > max_jitter_us {
        checkup.failure(TIES, found, remedy_of_offset(rig, camera, first.settings.exposure_us, off_us));
    } else {
        let remedy = format!(
            "the camera's time stamps or the line's edges scatter: see vsync edges above, and use a camera whose stamps are made by its hardware (the log says so if frames are dated by their arrival); or raise a plan's max_jitter_us, {max_jitter_us} by default, and accept blurred delays"
        );
        if (tied as f64) < LEAST_FRAMES * judged as f64 {
            checkup.failure(TIES, found, remedy);
        } else {
            checkup.warning(TIES, found, remedy);
        }
    }
}

/// What makes frames that begin `off_us` from where their edges put them begin there.
fn remedy_of_offset(rig: &Rig, camera: &CameraCapabilities, exposure_us: f64, off_us: f64) -> String {
    let section = &rig.file.camera;
    let (table, key, stamps) = match section.driver {
        CameraDriver::Aravis => (
            "camera.aravis",
            "camera.aravis.trigger_activation",
            "camera.aravis.timestamp_at, the moment that its time stamps mean, ",
        ),
        CameraDriver::V4l2 => (
            "camera.v4l2",
            "the control that chooses the trigger's edge (camera.v4l2.controls)",
            "camera.row_time_us, by which stamps of a frame's end are dated back, ",
        ),
        CameraDriver::Sim => ("sim.camera", "sim.camera", ""),
    };
    if section.driver == CameraDriver::Aravis
        && (off_us.abs() - exposure_us).abs() <= SweepPlan::default().max_jitter_us
    {
        // A stamp of the other end of the exposure is off by the exposure.
        let (now, other) = match section.aravis.timestamp_at {
            TimestampAt::ExposureStart => ("exposure_start", "exposure_end"),
            TimestampAt::ExposureEnd => ("exposure_end", "exposure_start"),
        };
        if (off_us > 0.0) == (section.aravis.timestamp_at == TimestampAt::ExposureStart) {
            return format!(
                "set camera.aravis.timestamp_at = \"{other}\" (now \"{now}\"): the frames are off by their exposure of {exposure_us} us"
            );
        }
    }
    let latency_us = camera.trigger_latency_us + off_us;
    if LATENCIES_US.contains(&latency_us) {
        format!(
            "check {stamps}and {key}: which of the pulse's two edges triggers; if they and the camera's delay are right, set {table}.trigger_latency_us = {latency_us:.1} (now {})",
            camera.trigger_latency_us
        )
    } else {
        format!(
            "no camera begins before its trigger: check {stamps}and {key}: which of the pulse's two edges triggers; then that {table}.trigger_latency_us = {} is not too long",
            camera.trigger_latency_us
        )
    }
}

/// Whether the trigger's delay acts.
fn examine_delay(
    checkup: &mut Checkup,
    rig: &Rig,
    camera: &CameraCapabilities,
    line: &SeenLine,
    SeenFrames { series, .. }: &SeenFrames,
) {
    let is_genicam = rig.file.camera.driver == CameraDriver::Aravis;
    if camera.trigger_delay_us == (0.0..=0.0) {
        let remedy = match is_genicam {
            true => "take a camera with the feature TriggerDelay",
            false => {
                "name the maker's delay in the rig file (camera.v4l2.trigger_delay), or take a camera that has one"
            }
        };
        let found = "this camera cannot delay its trigger, so that delays cannot be swept";
        return checkup.failure(DELAY, found, remedy);
    }
    let measured = |series: &FrameSeries| {
        let off_us = median(line.errors_us(series, camera.trigger_latency_us))?;
        Some((series.settings.trigger_delay_us, off_us))
    };
    let measured: Vec<(f64, f64)> = series.iter().filter_map(measured).collect();
    let &[(first_told_us, first_us), (told_us, second_us)] = &measured[..] else {
        let remedy = "`raysweep doctor` again; if that does not help, see the frames above";
        return checkup.unexamined(
            DELAY,
            NEEDED,
            "that needs frames with two delays and their edges",
            remedy,
        );
    };
    let told_us = told_us - first_told_us;
    let moved_us = told_us + second_us - first_us;
    let found = format!("exposures moved by {moved_us:.1} us when told to move by {told_us:.1} us");
    if (moved_us - told_us).abs() <= SweepPlan::default().max_jitter_us {
        checkup.ok(DELAY, found);
    } else {
        checkup.failure(
            DELAY,
            found,
            match is_genicam {
                true => {
                    "check by the maker's viewer that the trigger delay acts in the mode that the rig file sets; camera.aravis.features can set what it needs"
                }
                false => {
                    "check by the maker's tool that the trigger delay acts in the mode that the rig file sets, and the unit of camera.v4l2.trigger_delay"
                }
            },
        );
    }
}
