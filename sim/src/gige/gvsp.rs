//! GVSP, the streaming protocol of GigE Vision 2.0: a frame consists of a leader, payload packets and a trailer. All
//! header fields are big-endian; frame ids have 16 bits, packet ids 24.

use raysweep_core::PixelFormat;

use super::gvcp::GvcpStatus;

/// Bytes of IP, UDP and GVSP headers, which are included in a packet's size.
const HEADERS: usize = 20 + 8 + GVSP_HEADER;
const GVSP_HEADER: usize = 8;
/// Minimum packet size that a client may choose.
pub const MIN_PACKET_BYTES: usize = 576;
/// Maximum size of an IP datagram.
pub const MAX_PACKET_BYTES: usize = 65_535;

const LEADER: u8 = 1;
const TRAILER: u8 = 2;
const PAYLOAD: u8 = 3;

/// Payload types: an image, and an image followed by chunks.
const IMAGE: u16 = 0x0001;
const IMAGE_WITH_CHUNKS: u16 = 0x4001;
/// Chunk id of the image.
const IMAGE_CHUNK: u32 = 0x0000_0001;
/// Bytes of a chunk's trailer: its id and its length.
const CHUNK_TRAILER: usize = 8;
/// Data bytes of each chunk other than the image: one 64-bit value.
const CHUNK_DATA: usize = 8;

/// Metadata that a frame can carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Chunk {
    /// Exposure time in microseconds, a double.
    ExposureTime,
    /// Start of the exposure in ticks of the camera's clock.
    Timestamp,
    /// Frame number, which does not wrap.
    FrameId,
    /// Active sequencer set; 0 while the sequencer is off.
    SequencerSetActive,
}

impl Chunk {
    /// All chunks, in the order of `ChunkSelector`.
    pub const ALL: [Self; 4] = [Self::ExposureTime, Self::Timestamp, Self::FrameId, Self::SequencerSetActive];

    /// Chunk id in the payload.
    pub fn id(self) -> u32 {
        0x1000 + self as u32
    }

    /// SFNC name.
    pub fn feature(self) -> &'static str {
        match self {
            Self::ExposureTime => "ChunkExposureTime",
            Self::Timestamp => "ChunkTimestamp",
            Self::FrameId => "ChunkFrameID",
            Self::SequencerSetActive => "ChunkSequencerSetActive",
        }
    }
}

/// Region, packing and chunks of the transmitted frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameLayout {
    /// Pixel packing.
    pub format: PixelFormat,
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Enabled chunks, in the order of [`Chunk::ALL`]; `None`: plain image without chunks.
    pub chunks: Option<[bool; Chunk::ALL.len()]>,
}

impl FrameLayout {
    /// Size of the pixels in bytes.
    pub fn image_bytes(&self) -> usize {
        self.format.frame_bytes(self.width * self.height)
    }

    /// Size of a frame in bytes.
    pub fn payload_bytes(&self) -> usize {
        match self.chunks {
            None => self.image_bytes(),
            Some(enabled) => {
                let sent = enabled.iter().filter(|enabled| **enabled).count();
                self.image_chunk_bytes() + CHUNK_TRAILER + sent * (CHUNK_DATA + CHUNK_TRAILER)
            }
        }
    }

    /// Size of the image chunk; a chunk's length is a multiple of four.
    fn image_chunk_bytes(&self) -> usize {
        self.image_bytes().next_multiple_of(4)
    }
}

/// Metadata of a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Stamp {
    /// The camera's exposure counter.
    pub seq: u64,
    /// Start of row 0's exposure in ticks of the camera's clock.
    pub ticks: u64,
    /// Exposure time as reported by the chunk.
    pub exposure_us: f64,
    /// Active sequencer set.
    pub set: u64,
}

/// A frame as sent, kept for resend requests.
pub struct SentBlock {
    /// Block id carried by its packets; 0 if empty.
    pub id: u16,
    /// Region and packing.
    pub view: FrameLayout,
    /// Metadata.
    pub stamp: Stamp,
    /// Packet size in bytes, headers included.
    pub packet_bytes: usize,
    /// Buffer for pixels and chunks; the first [`FrameLayout::payload_bytes`] bytes are used.
    pub payload: Vec<u8>,
}

impl SentBlock {
    /// An empty block with capacity for any view of `pixels` pixels.
    pub fn with_room(view: FrameLayout, pixels: usize) -> Self {
        let bytes =
            PixelFormat::Mono16.frame_bytes(pixels) + (CHUNK_DATA + CHUNK_TRAILER) * (Chunk::ALL.len() + 1);
        Self { id: 0, view, stamp: Stamp::default(), packet_bytes: MIN_PACKET_BYTES, payload: vec![0; bytes] }
    }

    /// Buffer for the packed pixels.
    pub fn image_mut(&mut self) -> &mut [u8] {
        let bytes = self.view.image_bytes();
        &mut self.payload[..bytes]
    }

    /// Writes the chunks after the pixels.
    pub fn write_chunks(&mut self) {
        let Some(enabled) = self.view.chunks else { return };
        let mut at = self.view.image_chunk_bytes();
        put(&mut self.payload, &mut at, &IMAGE_CHUNK.to_be_bytes());
        put(&mut self.payload, &mut at, &(self.view.image_chunk_bytes() as u32).to_be_bytes());
        for (chunk, _) in Chunk::ALL.into_iter().zip(enabled).filter(|(_, enabled)| *enabled) {
            let value = match chunk {
                Chunk::ExposureTime => self.stamp.exposure_us.to_bits(),
                Chunk::Timestamp => self.stamp.ticks,
                Chunk::FrameId => self.stamp.seq,
                Chunk::SequencerSetActive => self.stamp.set,
            };
            put(&mut self.payload, &mut at, &value.to_be_bytes());
            put(&mut self.payload, &mut at, &chunk.id().to_be_bytes());
            put(&mut self.payload, &mut at, &(CHUNK_DATA as u32).to_be_bytes());
        }
    }

    /// Number of packets, including leader and trailer.
    pub fn packets(&self) -> u32 {
        (self.view.payload_bytes().div_ceil(self.packet_bytes - HEADERS) + 2) as u32
    }

    /// Writes packet `number` into `datagram`; returns its length.
    pub fn packet(&self, number: u32, datagram: &mut [u8]) -> usize {
        let mut at = 0;
        let mut word = |bytes: &[u8]| put(datagram, &mut at, bytes);
        let payload_type = if self.view.chunks.is_some() { IMAGE_WITH_CHUNKS } else { IMAGE };
        let last = self.packets() - 1;
        let kind = match number {
            0 => LEADER,
            number if number == last => TRAILER,
            _ => PAYLOAD,
        };
        word(&(GvcpStatus::Success as u16).to_be_bytes());
        word(&self.id.to_be_bytes());
        word(&(u32::from(kind) << 24 | number).to_be_bytes());
        match kind {
            LEADER => {
                word(&[0; 2]);
                word(&payload_type.to_be_bytes());
                word(&self.stamp.ticks.to_be_bytes());
                word(&self.view.format.pfnc().unwrap_or_default().to_be_bytes());
                for value in [self.view.width, self.view.height, self.view.x, self.view.y] {
                    word(&(value as u32).to_be_bytes());
                }
                word(&[0; 4]);
            }
            TRAILER => {
                word(&[0; 2]);
                word(&payload_type.to_be_bytes());
                word(&(self.view.height as u32).to_be_bytes());
                if self.view.chunks.is_some() {
                    // Chunk layout id: constant, since the layout does not change during acquisition.
                    word(&[0; 4]);
                }
            }
            _ => {
                let data = self.packet_bytes - HEADERS;
                let from = (number as usize - 1) * data;
                word(&self.payload[from..self.view.payload_bytes().min(from + data)]);
            }
        }
        at
    }
}

/// Writes the answer to a request for packets that are no longer stored; returns its length.
pub fn unavailable(block: u16, number: u32, datagram: &mut [u8]) -> usize {
    let mut at = 0;
    put(datagram, &mut at, &(GvcpStatus::PacketUnavailable as u16).to_be_bytes());
    put(datagram, &mut at, &block.to_be_bytes());
    put(datagram, &mut at, &(u32::from(PAYLOAD) << 24 | number).to_be_bytes());
    at
}

fn put(to: &mut [u8], at: &mut usize, bytes: &[u8]) {
    to[*at..*at + bytes.len()].copy_from_slice(bytes);
    *at += bytes.len();
}

/// Block id of the `n`th frame since the start of acquisition, from 0: runs from 1 to 65535 and wraps to 1.
pub fn block_id(n: u64) -> u16 {
    (n % 0xFFFF) as u16 + 1
}
