//! The device's side of USB/IP: transfers arrive as messages, and each is answered once. An incoming bulk transfer
//! waits until there is data, so that the host can cancel it, like a real transfer.
//!
//! The protocol is the kernel's `Documentation/usb/usbip_protocol.rst`; all fields are big-endian words.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, poll};

use super::{Stall, UsbDevice, UsbRequest};

const SUBMIT: u32 = 1;
const UNLINK: u32 = 2;
/// The command code of an answer is that of its request plus this.
const ANSWER: u32 = 2;
/// Maximum transfer length; a host that asks for more has lost its place in the stream.
const TRANSFER_MAX: u32 = 1 << 24;
/// Poll interval for a device that had no data.
const TICK_MS: u8 = 1;

/// An incoming bulk transfer waiting for data.
struct Parked {
    seqnum: u32,
    endpoint: u8,
    room: usize,
}

/// Serves a device until the host unplugs it by closing the stream.
///
/// # Errors
/// When the stream breaks or the host does not speak USB/IP.
pub fn respond(device: &mut dyn UsbDevice, mut host: UnixStream) -> io::Result<()> {
    let mut parked = VecDeque::new();
    loop {
        let mut ready = [PollFd::new(host.as_fd(), PollFlags::POLLIN)];
        let asked = match poll(&mut ready, TICK_MS) {
            Ok(ready) => ready > 0,
            Err(Errno::EINTR) => false,
            Err(errno) => return Err(errno.into()),
        };
        // Data that the device already has are sent before the answer to a new request, as on the bus.
        serve(device, &mut parked, &mut host)?;
        if asked {
            let Some(message) = Message::read(&mut host)? else { return Ok(()) };
            answer(device, message, &mut parked, &mut host)?;
        }
    }
}

/// A message from the host.
struct Message {
    command: u32,
    seqnum: u32,
    is_in: bool,
    endpoint: u8,
    /// Submit: number of bytes to transfer. Unlink: number of the transfer to cancel.
    argument: u32,
    setup: UsbRequest,
    data: Vec<u8>,
}

impl Message {
    /// Reads the next message; `None` at the end of the stream.
    fn read(host: &mut UnixStream) -> io::Result<Option<Self>> {
        let mut head = [0; 48];
        if let Err(error) = host.read_exact(&mut head) {
            return if error.kind() == io::ErrorKind::UnexpectedEof { Ok(None) } else { Err(error) };
        }
        let word = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        // The setup packet is in the stream as on the bus: little-endian.
        let half = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
        let (command, is_in) = (word(0), word(12) == 1);
        // In an unlink, the transfer's number takes the place of a submit's flags.
        let argument = if command == UNLINK { word(20) } else { word(24) };
        let strange = |what: String| Err(io::Error::new(io::ErrorKind::InvalidData, what));
        let mut data = Vec::new();
        if command == SUBMIT {
            if argument > TRANSFER_MAX {
                return strange(format!("USB/IP: a transfer of {argument} bytes"));
            }
            if !is_in {
                data.resize(argument as usize, 0);
                host.read_exact(&mut data)?;
            }
        } else if command != UNLINK {
            return strange(format!("USB/IP: unknown command {command}"));
        }
        let setup = UsbRequest {
            kind: head[40],
            request: head[41],
            value: half(42),
            index: half(44),
            length: half(46),
        };
        Ok(Some(Self { command, seqnum: word(4), is_in, endpoint: head[19], argument, setup, data }))
    }
}

fn answer(
    device: &mut dyn UsbDevice,
    message: Message,
    parked: &mut VecDeque<Parked>,
    host: &mut UnixStream,
) -> io::Result<()> {
    let Message { command, seqnum, is_in, endpoint, argument, setup, data } = message;
    if command == UNLINK {
        let waited = parked.len();
        parked.retain(|transfer| transfer.seqnum != argument);
        // A transfer that was already answered cannot be cancelled; status zero says so.
        let status = if parked.len() < waited { -(Errno::ECONNRESET as i32) } else { 0 };
        return send(host, UNLINK, seqnum, status, 0, &[]);
    }
    if endpoint == 0 {
        let reply = control(device, &setup, &data);
        let reply = reply.map(|mut reply| {
            reply.truncate(usize::from(setup.length));
            reply
        });
        return complete(host, seqnum, reply, data.len());
    }
    if is_in {
        parked.push_back(Parked { seqnum, endpoint, room: argument as usize });
        return Ok(());
    }
    complete(host, seqnum, device.bulk_out(endpoint, &data).map(|()| Vec::new()), data.len())
}

/// Answers incoming transfers while the device has data; those of one endpoint in the order of their arrival.
fn serve(device: &mut dyn UsbDevice, parked: &mut VecDeque<Parked>, host: &mut UnixStream) -> io::Result<()> {
    let mut dry = 0_u16;
    let mut next = 0;
    while let Some(&Parked { seqnum, endpoint, room }) = parked.get(next) {
        let bit = 1 << (endpoint & 0xf);
        if dry & bit == 0
            && let Some(data) = device.bulk_in(endpoint, room)
        {
            complete(host, seqnum, data, 0)?;
            parked.remove(next);
            continue;
        }
        dry |= bit;
        next += 1;
    }
    Ok(())
}

/// Answers standard requests, which are the same for all devices; passes all others to the device.
fn control(device: &mut dyn UsbDevice, setup: &UsbRequest, data: &[u8]) -> Result<Vec<u8>, Stall> {
    let [index, kind] = setup.value.to_le_bytes();
    match (setup.kind, setup.request) {
        (0x80, 6) => device.identity().descriptor(kind, index),
        // GET_STATUS of device, interface and endpoint; GET_CONFIGURATION; GET_INTERFACE.
        (0x80..=0x82, 0) => Ok(vec![0, 0]),
        (0x80, 8) => Ok(vec![1]),
        (0x81, 10) => Ok(vec![0]),
        // CLEAR_FEATURE of an endpoint, whose only feature is ENDPOINT_HALT.
        (0x02, 1) => {
            device.clear_halt(setup.index as u8);
            Ok(Vec::new())
        }
        // CLEAR_FEATURE, SET_CONFIGURATION, SET_INTERFACE: there is only one of each.
        (0x00..=0x02, 1 | 9 | 11) => Ok(Vec::new()),
        (kind, _) if kind & 0x60 == 0 => Err(Stall),
        _ => device.control(setup, data),
    }
}

/// Answers a transfer: with the data read, or with the number of bytes written.
fn complete(
    host: &mut UnixStream,
    seqnum: u32,
    data: Result<Vec<u8>, Stall>,
    out_len: usize,
) -> io::Result<()> {
    match data {
        Ok(data) => send(host, SUBMIT, seqnum, 0, data.len().max(out_len), &data),
        Err(Stall) => send(host, SUBMIT, seqnum, -(Errno::EPIPE as i32), 0, &[]),
    }
}

fn send(
    host: &mut UnixStream,
    command: u32,
    seqnum: u32,
    status: i32,
    len: usize,
    data: &[u8],
) -> io::Result<()> {
    let mut bytes = Vec::with_capacity(48 + data.len());
    // Device, direction and endpoint are zero in answers.
    for word in [command + ANSWER, seqnum, 0, 0, 0, status.cast_unsigned(), len as u32] {
        bytes.extend(word.to_be_bytes());
    }
    bytes.resize(48, 0);
    bytes.extend(data);
    host.write_all(&bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::usb::{Speed, UsbIdentity};
    use std::time::Duration;

    /// Returns on 0x81 what was sent to 0x02; stalls on 0x03.
    struct Echo {
        identity: UsbIdentity,
        bytes: Vec<u8>,
    }

    impl UsbDevice for Echo {
        fn identity(&self) -> &UsbIdentity {
            &self.identity
        }

        fn control(&mut self, request: &UsbRequest, _: &[u8]) -> Result<Vec<u8>, Stall> {
            if request.request == 0xB0 { Ok(vec![1, 4, 9]) } else { Err(Stall) }
        }

        fn bulk_in(&mut self, _: u8, room: usize) -> Option<Result<Vec<u8>, Stall>> {
            let len = room.min(self.bytes.len());
            (len > 0).then(|| Ok(self.bytes.drain(..len).collect()))
        }

        fn bulk_out(&mut self, endpoint: u8, data: &[u8]) -> Result<(), Stall> {
            if endpoint == 3 {
                return Err(Stall);
            }
            self.bytes.extend(data);
            Ok(())
        }
    }

    fn message(words: [u32; 10], setup: [u8; 8], data: &[u8]) -> Vec<u8> {
        let words = words.iter().flat_map(|word| word.to_be_bytes());
        words.chain(setup).chain(data.iter().copied()).collect()
    }

    /// Reads a reply: command, number, status, length.
    fn reply(host: &mut UnixStream) -> ([u32; 4], Vec<u8>) {
        let mut head = [0; 48];
        host.read_exact(&mut head).unwrap();
        let word = |at: usize| u32::from_be_bytes(head[at..at + 4].try_into().unwrap());
        let is_in = word(0) == SUBMIT + ANSWER && word(4) % 2 == 1;
        let mut data = vec![0; if is_in { word(24) as usize } else { 0 }];
        host.read_exact(&mut data).unwrap();
        ([word(0), word(4), word(20), word(24)], data)
    }

    /// Odd numbers denote incoming transfers, so that the test knows which answers carry data.
    #[test]
    fn transfers_are_answered_once_in_order_and_can_be_cancelled() {
        let (mut host, end) = UnixStream::pair().unwrap();
        host.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let identity = UsbIdentity {
            speed: Speed::High,
            vendor: 0x1d50,
            product: 0x608c,
            release: 1,
            strings: ["maker", "echo", "7"],
            endpoints: vec![0x81, 0x02, 0x03],
        };
        let thread = std::thread::spawn(move || respond(&mut Echo { identity, bytes: Vec::new() }, end));
        let submit = |seqnum, is_in, endpoint, len| [SUBMIT, seqnum, 1, is_in, endpoint, 0, len, 0, 0, 0];
        let refused = -(Errno::EPIPE as i32) as u32;
        let mut order = |words, setup, data: &[u8]| host.write_all(&message(words, setup, data)).unwrap();

        order(submit(1, 1, 0, 64), [0x80, 6, 0, 1, 0, 0, 8, 0], &[]); // first 8 bytes of the device's descriptor
        order(submit(3, 1, 0, 3), [0xc0, 0xB0, 0, 0, 0, 0, 3, 0], &[]);
        order(submit(5, 1, 0, 3), [0xc0, 0xB1, 0, 0, 0, 0, 3, 0], &[]);
        order(submit(7, 1, 1, 4), [0; 8], &[]); // these three wait
        order(submit(9, 1, 1, 4), [0; 8], &[]);
        order(submit(11, 1, 1, 4), [0; 8], &[]);
        order([UNLINK, 100, 1, 0, 0, 9, 0, 0, 0, 0], [0; 8], &[]);
        order(submit(12, 0, 2, 6), [0; 8], b"abcdef");
        order([UNLINK, 102, 1, 0, 0, 7, 0, 0, 0, 0], [0; 8], &[]); // too late
        order(submit(14, 0, 3, 1), [0; 8], b"x");

        let mut replies: Vec<_> = (0..9).map(|_| reply(&mut host)).collect();
        replies.sort_by_key(|(words, _)| words[1]);
        let cancelled = -(Errno::ECONNRESET as i32) as u32;
        let expected: Vec<([u32; 4], Vec<u8>)> = vec![
            ([3, 1, 0, 8], vec![18, 1, 0, 2, 0, 0, 0, 64]),
            ([3, 3, 0, 3], vec![1, 4, 9]),
            ([3, 5, refused, 0], vec![]),
            ([3, 7, 0, 4], b"abcd".to_vec()),
            ([3, 11, 0, 2], b"ef".to_vec()),
            ([3, 12, 0, 6], vec![]),
            ([3, 14, refused, 0], vec![]),
            ([4, 100, cancelled, 0], vec![]),
            ([4, 102, 0, 0], vec![]),
        ];
        assert_eq!(replies, expected);
        drop(host);
        thread.join().unwrap().unwrap();
    }

    #[test]
    fn a_host_that_speaks_nonsense_is_left() {
        for head in [[9, 1, 0, 0, 0, 0, 0, 0, 0, 0], [SUBMIT, 1, 1, 0, 2, 0, u32::MAX, 0, 0, 0]] {
            let (mut host, end) = UnixStream::pair().unwrap();
            let (device, _line) = crate::usb::Ftdi::new(Duration::from_millis(10), Duration::from_millis(1));
            let thread = std::thread::spawn(move || respond(&mut { device }, end));
            host.write_all(&message(head, [0; 8], &[])).unwrap();
            assert_eq!(thread.join().unwrap().unwrap_err().kind(), io::ErrorKind::InvalidData);
        }
    }
}
