//! The protocol without a network: effects of datagrams on the camera, and packets of frames.

use std::net::{SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use proptest::prelude::*;
use raysweep_core::PixelFormat;

use super::clock::CameraClock;
use super::control::ControlChannel;
use super::faults::{Faults, TriggerOrder};
use super::features::{Feature, FeatureId, Kind, RegisterAccess, features};
use super::gvcp::u32_at;
use super::gvsp::{FrameLayout, SentBlock, block_id};
use super::locks::lock;
use super::registers::{CameraIdentity, Registers};
use super::source;
use super::stream::StreamChannel;

const READ_REGISTER: u16 = 0x0080;
const WRITE_REGISTER: u16 = 0x0082;
const READ_MEMORY: u16 = 0x0084;
const WRITE_MEMORY: u16 = 0x0086;
const SUCCESS: u16 = 0;
const CCP: u32 = 0xA00;

/// A camera with test pictures of 48 x 64 pixels, and the datagrams sent to it.
struct Bench {
    control: ControlChannel,
    stream: std::sync::Arc<StreamChannel>,
    features: Vec<Feature>,
    now: Instant,
    reply: Vec<u8>,
}

fn client(number: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], 50_000 + number))
}

impl Bench {
    fn new() -> Self {
        let (controls, _) = source::pattern((48, 64));
        let capabilities = controls.capabilities();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let stream = std::sync::Arc::new(StreamChannel::new(
            socket,
            48 * 64,
            CameraClock::default(),
            Faults::default(),
        ));
        let features = features(&capabilities);
        let identity = CameraIdentity {
            address: [127, 0, 0, 1].into(),
            model: "model",
            serial: "a serial number that is far too long",
            tick_frequency_hz: 1_000_000_000,
            description: (b"<xml/>".to_vec(), "raysweep.xml"),
        };
        let registers = Registers::new(features.clone(), identity);
        let control = ControlChannel::new(registers, controls, stream.clone(), stream.wire().unwrap());
        Self { control, stream, features, now: Instant::now(), reply: Vec::new() }
    }

    /// Sends a request; returns status and data of the answer.
    fn ask(&mut self, from: u16, command: u16, data: &[u8]) -> (u16, Vec<u8>) {
        let mut datagram = vec![0x42, 1];
        datagram.extend_from_slice(&command.to_be_bytes());
        datagram.extend_from_slice(&(data.len() as u16).to_be_bytes());
        datagram.extend_from_slice(&77_u16.to_be_bytes());
        datagram.extend_from_slice(data);
        assert!(self.control.handle(&datagram, client(from), self.now, &mut self.reply), "no answer");
        let [s0, s1, a0, a1, l0, l1, i0, i1] = *self.reply.first_chunk().unwrap();
        assert_eq!(u16::from_be_bytes([a0, a1]), command + 1);
        assert_eq!(usize::from(u16::from_be_bytes([l0, l1])), self.reply.len() - 8);
        assert_eq!(u16::from_be_bytes([i0, i1]), 77);
        (u16::from_be_bytes([s0, s1]), self.reply[8..].to_vec())
    }

    fn write(&mut self, from: u16, address: u32, value: u32) -> u16 {
        let data = [address.to_be_bytes(), value.to_be_bytes()].concat();
        self.ask(from, WRITE_REGISTER, &data).0
    }

    fn read(&mut self, from: u16, address: u32) -> Result<u32, u16> {
        let (status, data) = self.ask(from, READ_REGISTER, &address.to_be_bytes());
        if status == SUCCESS { Ok(u32_at(&data, 0).unwrap()) } else { Err(status) }
    }

    fn address(&self, id: FeatureId) -> u32 {
        self.features.iter().find(|feature| feature.id == id).unwrap().address
    }

    fn set(&mut self, id: FeatureId, value: u32) -> u16 {
        let address = self.address(id);
        self.write(0, address, value)
    }

    fn get(&mut self, id: FeatureId) -> u32 {
        let address = self.address(id);
        self.read(0, address).unwrap()
    }

    fn set_float(&mut self, id: FeatureId, value: f64) -> u16 {
        let data = [&self.address(id).to_be_bytes()[..], &value.to_be_bytes()].concat();
        self.ask(0, WRITE_MEMORY, &data).0
    }

    fn get_float(&mut self, id: FeatureId) -> f64 {
        let data = [self.address(id).to_be_bytes(), 8_u32.to_be_bytes()].concat();
        let (status, data) = self.ask(0, READ_MEMORY, &data);
        assert_eq!(status, SUCCESS);
        f64::from_be_bytes(*data[4..].first_chunk().unwrap())
    }

    fn started(mut self) -> Self {
        assert_eq!(self.write(0, CCP, 2), SUCCESS);
        assert_eq!(self.set(FeatureId::GevSCDA, 0x7F00_0001), SUCCESS);
        assert_eq!(self.set(FeatureId::GevSCPHostPort, 50_999), SUCCESS);
        assert_eq!(self.set(FeatureId::AcquisitionStart, 1), SUCCESS);
        self
    }
}

#[test]
fn one_client_controls_and_the_others_may_look() {
    let mut bench = Bench::new();
    let width = bench.address(FeatureId::Width);
    assert_eq!(bench.write(0, width, 32), 0x8006, "nobody writes without control");
    assert_eq!(bench.write(0, CCP, 2), SUCCESS);
    assert_eq!(bench.read(1, CCP), Ok(2), "others see that it is taken");
    assert_eq!(bench.write(1, CCP, 2), 0x8006);
    assert_eq!(bench.write(1, width, 32), 0x8006);
    assert_eq!(bench.write(1, CCP, 0), 0x8006, "nor can they release it");
    assert_eq!(bench.write(0, width, 32), SUCCESS);
    assert_eq!(bench.read(1, width), Ok(32), "reading is free");
    assert_eq!(bench.write(0, CCP, 1), SUCCESS, "its owner may have it for itself");
    assert_eq!(bench.read(1, width), Err(0x8006));
    assert_eq!(bench.ask(1, 0x0002, &[]).0, SUCCESS, "discovery is for all");
    assert_eq!(bench.write(0, CCP, 0), SUCCESS);
    assert_eq!(bench.write(1, CCP, 2), SUCCESS);
    assert_eq!(bench.write(0, width, 16), 0x8006);
}

#[test]
fn a_silent_client_loses_the_camera_and_its_stream() {
    let mut bench = Bench::new().started();
    let timeout = Duration::from_millis(bench.get(FeatureId::GevHeartbeatTimeout).into());
    bench.now += timeout;
    bench.control.check_heartbeat(bench.now);
    assert_eq!(bench.read(0, CCP), Ok(2), "not silent for longer than the time-out, and now heard again");
    bench.now += timeout;
    bench.control.check_heartbeat(bench.now);
    assert!(bench.stream.order().is_some());
    // Messages of other clients do not reset the heartbeat.
    bench.now += Duration::from_millis(1);
    assert_eq!(bench.read(1, CCP), Ok(2));
    bench.control.check_heartbeat(bench.now);
    assert!(bench.stream.order().is_none());
    assert_eq!(bench.read(1, CCP), Ok(0));
    assert_eq!(bench.write(1, CCP, 2), SUCCESS);
}

#[test]
fn values_that_a_feature_does_not_take_change_nothing() {
    let mut bench = Bench::new();
    bench.write(0, CCP, 2);
    for feature in bench.features.clone() {
        let before =
            bench.ask(0, READ_MEMORY, &[feature.address.to_be_bytes(), 4_u32.to_be_bytes()].concat());
        let (refused, status) = match (&feature.kind, feature.access) {
            (_, RegisterAccess::ReadOnly) => (bench.set(feature.id, 1), 0x8004),
            (_, RegisterAccess::Command) => continue,
            (Kind::Integer { max: u32::MAX, .. } | Kind::Text(_) | Kind::Long, _) => continue,
            (Kind::Float { max, .. }, _) => {
                assert_eq!(bench.set_float(feature.id, f64::NAN), 0x8002, "{:?}", feature.id);
                (bench.set_float(feature.id, max * 2.0), 0x8002)
            }
            (Kind::Integer { max, .. }, _) => (bench.set(feature.id, max + 1), 0x8002),
            (Kind::Enumeration(_) | Kind::Boolean | Kind::BooleanFor(_), _) => {
                (bench.set(feature.id, 77), 0x8002)
            }
        };
        assert_eq!(refused, status, "{:?}", feature.id);
        let after = bench.ask(0, READ_MEMORY, &[feature.address.to_be_bytes(), 4_u32.to_be_bytes()].concat());
        assert_eq!(before, after, "{:?}", feature.id);
    }
    assert_eq!(bench.read(0, 2), Err(0x8005));
    assert_eq!(bench.read(0, 0x8000), Err(0x8003));
    assert_eq!(bench.write(0, 0x8000, 1), 0x8003);
    assert_eq!(bench.write(0, 0x0, 1), 0x8004);
    assert_eq!(bench.ask(0, 0x0123, &[]).0, 0x8001);
}

#[test]
fn registers_lie_apart() {
    let features = Bench::new().features;
    let mut taken: Vec<_> = features
        .iter()
        .map(|feature| (feature.address, feature.address + feature.bytes(&features)))
        .collect();
    taken.sort_unstable();
    assert!(taken.windows(2).all(|pair| pair[0].1 <= pair[1].0), "{taken:x?}");
}

#[test]
fn a_region_is_bounded_by_the_sensor_and_sets_the_payload() {
    let mut bench = Bench::new();
    bench.write(0, CCP, 2);
    assert_eq!(bench.set(FeatureId::OffsetX, 1), 0x8002, "the full width leaves no room");
    assert_eq!(bench.set(FeatureId::Width, 31), SUCCESS);
    assert_eq!(bench.set(FeatureId::OffsetX, 33), SUCCESS);
    assert_eq!(bench.set(FeatureId::OffsetX, 34), 0x8002);
    assert_eq!(bench.set(FeatureId::Width, 32), 0x8002);
    assert_eq!(bench.set(FeatureId::Height, 3), SUCCESS);
    assert_eq!(bench.set(FeatureId::PixelFormat, PixelFormat::Mono12p.pfnc().unwrap()), SUCCESS);
    assert_eq!(bench.get(FeatureId::PayloadSize), (31 * 3 * 12_u32).div_ceil(8));
    assert_eq!(bench.set(FeatureId::ChunkModeActive, 1), SUCCESS);
    let enable = bench.address(FeatureId::ChunkEnable);
    assert_eq!(bench.write(0, enable + 8, 1), SUCCESS);
    // 140 bytes of pixels and an 8-byte trailer; 8 bytes of a chunk and an 8-byte trailer.
    assert_eq!(bench.get(FeatureId::PayloadSize), 140 + 8 + 16);
}

#[test]
fn what_frames_look_like_is_locked_while_they_are_acquired() {
    let mut bench = Bench::new().started();
    for (id, value) in [
        (FeatureId::Width, 8),
        (FeatureId::PixelFormat, PixelFormat::Mono16.pfnc().unwrap()),
        (FeatureId::ChunkModeActive, 1),
    ] {
        assert_eq!(bench.set(id, value), 0x8006, "{id:?}");
    }
    assert_eq!(bench.set_float(FeatureId::ExposureTime, 1234.5), SUCCESS, "settings of a sweep are not");
    assert_eq!(bench.get_float(FeatureId::ExposureTime), 1234.5);
    assert_eq!(bench.set(FeatureId::AcquisitionStop, 1), SUCCESS);
    assert_eq!(bench.set(FeatureId::Width, 8), SUCCESS);
}

#[test]
fn user_sets_bring_settings_back() {
    let mut bench = Bench::new();
    bench.write(0, CCP, 2);
    let factory = bench.get_float(FeatureId::ExposureTime);
    bench.set_float(FeatureId::ExposureTime, 777.0);
    assert_eq!(bench.set(FeatureId::UserSetSave, 1), 0x8004, "the factory's set stays");
    bench.set(FeatureId::UserSetSelector, 1);
    assert_eq!(bench.set(FeatureId::UserSetSave, 1), SUCCESS);
    bench.set_float(FeatureId::ExposureTime, 5.0);
    bench.set(FeatureId::UserSetLoad, 1);
    assert_eq!(bench.get_float(FeatureId::ExposureTime), 777.0);
    bench.set(FeatureId::UserSetSelector, 0);
    bench.set(FeatureId::UserSetLoad, 1);
    assert_eq!(bench.get_float(FeatureId::ExposureTime), factory);
}

#[test]
fn sets_of_the_sequencer_are_made_in_configuration_mode_and_kept_while_it_runs() {
    const DENIED: u16 = 0x8006;
    let mut bench = Bench::new();
    bench.write(0, CCP, 2);
    assert_eq!(bench.set(FeatureId::SequencerSetSelector, 1), DENIED, "not yet configured");
    assert_eq!(bench.set(FeatureId::SequencerConfigurationMode, 1), SUCCESS);
    for (set, exposure_us, next) in [(0, 300.0, 1), (1, 400.0, 0)] {
        assert_eq!(bench.set(FeatureId::SequencerSetSelector, set), SUCCESS);
        assert_eq!(bench.set_float(FeatureId::ExposureTime, exposure_us), SUCCESS);
        assert_eq!(bench.set(FeatureId::SequencerSetNext, next), SUCCESS);
        assert_eq!(bench.set(FeatureId::SequencerTriggerSource, 1), SUCCESS);
        assert_eq!(bench.set(FeatureId::SequencerSetSave, 1), SUCCESS);
    }
    assert_eq!(bench.set(FeatureId::SequencerSetSelector, 0), SUCCESS);
    assert_eq!(bench.get(FeatureId::SequencerSetNext), 1);
    assert_eq!(bench.get_float(FeatureId::ExposureTime), 400.0, "not before it is loaded");
    assert_eq!(bench.set(FeatureId::SequencerSetLoad, 1), SUCCESS);
    assert_eq!(bench.get_float(FeatureId::ExposureTime), 300.0);
    assert_eq!(bench.set(FeatureId::SequencerMode, 1), DENIED, "still configured");
    assert_eq!(bench.set(FeatureId::SequencerConfigurationMode, 0), SUCCESS);
    assert_eq!(bench.set(FeatureId::SequencerMode, 1), SUCCESS);
    let written = lock(&bench.stream.truth).settings_written;
    assert_eq!(written, 2);
    for id in [
        FeatureId::SequencerConfigurationMode,
        FeatureId::SequencerSetSave,
        FeatureId::UserSetLoad,
        FeatureId::SequencerSetStart,
    ] {
        assert_eq!(bench.set(id, 1), DENIED, "{id:?}");
    }
    assert_eq!(bench.set_float(FeatureId::ExposureTime, 500.0), DENIED);
    assert_eq!(bench.set_float(FeatureId::TriggerDelay, 500.0), DENIED);
    assert_eq!(lock(&bench.stream.truth).settings_written, written);
    assert_eq!(bench.set(FeatureId::SequencerMode, 0), SUCCESS);
    assert_eq!(bench.set_float(FeatureId::ExposureTime, 500.0), SUCCESS);
}

#[test]
fn some_cameras_want_their_trigger_set_in_one_order() {
    let mut bench = Bench::new();
    bench.write(0, CCP, 2);
    lock(&bench.stream.faults).trigger_order = TriggerOrder::SelectorFirst;
    assert_eq!(bench.set(FeatureId::TriggerSource, 1), 0x8006);
    assert_eq!(bench.set(FeatureId::TriggerSelector, 0), SUCCESS);
    assert_eq!(bench.set(FeatureId::TriggerSource, 1), SUCCESS);
    lock(&bench.stream.faults).trigger_order = TriggerOrder::ModeLast;
    assert_eq!(bench.set(FeatureId::TriggerMode, 1), SUCCESS);
    assert_eq!(bench.set(FeatureId::TriggerSource, 0), 0x8006);
    assert_eq!(bench.set_float(FeatureId::TriggerDelay, 10.0), 0x8006);
    assert_eq!(bench.set(FeatureId::TriggerMode, 0), SUCCESS);
    assert_eq!(bench.set(FeatureId::TriggerSource, 0), SUCCESS);
}

#[test]
fn writes_of_several_registers_stop_at_the_first_that_is_refused() {
    let mut bench = Bench::new();
    bench.write(0, CCP, 2);
    let pairs = [(FeatureId::Width, 20), (FeatureId::Height, 1000), (FeatureId::OffsetX, 1)];
    let data: Vec<u8> = pairs
        .iter()
        .flat_map(|(id, value)| [bench.address(*id).to_be_bytes(), u32::to_be_bytes(*value)].concat())
        .collect();
    let (status, data) = bench.ask(0, WRITE_REGISTER, &data);
    assert_eq!((status, data), (0x8002, vec![0, 0, 0, 1]));
    assert_eq!((bench.get(FeatureId::Width), bench.get(FeatureId::OffsetX)), (20, 0));
}

#[test]
fn the_clock_keeps_its_offset_and_drift() {
    let clock = CameraClock { tick_frequency_hz: 125_000_000, offset_ns: 1_000, drift_ppm: 100.0 };
    assert_eq!(clock.ticks(0), 125);
    // One second of the host's clock is 1.0001 s of the camera's.
    assert_eq!(clock.ticks(1_000_000_000), 125_012_500 + 125);
    let reset = clock.reset(5_000_000_000);
    assert_eq!(reset.ticks(5_000_000_000), 0);
    assert_eq!(reset.ticks(6_000_000_000), 125_012_500);
}

#[test]
fn ids_of_blocks_go_round_without_zero() {
    let ids: Vec<u16> = (65_533..65_537).map(block_id).collect();
    assert_eq!(ids, [65_534, 65_535, 1, 2]);
    assert_eq!(block_id(0), 1);
}

proptest! {
    /// Any datagram leaves the camera running, and answers are well-formed and within GVCP's size limit.
    #[test]
    fn no_datagram_upsets_the_camera(
        datagrams in prop::collection::vec(
            prop_oneof![
                prop::collection::vec(any::<u8>(), 0..700),
                // Datagrams that resemble requests reach more of the code.
                (
                    prop_oneof![Just(2_u16), Just(0x40), Just(0x80), Just(0x82), Just(0x84), Just(0x86), Just(0xFFFF), any::<u16>()],
                    any::<u8>(),
                    prop::collection::vec(
                        prop_oneof![any::<u32>(), 0_u32..0x1000, 0x1_0000_u32..0x1_0400, Just(0x10_0000), 0_u32..600],
                        0..140,
                    ),
                )
                    .prop_map(|(command, flags, words)| {
                        let data: Vec<u8> = words.iter().flat_map(|word| word.to_be_bytes()).collect();
                        let mut datagram = vec![0x42, flags];
                        datagram.extend_from_slice(&command.to_be_bytes());
                        datagram.extend_from_slice(&(data.len() as u16).to_be_bytes());
                        datagram.extend_from_slice(&[0, 1]);
                        datagram.extend_from_slice(&data);
                        datagram
                    }),
            ],
            1..40,
        ),
    ) {
        let mut bench = Bench::new();
        bench.write(0, CCP, 2);
        for datagram in datagrams {
            let now = bench.now;
            if bench.control.handle(&datagram, client(0), now, &mut bench.reply) {
                prop_assert!(bench.reply.len() <= 576 - 28);
                prop_assert_eq!(usize::from(u16::from_be_bytes([bench.reply[4], bench.reply[5]])), bench.reply.len() - 8);
            }
        }
        prop_assert_eq!(bench.ask(7, 0x0002, &[]).0, SUCCESS);
    }

    /// The packets of a block, reassembled, are its payload at any packet size.
    #[test]
    fn packets_carry_the_payload(
        width in 1_usize..80,
        height in 1_usize..60,
        packet_bytes in 576_usize..4000,
        chunks in prop::option::of(any::<[bool; 4]>()),
    ) {
        let view = FrameLayout { format: PixelFormat::Mono12p, x: 3, y: 4, width, height, chunks };
        let mut block = SentBlock::with_room(view, 80 * 60);
        block.id = 9;
        block.packet_bytes = packet_bytes;
        block.payload.iter_mut().enumerate().for_each(|(index, byte)| *byte = (index * 7) as u8);
        block.write_chunks();
        let mut datagram = vec![0; 65_536];
        let mut payload = Vec::new();
        for number in 0..block.packets() {
            let bytes = block.packet(number, &mut datagram);
            prop_assert!(bytes + 28 <= packet_bytes);
            prop_assert_eq!(&datagram[..4], &[0, 0, 0, 9]);
            let kind = if number == 0 { 1 } else if number == block.packets() - 1 { 2 } else { 3 };
            prop_assert_eq!(u32_at(&datagram, 4), Some(kind << 24 | number));
            if kind == 3 {
                prop_assert!(bytes > 8, "no empty packets");
                payload.extend_from_slice(&datagram[8..bytes]);
            }
        }
        prop_assert_eq!(&payload[..], &block.payload[..view.payload_bytes()]);
    }
}
