//! However a process ends, the mirror is parked and the light is off. Prints how long it took.

use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use raysweep_core::{Clock, DeviceErrorKind, Mirror, MirrorPath, Tilt};
use raysweep_drivers::mirror::{
    self, Guardian, LightGuard, Mti, ParkError, Parked, PlayzerX, StateError, arm_light, park,
    park_when_closed,
};
use raysweep_sim::mirror::{Held, PlayzerXControllerConfig, WireFaults};

use crate::HUNG;
use crate::points::{circle, mti_config, mti_rig};
use crate::rig::{LIMITS, Rig, batch, codes, error_of, largest_step};

/// A mirror in the middle of a path.
fn playing(rig: &Rig) -> PlayzerX {
    let mut mirror = rig.open();
    mirror.load(&batch()).unwrap();
    mirror.start(1000).unwrap();
    for _ in 0..300 {
        mirror.feed().unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
    mirror
}

fn now_ns() -> i64 {
    Clock::real().now_ns()
}

#[test]
fn stop_and_drop() {
    let rig = Rig::good();
    let mut mirror = playing(&rig);
    let since_ns = now_ns();
    mirror.park().unwrap();
    rig.assert_parked().print("stop", since_ns);
    drop(mirror);
    let mirror = playing(&rig);
    let since_ns = now_ns();
    drop(mirror);
    rig.assert_parked().print("drop (an error or a cancelled run)", since_ns);
}

#[test]
fn panic() {
    let rig = Rig::good();
    let mirror = playing(&rig);
    let since_ns = now_ns();
    let panicked = catch_unwind(AssertUnwindSafe(move || {
        let _mirror = mirror;
        panic!("as planned");
    }));
    assert!(panicked.is_err());
    rig.assert_parked().print("panic", since_ns);
}

/// Starts at (3, 2) degrees and never comes near the origin.
fn far() -> MirrorPath {
    MirrorPath::lissajous(Tilt::new(3.0, 2.0), [10, 7], 6500, 39_000.0, &LIMITS).unwrap()
}

/// The state's next file is a pipe, at which a process that writes it stops, to be killed there.
#[test]
fn sigkill_while_the_state_is_being_written() {
    for when in ["start", "park"] {
        let rig = Rig::good();
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "ways_out::child_that_writes_into_a_pipe", "--ignored", "--nocapture"])
            .env("MIRROR_PORT", rig.pty.path())
            .env("MIRROR_STATE", rig.state())
            .env("MIRROR_WHEN", when)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        assert!(lines.any(|line| line.unwrap().contains("about to write")));
        // It stops at the pipe once it has said that its place is unknown; in the other case it says nothing before.
        std::thread::sleep(Duration::from_millis(300));
        let is_told = || {
            let sent = std::fs::read_to_string(format!("{}.sent", rig.state().display())).unwrap();
            sent.starts_with(&u64::MAX.to_string())
        };
        let began = Instant::now();
        while when == "park" && !is_told() {
            assert!(began.elapsed() < HUNG, "not told");
            std::thread::sleep(Duration::from_millis(5));
        }
        kill(Pid::from_raw(child.id() as i32), Signal::SIGKILL).unwrap();
        child.wait().unwrap();
        std::fs::remove_file(format!("{}.new", rig.state().display())).unwrap();
        let from = rig.pty.look(|truth| truth.held.len());
        let parked = park(&rig.state()).unwrap();
        let step = rig.pty.look(|truth| largest_step(&truth.held[from.saturating_sub(1)..]));
        println!("killed in {when}: {parked:?}, largest step {step} codes");
        // Its FIFO is empty, which tells nothing: the drive is switched off.
        assert_eq!(parked, Parked::ByReset);
        rig.await_parked();
        let last = rig.pty.look(|truth| truth.held[from.saturating_sub(1)..].to_vec());
        assert!(
            last.windows(2).all(|pair| pair[1] == last[last.len() - 1]),
            "moved before the reset: {step}"
        );
    }
}

fn open_playzerx(port: PathBuf, state: PathBuf, light: LightGuard) -> PlayzerX {
    PlayzerX::open(mirror::PlayzerXConfig {
        port,
        link: mirror::PlayzerXLink::VirtualCom,
        full_scale: LIMITS.max_tilt,
        limits: LIMITS,
        state,
        light,
    })
    .unwrap()
}

#[test]
#[ignore = "not a test: a process that another test starts and kills"]
fn child_that_writes_into_a_pipe() {
    let Some(port) = std::env::var_os("MIRROR_PORT") else { return };
    let state = PathBuf::from(std::env::var_os("MIRROR_STATE").unwrap());
    let light = LightGuard { armed_file: state.with_extension("armed"), interlock: None };
    arm_light(&light.armed_file).unwrap();
    let next = PathBuf::from(format!("{}.new", state.display()));
    let mut mirror = open_playzerx(port.into(), state, light);
    mirror.load(&far()).unwrap();
    let stop = || {
        nix::unistd::mkfifo(&next, nix::sys::stat::Mode::S_IRUSR | nix::sys::stat::Mode::S_IWUSR).unwrap();
        println!("about to write");
    };
    if std::env::var("MIRROR_WHEN").unwrap() == "start" {
        stop();
        mirror.start(1000).unwrap();
    }
    mirror.start(1000).unwrap();
    for _ in 0..450 {
        mirror.feed().unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
    stop();
    mirror.park().unwrap();
}

#[test]
fn stop_with_garbage_on_the_wire() {
    for seed in 0..6 {
        let faults = WireFaults { seed, garbage: 0.5, stalls: 0.0, stall_ms: 0 };
        let rig = Rig::playzerx(PlayzerXControllerConfig::default(), faults);
        let mut mirror = playing(&rig);
        let since_ns = now_ns();
        mirror.park().unwrap();
        let step = rig.assert_parked().print("stop with garbage", since_ns).largest_step;
        assert!(step <= 2.0 * largest_step(&codes(&batch())), "the ramp begins elsewhere: {step} codes");
    }
}

#[test]
fn stop_of_a_controller_that_stalls() {
    for seed in 0..6 {
        let faults = WireFaults { seed, garbage: 0.1, stalls: 0.005, stall_ms: 50 };
        let rig = Rig::playzerx(PlayzerXControllerConfig::default(), faults);
        let mut mirror = playing(&rig);
        let since_ns = now_ns();
        mirror.park().unwrap();
        let step = rig.assert_parked().print("stop with stalls", since_ns).largest_step;
        assert!(step <= 2.0 * largest_step(&codes(&batch())), "the ramp begins elsewhere: {step} codes");
    }
}

#[test]
fn stop_with_a_disk_that_takes_nothing() {
    let rig = Rig::good();
    let mut mirror = playing(&rig);
    std::fs::remove_dir_all(rig.folder.path()).unwrap();
    let since_ns = now_ns();
    assert!(mirror.park().is_err(), "what could not be noted is said");
    rig.assert_parked().print("stop without a disk", since_ns);
}

#[test]
fn unplug_and_plug_in_again() {
    let mut rig = Rig::good();
    let mut mirror = playing(&rig);
    let since_ns = now_ns();
    // The controller loses its power with the plug: the light is off and the mirror springs back.
    rig.pty.unplug();
    let error = error_of(&mut mirror);
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
    println!("unplug: noticed after {:.1} ms", (now_ns() - since_ns) as f64 / 1e6);
    drop(mirror);
    // Its state still says that it was left away from rest, so nobody assumes that it is parked.
    assert!(matches!(park(&rig.state()), Err(ParkError::Device(_))));
    let error = PlayzerX::open(rig.config()).err().unwrap();
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
}

#[test]
fn a_controller_that_was_plugged_in_again_is_not_taken_for_the_one_that_was_left() {
    let mut rig = Rig::good();
    let name = rig.folder.path().join("by-id");
    std::os::unix::fs::symlink(rig.pty.path(), &name).unwrap();
    let config = mirror::PlayzerXConfig { port: name.clone(), ..rig.config() };
    let mut mirror = PlayzerX::open(config).unwrap();
    mirror.load(&batch()).unwrap();
    mirror.start(1000).unwrap();
    for _ in 0..300 {
        mirror.feed().unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
    // When the power is back, it is at rest. Commanded to its last position, it would jump.
    let again =
        Rig::playzerx(PlayzerXControllerConfig { reset_s: 0.1, ..Default::default() }, WireFaults::default());
    rig.pty.unplug();
    error_of(&mut mirror);
    drop(mirror);
    std::fs::remove_file(&name).unwrap();
    std::os::unix::fs::symlink(again.pty.path(), &name).unwrap();
    assert_eq!(park(&rig.state()).unwrap(), Parked::ByReset);
    let held = again.assert_parked();
    assert_eq!(held.largest_step, 0.0);
}

/// Not a test but the process that the tests below end: plays until it is killed. It is listed as ignored because
/// only a test of this program can be started by name (`start_child`).
#[test]
#[ignore = "not a test: a process that other tests start and kill"]
fn child() {
    let Ok(port) = std::env::var("MIRROR_PORT") else { return };
    let state = std::path::PathBuf::from(std::env::var("MIRROR_STATE").unwrap());
    let _guardian = std::env::var("MIRROR_GUARDIAN").ok().map(|_| {
        let mut command = test_process("guardian");
        command.env("MIRROR_STATE", &state);
        Guardian::start(command).unwrap()
    });
    let light = LightGuard { armed_file: state.with_extension("armed"), interlock: None };
    arm_light(&light.armed_file).unwrap();
    let mut mirror: Box<dyn Mirror> = if std::env::var("MIRROR_DRIVER").unwrap() == "mti" {
        Box::new(Mti::open(mti_config(port.into(), state, light)).unwrap())
    } else {
        Box::new(open_playzerx(port.into(), state, light))
    };
    let path = if mirror.capabilities().fifo_samples == 1 { circle(60) } else { batch() };
    mirror.load(&path).unwrap();
    mirror.start(100_000).unwrap();
    println!("playing");
    loop {
        mirror.feed().unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Not a test but the guardian's process, which `child` starts.
#[test]
#[ignore = "not a test: a process that other tests start"]
fn guardian() {
    let Ok(state) = std::env::var("MIRROR_STATE") else { return };
    park_when_closed(std::io::stdin(), Path::new(&state)).unwrap();
}

fn test_process(name: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", &format!("ways_out::{name}"), "--ignored", "--nocapture"]);
    command
}

fn start_child(rig: &Rig, driver: &str, guarded: bool) -> Child {
    let mut command = test_process("child");
    command
        .env("MIRROR_DRIVER", driver)
        .env("MIRROR_PORT", rig.pty.path())
        .env("MIRROR_STATE", rig.state())
        .stdout(Stdio::piped());
    if guarded {
        command.env("MIRROR_GUARDIAN", "1");
    }
    let mut child = command.spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    assert!(lines.any(|line| line.unwrap().contains("playing")), "the child ended early");
    // Discards its remaining output.
    std::thread::spawn(move || lines.for_each(drop));
    child
}

fn end(child: &mut Child, signal: Signal) {
    kill(Pid::from_raw(child.id().try_into().unwrap()), signal).unwrap();
    assert_eq!(child.wait().unwrap().signal(), Some(signal as i32));
}

#[test]
fn sigkill_then_park() {
    let rig = Rig::good();
    // Several times, so that the process dies at different points of the path and of its loop.
    for round in 0..5 {
        let held = rig.pty.look(|truth| truth.held.len());
        let mut child = start_child(&rig, "playzerx", false);
        rig.await_light(20_000 + 3_000 * round);
        assert!(matches!(park(&rig.state()), Err(ParkError::State(StateError::Locked { .. }))));
        let since_ns = now_ns();
        end(&mut child, Signal::SIGKILL);
        let parked = park(&rig.state()).unwrap();
        assert!(matches!(parked, Parked::From(_)), "{parked:?}");
        rig.assert_parked_after_kill().print("SIGKILL, then park", since_ns);
        assert_eq!(park(&rig.state()).unwrap(), Parked::Already);
        // The path was correct up to where it was stopped.
        let truth = rig.pty.truth();
        let codes = codes(&batch());
        let lit: Vec<&Held> = truth.held[held..].iter().filter(|held| held.light > 0).collect();
        assert!(lit.iter().zip(codes.iter().cycle()).all(|(held, code)| **held == *code));
    }
}

#[test]
fn sigkill_of_what_drives_an_mti() {
    let rig = mti_rig(WireFaults::default());
    let mut child = start_child(&rig, "mti", false);
    rig.await_light(30);
    let since_ns = now_ns();
    end(&mut child, Signal::SIGKILL);
    assert!(rig.pty.look(|truth| truth.dark_since_ns.is_none()), "the light is still on");
    assert!(matches!(park(&rig.state()).unwrap(), Parked::From(_)));
    rig.assert_parked().print("SIGKILL, MTI, then park", since_ns);
}

#[test]
fn sigkill_with_a_guardian() {
    let rig = Rig::good();
    let mut child = start_child(&rig, "playzerx", true);
    rig.await_light(20_000);
    let since_ns = now_ns();
    end(&mut child, Signal::SIGKILL);
    rig.assert_parked_after_kill().print("SIGKILL, guardian", since_ns);
    assert_eq!(park(&rig.state()).unwrap(), Parked::Already, "the guardian has noted it");
}

#[test]
fn sigterm_without_a_handler_with_a_guardian() {
    let rig = Rig::good();
    let mut child = start_child(&rig, "playzerx", true);
    rig.await_light(20_000);
    let since_ns = now_ns();
    end(&mut child, Signal::SIGTERM);
    rig.assert_parked_after_kill().print("SIGTERM, guardian", since_ns);
    assert_eq!(park(&rig.state()).unwrap(), Parked::Already, "the guardian has noted it");
}

#[test]
fn the_next_driver_parks_what_the_last_one_left() {
    let rig = Rig::good();
    let mut child = start_child(&rig, "playzerx", false);
    rig.await_light(20_000);
    let since_ns = now_ns();
    end(&mut child, Signal::SIGKILL);
    let mirror = rig.open();
    rig.assert_parked_after_kill().print("SIGKILL, next driver", since_ns);
    drop(mirror);
}

#[test]
fn a_port_that_a_dying_process_releases_after_the_lock_is_waited_for() {
    let rig = Rig::good();
    let mut child = start_child(&rig, "playzerx", false);
    rig.await_light(20_000);
    end(&mut child, Signal::SIGKILL);
    let held = serialport::new(rig.pty.path().display().to_string(), 921_600).open_native().unwrap();
    let release = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(200));
        drop(held);
    });
    assert!(matches!(park(&rig.state()).unwrap(), Parked::From(_)));
    release.join().unwrap();
    rig.assert_parked_after_kill();
}

#[test]
fn a_state_of_another_boot_is_not_trusted() {
    let rig =
        Rig::playzerx(PlayzerXControllerConfig { reset_s: 0.1, ..Default::default() }, WireFaults::default());
    let mut child = start_child(&rig, "playzerx", false);
    rig.await_light(20_000);
    end(&mut child, Signal::SIGKILL);
    let text = std::fs::read_to_string(rig.state()).unwrap();
    let boot_id = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap();
    let other = text.replace(boot_id.trim(), "00000000-0000-0000-0000-000000000000");
    std::fs::write(rig.state(), other).unwrap();
    assert_eq!(park(&rig.state()).unwrap(), Parked::ByReset);
    // From where it stood, in one step: a reset lets go of the mirror.
    rig.await_parked();
}

/// A mirror that has never been moved counts as parked, and parking it needs no controller.
#[test]
fn nothing_to_park() {
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(park(&folder.path().join("mirror.json")).unwrap(), Parked::NeverMoved);
}
