//! The guest's machine.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use super::GuestTest;
use super::kernel::Kernel;
use crate::run::Done;

/// The clock is the HPET: on a busy host the kernel misjudges the TSC's rate, and the guest's time then runs several times too
/// fast. Mitigations are nothing that emulation needs.
const KERNEL_ARGUMENTS: &str = "console=ttyS0 loglevel=4 panic=-1 clocksource=hpet mitigations=off";

/// A running guest, killed when dropped.
pub struct Machine(Child);

impl Machine {
    /// Boots the guest. It powers off once it has run the tests.
    pub fn start(kernel: &Kernel, run: &Path, tests: &[&GuestTest]) -> Done<Self> {
        let log = run.join("qemu.log");
        let log = std::fs::File::create(&log).map_err(|error| format!("{}: {error}", log.display()))?;
        let mut qemu = Command::new("qemu-system-x86_64");
        // Paths of sockets are short by law (108 bytes), target folders are not: so all names are relative.
        qemu.current_dir(run).stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
        qemu.args(["-machine", "pc", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2", "-m", "1024"]);
        qemu.args(["-nodefaults", "-no-user-config", "-no-reboot", "-display", "none"]);
        qemu.args(["-serial", "file:console"]);
        qemu.arg("-kernel").arg(&kernel.image).args(["-initrd", "initramfs", "-append", KERNEL_ARGUMENTS]);
        mount(&mut qemu, "usr", Path::new("/usr"), ",readonly=on");
        mount(&mut qemu, "modules", &kernel.modules, ",readonly=on");
        mount(&mut qemu, "share", Path::new("."), "");
        qemu.args([
            "-device",
            "virtio-rng-pci",
            "-device",
            "qemu-xhci,id=usb",
            "-device",
            "virtio-serial-pci",
        ]);
        pipe(&mut qemu, "qmp");
        qemu.args(["-mon", "chardev=qmp,mode=control"]);
        // Tests may share what they need.
        let pipes: BTreeSet<&str> = tests.iter().flat_map(|test| test.pipes).copied().collect();
        let devices: BTreeSet<&str> = tests.iter().flat_map(|test| test.devices).copied().collect();
        pipes.iter().for_each(|name| pipe(&mut qemu, name));
        devices.iter().for_each(|device| {
            qemu.args(["-device", device]);
        });
        qemu.spawn().map(Self).map_err(|error| format!("cannot start qemu-system-x86_64: {error}"))
    }

    /// Whether the guest has powered off or failed.
    pub fn has_ended(&mut self) -> bool {
        !matches!(self.0.try_wait(), Ok(None))
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        // Both fail where the guest has powered off, which is how it should be.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A folder of the host that the guest can mount.
fn mount(qemu: &mut Command, tag: &str, path: &Path, options: &str) {
    // A comma in a value is written twice.
    let path = path.display().to_string().replace(',', ",,");
    qemu.args([
        "-fsdev",
        &format!("local,id={tag},path={path},security_model=none,multidevs=remap{options}"),
    ]);
    qemu.args(["-device", &format!("virtio-9p-pci,fsdev={tag},mount_tag={tag}")]);
}

/// A character device of QEMU with both ends inside: `name` for a device or the monitor, the other one for programs
/// of the guest. The ends meet in a socket, since QEMU has nothing that joins two directly.
fn pipe(qemu: &mut Command, name: &str) {
    qemu.args(["-chardev", &format!("socket,id={name},path={name}.socket,server=on,wait=off")]);
    qemu.args(["-chardev", &format!("socket,id={name}-guest,path={name}.socket")]);
    qemu.args(["-device", &format!("virtserialport,chardev={name}-guest,name={name}")]);
}
