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
    [bootstrap(), image(camera), acquisition(camera), chunks_and_user_sets(), sequencer()].concat()
}

// Categories of the SFNC.
const DEVICE: Option<&str> = Some("DeviceControl");
const TRANSPORT: Option<&str> = Some("TransportLayerControl");
const IMAGE: Option<&str> = Some("ImageFormatControl");
const ACQUISITION: Option<&str> = Some("AcquisitionControl");
const CHUNK_DATA: Option<&str> = Some("ChunkDataControl");
const USER_SETS: Option<&str> = Some("UserSetControl");
const SEQUENCER: Option<&str> = Some("SequencerControl");

/// A register at an address given by GigE Vision.
fn standard(
    id: FeatureId,
    address: u32,
    category: Option<&'static str>,
    access: RegisterAccess,
    kind: Kind,
) -> Feature {
    Feature { id, category, address, access, kind, initial: 0 }
}

/// A register at an address of the manufacturer's choice.
fn maker(
    id: FeatureId,
    category: Option<&'static str>,
    access: RegisterAccess,
    kind: Kind,
    initial: u64,
) -> Feature {
    let address = MAKERS_REGISTERS + MAKERS_STRIDE * id as u32;
    Feature { id, category, address, access, kind, initial }
}

fn whole(min: u32, max: u32, step: u32, max_in: Option<FeatureId>) -> Kind {
    Kind::Integer { min, max, step, max_in }
}

fn one_of(entries: &[&str]) -> Kind {
    Kind::Enumeration(entries.iter().map(|entry| (*entry).to_owned()).zip(0..).collect())
}

fn formats(mosaic: Mosaic) -> Kind {
    let formats = PixelFormat::all().filter(|format| format.mosaic == mosaic);
    Kind::Enumeration(formats.filter_map(|format| Some((format.to_string(), format.pfnc()?))).collect())
}

fn bootstrap() -> Vec<Feature> {
    use FeatureId::*;
    use RegisterAccess::{Command, ReadOnly, ReadWrite};
    vec![
        standard(DeviceVendorName, 0x48, DEVICE, ReadOnly, Kind::Text(32)),
        standard(DeviceModelName, 0x68, DEVICE, ReadOnly, Kind::Text(32)),
        standard(DeviceVersion, 0x88, DEVICE, ReadOnly, Kind::Text(32)),
        standard(DeviceManufacturerInfo, 0xA8, DEVICE, ReadOnly, Kind::Text(48)),
        standard(DeviceSerialNumber, 0xD8, DEVICE, ReadOnly, Kind::Text(16)),
        standard(DeviceUserID, 0xE8, DEVICE, ReadWrite, Kind::Text(16)),
        Feature {
            initial: 3000,
            ..standard(GevHeartbeatTimeout, 0x938, TRANSPORT, ReadWrite, whole(500, 60_000, 1, None))
        },
        standard(GevTimestampTickFrequency, 0x93C, TRANSPORT, ReadOnly, Kind::Long),
        standard(GevTimestampControl, 0x944, None, Command, Kind::any()),
        standard(GevTimestampValue, 0x948, TRANSPORT, ReadOnly, Kind::Long),
        standard(GevCCP, 0xA00, None, ReadWrite, Kind::any()),
        standard(GevSCPHostPort, 0xD00, TRANSPORT, ReadWrite, whole(0, 0xFFFF, 1, None)),
        Feature { initial: 1500, ..standard(GevSCPS, 0xD04, None, ReadWrite, Kind::any()) },
        standard(GevSCPD, 0xD08, TRANSPORT, ReadWrite, whole(0, MAX_PACKET_GAP_TICKS, 1, None)),
        standard(GevSCDA, 0xD18, TRANSPORT, ReadWrite, Kind::any()),
    ]
}

fn image(camera: &CameraCapabilities) -> Vec<Feature> {
    use FeatureId::*;
    use RegisterAccess::{ReadOnly, ReadWrite, ReadWriteIdle};
    let (width, height) = (camera.width as u32, camera.height as u32);
    // A region that starts in the middle of a 2 x 2 cell would change the mosaic.
    let offset_step = if camera.format.mosaic == Mosaic::Mono { 1 } else { 2 };
    vec![
        maker(SensorWidth, IMAGE, ReadOnly, Kind::any(), width.into()),
        maker(SensorHeight, IMAGE, ReadOnly, Kind::any(), height.into()),
        maker(SensorShutterMode, IMAGE, ReadWrite, one_of(&["Rolling", "Global"]), 0),
        maker(
            SensorReadoutTime,
            IMAGE,
            ReadOnly,
            Kind::Float { min: 0.0, max: 1e9, unit: "us" },
            camera.readout_us.to_bits(),
        ),
        maker(WidthMax, IMAGE, ReadOnly, Kind::any(), width.into()),
        maker(HeightMax, IMAGE, ReadOnly, Kind::any(), height.into()),
        maker(OffsetXMax, None, ReadOnly, Kind::any(), 0),
        maker(OffsetYMax, None, ReadOnly, Kind::any(), 0),
        maker(Width, IMAGE, ReadWriteIdle, whole(1, width, 1, Some(WidthMax)), width.into()),
        maker(Height, IMAGE, ReadWriteIdle, whole(1, height, 1, Some(HeightMax)), height.into()),
        maker(OffsetX, IMAGE, ReadWriteIdle, whole(0, width, offset_step, Some(OffsetXMax)), 0),
        maker(OffsetY, IMAGE, ReadWriteIdle, whole(0, height, offset_step, Some(OffsetYMax)), 0),
        maker(
            PixelFormat,
            IMAGE,
            ReadWriteIdle,
            formats(camera.format.mosaic),
            camera.format.pfnc().unwrap_or_default().into(),
        ),
    ]
}

fn acquisition(camera: &CameraCapabilities) -> Vec<Feature> {
    use FeatureId::*;
    use RegisterAccess::{Command, ReadWrite, ReadWriteIdle};
    let exposure =
        Kind::Float { min: *camera.exposure_us.start(), max: *camera.exposure_us.end(), unit: "us" };
    let (delay_min, delay_max) = (*camera.trigger_delay_us.start(), *camera.trigger_delay_us.end());
    let delay = Kind::Float { min: delay_min, max: delay_max, unit: "us" };
    vec![
        maker(AcquisitionMode, ACQUISITION, ReadWriteIdle, one_of(&["Continuous", "SingleFrame"]), 0),
        maker(AcquisitionStart, ACQUISITION, Command, Kind::any(), 0),
        maker(AcquisitionStop, ACQUISITION, Command, Kind::any(), 0),
        maker(AcquisitionFrameRateEnable, ACQUISITION, ReadWrite, Kind::Boolean, 1),
        maker(
            AcquisitionFrameRate,
            ACQUISITION,
            ReadWrite,
            Kind::Float { min: 0.1, max: 10_000.0, unit: "Hz" },
            30_f64.to_bits(),
        ),
        maker(TriggerSelector, ACQUISITION, ReadWrite, one_of(&["FrameStart"]), 0),
        maker(TriggerMode, ACQUISITION, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(TriggerSoftware, ACQUISITION, Command, Kind::any(), 0),
        maker(TriggerSource, ACQUISITION, ReadWrite, one_of(&["Line0", "Software"]), 0),
        maker(TriggerActivation, ACQUISITION, ReadWrite, one_of(&["RisingEdge"]), 0),
        maker(TriggerDelay, ACQUISITION, ReadWrite, delay, delay_min.to_bits()),
        maker(ExposureMode, ACQUISITION, ReadWrite, one_of(&["Timed"]), 0),
        maker(ExposureTime, ACQUISITION, ReadWrite, exposure, 1000_f64.to_bits()),
    ]
}

fn chunks_and_user_sets() -> Vec<Feature> {
    use FeatureId::*;
    use RegisterAccess::{Command, ReadOnly, ReadWrite, ReadWriteIdle};
    vec![
        maker(ChunkModeActive, CHUNK_DATA, ReadWriteIdle, Kind::Boolean, 0),
        maker(ChunkSelector, CHUNK_DATA, ReadWrite, one_of(&CHUNKS), 0),
        maker(ChunkEnable, CHUNK_DATA, ReadWriteIdle, Kind::BooleanFor(ChunkSelector), 0),
        maker(TimestampLatch, DEVICE, Command, Kind::any(), 0),
        maker(PayloadSize, TRANSPORT, ReadOnly, Kind::any(), 0),
        maker(TLParamsLocked, TRANSPORT, ReadWrite, whole(0, 1, 1, None), 0),
        maker(UserSetSelector, USER_SETS, ReadWrite, one_of(&["Default", "UserSet1"]), 0),
        maker(UserSetLoad, USER_SETS, Command, Kind::any(), 0),
        maker(UserSetSave, USER_SETS, Command, Kind::any(), 0),
    ]
}

fn sequencer() -> Vec<Feature> {
    use FeatureId::*;
    use RegisterAccess::{Command, ReadOnly, ReadWrite};
    let set = whole(0, SEQUENCER_SETS as u32 - 1, 1, None);
    vec![
        maker(SequencerMode, SEQUENCER, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(SequencerConfigurationMode, SEQUENCER, ReadWrite, one_of(&["Off", "On"]), 0),
        maker(SequencerFeatureSelector, SEQUENCER, ReadWrite, one_of(&SEQUENCED), 0),
        maker(SequencerFeatureEnable, SEQUENCER, ReadWrite, Kind::BooleanFor(SequencerFeatureSelector), 0),
        maker(SequencerSetSelector, SEQUENCER, ReadWrite, set.clone(), 0),
        maker(SequencerSetSave, SEQUENCER, Command, Kind::any(), 0),
        maker(SequencerSetLoad, SEQUENCER, Command, Kind::any(), 0),
        maker(SequencerSetStart, SEQUENCER, ReadWrite, set.clone(), 0),
        maker(SequencerPathSelector, SEQUENCER, ReadWrite, whole(0, 0, 1, None), 0),
        maker(SequencerSetNext, SEQUENCER, ReadWrite, set, 0),
        maker(SequencerTriggerSource, SEQUENCER, ReadWrite, one_of(&["Off", "FrameStart"]), 0),
        maker(SequencerSetActive, SEQUENCER, ReadOnly, Kind::any(), 0),
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
