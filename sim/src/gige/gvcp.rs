//! GVCP, the control protocol of GigE Vision 2.0: what datagrams say. Every field is big-endian.

/// The port that cameras listen on.
pub const PORT: u16 = 3956;
/// Bytes of a header.
pub const HEADER: usize = 8;
/// Most bytes that one request may read or write: a datagram is at most 576 bytes.
pub const MAX_DATA: usize = 536;

const KEY: u8 = 0x42;
const ACKNOWLEDGE: u8 = 0x01;
const EXTENDED_IDS: u8 = 0x10;

/// How a request went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names are defined by GigE Vision")]
pub enum Status {
    Success = 0x0000,
    NotImplemented = 0x8001,
    InvalidParameter = 0x8002,
    InvalidAddress = 0x8003,
    WriteProtect = 0x8004,
    BadAlignment = 0x8005,
    AccessDenied = 0x8006,
    PacketUnavailable = 0x800C,
    InvalidHeader = 0x800E,
}

/// The packets of a frame that a client misses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Resend {
    /// The frame.
    pub block: u64,
    /// First packet missed.
    pub first: u32,
    /// Last packet missed.
    pub last: u32,
}

/// What a client asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command<'a> {
    /// Who is there?
    Discovery,
    /// Addresses of registers, four bytes each.
    ReadRegisters(&'a [u8]),
    /// Addresses and values, eight bytes a pair.
    WriteRegisters(&'a [u8]),
    /// So many bytes from an address on.
    ReadMemory(u32, usize),
    /// Bytes for an address.
    WriteMemory(u32, &'a [u8]),
    /// Send these again.
    Resend(Resend),
}

/// A request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Request<'a> {
    /// What to call it in the answer.
    pub id: u16,
    /// The number of its command.
    pub code: u16,
    /// Whether it wants an answer.
    pub acknowledge: bool,
    /// The command, or why it cannot be one.
    pub command: Result<Command<'a>, Status>,
}

impl<'a> Request<'a> {
    /// Reads a datagram; `None`: it is not for a camera, or not whole, and must not be answered.
    pub fn parse(datagram: &'a [u8]) -> Option<Self> {
        let (header, data) = datagram.split_first_chunk::<HEADER>()?;
        let [key, flags, code_high, code_low, length_high, length_low, id_high, id_low] = *header;
        let length = usize::from(u16::from_be_bytes([length_high, length_low]));
        if key != KEY || data.len() < length {
            return None;
        }
        let code = u16::from_be_bytes([code_high, code_low]);
        Some(Self {
            id: u16::from_be_bytes([id_high, id_low]),
            code,
            acknowledge: flags & ACKNOWLEDGE != 0,
            command: Self::command(code, flags, &data[..length]),
        })
    }

    fn command(code: u16, flags: u8, data: &'a [u8]) -> Result<Command<'a>, Status> {
        let word = |at: usize| u32_at(data, at).ok_or(Status::InvalidHeader);
        let whole = |bytes: usize| {
            let fits = !data.is_empty() && data.len().is_multiple_of(bytes) && data.len() <= MAX_DATA;
            if fits { Ok(data) } else { Err(Status::InvalidHeader) }
        };
        match code {
            0x0002 => Ok(Command::Discovery),
            0x0040 if flags & EXTENDED_IDS == 0 => Ok(Command::Resend(Resend {
                block: u64::from(word(0)? & 0xFFFF),
                first: word(4)? & 0xFF_FFFF,
                last: word(8)? & 0xFF_FFFF,
            })),
            0x0080 => Ok(Command::ReadRegisters(whole(4)?)),
            0x0082 => Ok(Command::WriteRegisters(whole(8)?)),
            0x0084 => {
                let bytes = (word(4)? & 0xFFFF) as usize;
                if bytes > MAX_DATA {
                    Err(Status::InvalidParameter)
                } else {
                    Ok(Command::ReadMemory(word(0)?, bytes))
                }
            }
            0x0086 => Ok(Command::WriteMemory(word(0)?, &whole(4)?[4..])),
            _ => Err(Status::NotImplemented),
        }
    }

    /// Begins an answer, whose data the caller appends; [`seal`] ends it.
    pub fn answer(&self, status: Status, reply: &mut Vec<u8>) {
        reply.clear();
        reply.extend_from_slice(&(status as u16).to_be_bytes());
        reply.extend_from_slice(&(self.code + 1).to_be_bytes());
        reply.extend_from_slice(&[0; 2]);
        reply.extend_from_slice(&self.id.to_be_bytes());
    }
}

/// Writes the length of an answer's data into its header.
pub fn seal(reply: &mut [u8]) {
    let length = (reply.len() - HEADER) as u16;
    reply[4..6].copy_from_slice(&length.to_be_bytes());
}

/// A big-endian word of `data`.
pub fn u32_at(data: &[u8], at: usize) -> Option<u32> {
    data.get(at..)?.first_chunk().map(|word| u32::from_be_bytes(*word))
}
