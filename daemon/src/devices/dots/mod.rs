//! The devices of the dot rig: a mirror that plays a path while the camera takes one frame per dot.

pub mod camera;
pub mod motion;
pub mod play;

use crate::rig::Pace;

/// Queue length for frames if the source waits for room.
const FEWEST_WAITING: usize = 24;
/// Stall of the host, as on virtual machines, that must cost no frame, as far as memory allows.
const STANDSTILL_S: f64 = 0.2;
/// Upper limit of memory for queued frames.
const MOST_WAITING_BYTES: usize = 1 << 30;
/// Buffers for frames in the workers.
pub const FRAMES_AT_WORK: usize = 40;

/// Queue length for frames between the camera and the workers.
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
