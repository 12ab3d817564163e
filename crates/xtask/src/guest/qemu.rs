//! The guest's virtual machine.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use super::kernel::GuestKernel;
use super::pipe::pipe;
use super::table::{GuestTest, ports};
use crate::run::Done;

/// HPET clock source: on a busy host the kernel misjudges the TSC's rate, and the guest's time then runs several times
/// too fast. Mitigations are unnecessary under emulation.
const KERNEL_ARGUMENTS: &str = "console=ttyS0 loglevel=4 panic=-1 clocksource=hpet mitigations=off";

/// What the guest's time is counted in.
#[derive(Clone, Copy, PartialEq)]
pub enum GuestClock {
    /// Instructions, 2 ns each: time stops while a busy host does not run the guest. With the host's clock, USB stamps
    /// scattered by up to 440 us on a busy machine, with this one by 15 us. Excludes a second processor, at whose start
    /// the kernel hangs, and devices of QEMU, which work by the host's clock.
    Instructions,
    /// The host's.
    Host,
}

impl GuestClock {
    /// QEMU's arguments.
    pub fn arguments(self) -> &'static [&'static str] {
        match self {
            Self::Instructions => &["-accel", "tcg,thread=single", "-icount", "shift=1", "-smp", "1"],
            Self::Host => &["-accel", "tcg,thread=multi", "-smp", "2"],
        }
    }
}

/// A running guest, killed when dropped.
pub struct Machine(Child);

impl Machine {
    /// Boots the guest. It powers off once it has run the tests.
    pub fn start(kernel: &GuestKernel, run: &Path, tests: &[&GuestTest], clock: GuestClock) -> Done<Self> {
        let mut qemu = Self::command(kernel, run, KERNEL_ARGUMENTS)?;
        mount(&mut qemu, "usr", Path::new("/usr"), ",readonly=on");
        mount(&mut qemu, "modules", &kernel.modules, ",readonly=on");
        mount(&mut qemu, "share", Path::new("."), "");
        qemu.args(clock.arguments()).args(["-device", "qemu-xhci,id=usb", "-device", "virtio-serial-pci"]);
        for name in ports(tests) {
            pipe(&mut qemu, name)?;
        }
        qemu.args(["-mon", "chardev=qmp,mode=control"]);
        // Tests may share devices.
        let devices: BTreeSet<&str> = tests.iter().flat_map(|test| test.devices).copied().collect();
        devices.iter().for_each(|device| {
            qemu.args(["-device", device]);
        });
        Self::spawn(qemu)
    }

    /// QEMU with memory, a console and the kernel, which takes `initramfs` from the folder `run`.
    pub fn command(kernel: &GuestKernel, run: &Path, kernel_arguments: &str) -> Done<Command> {
        let log = run.join("qemu.log");
        let log = std::fs::File::create(&log).map_err(|error| format!("{}: {error}", log.display()))?;
        let mut qemu = Command::new("qemu-system-x86_64");
        // Paths of sockets are limited to 108 bytes and target folders may be longer, so all paths are relative.
        qemu.current_dir(run).stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
        qemu.args(["-machine", "pc", "-cpu", "max", "-m", "1024"]);
        qemu.args(["-nodefaults", "-no-user-config", "-no-reboot", "-display", "none"]);
        qemu.args(["-serial", "file:console", "-device", "virtio-rng-pci"]);
        qemu.arg("-kernel").arg(&kernel.image).args(["-initrd", "initramfs", "-append", kernel_arguments]);
        Ok(qemu)
    }

    /// Starts QEMU.
    pub fn spawn(mut qemu: Command) -> Done<Self> {
        qemu.spawn().map(Self).map_err(|error| format!("cannot start qemu-system-x86_64: {error}"))
    }

    /// Waits until the guest has powered off.
    pub fn wait(mut self) {
        // An error means that there is no such process any more.
        let _ = self.0.wait();
    }

    /// Whether the guest has powered off or failed.
    pub fn has_ended(&mut self) -> bool {
        !matches!(self.0.try_wait(), Ok(None))
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        // Both fail if the guest has already powered off, as it should.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Makes a host folder available to the guest.
pub fn mount(qemu: &mut Command, tag: &str, path: &Path, options: &str) {
    // QEMU expects commas in values to be doubled.
    let path = path.display().to_string().replace(',', ",,");
    qemu.args([
        "-fsdev",
        &format!("local,id={tag},path={path},security_model=none,multidevs=remap{options}"),
    ]);
    qemu.args(["-device", &format!("virtio-9p-pci,fsdev={tag},mount_tag={tag}")]);
}
