//! The viewfinder of a dot rig: the mirror holds the dot while the camera looks.

use std::sync::atomic::{AtomicBool, Ordering};

use raysweep_config::plan::ViewfinderPlan;
use raysweep_core::{
    CameraSettings, DeviceErrorKind, FinderPicture, FramePool, MirrorPath, PathError, SettingsId, Shutter,
    Tilt,
};
use raysweep_pipeline::dots::Arrival;
use raysweep_processing::viewfinder::{CountScale, EXPOSED_SHARE, saturation_dn};
use raysweep_proto::RunState;

use super::LitTime;
use super::finder::{Finder, FinderRig};
use crate::devices::dots::FRAMES_AT_WORK;
use crate::devices::dots::camera::FrameRefused;
use crate::devices::dots::motion::Motion;
use crate::devices::dots::play::Player;
use crate::rig::{DotDevices, DotRig, Pace};
use crate::run::error::RunError;
use crate::run::life::Run;
use crate::run::orders::Order;

/// Duration of the path that holds the mirror, which is played again and again.
const HELD_S: f64 = 0.5;
/// How often: a day.
const ROUNDS: u32 = 172_800;

/// The path that holds the mirror.
///
/// # Errors
/// Beyond the mirror's limits.
pub fn path(rig: &DotRig, plan: &ViewfinderPlan, picture: FinderPicture) -> Result<MirrorPath, PathError> {
    let [x_deg, y_deg] = plan.tilt_deg;
    let samples = ((HELD_S * plan.rate_hz).ceil() as usize).max(2);
    let tilts = std::iter::repeat_n(Tilt::new(x_deg, y_deg), samples);
    let light = if picture == FinderPicture::Black { 0 } else { 255 };
    Ok(MirrorPath::through(tilts, plan.rate_hz, &rig.file.limits())?.with_light(|_| light))
}

/// Camera settings with the plan's exposure.
pub fn settings(rig: &DotRig, plan: &ViewfinderPlan) -> CameraSettings {
    let most_us = EXPOSED_SHARE * 1e6 / plan.camera_rate_hz;
    let exposure_us = plan.exposure_us.unwrap_or(rig.file.camera.white_exposure_us.min(most_us));
    CameraSettings { shutter: Shutter::Global, exposure_us, trigger_delay_us: 0.0 }
}

/// Shows pictures until the run is told to end, or the plan's time is over.
///
/// # Errors
/// When a device fails, or light is not permitted.
pub fn view(rig: &DotRig, plan: &ViewfinderPlan, run: &Run, lit: &mut LitTime) -> Result<(), RunError> {
    let opened = rig.open(&run.data, plan.camera_rate_hz)?;
    let DotDevices { mut camera, mirror, stand, clock, pace, .. } = run.probes.instead_of_dots(opened);
    let mut motion = Motion::new(mirror);
    let (orders, capabilities) = (&*run.orders, camera.capabilities().clone());
    let (size, format) = ((capabilities.height, capabilities.width), capabilities.format);
    let mut settings = settings(rig, plan);
    camera.configure(SettingsId { point: 0, attempt: 0 }, &settings)?;
    camera.arm()?;
    let _ = run.board.go(RunState::Armed);
    let _ = run.board.go(RunState::Running);
    let full_dn = format.max_value();
    let scale =
        CountScale { black_dn: rig.file.camera.black_dn(), saturation_dn: saturation_dn(format), full_dn };
    let seen = FinderRig {
        size,
        format,
        scale,
        white_dn: None,
        exposure_us: settings.exposure_us,
        is_dot_rig: true,
    };
    let mut finder = Finder::new(run, plan, &seen);
    let mut player = Player {
        orders,
        board: &run.board,
        motion: &mut motion,
        camera: &mut *camera,
        pool: FramePool::new(FRAMES_AT_WORK, format.frame_bytes(size.0 * size.1)),
        stand,
        clock,
        pace,
    };
    let viewed = watch(&mut player, &mut finder, rig, plan, &mut settings, lit);
    let _ = run.board.go(RunState::Draining);
    // Turn the light off before anything else ends.
    drop(motion);
    if let Err(error) = camera.disarm() {
        tracing::warn!(%error, "camera not disarmed");
    }
    viewed
}

/// Holds the dot and shows frames; parks the mirror for each change.
fn watch(
    player: &mut Player<'_>,
    finder: &mut Finder,
    rig: &DotRig,
    plan: &ViewfinderPlan,
    settings: &mut CameraSettings,
    lit: &mut LitTime,
) -> Result<(), RunError> {
    let (orders, pace) = (player.orders, player.pace);
    let mut writes = 0;
    loop {
        orders.wait_while_paused_until(finder.ends());
        if !orders.go_on() || finder.is_over() {
            return Ok(());
        }
        let wanted = orders.look.take();
        finder.change(&wanted);
        if let Some(exposure_us) = wanted.exposure_us {
            let wanted = CameraSettings { exposure_us, ..*settings };
            writes += 1;
            match player.camera.configure(SettingsId { point: 0, attempt: writes }, &wanted) {
                Ok(_) => {
                    *settings = wanted;
                    finder.expose(exposure_us, 0.0);
                }
                Err(error) if error.kind == DeviceErrorKind::OutOfRange => finder.complain(error.to_string()),
                Err(error) => return Err(error.into()),
            }
        }
        let path = path(rig, plan, finder.picture()).map_err(|error| RunError::Frame(error.to_string()))?;
        let enough = AtomicBool::new(false);
        let mut failed = None;
        lit.note(path.is_lit());
        let played = player.play(&path, ROUNDS, u64::MAX, &enough, &mut |arrival: Arrival| {
            let is_enough = finder.is_over() || orders.look.is_changed() || orders.now() != Order::Go;
            enough.fetch_or(is_enough, Ordering::Relaxed);
            if is_enough || (pace == Pace::Devices && !finder.time_to_next().is_zero()) {
                return Ok(());
            }
            if let Err(error) = finder.unpack(&arrival.frame.data) {
                failed = Some(RunError::Frame(error));
                return Err(FrameRefused::Closed);
            }
            finder.show();
            if pace == Pace::Pipeline {
                orders.rest(finder.time_to_next());
            }
            Ok(())
        });
        lit.note(false);
        played?;
        if let Some(error) = failed {
            return Err(error);
        }
    }
}
