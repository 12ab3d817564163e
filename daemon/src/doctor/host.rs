//! The host: user, real-time priority, clock, memory, service.

use std::env;
use std::fs;
use std::process::Command;
use std::thread;

use nix::unistd::{Group, User, geteuid, getgroups};
use raysweep_core::Size;
use raysweep_processing::memory::available_bytes;

use super::checkup::Checkup;
use crate::devices::priority;

const CLOCK_SOURCE: &str = "/sys/devices/system/clocksource/clocksource0/current_clocksource";
/// Clocks that the processor reads itself, in nanoseconds; others cost a microsecond or more a reading.
const FAST_CLOCKS: [&str; 4] = ["tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page"];
/// Less free memory than this is little for any run.
const LITTLE_MEMORY_BYTES: u64 = 1 << 30;

/// Name of the user whose permissions count.
pub fn user() -> String {
    let uid = geteuid();
    User::from_uid(uid).ok().flatten().map_or_else(|| format!("user {uid}"), |user| user.name)
}

pub(super) fn examine(checkup: &mut Checkup) {
    versions(checkup);
    groups(checkup);
    service(checkup);
    real_time(checkup);
    clock(checkup);
    memory(checkup);
}

fn versions(checkup: &mut Checkup) {
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    #[cfg(feature = "aravis")]
    let aravis = format!("libaravis {}", raysweep_drivers::camera::aravis::version());
    #[cfg(not(feature = "aravis"))]
    let aravis = "without libaravis";
    let found = format!("raysweepd {}, {aravis}, Linux {}", env!("CARGO_PKG_VERSION"), kernel.trim());
    checkup.ok("versions", found);
}

fn groups(checkup: &mut Checkup) {
    let name_of =
        |gid| Group::from_gid(gid).ok().flatten().map_or_else(|| gid.to_string(), |group| group.name);
    let mut groups: Vec<String> = getgroups().unwrap_or_default().into_iter().map(name_of).collect();
    groups.sort_unstable();
    groups.dedup();
    let groups =
        if groups.is_empty() { "no group".into() } else { format!("the groups {}", groups.join(", ")) };
    checkup.ok("user", format!("{}, in {groups}", user()));
}

/// Whether this process, or another one, serves the rig by systemd.
fn service(checkup: &mut Checkup) {
    const NAME: &str = "service";
    if env::var_os("INVOCATION_ID").is_some() && env::var_os("NOTIFY_SOCKET").is_some() {
        let watchdog = match sd_notify::watchdog_enabled() {
            Some(interval) => format!("watchdog {} s", interval.as_secs()),
            None => "no watchdog".into(),
        };
        return checkup.ok(NAME, format!("started by systemd, {watchdog}"));
    }
    let shown = Command::new("systemctl")
        .args(["show", "raysweepd.service", "--property=LoadState,ActiveState,Result"])
        .output();
    let said = shown.map(|output| String::from_utf8_lossy(&output.stdout).into_owned()).unwrap_or_default();
    let value = |key: &str| said.lines().find_map(|line| line.strip_prefix(key)).unwrap_or_default();
    match (value("LoadState="), value("ActiveState="), value("Result=")) {
        ("loaded", "failed", result) => checkup.failure(
            NAME,
            format!("raysweepd.service has failed ({result})"),
            "`journalctl -u raysweepd.service -n 50` says why; then `systemctl restart raysweepd.service`",
        ),
        ("loaded", state, _) => checkup.ok(NAME, format!("raysweepd.service is {state}")),
        _ => checkup.ok(NAME, "not installed as a service; started by hand"),
    }
}

fn real_time(checkup: &mut Checkup) {
    const NAME: &str = "real-time priority";
    // Of a thread of its own: this one must not stay at that priority.
    let obtained = thread::spawn(|| priority::for_device("doctor")).join().unwrap_or(false);
    if obtained {
        checkup.ok(NAME, "obtained");
    } else {
        checkup.warning(
            NAME,
            "not permitted: on a busy host frames and edges may come late",
            "the service permits it (LimitRTPRIO=40); for a daemon started by hand, write `@raysweep - rtprio 40` to /etc/security/limits.d/raysweep.conf and log in again",
        );
    }
}

fn clock(checkup: &mut Checkup) {
    const NAME: &str = "clock source";
    let source = fs::read_to_string(CLOCK_SOURCE).unwrap_or_default();
    match source.trim() {
        "" => checkup.skipped(NAME, format!("{CLOCK_SOURCE} cannot be read")),
        source if FAST_CLOCKS.contains(&source) => checkup.ok(NAME, source),
        source => checkup.warning(
            NAME,
            format!("{source}: each time stamp costs microseconds"),
            format!("`echo tsc > {CLOCK_SOURCE}` as root, if available_clocksource beside it lists tsc"),
        ),
    }
}

fn memory(checkup: &mut Checkup) {
    const NAME: &str = "memory";
    let free_bytes = available_bytes(None);
    let found = format!("{} free", Size(free_bytes));
    if free_bytes < LITTLE_MEMORY_BYTES {
        checkup.warning(NAME, found, "close other programs; `ps aux --sort=-rss | head` lists the largest");
    } else {
        checkup.ok(NAME, found);
    }
}
