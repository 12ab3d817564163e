//! The camera's feature table. Both the description that clients download and the registers that they access are
//! generated from it, so they always agree. Names are from the GenICam SFNC 2.7; registers below 0x1000 are located as
//! GigE Vision 2.0 requires.

use raysweep_core::{CameraCapabilities, Mosaic, PixelFormat};

/// Identifies a register by the name of its feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs, reason = "the names are defined by the SFNC and by GigE Vision")]
pub enum Id {
    DeviceVendorName,
    DeviceModelName,
    DeviceVersion,
    DeviceManufacturerInfo,
    DeviceSerialNumber,
    DeviceUserID,
    GevHeartbeatTimeout,
    GevTimestampTickFrequency,
    GevTimestampControl,
    GevTimestampValue,
    GevCCP,
    GevSCPHostPort,
    GevSCPS,
    GevSCPD,
    GevSCDA,
    SensorWidth,
    SensorHeight,
    SensorShutterMode,
    SensorReadoutTime,
    WidthMax,
    HeightMax,
    OffsetXMax,
    OffsetYMax,
    Width,
    Height,
    OffsetX,
    OffsetY,
    PixelFormat,
    AcquisitionMode,
    AcquisitionStart,
    AcquisitionStop,
    AcquisitionFrameRateEnable,
    AcquisitionFrameRate,
    TriggerSelector,
    TriggerMode,
    TriggerSoftware,
    TriggerSource,
    TriggerActivation,
    TriggerDelay,
    ExposureMode,
    ExposureTime,
    ChunkModeActive,
    ChunkSelector,
    ChunkEnable,
    TimestampLatch,
    PayloadSize,
    TLParamsLocked,
    UserSetSelector,
    UserSetLoad,
    UserSetSave,
    SequencerMode,
    SequencerConfigurationMode,
    SequencerFeatureSelector,
    SequencerFeatureEnable,
    SequencerSetSelector,
    SequencerSetSave,
    SequencerSetLoad,
    SequencerSetStart,
    SequencerPathSelector,
    SequencerSetNext,
    SequencerTriggerSource,
    SequencerSetActive,
}

/// Access mode of a register.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Read-only for clients.
    ReadOnly,
    /// Writable by the client in control.
    ReadWrite,
    /// Writable by the client in control, but not during acquisition.
    ReadWriteIdle,
    /// A command: writing executes it, reading returns 0.
    Command,
}

/// Type of a register; all types are big-endian.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// Unsigned, four bytes.
    Integer {
        /// Smallest value.
        min: u32,
        /// Largest value.
        max: u32,
        /// Step between allowed values.
        step: u32,
        /// Register that holds the current maximum, if it varies.
        max_in: Option<Id>,
    },
    /// Unsigned, eight bytes.
    Long,
    /// Double, eight bytes.
    Float {
        /// Smallest value.
        min: f64,
        /// Largest value.
        max: f64,
        /// Unit.
        unit: &'static str,
    },
    /// Four bytes, one of these values.
    Enumeration(Vec<(String, u32)>),
    /// Four bytes: 0 or 1.
    Boolean,
    /// Four bytes, 0 or 1, for each entry of this enumeration.
    BooleanFor(Id),
    /// Zero-terminated text in a register of this many bytes.
    Text(u32),
}

impl Kind {
    /// An integer without range limits.
    fn any() -> Self {
        Self::Integer { min: 0, max: u32::MAX, step: 1, max_in: None }
    }
}

/// One row of the table.
#[derive(Debug, Clone)]
pub struct Feature {
    /// Register and feature name.
    pub id: Id,
    /// Category in the description; `None`: an auxiliary register that is not shown.
    pub category: Option<&'static str>,
    /// Address of the register.
    pub address: u32,
    /// Access mode.
    pub access: Access,
    /// Type.
    pub kind: Kind,
    /// Initial value as the bits of a `u64`: an integer, or a double's bits.
    pub initial: u64,
}

impl Feature {
    /// Size of its register in bytes.
    pub fn bytes(&self, features: &[Self]) -> u32 {
        match &self.kind {
            Kind::Integer { .. } | Kind::Enumeration(_) | Kind::Boolean => 4,
            Kind::Long | Kind::Float { .. } => 8,
            Kind::Text(bytes) => *bytes,
            Kind::BooleanFor(selector) => {
                let entries = features.iter().find(|feature| feature.id == *selector);
                entries.map_or(4, |feature| match &feature.kind {
                    Kind::Enumeration(entries) => 4 * entries.len() as u32,
                    _ => 4,
                })
            }
        }
    }
}

/// First address of the manufacturer-specific registers.
pub const MAKERS_REGISTERS: u32 = 0x1_0000;
/// Bytes reserved for each manufacturer-specific register.
pub const MAKERS_STRIDE: u32 = 16;

/// Maximum gap between packets: the sender waits during gaps.
const MAX_PACKET_GAP_TICKS: u32 = 100_000;

/// Value of `AcquisitionMode`.
pub const SINGLE_FRAME: u32 = 1;
/// Value of `TriggerSource`.
pub const SOFTWARE: u32 = 1;
/// Value of `SensorShutterMode`.
pub const GLOBAL_SHUTTER: u32 = 1;
/// Number of sequencer sets.
pub const SEQUENCER_SETS: usize = 16;
/// Value of `SequencerTriggerSource`.
pub const FRAME_START: u32 = 1;
/// Entries of `SequencerFeatureSelector`.
pub const SEQUENCED: [&str; 2] = ["ExposureTime", "TriggerDelay"];
/// Entries of `ChunkSelector`, which also select an entry of `ChunkEnable`.
pub const CHUNKS: [&str; 4] = ["ExposureTime", "Timestamp", "FrameID", "SequencerSetActive"];

/// Returns the feature table of a camera with these capabilities.
pub fn features(camera: &CameraCapabilities) -> Vec<Feature> {
    use Access::{Command, ReadOnly, ReadWrite, ReadWriteIdle};
    let (width, height) = (camera.width as u32, camera.height as u32);
    let whole = |min, max, step, max_in| Kind::Integer { min, max, step, max_in };
    let one_of = |entries: &[&str]| {
        Kind::Enumeration(entries.iter().map(|entry| (*entry).to_owned()).zip(0..).collect())
    };
    let exposure =
        Kind::Float { min: *camera.exposure_us.start(), max: *camera.exposure_us.end(), unit: "us" };
    let (delay_min, delay_max) = (*camera.trigger_delay_us.start(), *camera.trigger_delay_us.end());
    let delay = Kind::Float { min: delay_min, max: delay_max, unit: "us" };
    let mosaic = camera.format.mosaic;
    // A region that starts in the middle of a 2 x 2 cell would change the mosaic.
    let offset_step = if mosaic == Mosaic::Mono { 1 } else { 2 };
    let formats = PixelFormat::all().filter(|format| format.mosaic == mosaic);
    let formats = formats.filter_map(|format| Some((format.to_string(), format.pfnc()?)));
    let formats = Kind::Enumeration(formats.collect());

    let device = Some("DeviceControl");
    let transport = Some("TransportLayerControl");
    let image = Some("ImageFormatControl");
    let acquisition = Some("AcquisitionControl");
    let chunks = Some("ChunkDataControl");
    let user_sets = Some("UserSetControl");
    let sequencer = Some("SequencerControl");
    let set = whole(0, SEQUENCER_SETS as u32 - 1, 1, None);
    let standard =
        |id, address, category, access, kind| Feature { id, category, address, access, kind, initial: 0 };
    let maker = |id, category, access, kind, initial| {
        let address = MAKERS_REGISTERS + MAKERS_STRIDE * id as u32;
        Feature { id, category, address, access, kind, initial }
    };
    vec![
        standard(Id::DeviceVendorName, 0x48, device, ReadOnly, Kind::Text(32)),
        standard(Id::DeviceModelName, 0x68, device, ReadOnly, Kind::Text(32)),
        standard(Id::DeviceVersion, 0x88, device, ReadOnly, Kind::Text(32)),
        standard(Id::DeviceManufacturerInfo, 0xA8, device, ReadOnly, Kind::Text(48)),
        standard(Id::DeviceSerialNumber, 0xD8, device, ReadOnly, Kind::Text(16)),
        standard(Id::DeviceUserID, 0xE8, device, ReadWrite, Kind::Text(16)),
        Feature {
            initial: 3000,
            ..standard(Id::GevHeartbeatTimeout, 0x938, transport, ReadWrite, whole(500, 60_000, 1, None))
        },
        standard(Id::GevTimestampTickFrequency, 0x93C, transport, ReadOnly, Kind::Long),
        standard(Id::GevTimestampControl, 0x944, None, Command, Kind::any()),
        standard(Id::GevTimestampValue, 0x948, transport, ReadOnly, Kind::Long),
        standard(Id::GevCCP, 0xA00, None, ReadWrite, Kind::any()),
        standard(Id::GevSCPHostPort, 0xD00, transport, ReadWrite, whole(0, 0xFFFF, 1, None)),
        Feature { initial: 1500, ..standard(Id::GevSCPS, 0xD04, None, ReadWrite, Kind::any()) },
        standard(Id::GevSCPD, 0xD08, transport, ReadWrite, whole(0, MAX_PACKET_GAP_TICKS, 1, None)),
        standard(Id::GevSCDA, 0xD18, transport, ReadWrite, Kind::any()),
        maker(Id::SensorWidth, image, ReadOnly, Kind::any(), width.into()),
        maker(Id::SensorHeight, image, ReadOnly, Kind::any(), height.into()),
        maker(Id::SensorShutterMode, image, ReadWrite, one_of(&["Rolling", "Global"]), 0),
        maker(
            Id::SensorReadoutTime,
            image,
            ReadOnly,
            Kind::Float { min: 0.0, max: 1e9, unit: "us" },
            camera.readout_us.to_bits(),
        ),
        maker(Id::WidthMax, image, ReadOnly, Kind::any(), width.into()),
        maker(Id::HeightMax, image, ReadOnly, Kind::any(), height.into()),
        maker(Id::OffsetXMax, None, ReadOnly, Kind::any(), 0),
        maker(Id::OffsetYMax, None, ReadOnly, Kind::any(), 0),
        maker(Id::Width, image, ReadWriteIdle, whole(1, width, 1, Some(Id::WidthMax)), width.into()),
        maker(Id::Height, image, ReadWriteIdle, whole(1, height, 1, Some(Id::HeightMax)), height.into()),
        maker(Id::OffsetX, image, ReadWriteIdle, whole(0, width, offset_step, Some(Id::OffsetXMax)), 0),
        maker(Id::OffsetY, image, ReadWriteIdle, whole(0, height, offset_step, Some(Id::OffsetYMax)), 0),
        maker(
            Id::PixelFormat,
            image,
            ReadWriteIdle,
            formats,
            camera.format.pfnc().unwrap_or_default().into(),
        ),
        maker(Id::AcquisitionMode, acquisition, ReadWriteIdle, one_of(&["Continuous", "SingleFrame"]), 0),
        maker(Id::AcquisitionStart, acquisition, Command, Kind::any(), 0),
        maker(Id::AcquisitionStop, acquisition, Command, Kind::any(), 0),
        maker(Id::AcquisitionFrameRateEnable, acquisition, ReadWrite, Kind::Boolean, 1),
        maker(
            Id::AcquisitionFrameRate,
            acquisition,
            ReadWrite,
            Kind::Float { min: 0.1, max: 10_000.0, unit: "Hz" },
            30_f64.to_bits(),
        ),
        maker(Id::TriggerSelector, acquisition, ReadWrite, one_of(&["FrameStart"]), 0),
        maker(Id::TriggerMode, acquisition, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(Id::TriggerSoftware, acquisition, Command, Kind::any(), 0),
        maker(Id::TriggerSource, acquisition, ReadWrite, one_of(&["Line0", "Software"]), 0),
        maker(Id::TriggerActivation, acquisition, ReadWrite, one_of(&["RisingEdge"]), 0),
        maker(Id::TriggerDelay, acquisition, ReadWrite, delay, delay_min.to_bits()),
        maker(Id::ExposureMode, acquisition, ReadWrite, one_of(&["Timed"]), 0),
        maker(Id::ExposureTime, acquisition, ReadWrite, exposure, 1000_f64.to_bits()),
        maker(Id::ChunkModeActive, chunks, ReadWriteIdle, Kind::Boolean, 0),
        maker(Id::ChunkSelector, chunks, ReadWrite, one_of(&CHUNKS), 0),
        maker(Id::ChunkEnable, chunks, ReadWriteIdle, Kind::BooleanFor(Id::ChunkSelector), 0),
        maker(Id::TimestampLatch, device, Command, Kind::any(), 0),
        maker(Id::PayloadSize, transport, ReadOnly, Kind::any(), 0),
        maker(Id::TLParamsLocked, transport, ReadWrite, whole(0, 1, 1, None), 0),
        maker(Id::UserSetSelector, user_sets, ReadWrite, one_of(&["Default", "UserSet1"]), 0),
        maker(Id::UserSetLoad, user_sets, Command, Kind::any(), 0),
        maker(Id::UserSetSave, user_sets, Command, Kind::any(), 0),
        maker(Id::SequencerMode, sequencer, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(Id::SequencerConfigurationMode, sequencer, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(Id::SequencerFeatureSelector, sequencer, ReadWrite, one_of(&SEQUENCED), 0),
        maker(
            Id::SequencerFeatureEnable,
            sequencer,
            ReadWrite,
            Kind::BooleanFor(Id::SequencerFeatureSelector),
            0,
        ),
        maker(Id::SequencerSetSelector, sequencer, ReadWrite, set.clone(), 0),
        maker(Id::SequencerSetSave, sequencer, Command, Kind::any(), 0),
        maker(Id::SequencerSetLoad, sequencer, Command, Kind::any(), 0),
        maker(Id::SequencerSetStart, sequencer, ReadWrite, set.clone(), 0),
        maker(Id::SequencerPathSelector, sequencer, ReadWrite, whole(0, 0, 1, None), 0),
        maker(Id::SequencerSetNext, sequencer, ReadWrite, set, 0),
        maker(Id::SequencerTriggerSource, sequencer, ReadWrite, one_of(&["Off", "FrameStart"]), 0),
        maker(Id::SequencerSetActive, sequencer, ReadOnly, Kind::any(), 0),
    ]
}

/// A feature that is part of a register, or an alias of one.
pub struct View {
    /// Its SFNC name.
    pub name: &'static str,
    /// The register.
    pub of: Id,
    /// The part of the register that it represents.
    pub shows: Shows,
}

/// What a [`View`] represents.
pub enum Shows {
    /// The bits from the first to the second, counted from the least significant, as an integer.
    Bits(u32, u32),
    /// One bit.
    Flag(u32),
    /// A command that writes this value.
    Command(u32),
    /// The whole register.
    All,
}

/// Views in the description only; accesses are checked at the register.
pub const VIEWS: [View; 7] = [
    View { name: "GevSCPSPacketSize", of: Id::GevSCPS, shows: Shows::Bits(0, 15) },
    View { name: "GevSCPSDoNotFragment", of: Id::GevSCPS, shows: Shows::Flag(30) },
    View { name: "GevSCPSFireTestPacket", of: Id::GevSCPS, shows: Shows::Flag(31) },
    View { name: "GevTimestampControlLatch", of: Id::GevTimestampControl, shows: Shows::Command(2) },
    View { name: "GevTimestampControlReset", of: Id::GevTimestampControl, shows: Shows::Command(1) },
    View { name: "TimestampLatchValue", of: Id::GevTimestampValue, shows: Shows::All },
    View { name: "DeviceID", of: Id::DeviceSerialNumber, shows: Shows::All },
];
