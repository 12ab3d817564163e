//! The guest's initial file system: busybox, the modules for mounting the host's folders, and a script that mounts
//! them.

use std::path::Path;

use super::kernel::GuestKernel;
use crate::run::{Done, program};

/// Modules needed before the host's folders are mounted.
pub const BOOT_MODULES: [&str; 3] = ["virtio_pci", "9pnet_virtio", "9p"];

/// Init script (process 1). Programs and libraries are the host's own; `run.sh` is generated for each run.
pub const INIT: &str = "\
#!/bin/busybox sh
/bin/busybox mkdir -p /proc /sys /dev /tmp /usr /share /etc /lib64
/bin/busybox --install -s /bin
export PATH=/bin:/usr/bin:/usr/sbin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
mkdir -p /dev/pts /dev/shm
mount -t devpts pts /dev/pts
mount -t tmpfs shm /dev/shm
mount -t tmpfs tmp /tmp
ln -s /proc/self/fd /dev/fd
modprobe virtio_pci
modprobe 9pnet_virtio
modprobe 9p
nine() { mount -t 9p -o \"trans=virtio,version=9p2000.L,msize=512000,$3\" \"$1\" \"$2\"; }
nine usr /usr ro,cache=loose
nine modules /lib/modules ro,cache=loose
nine share /share rw
ln -s /usr/lib/x86_64-linux-gnu /lib/x86_64-linux-gnu
ln -s /usr/lib64/ld-linux-x86-64.so.2 /lib64/
ip link set lo up
sh /share/run.sh
poweroff -f
";

/// Writes the initramfs with these modules and this script as process 1: an uncompressed cpio archive in `newc` format.
pub fn write(path: &Path, kernel: &GuestKernel, modules: &[&str], init: &str) -> Done {
    let busybox = program("busybox").ok_or("no busybox on the path: install busybox-static")?;
    let mut archive = Archive::default();
    for folder in ["bin", "lib"] {
        archive.folder(folder);
    }
    archive.file("init", init.as_bytes());
    archive.file("bin/busybox", &read(&busybox)?);
    let release = format!("lib/modules/{}", kernel.release());
    let unpacked = kernel.modules.join(kernel.release());
    archive.file(&format!("{release}/modules.dep"), &read(&unpacked.join("modules.dep"))?);
    for file in kernel.files_of(modules)? {
        archive.file(&format!("{release}/{file}"), &read(&unpacked.join(&file))?);
    }
    std::fs::write(path, archive.finish()).map_err(|error| format!("{}: {error}", path.display()))
}

fn read(path: &Path) -> Done<Vec<u8>> {
    std::fs::read(path).map_err(|error| format!("{}: {error}", path.display()))
}

/// A cpio archive: for each entry a header of 110 characters, the name and the data; the latter two padded to four
/// bytes.
#[derive(Default)]
struct Archive {
    bytes: Vec<u8>,
    folders: std::collections::BTreeSet<String>,
    entries: u32,
}

impl Archive {
    fn folder(&mut self, name: &str) {
        if self.folders.insert(name.to_owned()) {
            if let Some((parent, _)) = name.rsplit_once('/') {
                self.folder(parent);
            }
            self.entry(name, 0o040_755, &[]);
        }
    }

    fn file(&mut self, name: &str, data: &[u8]) {
        if let Some((parent, _)) = name.rsplit_once('/') {
            self.folder(parent);
        }
        self.entry(name, 0o100_755, data);
    }

    fn entry(&mut self, name: &str, mode: u32, data: &[u8]) {
        self.entries += 1;
        let (data_len, name_len) = (data.len() as u32, name.len() as u32 + 1);
        // inode, mode, uid, gid, links, mtime, size, device (4 fields), length of the name, checksum
        let fields = [self.entries, mode, 0, 0, 1, 0, data_len, 0, 0, 0, 0, name_len, 0];
        self.bytes.extend(b"070701");
        self.bytes.extend(fields.map(|field| format!("{field:08x}")).concat().bytes());
        self.bytes.extend(name.bytes().chain([0]));
        self.pad();
        self.bytes.extend(data);
        self.pad();
    }

    fn pad(&mut self) {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
    }

    fn finish(mut self) -> Vec<u8> {
        self.entry("TRAILER!!!", 0, &[]);
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::process::{Command, Stdio};

    #[test]
    fn the_archive_holds_what_was_put_in() {
        let mut archive = Archive::default();
        archive.file("a/b/odd", b"12345");
        archive.file("a/b/even", b"1234");
        let folder = std::env::temp_dir().join(format!("raysweep-cpio-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let mut cpio = Command::new("busybox")
            .args(["cpio", "-i"])
            .current_dir(&folder)
            .stdin(Stdio::piped())
            .spawn()
            .unwrap();
        cpio.stdin.take().unwrap().write_all(&archive.finish()).unwrap();
        assert!(cpio.wait().unwrap().success());
        let file = |name: &str| std::fs::read(folder.join("a/b").join(name)).unwrap();
        assert_eq!((file("odd"), file("even")), (b"12345".to_vec(), b"1234".to_vec()));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
