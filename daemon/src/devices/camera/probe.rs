//! How late settings take effect, found out at the start of a run.

use std::time::Duration;

use raysweep_core::{CameraSettings, DeviceError, SettingsLatency};

use super::{POLL, Sequencer, Watchdog};

/// Changes of settings that are looked at: a latency that varies over four numbers of frames passes for constant once in
/// 4^7.
const CHANGES: u32 = 8;
/// Changes that must have shown when they acted; a false edge or a lost frame may hide it.
const ENOUGH: usize = 4;
/// By so much the exposure changes, where frames tell it.
const EXPOSURE_FACTOR: f64 = 1.25;

impl Sequencer {
    /// Changes settings to and fro and sees in the stamps of frames from which one on they act; nothing if too few tell.
    pub(super) fn probe(
        &mut self,
        settings: &CameraSettings,
    ) -> Result<Option<SettingsLatency>, DeviceError> {
        self.warm_up(i64::MIN)?;
        let mut other = self.apart_from(settings);
        let longer_us = settings.exposure_us * EXPOSURE_FACTOR;
        if self.ahead.frames_carry_exposure() && self.camera.capabilities().exposure_us.contains(&longer_us) {
            other.exposure_us = longer_us;
        }
        let mut late_frames = Vec::with_capacity(CHANGES as usize);
        // The first change does not count: nothing is known of what was before it.
        for change in 0..=CHANGES {
            self.pass_until_due()?;
            self.pass_through(if change % 2 == 0 { settings } else { &other })?;
            late_frames.extend(self.see_through()?.filter(|_| change > 0));
        }
        let found = late_frames.iter().min().zip(late_frames.iter().max());
        let latency = found
            .filter(|_| late_frames.len() >= ENOUGH)
            .map(|(&min_frames, &max_frames)| SettingsLatency { min_frames, max_frames });
        if let Some(latency) = latency {
            self.ahead.set_latency(latency);
        }
        tracing::info!(?latency, changes_seen = late_frames.len(), "how late the camera's settings act");
        Ok(latency)
    }

    /// Lets frames go by until settings may be written.
    fn pass_until_due(&mut self) -> Result<(), DeviceError> {
        let mut watchdog = Watchdog::default();
        while self.orders.go_on() {
            let now_ns = self.clock.now_ns();
            let left_ns = self.ahead.due_ns(now_ns, true).saturating_sub(now_ns);
            if left_ns <= 0 {
                break;
            }
            let timeout = Duration::from_nanos(left_ns.unsigned_abs()).min(POLL);
            match self.receive(timeout)? {
                Some(received) => {
                    self.pass(received)?;
                    watchdog.feed();
                }
                None => watchdog.missed(timeout, self.longest_frame_us, self.camera.state())?,
            }
        }
        Ok(())
    }

    /// Lets frames go by until the settings written last are in force for certain; how many frames late they acted, if
    /// that was seen.
    fn see_through(&mut self) -> Result<Option<u32>, DeviceError> {
        let mut watchdog = Watchdog::default();
        let mut late_frames = None;
        while self.orders.go_on() && !self.ahead.is_idle() {
            match self.receive(POLL)? {
                Some(received) => {
                    late_frames = late_frames.or(received.seen.late_frames);
                    self.pass(received)?;
                    watchdog.feed();
                }
                None => watchdog.missed(POLL, self.longest_frame_us, self.camera.state())?,
            }
        }
        Ok(late_frames)
    }
}
