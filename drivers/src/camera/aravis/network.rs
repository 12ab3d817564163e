//! GigE Vision on this host: packet sizes, resends, and a socket buffer large enough for times when the host is busy.

use std::fs;

use aravis::glib::object::Cast;
use aravis::prelude::*;
use aravis::{Camera, GvStream, GvStreamOption, GvStreamSocketBuffer, Stream};

use raysweep_config::rig::aravis::AravisConfig;

/// The system's limit for socket buffers.
const RMEM_MAX: &str = "/proc/sys/net/core/rmem_max";
/// Packet size that every GigE Vision device supports.
const MIN_PACKET_BYTES: u32 = 576;
/// Packets of a frame that may always be requested again.
const FEWEST_REQUESTS: f64 = 8.0;
/// Minimum size of the socket buffer.
const MIN_SOCKET_BUFFER_BYTES: u64 = 1 << 20;

/// Socket buffer that frames need on this host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SocketBuffer {
    /// Requested bytes.
    pub wanted_bytes: u64,
    /// Bytes that the system allows.
    pub allowed_bytes: u64,
}

impl SocketBuffer {
    /// Two frames: one is read while the next arrives.
    pub fn of(config: &AravisConfig, payload_bytes: usize) -> Self {
        let wanted = (2 * payload_bytes as u64).max(MIN_SOCKET_BUFFER_BYTES);
        let allowed = fs::read_to_string(RMEM_MAX).ok().and_then(|text| text.trim().parse().ok());
        Self {
            wanted_bytes: config.socket_buffer_bytes.map_or(wanted, u64::from),
            allowed_bytes: allowed.unwrap_or(u64::MAX),
        }
    }

    /// Whether the system allows what is wanted.
    pub fn suffices(&self) -> bool {
        self.wanted_bytes <= self.allowed_bytes
    }

    /// What is wrong, if the allowed size is too small, and how to fix it.
    pub fn shortage(&self) -> Option<(String, String)> {
        let Self { wanted_bytes, allowed_bytes } = self;
        (!self.suffices()).then(|| {
            let what = format!(
                "net.core.rmem_max = {allowed_bytes} allows no socket buffer of {wanted_bytes} bytes for this camera's frames: packets will be lost whenever the host is busy"
            );
            let remedy = format!("`sysctl -w net.core.rmem_max={wanted_bytes}`; a file in /etc/sysctl.d keeps it");
            (what, remedy)
        })
    }

    /// Both in one line.
    pub fn warning(&self) -> Option<String> {
        self.shortage().map(|(what, remedy)| format!("{what}. Mend it with {remedy}"))
    }
}

/// Call before the stream is created: sets the socket type and the packet size.
pub fn prepare(camera: &Camera, config: &AravisConfig, socket: SocketBuffer) {
    if !camera.is_gv_device() {
        return;
    }
    // libaravis uses a packet socket if it may. That is slower than a UDP socket with room for one or two frames, but
    // better than a UDP socket with less.
    camera.gv_set_stream_options(if socket.suffices() {
        GvStreamOption::PACKET_SOCKET_DISABLED
    } else {
        GvStreamOption::NONE
    });
    let sized = match config.packet_size {
        Some(size) => camera.gv_set_packet_size(size.try_into().unwrap_or(i32::MAX)),
        None => camera.gv_auto_packet_size(),
    };
    if let Err(error) = sized {
        tracing::warn!(%error, "packet size not negotiated; it stays as the camera has it");
    }
}

/// Call after the stream is created. libaravis detects whether the camera supports resending packets.
pub fn tune(camera: &Camera, stream: &Stream, socket: SocketBuffer, payload_bytes: usize) {
    if let Some(stream) = stream.downcast_ref::<GvStream>() {
        let packet_bytes = camera.gv_get_packet_size().unwrap_or(MIN_PACKET_BYTES);
        stream.set_packet_request_ratio(request_ratio(payload_bytes, packet_bytes));
        stream.set_socket_buffer(GvStreamSocketBuffer::Fixed);
        let bytes = socket.wanted_bytes.min(socket.allowed_bytes);
        stream.set_socket_buffer_size(bytes.try_into().unwrap_or(i32::MAX));
    }
}

/// Fraction of a frame's packets that may be requested again. libaravis' own limit of a quarter is less than one
/// packet for a frame of three jumbo packets; a much higher limit for large frames would overload a host that is too
/// slow for its camera.
fn request_ratio(payload_bytes: usize, packet_bytes: u32) -> f64 {
    let packets = payload_bytes as f64 / f64::from(packet_bytes.max(1));
    (FEWEST_REQUESTS / packets.max(1.0)).clamp(0.25, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_that_the_system_does_not_allow_is_told_with_the_remedy() {
        let small = SocketBuffer { wanted_bytes: 4_000_000, allowed_bytes: 212_992 };
        let warning = small.warning().unwrap();
        assert!(warning.contains("sysctl -w net.core.rmem_max=4000000"), "{warning}");
        assert_eq!(SocketBuffer { allowed_bytes: 4_000_000, ..small }.warning(), None);
    }

    #[test]
    fn a_few_packets_of_any_frame_may_be_asked_for_again() {
        assert_eq!(request_ratio(24_576, 9_000), 1.0, "three packets");
        assert!((request_ratio(24_576, 1_536) - 0.5).abs() < 1e-12, "sixteen");
        assert_eq!(request_ratio(2_880_000, 1_500), 0.25);
    }

    #[test]
    fn two_frames_fit_unless_the_rig_says_otherwise() {
        let wanted = |config: &AravisConfig, payload| SocketBuffer::of(config, payload).wanted_bytes;
        let config = AravisConfig::default();
        assert_eq!(wanted(&config, 3_000_000), 6_000_000);
        assert_eq!(wanted(&config, 1_000), MIN_SOCKET_BUFFER_BYTES);
        let stated = AravisConfig { socket_buffer_bytes: Some(5_000), ..config };
        assert_eq!(wanted(&stated, 3_000_000), 5_000);
    }
}
