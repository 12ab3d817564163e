//! A minimal client of GigE Vision cameras for these tests, written against the standard, not against the camera.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(10);

pub struct Client {
    control: UdpSocket,
    stream: UdpSocket,
    camera: SocketAddr,
    next_id: u16,
    /// Register addresses by feature name, from the description.
    addresses: BTreeMap<String, u32>,
    /// Packets of incomplete frames.
    parts: BTreeMap<u16, BTreeMap<u32, Vec<u8>>>,
    /// How often each packet was received.
    pub received: BTreeMap<(u16, u32), u32>,
    /// Whether to request missing packets.
    pub resend: bool,
}

pub struct Frame {
    pub block: u16,
    pub ticks: u64,
    pub size: (usize, usize),
    pub payload: Vec<u8>,
}

impl Frame {
    /// Value of an eight-byte chunk.
    pub fn chunk(&self, id: u32) -> u64 {
        let mut end = self.payload.len();
        loop {
            let word = |at: usize| u32::from_be_bytes(*self.payload[at..].first_chunk().unwrap());
            let bytes = word(end - 4) as usize;
            if word(end - 8) == id {
                assert_eq!(bytes, 8);
                return u64::from_be_bytes(*self.payload[end - 16..].first_chunk().unwrap());
            }
            end -= 8 + bytes;
        }
    }
}

impl Client {
    /// Takes control of the camera and sets the stream's destination.
    pub fn open(address: Ipv4Addr) -> Self {
        let bind = || {
            let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
            socket.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
            socket
        };
        let (control, stream) = (bind(), bind());
        let mut client = Self {
            control,
            stream,
            camera: (address, 3956).into(),
            next_id: 1,
            addresses: BTreeMap::new(),
            parts: BTreeMap::new(),
            received: BTreeMap::new(),
            resend: false,
        };
        client.read_description();
        assert_eq!(client.write_word(0xA00, 2), 0, "control");
        let port = client.stream.local_addr().unwrap().port();
        assert_eq!(client.write_word(0xD18, u32::from(Ipv4Addr::LOCALHOST)), 0);
        assert_eq!(client.write_word(0xD00, port.into()), 0);
        client
    }

    fn read_description(&mut self) {
        let url = self.read(0x200, 512);
        let url = String::from_utf8(url.split(|byte| *byte == 0).next().unwrap().to_vec()).unwrap();
        let parts: Vec<&str> = url.split(';').collect();
        let [_, address, bytes] = parts[..] else { panic!("{url}") };
        let hex = |text: &str| u32::from_str_radix(text, 16).unwrap();
        let mut xml = Vec::new();
        while xml.len() < hex(bytes) as usize {
            let left = (hex(bytes) - xml.len() as u32).next_multiple_of(4);
            xml.extend(self.read(hex(address) + xml.len() as u32, left.min(512)));
        }
        let xml = String::from_utf8(xml).unwrap();
        for register in xml.split("Reg Name=\"").skip(1) {
            let name = register.split('"').next().unwrap().trim_end_matches("Register");
            if let Some(address) = register.split("<Address>0x").nth(1) {
                let address = hex(address.split('<').next().unwrap());
                self.addresses.entry(name.to_owned()).or_insert(address);
            }
        }
    }

    /// Sends a command; returns status and data of the answer.
    fn ask(&mut self, command: u16, data: &[u8]) -> (u16, Vec<u8>) {
        let id = self.next_id;
        self.next_id += 1;
        let mut datagram = vec![0x42, 1];
        for word in [command, data.len() as u16, id] {
            datagram.extend_from_slice(&word.to_be_bytes());
        }
        datagram.extend_from_slice(data);
        self.control.send_to(&datagram, self.camera).unwrap();
        let deadline = Instant::now() + PATIENCE;
        let mut reply = [0; 1024];
        while Instant::now() < deadline {
            if let Ok(bytes) = self.control.recv(&mut reply)
                && reply[6..8] == id.to_be_bytes()
            {
                return (u16::from_be_bytes([reply[0], reply[1]]), reply[8..bytes].to_vec());
            }
        }
        panic!("no answer to {command:#x}");
    }

    /// Whether the camera answers within `patience`.
    pub fn is_answered(&mut self, patience: Duration) -> bool {
        self.control.send_to(&[0x42, 1, 0, 2, 0, 0, 0xFF, 0xFF], self.camera).unwrap();
        let deadline = Instant::now() + patience;
        let mut reply = [0; 1024];
        while Instant::now() < deadline {
            if self.control.recv(&mut reply).is_ok() {
                return true;
            }
        }
        false
    }

    fn read(&mut self, address: u32, bytes: u32) -> Vec<u8> {
        let (status, data) = self.ask(0x84, &[address.to_be_bytes(), bytes.to_be_bytes()].concat());
        assert_eq!(status, 0, "read {address:#x}");
        data[4..].to_vec()
    }

    fn write_word(&mut self, address: u32, value: u32) -> u16 {
        self.ask(0x82, &[address.to_be_bytes(), value.to_be_bytes()].concat()).0
    }

    pub fn set(&mut self, feature: &str, value: u32) {
        let address = self.addresses[feature];
        assert_eq!(self.write_word(address, value), 0, "{feature} = {value}");
    }

    pub fn set_entry(&mut self, feature: &str, entry: u32, value: u32) {
        let address = self.addresses[feature] + 4 * entry;
        assert_eq!(self.write_word(address, value), 0, "{feature}[{entry}] = {value}");
    }

    pub fn set_float(&mut self, feature: &str, value: f64) {
        let data = [&self.addresses[feature].to_be_bytes()[..], &value.to_be_bytes()].concat();
        assert_eq!(self.ask(0x86, &data).0, 0, "{feature} = {value}");
    }

    pub fn long(&mut self, feature: &str) -> u64 {
        let address = self.addresses[feature];
        u64::from_be_bytes(*self.read(address, 8).first_chunk().unwrap())
    }

    pub fn number(&mut self, feature: &str) -> u32 {
        let address = self.addresses[feature];
        u32::from_be_bytes(*self.read(address, 4).first_chunk().unwrap())
    }

    /// Requests packets, from the receiving socket.
    pub fn ask_again(&self, block: u16, first: u32, last: u32) {
        let mut datagram = vec![0x42, 0, 0, 0x40, 0, 12, 0, 1];
        for word in [u32::from(block), first, last] {
            datagram.extend_from_slice(&word.to_be_bytes());
        }
        self.stream.send_to(&datagram, self.camera).unwrap();
    }

    /// Receives one packet: status, block, kind, number, data.
    pub fn packet(&mut self) -> Option<(u16, u16, u8, u32, Vec<u8>)> {
        let mut datagram = vec![0; 65_536];
        let bytes = self.stream.recv(&mut datagram).ok()?;
        let word = |at: usize| u16::from_be_bytes([datagram[at], datagram[at + 1]]);
        let packet = u32::from_be_bytes([0, datagram[5], datagram[6], datagram[7]]);
        Some((word(0), word(2), datagram[4], packet, datagram[8..bytes].to_vec()))
    }

    /// Receives the next complete frame; `None` if the camera falls silent.
    pub fn frame(&mut self) -> Option<Frame> {
        self.frame_within(PATIENCE)
    }

    /// The same for a camera that falls silent within `patience`.
    pub fn frame_within(&mut self, patience: Duration) -> Option<Frame> {
        let mut silent = Instant::now();
        // Number of the last packet by block, where the trailer has arrived.
        let mut last = BTreeMap::new();
        while silent.elapsed() < patience {
            let Some((status, block, kind, packet, data)) = self.packet() else {
                if self.resend {
                    // The trailers of incomplete frames were lost, so request all their packets.
                    self.parts.keys().for_each(|block| self.ask_again(*block, 0, 0xFF_FFFF));
                }
                continue;
            };
            if status != 0 {
                continue;
            }
            silent = Instant::now();
            *self.received.entry((block, packet)).or_default() += 1;
            let parts = self.parts.entry(block).or_default();
            parts.insert(packet, data);
            if kind == 2 {
                last.insert(block, packet);
            }
            let Some(&end) = last.get(&block) else { continue };
            if parts.len() == end as usize + 1 {
                let parts = self.parts.remove(&block)?;
                return Some(whole(block, parts));
            }
            if self.resend && kind == 2 {
                let missing: Vec<u32> = (0..end).filter(|packet| !parts.contains_key(packet)).collect();
                missing.iter().for_each(|packet| self.ask_again(block, *packet, *packet));
            }
        }
        None
    }
}

fn whole(block: u16, parts: BTreeMap<u32, Vec<u8>>) -> Frame {
    let end = parts.len() as u32 - 1;
    let leader = &parts[&0];
    let word = |at: usize| u32::from_be_bytes(*leader[at..].first_chunk().unwrap()) as usize;
    let payload = (1..end).flat_map(|packet| parts[&packet].clone()).collect();
    Frame {
        block,
        ticks: u64::from_be_bytes(*leader[4..].first_chunk().unwrap()),
        size: (word(20), word(16)),
        payload,
    }
}
