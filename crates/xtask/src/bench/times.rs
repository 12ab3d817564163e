//! Processor time of a process's threads.

use std::collections::BTreeMap;

use crate::run::Done;

/// Clock ticks per second of `/proc/PID/task/TID/stat`: 100 on all Linux machines for decades.
const TICKS_PER_S: f64 = 100.0;

/// Name and processor time in seconds, by thread.
pub type Times = BTreeMap<String, (String, f64)>;

/// Processor time since `before` of the threads selected by name.
pub fn spent_s(before: &Times, latest: &Times, wanted: impl Fn(&str) -> bool) -> f64 {
    let threads = latest.iter().filter(|(_, (name, _))| wanted(name));
    threads.map(|(thread, (_, s))| s - before.get(thread).map_or(0.0, |(_, s)| *s)).sum()
}

/// Name and processor time of each running thread of a process.
pub fn cpu_s(process: u32) -> Times {
    let threads = std::fs::read_dir(format!("/proc/{process}/task")).into_iter().flatten().flatten();
    let times = threads.filter_map(|thread| {
        let stat = std::fs::read_to_string(thread.path().join("stat")).ok()?;
        Some((thread.file_name().to_string_lossy().into_owned(), name_and_cpu_s(&stat)?))
    });
    times.collect()
}

/// Processor time of a process in seconds, including that of threads that have ended.
pub fn process_s(process: u32) -> Done<f64> {
    let path = format!("/proc/{process}/stat");
    let stat = std::fs::read_to_string(&path).map_err(|error| format!("{path}: {error}"))?;
    name_and_cpu_s(&stat).map(|(_, s)| s).ok_or_else(|| format!("{path}: no times in {stat:?}"))
}

/// Parses a line of `stat`. Names may contain spaces and parentheses, so fields are counted from the last parenthesis.
fn name_and_cpu_s(stat: &str) -> Option<(String, f64)> {
    let name = stat.get(stat.find('(')? + 1..stat.rfind(')')?)?;
    let mut fields = stat.get(stat.rfind(')')? + 1..)?.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((name.to_owned(), (ticks()? + ticks()?) / TICKS_PER_S))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_s_time_is_read_whatever_its_name() {
        let stat = "77 (a (b) c) S 1 2 3 4 5 6 7 8 9 10 150 50 0 0 20 0 1 0 99";
        assert_eq!(name_and_cpu_s(stat), Some(("a (b) c".into(), 2.0)));
        assert_eq!(name_and_cpu_s("77 (short) S 1"), None);
    }
}
