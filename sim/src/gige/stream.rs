//! The stream channel: sends frames, and resends packets on request.

use std::net::UdpSocket;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, RwLock};
use std::time::Duration;

use raysweep_core::PixelFormat;

use super::clock::CameraClock;
use super::faults::{Faults, WireTruth};
use super::gvcp::Resend;
use super::gvsp::{FrameLayout, MIN_PACKET_BYTES, SentBlock, Stamp, block_id};
use super::locks::{lock, read, write};
use super::source::{BLOCKS, Pictures, SourceControls};
use super::wire::{Route, Wire};
use crate::keyed::{Purpose, keyed, uniform};

/// Longest wait for an exposure, and so the longest delay of a stop.
const PATIENCE: Duration = Duration::from_millis(2);

/// What the client has requested.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamOrder {
    /// Number of the acquisition: frames exposed for an earlier one are not sent.
    pub acquisition: u64,
    /// Region and packing.
    pub view: FrameLayout,
    /// Packet size in bytes, including IP and UDP headers.
    pub packet_bytes: usize,
    /// Destination and packet gap.
    pub route: Route,
    /// Number of the first exposure to send.
    pub first_seq: u64,
    /// Whether to send a single frame only.
    pub single: bool,
}

/// State shared by the control and stream threads.
pub struct StreamChannel {
    order: Mutex<Option<StreamOrder>>,
    blocks: Vec<RwLock<SentBlock>>,
    /// Current faults.
    pub faults: Mutex<Faults>,
    /// Ground truth of what was sent.
    pub truth: Arc<Mutex<WireTruth>>,
    /// The camera's clock.
    pub clock: Mutex<CameraClock>,
    socket: UdpSocket,
}

impl StreamChannel {
    /// An idle stream that sends from `socket`; pictures have at most `pixels` pixels.
    pub fn new(socket: UdpSocket, pixels: usize, clock: CameraClock, faults: Faults) -> Self {
        let nothing =
            FrameLayout { format: PixelFormat::Mono8, x: 0, y: 0, width: 0, height: 0, chunks: None };
        Self {
            order: Mutex::new(None),
            blocks: (0..BLOCKS).map(|_| RwLock::new(SentBlock::with_room(nothing, pixels))).collect(),
            faults: Mutex::new(faults),
            truth: Arc::default(),
            clock: Mutex::new(clock),
            socket,
        }
    }

    /// A new sender on the stream's socket.
    ///
    /// # Errors
    /// When the socket cannot be cloned.
    pub fn wire(&self) -> std::io::Result<Wire> {
        Ok(Wire::new(self.socket.try_clone()?, self.truth.clone()))
    }

    /// Starts or ends an acquisition.
    pub fn set_order(&self, order: Option<StreamOrder>) {
        if order.is_some() {
            // Block ids restart, and stored frames of the previous acquisition would match them.
            self.blocks.iter().for_each(|block| write(block).id = 0);
        }
        *lock(&self.order) = order;
    }

    /// The current order, if any.
    pub fn order(&self) -> Option<StreamOrder> {
        *lock(&self.order)
    }

    /// Resends packets that a client is missing.
    pub fn resend(&self, wanted: Resend, wire: &mut Wire) {
        let Some(order) = self.order() else { return };
        let faults = *lock(&self.faults);
        if !faults.resend || wanted.block == 0 {
            return;
        }
        let kept = self.blocks.iter().map(read).find(|block| u64::from(block.id) == wanted.block);
        match kept {
            Some(block) => wire.resend(&block, wanted.first..=wanted.last, order.route, &faults),
            None => wire.send_unavailable(wanted.block as u16, wanted.first, order.route),
        }
    }

    /// Sends frames until `stop`.
    pub fn run(
        &self,
        controls: &dyn SourceControls,
        mut pictures: Box<dyn Pictures>,
        mut wire: Wire,
        stop: &AtomicBool,
    ) {
        let mut exposure_before_us = 0.0;
        while !stop.load(Ordering::Relaxed) {
            let Some(order) = self.order() else {
                std::thread::sleep(PATIENCE);
                continue;
            };
            let Some(exposed) = pictures.wait(&order.view, PATIENCE) else { continue };
            let faults = *lock(&self.faults);
            let count = exposed.seq.checked_sub(order.first_seq);
            let Some(count) = count.filter(|_| self.order() == Some(order) && !faults.dead) else { continue };
            let told_us = if faults.late_chunk { exposure_before_us } else { exposed.exposure_us };
            exposure_before_us = exposed.exposure_us;
            let slot = &self.blocks[(exposed.seq % BLOCKS as u64) as usize];
            {
                let mut block = write(slot);
                block.id = block_id(count);
                block.view = order.view;
                block.packet_bytes = order.packet_bytes.max(MIN_PACKET_BYTES);
                let ticks = lock(&self.clock).ticks(exposed.start_ns);
                block.stamp = Stamp { seq: exposed.seq, ticks, exposure_us: told_us, set: exposed.set };
                pictures.write(&exposed, &mut block);
                block.write_chunks();
            }
            if faults.delay_us > 0 {
                std::thread::sleep(Duration::from_micros(faults.delay_us.into()));
            }
            if uniform(&mut keyed(faults.seed, Purpose::Wire, &[exposed.seq])) < faults.frame_loss {
                // A frame that is not sent must not be stored either, or a client could request it.
                write(slot).id = 0;
                lock(&self.truth).frames_lost += 1;
            } else {
                wire.send(&read(slot), order.route, &faults);
            }
            if order.single {
                controls.disarm();
                self.set_order(None);
            }
        }
    }
}
