//! GVCP, the control protocol of GigE Vision 2.0: datagram contents. All fields are big-endian.

/// UDP port of cameras.
pub const PORT: u16 = 3956;
/// Length of a header in bytes.
pub const HEADER: usize = 8;
/// Maximum number of data bytes per request: a datagram has at most 576 bytes.
pub const MAX_DATA: usize = 536;

const KEY: u8 = 0x42;
const ACKNOWLEDGE: u8 = 0x01;
const EXTENDED_IDS: u8 = 0x10;

/// Status of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names are defined by GigE Vision")]
pub enum GvcpStatus {
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

/// A client's request for missing packets of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Resend {
    /// Block id of the frame.
    pub block: u64,
    /// First missing packet.
    pub first: u32,
    /// Last missing packet.
    pub last: u32,
}

/// A client's command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GvcpCommand<'a> {
    /// Device discovery.
    Discovery,
    /// Register addresses, four bytes each.
    ReadRegisters(&'a [u8]),
    /// Pairs of address and value, eight bytes each.
    WriteRegisters(&'a [u8]),
    /// Start address and number of bytes.
    ReadMemory(u32, usize),
    /// Start address and data.
    WriteMemory(u32, &'a [u8]),
    /// Packets to resend.
    Resend(Resend),
}

/// A request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GvcpRequest<'a> {
    /// Request id, repeated in the answer.
    pub id: u16,
    /// Command code.
    pub code: u16,
    /// Whether an answer is requested.
    pub acknowledge: bool,
    /// The command, or the error status if it is invalid.
    pub command: Result<GvcpCommand<'a>, GvcpStatus>,
}

impl<'a> GvcpRequest<'a> {
    /// Parses a datagram; `None` if it is incomplete or not a request, and must not be answered.
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

    fn command(code: u16, flags: u8, data: &'a [u8]) -> Result<GvcpCommand<'a>, GvcpStatus> {
        let word = |at: usize| u32_at(data, at).ok_or(GvcpStatus::InvalidHeader);
        let whole = |bytes: usize| {
            let fits = !data.is_empty() && data.len().is_multiple_of(bytes) && data.len() <= MAX_DATA;
            if fits { Ok(data) } else { Err(GvcpStatus::InvalidHeader) }
        };
        match code {
            0x0002 => Ok(GvcpCommand::Discovery),
            0x0040 if flags & EXTENDED_IDS == 0 => Ok(GvcpCommand::Resend(Resend {
                block: u64::from(word(0)? & 0xFFFF),
                first: word(4)? & 0xFF_FFFF,
                last: word(8)? & 0xFF_FFFF,
            })),
            0x0080 => Ok(GvcpCommand::ReadRegisters(whole(4)?)),
            0x0082 => Ok(GvcpCommand::WriteRegisters(whole(8)?)),
            0x0084 => {
                let bytes = (word(4)? & 0xFFFF) as usize;
                if bytes > MAX_DATA {
                    Err(GvcpStatus::InvalidParameter)
                } else {
                    Ok(GvcpCommand::ReadMemory(word(0)?, bytes))
                }
            }
            0x0086 => Ok(GvcpCommand::WriteMemory(word(0)?, &whole(4)?[4..])),
            _ => Err(GvcpStatus::NotImplemented),
        }
    }

    /// Starts an answer, to which the caller appends data; [`seal`] completes it. Its code is the request's plus one,
    /// which wraps for the last code, as any client may send it.
    pub fn answer(&self, status: GvcpStatus, reply: &mut Vec<u8>) {
        reply.clear();
        reply.extend_from_slice(&(status as u16).to_be_bytes());
        reply.extend_from_slice(&self.code.wrapping_add(1).to_be_bytes());
        reply.extend_from_slice(&[0; 2]);
        reply.extend_from_slice(&self.id.to_be_bytes());
    }
}

/// Writes the length of the answer's data into its header.
pub fn seal(reply: &mut [u8]) {
    let length = (reply.len() - HEADER) as u16;
    reply[4..6].copy_from_slice(&length.to_be_bytes());
}

/// Reads a big-endian word of `data` at byte `at`.
pub fn u32_at(data: &[u8], at: usize) -> Option<u32> {
    data.get(at..)?.first_chunk().map(|word| u32::from_be_bytes(*word))
}
