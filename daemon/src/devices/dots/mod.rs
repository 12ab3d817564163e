//! The devices of the dot rig: a mirror that plays a path while the camera takes a frame of each dot.

pub mod camera;
pub mod motion;
pub mod play;

use crate::rig::Pace;

/// Frames that may wait for the workers where the source waits for room.
const FEWEST_WAITING: usize = 24;
/// How long a host may stand still, as virtual machines do, without loss of a frame; as far as memory goes.
const STANDSTILL_S: f64 = 0.2;
/// Most memory for frames that wait.
const MOST_WAITING_BYTES: usize = 1 << 30;
/// Buffers of the frames under work, and of those of the beam dump that wait for their index.
pub const FRAMES_AT_WORK: usize = 40;

/// Frames of a camera that may wait for the workers.
pub fn frames_waiting(pace: Pace, rate_hz: f64, frame_bytes: usize) -> usize {
    match pace {
        Pace::Pipeline => FEWEST_WAITING,
        Pace::Devices => {
            let of_standstill = (STANDSTILL_S * rate_hz).ceil() as usize;
            of_standstill.min(MOST_WAITING_BYTES / frame_bytes).max(FEWEST_WAITING)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_a_fifth_of_a_second_may_wait_where_the_camera_does_not_as_far_as_memory_goes() {
        assert_eq!(frames_waiting(Pace::Pipeline, 13_500.0, 1 << 15), 24);
        assert_eq!(frames_waiting(Pace::Devices, 13_500.0, 1 << 15), 2700);
        assert_eq!(frames_waiting(Pace::Devices, 13_500.0, 1 << 21), 512);
        assert_eq!(frames_waiting(Pace::Devices, 60.0, 1 << 21), 24);
    }
}
