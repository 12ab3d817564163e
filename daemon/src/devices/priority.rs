//! Thread priorities: devices before the pipeline, the pipeline before solvers.

use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// SCHED_FIFO priority of device threads: below the kernel's interrupt threads, which have 50.
const DEVICE: u8 = 40;
/// On a scale of 0 to 99, where 50 is nice 0; corresponds to nice 9.
const COMPUTING: u8 = 25;

/// Lets the calling thread, which serves a device and mostly sleeps, run as soon as it wakes: SCHED_FIFO, if the unit
/// or the user's limits allow it (`LimitRTPRIO`). Returns whether they do.
pub fn for_device(device: &str) -> bool {
    let priority = ThreadPriorityValue::try_from(DEVICE).map(ThreadPriority::Crossplatform);
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let set = priority.map(|priority| set_thread_priority_and_policy(thread_native_id(), priority, policy));
    if let Ok(Err(error)) = &set {
        tracing::info!(
            device,
            ?error,
            "no real-time priority: on a busy host frames may come late; LimitRTPRIO={DEVICE} allows it"
        );
    }
    matches!(set, Ok(Ok(())))
}

/// Makes the calling thread, which computes for a long time, yield to the threads that capture.
pub fn for_computing() {
    let priority = ThreadPriorityValue::try_from(COMPUTING).map(ThreadPriority::Crossplatform);
    let set = priority.map(thread_priority::set_current_thread_priority);
    if let Ok(Err(error)) = set {
        tracing::debug!(?error, "computes at the priority of capture");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn computing_gives_way() {
        let nice = std::thread::spawn(|| {
            for_computing();
            let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
            let after_name = &stat[stat.rfind(')').unwrap() + 2..];
            after_name.split_whitespace().nth(16).unwrap().parse::<i32>().unwrap()
        });
        assert!(nice.join().unwrap() >= 9, "proc(5): the 19th field of stat is the nice value");
    }
}
