//! Sends packets to the network, with packet loss, duplication and reordering.

use std::net::{SocketAddrV4, UdpSocket};
use std::ops::RangeInclusive;
use std::sync::{Arc, Mutex};

use raysweep_core::Clock;

use super::faults::{Faults, WireTruth};
use super::gvsp::{self, MAX_PACKET_BYTES, SentBlock};
use super::locks::lock;
use crate::keyed::{Purpose, keyed, uniform};

/// Sends packets from one socket; each sending thread has its own.
pub struct Wire {
    socket: UdpSocket,
    clock: Clock,
    truth: Arc<Mutex<WireTruth>>,
    datagram: Vec<u8>,
    /// A packet that the next one will overtake.
    held: Vec<u8>,
    /// Number of resent packets so far, which keys the faults of the next one.
    resent: u64,
}

/// Destination and rate of packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Route {
    /// The client.
    pub to: SocketAddrV4,
    /// Minimum time between packets.
    pub gap_ns: i64,
}

impl Wire {
    /// A sender on `socket`.
    pub fn new(socket: UdpSocket, truth: Arc<Mutex<WireTruth>>) -> Self {
        Self {
            socket,
            clock: Clock::real(),
            truth,
            datagram: vec![0; MAX_PACKET_BYTES],
            held: Vec::with_capacity(MAX_PACKET_BYTES),
            resent: 0,
        }
    }

    /// Sends a frame.
    pub fn send(&mut self, block: &SentBlock, route: Route, faults: &Faults) {
        let mut truth = WireTruth { frames: 1, ..WireTruth::default() };
        let mut due_ns = self.clock.now_ns();
        for number in 0..block.packets() {
            if route.gap_ns > 0 {
                // Gaps are in the range of microseconds: too short to sleep.
                while self.clock.now_ns() < due_ns {
                    std::hint::spin_loop();
                }
                due_ns += route.gap_ns;
            }
            let bytes = block.packet(number, &mut self.datagram);
            truth.packets += 1;
            if number + 1 == block.packets() {
                truth.last_left_ns = self.clock.now_ns();
            }
            self.pass(bytes, route.to, faults, [block.stamp.seq, number.into(), 0], &mut truth);
        }
        self.release(route.to, &mut truth);
        self.note(truth);
    }

    /// Resends packets of a frame.
    pub fn resend(&mut self, block: &SentBlock, numbers: RangeInclusive<u32>, route: Route, faults: &Faults) {
        let mut truth = WireTruth::default();
        let last = block.packets() - 1;
        for number in *numbers.start()..=last.min(*numbers.end()) {
            let bytes = block.packet(number, &mut self.datagram);
            self.resent += 1;
            truth.packets_resent += 1;
            self.pass(bytes, route.to, faults, [block.stamp.seq, number.into(), self.resent], &mut truth);
        }
        self.release(route.to, &mut truth);
        self.note(truth);
    }

    /// Tells a client that a packet is no longer stored.
    pub fn send_unavailable(&mut self, block: u16, number: u32, route: Route) {
        let bytes = gvsp::unavailable(block, number, &mut self.datagram);
        let mut truth = WireTruth { packets_unavailable: 1, ..WireTruth::default() };
        transmit(&self.socket, &self.datagram[..bytes], route.to, &mut truth);
        self.note(truth);
    }

    /// Sends a test packet of the requested size: `packet_bytes`, including IP and UDP headers.
    pub fn send_test(&mut self, packet_bytes: usize, route: Route) {
        self.datagram.fill(0);
        let mut truth = WireTruth::default();
        transmit(&self.socket, &self.datagram[..packet_bytes - 28], route.to, &mut truth);
        self.note(truth);
    }

    fn pass(
        &mut self,
        bytes: usize,
        to: SocketAddrV4,
        faults: &Faults,
        key: [u64; 3],
        truth: &mut WireTruth,
    ) {
        let datagram = &self.datagram[..bytes];
        if faults.packet_loss + faults.duplication + faults.reordering == 0.0 {
            transmit(&self.socket, datagram, to, truth);
            return;
        }
        let mut random = keyed(faults.seed, Purpose::Wire, &key);
        if uniform(&mut random) < faults.packet_loss {
            truth.packets_lost += 1;
            return;
        }
        if uniform(&mut random) < faults.reordering && self.held.is_empty() {
            truth.packets_reordered += 1;
            self.held.extend_from_slice(datagram);
            return;
        }
        transmit(&self.socket, datagram, to, truth);
        if uniform(&mut random) < faults.duplication {
            truth.packets_duplicated += 1;
            transmit(&self.socket, datagram, to, truth);
        }
        self.release(to, truth);
    }

    fn release(&mut self, to: SocketAddrV4, truth: &mut WireTruth) {
        if !self.held.is_empty() {
            transmit(&self.socket, &self.held, to, truth);
            self.held.clear();
        }
    }

    fn note(&self, sent: WireTruth) {
        let mut truth = lock(&self.truth);
        truth.frames += sent.frames;
        truth.last_left_ns = truth.last_left_ns.max(sent.last_left_ns);
        truth.packets += sent.packets;
        truth.packets_lost += sent.packets_lost;
        truth.packets_duplicated += sent.packets_duplicated;
        truth.packets_reordered += sent.packets_reordered;
        truth.packets_resent += sent.packets_resent;
        truth.packets_unavailable += sent.packets_unavailable;
        truth.packets_refused += sent.packets_refused;
    }
}

fn transmit(socket: &UdpSocket, datagram: &[u8], to: SocketAddrV4, truth: &mut WireTruth) {
    // The ICMP message of a vanished client appears as an error on the next packet.
    if socket.send_to(datagram, to).is_err() {
        truth.packets_refused += 1;
    }
}
