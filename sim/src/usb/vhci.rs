//! Plugs devices into the kernel's virtual host controller.

use std::fs;
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::thread::JoinHandle;

use super::{UsbDevice, respond};

const CONTROLLER: &str = "/sys/devices/platform/vhci_hcd.0";
/// Any nonzero number; the kernel repeats it in each message.
const DEVICE_ID: u32 = 1;

/// A plugged-in device; dropping it unplugs it.
pub struct Plugged {
    port: u32,
    responder: Option<JoinHandle<io::Result<()>>>,
}

impl Plugged {
    /// Plugs a device into a free port. The kernel then enumerates it.
    ///
    /// # Errors
    /// When the module `vhci-hcd` or a free port is missing, or without permission.
    pub fn new(mut device: impl UsbDevice + 'static) -> io::Result<Self> {
        let status = fs::read_to_string(format!("{CONTROLLER}/status"))?;
        let port = free_port(&status).ok_or_else(|| io::Error::other("vhci-hcd: no free port"))?;
        let (near, far) = UnixStream::pair()?;
        let attach = format!("{port} {} {DEVICE_ID} {}", far.as_raw_fd(), device.identity().speed as u8);
        fs::write(format!("{CONTROLLER}/attach"), attach)?;
        // The kernel holds its own reference to the far end, so ours can be closed.
        drop(far);
        let responder = std::thread::Builder::new()
            .name("usb-device".into())
            .spawn(move || respond(&mut device, near))?;
        Ok(Self { port, responder: Some(responder) })
    }
}

impl Drop for Plugged {
    fn drop(&mut self) {
        // On detach the kernel closes the stream, which ends the responder. If the kernel has already given up, there
        // is nothing to detach.
        let _ = fs::write(format!("{CONTROLLER}/detach"), self.port.to_string());
        if let Some(responder) = self.responder.take() {
            let _ = responder.join();
        }
    }
}

/// Finds a free port of the high-speed hub in the controller's status table, `hub port sta ...`.
fn free_port(status: &str) -> Option<u32> {
    const FREE: &str = "004";
    status.lines().find_map(|line| match line.split_whitespace().collect::<Vec<_>>().as_slice() {
        ["hs", port, FREE, ..] => port.parse().ok(),
        _ => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_free_port_is_taken() {
        let status = "hub port sta spd dev      sockfd local_busid\n\
                      hs  0000 006 003 00010002 000003 1-1\n\
                      hs  0001 004 000 00000000 000000 0-0\n\
                      ss  0008 004 000 00000000 000000 0-0\n";
        assert_eq!(free_port(status), Some(1));
        assert_eq!(free_port("hub port sta\nss  0008 004 000\n"), None);
    }
}
