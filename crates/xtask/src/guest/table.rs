//! The tests that run in the guest.

use std::collections::BTreeSet;

use super::qemu::GuestClock;

/// An integration test and its requirements on the guest.
pub struct GuestTest {
    /// File name in the crate's `tests` folder, without `.rs`.
    pub name: &'static str,
    /// Programs of that crate that the test starts; they are placed next to it.
    pub programs: &'static [&'static str],
    /// Kernel modules with their parameters, loaded just before the test.
    pub modules: &'static [&'static str],
    /// QEMU devices present from the start; tests plug in others through QMP.
    pub devices: &'static [&'static str],
    /// QEMU character devices whose other end the test opens as `/dev/virtio-ports/NAME`.
    pub pipes: &'static [&'static str],
    /// Environment variables that tell the test its devices.
    pub environment: &'static [(&'static str, &'static str)],
}

impl GuestTest {
    /// The clock that suits the test's devices.
    pub fn clock(&self) -> GuestClock {
        if self.devices.is_empty() && self.pipes.is_empty() {
            GuestClock::Instructions
        } else {
            GuestClock::Host
        }
    }
}

/// Names of the ports that programs in the guest open: QEMU's monitor, and what the tests share.
pub fn ports(tests: &[&GuestTest]) -> Vec<&'static str> {
    let pipes: BTreeSet<&str> = tests.iter().flat_map(|test| test.pipes).copied().collect();
    ["qmp"].into_iter().chain(pipes).collect()
}

/// To add a test, add its line here, and its modules' folder in `kernel.rs` if that is new.
pub const TESTS: &[GuestTest] = &[
    GuestTest {
        name: "guest_daemon",
        programs: &["raysweepd"],
        modules: &["vhci-hcd"],
        devices: &[],
        pipes: &[],
        environment: &[],
    },
    GuestTest {
        name: "guest_drm",
        programs: &[],
        modules: &["virtio-gpu"],
        devices: &["virtio-gpu-pci"],
        pipes: &[],
        environment: &[("RAYSWEEP_DRM_CARD", "/dev/dri/card0")],
    },
    GuestTest {
        name: "guest_fx2lafw",
        programs: &[],
        modules: &["vhci-hcd"],
        devices: &[],
        pipes: &[],
        environment: &[],
    },
    GuestTest {
        name: "guest_mirror",
        programs: &[],
        modules: &["xhci_pci", "ftdi_sio"],
        devices: &[],
        pipes: &["serial"],
        environment: &[],
    },
    GuestTest {
        name: "guest_modemline",
        programs: &[],
        modules: &["vhci-hcd", "ftdi_sio", "pps-ldisc"],
        devices: &[],
        pipes: &[],
        environment: &[],
    },
    GuestTest {
        name: "guest_serial",
        programs: &[],
        modules: &["xhci_pci", "ftdi_sio"],
        devices: &[],
        pipes: &["serial"],
        environment: &[],
    },
    GuestTest {
        name: "v4l2_vivid",
        programs: &[],
        modules: &["vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=3"],
        devices: &[],
        pipes: &[],
        environment: &[("RAYSWEEP_V4L2_DEVICE", "/dev/video0")],
    },
];
