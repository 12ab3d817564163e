//! A stock Debian kernel and the modules needed by the drivers' tests, from its package; stored in the target folder.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::packages::apt;
use crate::rootfs;
use crate::run::{Done, run};

/// Metapackage that depends on the newest kernel. Not the cloud variant, which supports neither cameras nor USB.
const META_PACKAGE: &str = "linux-image-amd64";

/// Folders of the modules that tests may request. Unpacking all 4000 modules would take longer than the tests. Every
/// entry must exist in both releases: `fs/f*` stands for `fs/fscache`, which in Debian 13 is part of `fs/netfs`.
const MODULE_FOLDERS: [&str; 21] = [
    "crypto/crc32c_generic.ko*",
    "drivers/block/virtio_blk.ko*",
    "drivers/char",
    "drivers/gpu/drm/*.ko*",
    "drivers/gpu/drm/display",
    "drivers/gpu/drm/virtio",
    "drivers/i2c",
    "drivers/media",
    "drivers/pps",
    "drivers/usb",
    "drivers/video",
    "drivers/virtio",
    "fs/9p",
    "fs/configfs",
    "fs/ext4",
    "fs/f*",
    "fs/jbd2",
    "fs/mbcache.ko*",
    "fs/netfs",
    "lib",
    "net/9p",
];

/// An unpacked kernel.
pub struct GuestKernel {
    /// ELF image, which QEMU boots faster than a compressed one, or else the image from the package.
    pub image: PathBuf,
    /// Folder mounted by the guest as `/lib/modules`; it contains one folder, named after the output of `uname -r`.
    pub modules: PathBuf,
    release: String,
}

impl GuestKernel {
    /// Returns the kernel in `folder`; downloads and unpacks it if necessary.
    pub fn fetch(folder: &Path) -> Done<Self> {
        let kept = folder.join("kernel");
        // A kernel that was unpacked for fewer modules is unpacked anew.
        let folders = MODULE_FOLDERS.join("\n");
        if std::fs::read_to_string(kept.join("folders")).ok().as_ref() != Some(&folders) {
            // Renamed only when complete, so that an interrupted download is restarted.
            let fresh = folder.join("kernel.part");
            let _ = std::fs::remove_dir_all(&fresh);
            let _ = std::fs::remove_dir_all(&kept);
            std::fs::create_dir_all(&fresh).map_err(|error| format!("{}: {error}", fresh.display()))?;
            unpack(&download(&fresh)?, &fresh)?;
            std::fs::write(fresh.join("folders"), folders)
                .map_err(|error| format!("{}: {error}", fresh.display()))?;
            std::fs::rename(&fresh, &kept).map_err(|error| format!("{}: {error}", kept.display()))?;
        }
        let modules = kept.join("lib/modules");
        let release = only_entry(&modules, "")?;
        Ok(Self { image: kept.join("vmlinux"), modules, release })
    }

    /// Name of the release, which is the folder below [`GuestKernel::modules`].
    pub fn release(&self) -> &str {
        &self.release
    }

    /// Files of these modules and their dependencies, relative to the release's folder; built-in modules are skipped.
    pub fn files_of(&self, names: &[&str]) -> Done<BTreeSet<String>> {
        let folder = self.modules.join(&self.release);
        let path = folder.join("modules.dep");
        let text = read_to_string(&path)?;
        let builtin = read_to_string(&folder.join("modules.builtin"))?;
        let is_builtin = |name: &&&str| builtin.lines().any(|file| file.ends_with(&format!("/{name}.ko")));
        let mut files = BTreeSet::new();
        for name in names.iter().filter(|name| !is_builtin(name)) {
            let line = text.lines().find(|line| {
                line.split_once(':').is_some_and(|(file, _)| file.ends_with(&format!("/{name}.ko")))
            });
            let line = line.ok_or_else(|| format!("{}: no module `{name}`", path.display()))?;
            files.extend(line.replace(':', "").split_whitespace().map(str::to_owned));
        }
        Ok(files)
    }
}

/// Downloads the kernel's package with apt.
fn download(folder: &Path) -> Done<PathBuf> {
    let fetched = package_name().and_then(|name| download_package(&name, folder)).or_else(|error| {
        if !rootfs::is_root() {
            return Err(format!(
                "cannot download the guest's kernel: {error}\nthe guest needs Debian's {META_PACKAGE}; is the list of \
                 packages fresh?\n  sudo apt-get update"
            ));
        }
        // Lists that are only partly updated may be sufficient.
        let _ = apt::update();
        download_package(&package_name()?, folder)
    });
    fetched.and_then(|()| only_entry(folder, ".deb")).map(|file| folder.join(file))
}

fn package_name() -> Done<String> {
    let output = Command::new("apt-cache")
        .args(["depends", META_PACKAGE])
        // The output is parsed below, so it must not be translated.
        .env("LC_ALL", "C")
        .output()
        .map_err(|error| format!("cannot start apt-cache: {error}"))?;
    let text = String::from_utf8_lossy(&output.stdout);
    let name = text.lines().find_map(|line| line.trim().strip_prefix("Depends: "));
    name.map(str::to_owned).ok_or_else(|| format!(
            "apt knows no package {META_PACKAGE}, Debian's kernel, which the guest runs; elsewhere leave the guest out: \
             `cargo xtask test --no-guest`"
        ))
}

fn download_package(name: &str, folder: &Path) -> Done {
    // As root, apt would download as another user, who cannot write here, and print a warning.
    run(Command::new("apt-get")
        .args(["-o", "APT::Sandbox::User=root", "-qq", "download", name])
        .current_dir(folder))
}

/// Unpacks the parts of the package that a guest needs, and generates the module index.
fn unpack(package: &Path, folder: &Path) -> Done {
    let mut archive = Command::new("dpkg-deb")
        .arg("--fsys-tarfile")
        .arg(package)
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|error| format!("cannot start dpkg-deb: {error}"))?;
    let stream = archive.stdout.take().ok_or("dpkg-deb without output")?;
    // Debian 13 has its modules below /usr and compressed; in Debian 12 neither is the case.
    run(Command::new("tar")
        .arg("-x")
        .arg("-C")
        .arg(folder)
        .arg("--transform=s,^\\./usr/lib/,./lib/,")
        .args(["--wildcards", "--no-anchored", "boot/vmlinuz-*", "lib/modules/*/modules.*"])
        .args(MODULE_FOLDERS.map(|path| format!("lib/modules/*/kernel/{path}")))
        .stdin(stream))?;
    let status = archive.wait().map_err(|error| format!("dpkg-deb: {error}"))?;
    if !status.success() {
        return Err(format!("dpkg-deb ended with {status}: is {} whole?", package.display()));
    }
    let _ = std::fs::remove_file(package);
    run(Command::new("find").arg(folder).args([
        "-name",
        "*.ko.xz",
        "-exec",
        "xz",
        "--decompress",
        "{}",
        "+",
    ]))?;
    let release = only_entry(&folder.join("lib/modules"), "")?;
    run(Command::new("busybox").args(["depmod", "-b"]).arg(folder).arg(&release))?;
    let compressed = folder.join("boot").join(format!("vmlinuz-{release}"));
    decompress(&compressed, &folder.join("vmlinux"))
}

/// Extracts the ELF image from `vmlinuz`, which is a loader followed by a compressed stream: xz in Debian 12. Debian
/// 13's image is kept as it is, because its own loader decompresses it quickly.
fn decompress(compressed: &Path, image: &Path) -> Done {
    const XZ: &[u8] = b"\xfd7zXZ\0";
    let bytes = std::fs::read(compressed).map_err(|error| format!("{}: {error}", compressed.display()))?;
    let Some(start) = bytes.windows(XZ.len()).position(|window| window == XZ) else {
        return std::fs::rename(compressed, image).map_err(|error| format!("{}: {error}", image.display()));
    };
    let stream = image.with_extension("xz");
    std::fs::write(&stream, &bytes[start..]).map_err(|error| format!("{}: {error}", stream.display()))?;
    let part = image.with_extension("part");
    let output = std::fs::File::create(&part).map_err(|error| format!("{}: {error}", part.display()))?;
    // The end of the loader follows the stream, so xz writes the complete image and then reports an error.
    let _ = Command::new("xz")
        .args(["-dc", "--single-stream"])
        .arg(&stream)
        .stdout(output)
        .stderr(Stdio::null())
        .status();
    let _ = std::fs::remove_file(&stream);
    let elf = std::fs::read(&part).is_ok_and(|bytes| bytes.starts_with(b"\x7fELF"));
    if !elf {
        return Err(format!("{}: its xz stream holds no ELF image", compressed.display()));
    }
    std::fs::rename(&part, image).map_err(|error| format!("{}: {error}", image.display()))
}

fn read_to_string(path: &Path) -> Done<String> {
    std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))
}

/// Name of the only entry of a folder with this ending.
fn only_entry(folder: &Path, ending: &str) -> Done<String> {
    let entries = std::fs::read_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let names = entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned());
    let names: Vec<String> = names.filter(|name| name.ends_with(ending)).collect();
    match names.as_slice() {
        [name] => Ok(name.clone()),
        _ => Err(format!("{}: {} entries `*{ending}`, not one", folder.display(), names.len())),
    }
}
