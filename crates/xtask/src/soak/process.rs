//! What a process takes of the machine.

use std::time::Duration;

use crate::run::Done;

/// A process between two rounds, when no client is connected.
#[derive(Clone, Copy)]
pub struct AtRest {
    pub resident_mib: f64,
    pub descriptors: usize,
    pub threads: usize,
}

impl AtRest {
    /// Waits until the process has closed what its clients have left.
    pub fn of(process: u32) -> Done<Self> {
        std::thread::sleep(Duration::from_secs(1));
        let path = format!("/proc/{process}/status");
        let status = std::fs::read_to_string(&path)
            .map_err(|error| format!("raysweepd has ended: {path}: {error}"))?;
        let number = |key: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(key));
            line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok()).unwrap_or(0.0)
        };
        Ok(Self {
            resident_mib: number("VmRSS:") / 1024.0,
            descriptors: std::fs::read_dir(format!("/proc/{process}/fd")).map_or(0, Iterator::count),
            threads: number("Threads:") as usize,
        })
    }
}
