//! The camera's part: passes frames from the camera to the pipeline, and accounts for every exposure that is lost.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use raysweep_core::{Camera, DeviceError, DeviceErrorKind, DeviceState, Frame, FramePool, LossCause};
use raysweep_pipeline::QueueError;
use raysweep_pipeline::dots::{Arrival, Loss};

use crate::rig::Pace;

/// Timeout of one wait for a frame.
const POLL: Duration = Duration::from_millis(100);
/// How long a camera that failed is left alone.
const REST: Duration = Duration::from_millis(1);
/// A camera without frames for this long has lost its trigger. Measured in host time, because a virtual clock runs on
/// while another thread is about to start the mirror.
const PATIENCE: Duration = Duration::from_secs(5);
/// Most frames that are taken after the last trigger: a free-running camera never stops.
const MOST_REST_FRAMES: u32 = 1024;
/// If more ids than this are missing at once, they are not looked up one by one.
const MOST_ASKED: u64 = 1 << 16;

/// What the caller wants next from the camera; asked before each frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NextWanted {
    /// Frames; a long wait for one is an error.
    Frames,
    /// Frames that are still in transit: no more are triggered.
    Rest,
    /// No more frames.
    Nothing,
}

/// An armed camera, and the memory for its frames.
pub struct Source<'a> {
    /// The camera.
    pub camera: &'a mut dyn Camera,
    /// Buffers for frames in transit.
    pub pool: &'a FramePool,
    /// Whether the camera waits for room.
    pub pace: Pace,
}

/// Why the pipeline did not take a frame.
pub enum FrameRefused {
    /// There is no room, and the camera does not wait.
    Full(Arrival),
    /// The pipeline is closed.
    Closed,
}

impl From<QueueError<Arrival>> for FrameRefused {
    fn from(error: QueueError<Arrival>) -> Self {
        match error {
            QueueError::Full(arrival) => Self::Full(arrival),
            QueueError::Closed => Self::Closed,
        }
    }
}

impl Source<'_> {
    /// Reads and discards frames until `is_over`, whatever the camera does.
    pub fn idle(&mut self, is_over: &dyn Fn() -> bool) {
        let mut data = self.pool.spare();
        while !is_over() {
            let read = catch_unwind(AssertUnwindSafe(|| self.camera.next_frame(&mut data, POLL)));
            if !matches!(read, Ok(Ok(_))) {
                std::thread::sleep(REST);
            }
        }
    }

    /// Takes frames as long as `wanted` asks for them and hands them to `deliver`; returns what was lost after the
    /// last one.
    ///
    /// # Errors
    /// An error of the camera, or that no frames arrive.
    pub fn take(
        &mut self,
        wanted: &dyn Fn() -> NextWanted,
        deliver: &mut dyn FnMut(Arrival) -> Result<(), FrameRefused>,
    ) -> Result<Vec<Loss>, DeviceError> {
        let format = self.camera.capabilities().format;
        let mut spare = None;
        let mut last: Option<u64> = None;
        let mut lost = Vec::new();
        let mut waiting_since: Option<Instant> = None;
        let mut rest_frames = 0;
        loop {
            let before = wanted();
            if before == NextWanted::Nothing || rest_frames > MOST_REST_FRAMES {
                return Ok(lost);
            }
            let free = match self.pace {
                // Orders are obeyed during a long wait, too.
                Pace::Pipeline => match self.pool.take_within(POLL) {
                    None => continue,
                    free => free,
                },
                Pace::Devices => self.pool.try_take(),
            };
            rest_frames += u32::from(before == NextWanted::Rest);
            let has_room = free.is_some();
            let mut data = match free {
                Some(data) => data,
                None => spare.take().unwrap_or_else(|| self.pool.spare()),
            };
            let Some(stamp) = self.camera.next_frame(&mut data, POLL)? else {
                // A recording is over: an armed camera streams.
                let is_over = self.camera.state() == DeviceState::Ready;
                if before == NextWanted::Rest || is_over {
                    return Ok(lost);
                }
                if waiting_since.get_or_insert_with(Instant::now).elapsed() > PATIENCE {
                    let what = "no frame for 5 s while the mirror plays its path: check that the mirror's sample clock triggers the camera";
                    return Err(DeviceError::new("camera", DeviceErrorKind::Timeout, what));
                }
                continue;
            };
            waiting_since = None;
            if let Some(last) = last.filter(|last| stamp.seq > last + 1) {
                self.note_gap(last + 1, stamp.seq, &mut lost);
            }
            // A frame that arrives twice is not a separate exposure.
            let is_new = last.is_none_or(|last| stamp.seq > last);
            last = last.max(Some(stamp.seq));
            if !has_room {
                spare = Some(data);
                note(&mut lost, u64::from(is_new), LossCause::PoolEmpty);
                continue;
            }
            let frame = Frame { data, format, stamp };
            match deliver(Arrival { frame, lost_before: std::mem::take(&mut lost) }) {
                Ok(()) => {}
                Err(FrameRefused::Full(Arrival { lost_before, .. })) => {
                    lost = lost_before;
                    note(&mut lost, u64::from(is_new), LossCause::QueueFull);
                }
                Err(FrameRefused::Closed) => return Ok(lost),
            }
        }
    }

    fn note_gap(&self, first: u64, end: u64, lost: &mut Vec<Loss>) {
        let asked = (end - first).min(MOST_ASKED);
        (first..first + asked).for_each(|seq| note(lost, 1, self.camera.loss_of(seq)));
        note(lost, end - first - asked, LossCause::CameraGap);
    }
}

fn note(lost: &mut Vec<Loss>, frames: u64, cause: LossCause) {
    match lost.last_mut().filter(|loss| loss.cause == cause) {
        Some(loss) => loss.frames += frames,
        None if frames > 0 => lost.push(Loss { frames, cause }),
        None => {}
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use raysweep_core::{
        Applied, CameraCapabilities, CameraSettings, DeviceState, FrameBuf, FrameStamp, PixelFormat, Readout,
        SettingsId,
    };

    use super::*;

    /// Delivers frames with these ids, then none.
    struct Scripted(CameraCapabilities, std::vec::IntoIter<u64>);

    impl Camera for Scripted {
        fn capabilities(&self) -> &CameraCapabilities {
            &self.0
        }
        fn state(&self) -> DeviceState {
            DeviceState::Streaming
        }
        fn configure(&mut self, _: SettingsId, _: &CameraSettings) -> Result<Applied, DeviceError> {
            Err(DeviceError::new("camera", DeviceErrorKind::Unsupported, "not asked for"))
        }
        fn arm(&mut self) -> Result<(), DeviceError> {
            Ok(())
        }
        fn next_frame(&mut self, _: &mut FrameBuf, _: Duration) -> Result<Option<FrameStamp>, DeviceError> {
            let stamp =
                |seq| FrameStamp { seq, device_ns: 0, exposure_start_ns: 0, host_ns: 0, exposure_us: None };
            Ok(self.1.next().map(stamp))
        }
        fn disarm(&mut self) -> Result<(), DeviceError> {
            Ok(())
        }
    }

    fn scripted(ids: Vec<u64>) -> Scripted {
        let capabilities = CameraCapabilities {
            model: String::new(),
            width: 1,
            height: 1,
            format: PixelFormat::Mono8,
            row_time_us: 0.0,
            trigger_latency_us: 0.0,
            readout_us: 0.0,
            readout: Readout::Overlapped,
            exposure_us: 0.0..=1.0,
            trigger_delay_us: 0.0..=0.0,
        };
        Scripted(capabilities, ids.into_iter())
    }

    #[test]
    fn every_exposure_without_a_frame_is_told_before_the_next_frame_by_cause() {
        let mut camera = scripted(vec![3, 4, 7, 7, 8, 9, 12]);
        let pool = FramePool::new(2, 1);
        let mut source = Source { camera: &mut camera, pool: &pool, pace: Pace::Devices };
        let mut taken = Vec::new();
        let mut held = Vec::new();
        let rest = source
            .take(&|| NextWanted::Rest, &mut |arrival| {
                match arrival.frame.stamp.seq {
                    // The pipeline is full, once.
                    4 => return Err(FrameRefused::Full(arrival)),
                    7 | 8 => held.push(arrival.frame),
                    seq => {
                        held.clear();
                        taken.push((seq, arrival.lost_before));
                        return Ok(());
                    }
                }
                taken.push((held.last().map_or(0, |frame| frame.stamp.seq), arrival.lost_before));
                Ok(())
            })
            .unwrap();
        let loss = |frames, cause| Loss { frames, cause };
        // Buffers are held by 7 and its duplicate, so there is none for 8, 9 and 12.
        assert_eq!(
            taken,
            [
                (3, vec![]),
                (7, vec![loss(1, LossCause::QueueFull), loss(2, LossCause::CameraGap)]),
                (7, vec![]),
            ]
        );
        assert_eq!(
            rest,
            [loss(2, LossCause::PoolEmpty), loss(2, LossCause::CameraGap), loss(1, LossCause::PoolEmpty)]
        );
    }

    #[test]
    fn a_camera_without_frames_is_an_error_only_while_some_must_come() {
        let pool = FramePool::new(2, 1);
        let mut camera = scripted(vec![1]);
        let mut source = Source { camera: &mut camera, pool: &pool, pace: Pace::Pipeline };
        let error = source.take(&|| NextWanted::Frames, &mut |_| Ok(())).unwrap_err();
        assert_eq!(error.kind, DeviceErrorKind::Timeout);
        let asked = Cell::new(0);
        let until_third = || {
            asked.set(asked.get() + 1);
            if asked.get() < 3 { NextWanted::Frames } else { NextWanted::Nothing }
        };
        assert!(source.take(&until_third, &mut |_| Ok(())).unwrap().is_empty());
    }
}
