//! Measures the settings latency at the start of a run.

use std::time::Duration;

use raysweep_core::{CameraSettings, DeviceError, SettingsLatency};

use super::{Acquisition, POLL, Watchdog};

/// Number of observed changes of settings: a latency that varies over four numbers of frames passes for constant once
/// in 4^7.
const CHANGES: u32 = 8;
/// Number of changes whose effect must have been seen; a false edge or a lost frame may hide it.
const ENOUGH: usize = 4;
/// Factor by which the exposure changes, if frames carry it.
const EXPOSURE_FACTOR: f64 = 1.25;

impl Acquisition {
    /// Changes settings back and forth and finds, from the frames' timestamps, when they take effect; `None` if too
    /// few changes could be seen.
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
        // The first change does not count: the settings before it are unknown.
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
        match latency {
            Some(SettingsLatency { min_frames, max_frames }) => tracing::info!(
                min_frames,
                max_frames,
                changes_seen = late_frames.len(),
                "measured how late the camera's settings take effect"
            ),
            None => tracing::info!(
                changes_seen = late_frames.len(),
                "the probe could not measure how late the camera's settings take effect"
            ),
        }
        Ok(latency)
    }

    /// Skips frames until settings may be written.
    pub(super) fn pass_until_due(&mut self) -> Result<(), DeviceError> {
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

    /// Skips frames until the last settings are certainly in force; returns their latency in frames, if it was
    /// observed.
    pub(super) fn see_through(&mut self) -> Result<Option<u32>, DeviceError> {
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
