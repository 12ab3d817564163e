//! `cargo xtask guest --systemd`: the Debian package under systemd, in a QEMU guest with a disk of its own. It is
//! installed, used by members of its group and by others, killed, hung, stopped, upgraded, cut off from power in
//! mid-run, and purged. The shell scripts beside this file are the checks.
//!
//! Power losses: once the machine itself is killed and booted again. For more of them, QEMU logs what a run writes to the
//! disk; the disks that a power loss could have left are made from the log, mended by e2fsck as at a boot, and the
//! daemon of this machine completes the run on each.

mod disk;
mod writes;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use self::writes::ReplayRandom;
use super::initramfs;
use super::kernel::GuestKernel;
use super::qemu::{GuestClock, Machine};
use super::report;
use crate::daemon::Daemon;
use crate::run::{self, Done};
use crate::{deb, rootfs};

const PRELUDE: &str = include_str!("prelude.sh");
/// Files for the scripts.
const SHARED: [(&str, &str); 5] = [
    ("rig.toml", include_str!("rig.toml")),
    ("plan.toml", include_str!("plan.toml")),
    ("open.sh", include_str!("open.sh")),
    ("optotune.sh", include_str!("optotune.sh")),
    ("mirror.json", include_str!("mirror.json")),
];

/// A boot of the guest and the script that it runs.
struct Stage {
    name: &'static str,
    script: &'static str,
}

const SERVICE: Stage = Stage { name: "service", script: include_str!("service.sh") };
const CUT: Stage = Stage { name: "cut", script: include_str!("cut.sh") };
const LOGGED: Stage = Stage { name: "logged", script: include_str!("cut.sh") };
const BOOT: Stage = Stage { name: "boot", script: include_str!("boot.sh") };

/// Limit of a stage: some take minutes, and beside other tests several times as long.
const STAGE_LIMIT_S: u32 = 2400;

/// Power losses that are made from the log of one run.
const POWER_LOSSES: u64 = 5;

/// Modules without which the disk and the share cannot be mounted, in the order of loading; dependencies come before
/// them. ext4 wants crc32c_generic without saying so.
const BOOT_MODULES: [&str; 6] = ["virtio_pci", "virtio_blk", "crc32c_generic", "ext4", "9pnet_virtio", "9p"];

const INIT: &str = "\
#!/bin/busybox sh
/bin/busybox mkdir -p /proc /dev /root
/bin/busybox --install -s /bin
export PATH=/bin
mount -t proc proc /proc
mount -t devtmpfs dev /dev
for name in virtio_pci virtio_blk crc32c_generic ext4 9pnet_virtio 9p; do modprobe $name; done
mount -t ext4 -o noatime /dev/vda /root
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000 share /root/share
mount --move /dev /root/dev
umount /proc
exec switch_root /root /sbin/init
";

/// Units that the checks do not need, and that would make the boot longer.
const MASKED: [&str; 17] = [
    "dev-hugepages.mount",
    "dev-mqueue.mount",
    "sys-kernel-debug.mount",
    "sys-kernel-tracing.mount",
    "systemd-modules-load.service",
    "systemd-random-seed.service",
    "systemd-update-utmp.service",
    "systemd-ask-password-console.path",
    "systemd-journald-audit.socket",
    "systemd-logind.service",
    "getty.target",
    "modprobe@configfs.service",
    "modprobe@efi_pstore.service",
    "modprobe@fuse.service",
    "modprobe@loop.service",
    "modprobe@dm_mod.service",
    "fstrim.timer",
];

/// Runs all stages with the package of these programs, or says why this machine does not permit it.
pub fn run(folder: &Path, kernel: &GuestKernel, programs: &Path) -> Done {
    if let Some(why) = rootfs::forbidden() {
        println!("systemd guest: SKIPPED: {why}");
        return Ok(());
    }
    let began = Instant::now();
    let guest = Guest::prepare(folder, kernel, programs)?;
    let mut checks = guest.run(&SERVICE)?;
    let installed = guest.disk.with_extension("installed");
    disk::copy(&guest.disk, &installed)?;

    guest.cut()?;
    checks += guest.run(&BOOT)?;

    std::fs::rename(&installed, &guest.disk).map_err(|error| format!("{}: {error}", installed.display()))?;
    checks += guest.power_losses(programs)?;
    println!("systemd guest: {checks} checks passed in {:.0} s", began.elapsed().as_secs_f64());
    Ok(())
}

/// The guest's disk and what it shares with this machine.
struct Guest<'a> {
    kernel: &'a GuestKernel,
    /// The folder in which QEMU runs.
    run: PathBuf,
    disk: PathBuf,
    /// The guest's `/share`.
    share: PathBuf,
}

impl<'a> Guest<'a> {
    fn prepare(folder: &Path, kernel: &'a GuestKernel, programs: &Path) -> Done<Self> {
        let folder = folder.join("systemd");
        let run = folder.join("run");
        let share = run.join("share");
        let _ = std::fs::remove_dir_all(&run);
        std::fs::create_dir_all(&share).map_err(|error| format!("{}: {error}", share.display()))?;
        for (name, text) in SHARED {
            write(&share.join(name), text)?;
        }
        let package = deb::package(programs, &folder.join("deb"))?;
        deb::copy(&package, &share.join("raysweep.deb"))?;
        initramfs::write(&run.join("initramfs"), kernel, &BOOT_MODULES, INIT)?;
        let disk = run.join("disk");
        disk::make(&folder, kernel, &disk)?;
        println!("systemd guest: Linux {}, {}", kernel.release(), package.display());
        Ok(Self { kernel, run, disk, share })
    }

    /// Boots a stage and waits until its script has ended; returns how many checks have passed.
    fn run(&self, stage: &Stage) -> Done<usize> {
        let mut machine = self.boot(stage, None)?;
        let checks = report::follow(&mut machine, &self.share, &[stage.name], STAGE_LIMIT_S)?;
        machine.wait();
        Ok(checks)
    }

    /// Boots and kills the machine in the middle of a run.
    fn cut(&self) -> Done {
        let mut machine = self.boot(&CUT, None)?;
        let midway = self.share.join(CUT.name).join("midway");
        let began = Instant::now();
        while !midway.exists() {
            if machine.has_ended() || began.elapsed() > Duration::from_secs(STAGE_LIMIT_S.into()) {
                return Err(format!(
                    "the guest has begun no run; its log is {}",
                    midway.with_file_name("log").display()
                ));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        // At a random moment of what is left of the run.
        std::thread::sleep(Duration::from_millis(seed() % 1000));
        drop(machine);
        println!("  cut: power cut in mid-run");
        Ok(())
    }

    /// Lets a run end, then makes power losses from the log of its writes, and completes the run on each.
    fn power_losses(&self, programs: &Path) -> Done<usize> {
        let before = self.run.join("before");
        disk::copy(&self.disk, &before)?;
        let log = self.run.join("writes");
        let sparse = std::fs::File::create(&log).and_then(|file| file.set_len(8 << 30));
        sparse.map_err(|error| format!("{}: {error}", log.display()))?;
        let mut machine = self.boot(&LOGGED, Some(&log))?;
        let checks = report::follow(&mut machine, &self.share, &[LOGGED.name], STAGE_LIMIT_S)?;
        machine.wait();
        let entries = writes::read(&log)?;
        let seed = seed();
        let mut random = ReplayRandom::new(seed);
        let mut completed = 0;
        for _ in 0..POWER_LOSSES {
            let end = 1 + random.number() as usize % (entries.len() - 1);
            let what = format!("power loss at write {end} of {} (seed {seed})", entries.len());
            disk::copy(&before, &self.disk)?;
            writes::replay(&self.disk, &entries, end, &mut random)?;
            let outcome = self.recover(programs).map_err(|error| format!("{what}: {error}"))?;
            println!("  {what}: {outcome}");
            completed += 1;
        }
        Ok(checks + completed)
    }

    /// Mends the disk as a boot does, takes the sessions from it, and completes its newest on this machine.
    fn recover(&self, programs: &Path) -> Done<String> {
        // 1: errors were corrected.
        let mended = Command::new("e2fsck").args(["-f", "-y"]).arg(&self.disk).output();
        let mended = mended.map_err(|error| format!("cannot start e2fsck: {error}"))?;
        if mended.status.code().is_none_or(|code| code > 1) {
            return Err(format!("e2fsck: {}", String::from_utf8_lossy(&mended.stdout)));
        }
        let data = self.run.join("recovered");
        let _ = std::fs::remove_dir_all(&data);
        std::fs::create_dir_all(&data).map_err(|error| format!("{}: {error}", data.display()))?;
        let dump = format!("rdump /var/lib/raysweep {}", data.display());
        run::run(
            Command::new("debugfs")
                .args(["-R", &dump])
                .arg(&self.disk)
                .stdout(Stdio::null())
                .stderr(Stdio::null()),
        )?;
        let data = data.join("raysweep");
        let daemon = Daemon::start(programs, &self.share.join("rig.toml"), &data)?;
        let resumed = Command::new(programs.join("raysweep"))
            .arg("--socket")
            .arg(daemon.socket())
            .args(["resume", "--auto"])
            .output()
            .map_err(|error| format!("cannot start raysweep: {error}"))?;
        daemon.stop()?;
        let said = String::from_utf8_lossy(&resumed.stdout).into_owned();
        if !resumed.status.success() {
            return Err(format!("resume: {said}{}", String::from_utf8_lossy(&resumed.stderr)));
        }
        let mut sessions: Vec<PathBuf> = folders(&data)?;
        sessions.sort();
        let newest = sessions.pop().ok_or("no session on the disk")?;
        let bits = Command::new("sha256sum").stdin(open(&newest.join("products/transport.npy"))?).output();
        let bits = bits.map_err(|error| format!("cannot start sha256sum: {error}"))?.stdout;
        let expected = std::fs::read(self.share.join("bits")).map_err(|error| format!("bits: {error}"))?;
        if bits != expected {
            return Err(format!("{} has other bits than the undisturbed run", newest.display()));
        }
        Ok(said.lines().last().unwrap_or("complete").to_owned())
    }

    fn boot(&self, stage: &Stage, log: Option<&Path>) -> Done<Machine> {
        let folder = self.share.join(stage.name);
        std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        let script = self.share.join("run.sh");
        let text = PRELUDE.replacen('\n', &format!("\nSTAGE={}\n", stage.name), 1);
        write(&script, &format!("{text}{}", stage.script))?;
        run::run(Command::new("chmod").arg("755").arg(&script))?;
        let masks: String = MASKED.iter().map(|unit| format!(" systemd.mask={unit}")).collect();
        let arguments = format!(
            "console=ttyS0 panic=-1 clocksource=hpet mitigations=off quiet systemd.run=/share/run.sh \
             systemd.run_success_action=poweroff-force systemd.run_failure_action=poweroff-force{masks}"
        );
        let mut qemu = Machine::command(self.kernel, &self.run, &arguments)?;
        qemu.args(GuestClock::Host.arguments());
        match log {
            None => qemu.args(["-drive", "if=none,id=d0,format=raw,cache=unsafe,file=disk"]),
            Some(_) => qemu.args([
                "-blockdev",
                "driver=file,node-name=f,filename=disk",
                "-blockdev",
                "driver=file,node-name=l,filename=writes",
                "-blockdev",
                "driver=blklogwrites,node-name=d0,file=f,log=l,log-sector-size=512",
            ]),
        };
        qemu.args(["-device", "virtio-blk-pci,drive=d0", "-serial", "null"]);
        super::qemu::mount(&mut qemu, "share", Path::new("share"), "");
        if stage.name == SERVICE.name {
            qemu.args([
                "-device",
                "qemu-xhci,id=usb",
                "-device",
                "virtio-serial-pci",
                "-device",
                "virtio-gpu-pci",
            ]);
            super::pipe::pipe(&mut qemu, "serial")?;
            qemu.args(["-device", "usb-serial,chardev=serial,always-plugged=true"]);
        }
        Machine::spawn(qemu)
    }
}

fn folders(path: &Path) -> Done<Vec<PathBuf>> {
    let entries = std::fs::read_dir(path).map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.join("ledger.jsonl").exists())
        .collect())
}

fn open(path: &Path) -> Done<std::fs::File> {
    std::fs::File::open(path).map_err(|error| format!("{}: {error}", path.display()))
}

fn write(path: &Path, text: &str) -> Done {
    std::fs::write(path, text).map_err(|error| format!("{}: {error}", path.display()))
}

/// Another number each time.
fn seed() -> u64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.map_or(1, |since| u64::from(since.subsec_nanos()) + since.as_secs())
}
