//! The disk of the guest with systemd: a minimal Debian of the machine's own release, as an ext4 image.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, SystemTime};

use crate::deb;
use crate::guest::kernel::GuestKernel;
use crate::run::{Done, run};
use crate::space;

/// How long an unpacked Debian is kept; a newer one has newer packages.
const KEPT: Duration = Duration::from_secs(30 * 24 * 3600);

/// Packages besides the essential ones. The daemon's own dependency is among them, as the guest has no network.
const PACKAGES: &str = "usr-is-merged,systemd,systemd-sysv,dbus,udev,kmod,libaravis-0.8-0";

/// Modules that the checks load; more would take `depmod` in the guest longer.
const MODULES: [&str; 11] = [
    "cdc-acm",
    "dummy_hcd",
    "ftdi_sio",
    "g_serial",
    "usb_f_acm",
    "pps-ldisc",
    "usbserial",
    "virtio-gpu",
    "virtio_console",
    "vivid",
    "xhci-pci",
];

/// Makes the image `$4` from the tar file `$1` with the modules `$2`, in the folder `$3`: root's files stay root's by
/// fakeroot.
const IMAGE: &str = r#"
mkdir -p "$3"
chmod 755 "$3"
tar -C "$3" -xpf "$1"
mkdir -p "$3/share" "$3/var/log/journal" "$3/etc/systemd/system-generators" "$3/usr/lib/modules"
cp -r "$2"/. "$3/usr/lib/modules"
# mmdebstrap empties it, and systemd would take the boot for the first.
echo 0123456789abcdef0123456789abcdef >"$3/etc/machine-id"
# A second less for each daemon-reload.
for generator in "$3"/lib/systemd/system-generators/*; do
    case ${generator##*/} in
        systemd-run-generator | systemd-debug-generator) ;;
        *) ln -sf /dev/null "$3/etc/systemd/system-generators/${generator##*/}" ;;
    esac
done
mke2fs -q -t ext4 -d "$3" -m 0 -E root_owner=0:0 "$4" 1G
"#;

/// Makes the disk, from a Debian that is unpacked once and kept.
pub fn make(folder: &Path, kernel: &GuestKernel, image: &Path) -> Done {
    let tar = debian(folder)?;
    let (tree, modules) = (folder.join("tree"), folder.join("modules"));
    for left in [&tree, &modules] {
        // What an interrupted command has left.
        let _ = std::fs::remove_dir_all(left);
    }
    let lists = ["modules.order", "modules.builtin"].map(str::to_owned);
    for file in kernel.files_of(&MODULES)?.into_iter().chain(lists) {
        let release = Path::new(kernel.release());
        deb::copy(&kernel.modules.join(release).join(&file), &modules.join(release).join(&file))?;
    }
    let _ = std::fs::remove_file(image);
    run(Command::new("fakeroot")
        .args(["sh", "-euc", IMAGE, "sh"])
        .arg(tar)
        .arg(&modules)
        .arg(&tree)
        .arg(image))?;
    std::fs::remove_dir_all(&tree).map_err(|error| format!("{}: {error}", tree.display()))
}

fn debian(folder: &Path) -> Done<PathBuf> {
    let about = std::fs::read_to_string("/etc/os-release").unwrap_or_default();
    let suite = about.lines().find_map(|line| line.strip_prefix("VERSION_CODENAME="));
    // Programs that are built here need the C library of this release.
    let suite = suite.ok_or("/etc/os-release has no VERSION_CODENAME: the guest needs Debian; elsewhere leave it out: `cargo xtask test --no-guest`")?;
    let tar = folder.join(format!("{suite}.tar"));
    let age = tar.metadata().and_then(|about| about.modified()).ok();
    let age = age.and_then(|modified| SystemTime::now().duration_since(modified).ok());
    if age.is_some_and(|age| age < KEPT) {
        return Ok(tar);
    }
    let part = folder.join(format!("{suite}.part.tar"));
    let mut make = Command::new("mmdebstrap");
    // On disk it takes three times as long; containers have as little as 64 MiB there.
    let memory = Path::new("/dev/shm");
    if memory.is_dir() && space::require(memory, 1, "a Debian takes up to", "mount a larger one").is_ok() {
        make.env("TMPDIR", "/dev/shm");
    }
    make.args(["--quiet", "--variant=custom", "--include=?essential", &format!("--include={PACKAGES}")]);
    make.args(["--hook-dir=/usr/share/mmdebstrap/hooks/merged-usr", "--dpkgopt=force-unsafe-io"]);
    for path in ["/usr/share/doc/*", "/usr/share/man/*", "/usr/share/locale/*"] {
        make.arg(format!("--dpkgopt=path-exclude={path}"));
    }
    // Options of the build stay in the image, and would leave out our package's documentation too.
    make.arg(
        "--customize-hook=echo force-unsafe-io >\"$1/etc/dpkg/dpkg.cfg.d/99mmdebstrap\"; echo guest >\"$1/etc/hostname\"",
    );
    run(make.arg(suite).arg(&part).stdout(Stdio::null()))?;
    std::fs::rename(&part, &tar).map_err(|error| format!("{}: {error}", tar.display()))?;
    Ok(tar)
}

/// Copies a disk, without its holes.
pub fn copy(from: &Path, to: &Path) -> Done {
    run(Command::new("cp").arg("--sparse=always").args([from, to]))
}
