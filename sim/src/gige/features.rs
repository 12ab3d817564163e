//! The camera's feature table. Both the description that clients download and the registers that they access are
//! generated from it, so they always agree. Names are from the GenICam SFNC 2.7; registers below 0x1000 are located as
//! GigE Vision 2.0 requires.

use raysweep_core::{CameraCapabilities, Mosaic, PixelFormat};

/// Identifies a register by the name of its feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs, reason = "the names are defined by the SFNC and by GigE Vision")]
pub enum FeatureId {
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
pub enum RegisterAccess {
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
        max_in: Option<FeatureId>,
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
    BooleanFor(FeatureId),
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
    pub id: FeatureId,
    /// Category in the description; `None`: an auxiliary register that is not shown.
    pub category: Option<&'static str>,
    /// Address of the register.
    pub address: u32,
    /// Access mode.
    pub access: RegisterAccess,
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
    use RegisterAccess::{Command, ReadOnly, ReadWrite, ReadWriteIdle};
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
        standard(FeatureId::DeviceVendorName, 0x48, device, ReadOnly, Kind::Text(32)),
        standard(FeatureId::DeviceModelName, 0x68, device, ReadOnly, Kind::Text(32)),
        standard(FeatureId::DeviceVersion, 0x88, device, ReadOnly, Kind::Text(32)),
        standard(FeatureId::DeviceManufacturerInfo, 0xA8, device, ReadOnly, Kind::Text(48)),
        standard(FeatureId::DeviceSerialNumber, 0xD8, device, ReadOnly, Kind::Text(16)),
        standard(FeatureId::DeviceUserID, 0xE8, device, ReadWrite, Kind::Text(16)),
        Feature {
            initial: 3000,
            ..standard(
                FeatureId::GevHeartbeatTimeout,
                0x938,
                transport,
                ReadWrite,
                whole(500, 60_000, 1, None),
            )
        },
        standard(FeatureId::GevTimestampTickFrequency, 0x93C, transport, ReadOnly, Kind::Long),
        standard(FeatureId::GevTimestampControl, 0x944, None, Command, Kind::any()),
        standard(FeatureId::GevTimestampValue, 0x948, transport, ReadOnly, Kind::Long),
        standard(FeatureId::GevCCP, 0xA00, None, ReadWrite, Kind::any()),
        standard(FeatureId::GevSCPHostPort, 0xD00, transport, ReadWrite, whole(0, 0xFFFF, 1, None)),
        Feature { initial: 1500, ..standard(FeatureId::GevSCPS, 0xD04, None, ReadWrite, Kind::any()) },
        standard(FeatureId::GevSCPD, 0xD08, transport, ReadWrite, whole(0, MAX_PACKET_GAP_TICKS, 1, None)),
        standard(FeatureId::GevSCDA, 0xD18, transport, ReadWrite, Kind::any()),
        maker(FeatureId::SensorWidth, image, ReadOnly, Kind::any(), width.into()),
        maker(FeatureId::SensorHeight, image, ReadOnly, Kind::any(), height.into()),
        maker(FeatureId::SensorShutterMode, image, ReadWrite, one_of(&["Rolling", "Global"]), 0),
        maker(
            FeatureId::SensorReadoutTime,
            image,
            ReadOnly,
            Kind::Float { min: 0.0, max: 1e9, unit: "us" },
            camera.readout_us.to_bits(),
        ),
        maker(FeatureId::WidthMax, image, ReadOnly, Kind::any(), width.into()),
        maker(FeatureId::HeightMax, image, ReadOnly, Kind::any(), height.into()),
        maker(FeatureId::OffsetXMax, None, ReadOnly, Kind::any(), 0),
        maker(FeatureId::OffsetYMax, None, ReadOnly, Kind::any(), 0),
        maker(
            FeatureId::Width,
            image,
            ReadWriteIdle,
            whole(1, width, 1, Some(FeatureId::WidthMax)),
            width.into(),
        ),
        maker(
            FeatureId::Height,
            image,
            ReadWriteIdle,
            whole(1, height, 1, Some(FeatureId::HeightMax)),
            height.into(),
        ),
        maker(
            FeatureId::OffsetX,
            image,
            ReadWriteIdle,
            whole(0, width, offset_step, Some(FeatureId::OffsetXMax)),
            0,
        ),
        maker(
            FeatureId::OffsetY,
            image,
            ReadWriteIdle,
            whole(0, height, offset_step, Some(FeatureId::OffsetYMax)),
            0,
        ),
        maker(
            FeatureId::PixelFormat,
            image,
            ReadWriteIdle,
            formats,
            camera.format.pfnc().unwrap_or_default().into(),
        ),
        maker(
            FeatureId::AcquisitionMode,
            acquisition,
            ReadWriteIdle,
            one_of(&["Continuous", "SingleFrame"]),
            0,
        ),
        maker(FeatureId::AcquisitionStart, acquisition, Command, Kind::any(), 0),
        maker(FeatureId::AcquisitionStop, acquisition, Command, Kind::any(), 0),
        maker(FeatureId::AcquisitionFrameRateEnable, acquisition, ReadWrite, Kind::Boolean, 1),
        maker(
            FeatureId::AcquisitionFrameRate,
            acquisition,
            ReadWrite,
            Kind::Float { min: 0.1, max: 10_000.0, unit: "Hz" },
            30_f64.to_bits(),
        ),
        maker(FeatureId::TriggerSelector, acquisition, ReadWrite, one_of(&["FrameStart"]), 0),
        maker(FeatureId::TriggerMode, acquisition, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(FeatureId::TriggerSoftware, acquisition, Command, Kind::any(), 0),
        maker(FeatureId::TriggerSource, acquisition, ReadWrite, one_of(&["Line0", "Software"]), 0),
        maker(FeatureId::TriggerActivation, acquisition, ReadWrite, one_of(&["RisingEdge"]), 0),
        maker(FeatureId::TriggerDelay, acquisition, ReadWrite, delay, delay_min.to_bits()),
        maker(FeatureId::ExposureMode, acquisition, ReadWrite, one_of(&["Timed"]), 0),
        maker(FeatureId::ExposureTime, acquisition, ReadWrite, exposure, 1000_f64.to_bits()),
        maker(FeatureId::ChunkModeActive, chunks, ReadWriteIdle, Kind::Boolean, 0),
        maker(FeatureId::ChunkSelector, chunks, ReadWrite, one_of(&CHUNKS), 0),
        maker(FeatureId::ChunkEnable, chunks, ReadWriteIdle, Kind::BooleanFor(FeatureId::ChunkSelector), 0),
        maker(FeatureId::TimestampLatch, device, Command, Kind::any(), 0),
        maker(FeatureId::PayloadSize, transport, ReadOnly, Kind::any(), 0),
        maker(FeatureId::TLParamsLocked, transport, ReadWrite, whole(0, 1, 1, None), 0),
        maker(FeatureId::UserSetSelector, user_sets, ReadWrite, one_of(&["Default", "UserSet1"]), 0),
        maker(FeatureId::UserSetLoad, user_sets, Command, Kind::any(), 0),
        maker(FeatureId::UserSetSave, user_sets, Command, Kind::any(), 0),
        maker(FeatureId::SequencerMode, sequencer, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(FeatureId::SequencerConfigurationMode, sequencer, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(FeatureId::SequencerFeatureSelector, sequencer, ReadWrite, one_of(&SEQUENCED), 0),
        maker(
            FeatureId::SequencerFeatureEnable,
            sequencer,
            ReadWrite,
            Kind::BooleanFor(FeatureId::SequencerFeatureSelector),
            0,
        ),
        maker(FeatureId::SequencerSetSelector, sequencer, ReadWrite, set.clone(), 0),
        maker(FeatureId::SequencerSetSave, sequencer, Command, Kind::any(), 0),
        maker(FeatureId::SequencerSetLoad, sequencer, Command, Kind::any(), 0),
        maker(FeatureId::SequencerSetStart, sequencer, ReadWrite, set.clone(), 0),
        maker(FeatureId::SequencerPathSelector, sequencer, ReadWrite, whole(0, 0, 1, None), 0),
        maker(FeatureId::SequencerSetNext, sequencer, ReadWrite, set, 0),
        maker(FeatureId::SequencerTriggerSource, sequencer, ReadWrite, one_of(&["Off", "FrameStart"]), 0),
        maker(FeatureId::SequencerSetActive, sequencer, ReadOnly, Kind::any(), 0),
    ]
}

/// A feature that is part of a register, or an alias of one.
pub struct FeatureView {
    /// Its SFNC name.
    pub name: &'static str,
    /// The register.
    pub of: FeatureId,
    /// The part of the register that it represents.
    pub shows: Shows,
}

/// What a [`FeatureView`] represents.
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
pub const VIEWS: [FeatureView; 7] = [
    FeatureView { name: "GevSCPSPacketSize", of: FeatureId::GevSCPS, shows: Shows::Bits(0, 15) },
    FeatureView { name: "GevSCPSDoNotFragment", of: FeatureId::GevSCPS, shows: Shows::Flag(30) },
    FeatureView { name: "GevSCPSFireTestPacket", of: FeatureId::GevSCPS, shows: Shows::Flag(31) },
    FeatureView {
        name: "GevTimestampControlLatch",
        of: FeatureId::GevTimestampControl,
        shows: Shows::Command(2),
    },
    FeatureView {
        name: "GevTimestampControlReset",
        of: FeatureId::GevTimestampControl,
        shows: Shows::Command(1),
    },
    FeatureView { name: "TimestampLatchValue", of: FeatureId::GevTimestampValue, shows: Shows::All },
    FeatureView { name: "DeviceID", of: FeatureId::DeviceSerialNumber, shows: Shows::All },
];
