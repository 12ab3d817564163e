//! The camera's sequencer after the SFNC 2.7, chapter "Sequencer Control": sets of settings that the camera steps
//! through, one per frame, without intervention by the client.

use raysweep_core::CameraSettings;

use super::features::{FRAME_START, FeatureId, SEQUENCER_SETS};
use super::gvcp::GvcpStatus;
use super::registers::Registers;
use super::source::Sets;

/// Values of `SequencerMode` and `SequencerConfigurationMode`.
const ON: u32 = 1;
/// Entries of `SequencerFeatureEnable`, as in [`super::features::SEQUENCED`].
const EXPOSURE_TIME: u32 = 0;
const TRIGGER_DELAY: u32 = 1;

/// The stored sets.
pub struct Sequencer {
    sets: [Set; SEQUENCER_SETS],
}

/// One set.
#[derive(Clone, Copy)]
struct Set {
    settings: CameraSettings,
    /// `SequencerSetNext`.
    next: u32,
    /// `SequencerTriggerSource`.
    source: u32,
}

impl Sequencer {
    /// All sets have these settings and no successor.
    pub fn new(settings: CameraSettings) -> Self {
        Self { sets: [Set { settings, next: 0, source: 0 }; SEQUENCER_SETS] }
    }

    /// Whether a register may be written now: sets can be changed only in configuration mode; while the sequencer runs,
    /// neither the sets nor the features they control can be written.
    ///
    /// # Errors
    /// `AccessDenied`.
    pub fn check(registers: &Registers, id: FeatureId) -> Result<(), GvcpStatus> {
        let runs = registers.number(FeatureId::SequencerMode) == ON;
        let configures = registers.number(FeatureId::SequencerConfigurationMode) == ON;
        let allowed = match id {
            FeatureId::SequencerMode => !configures,
            FeatureId::SequencerConfigurationMode
            | FeatureId::ExposureTime
            | FeatureId::TriggerDelay
            | FeatureId::SensorShutterMode
            | FeatureId::UserSetLoad
            | FeatureId::UserSetSave => !runs,
            FeatureId::SequencerFeatureSelector
            | FeatureId::SequencerFeatureEnable
            | FeatureId::SequencerSetSelector
            | FeatureId::SequencerSetSave
            | FeatureId::SequencerSetLoad
            | FeatureId::SequencerSetStart
            | FeatureId::SequencerPathSelector
            | FeatureId::SequencerSetNext
            | FeatureId::SequencerTriggerSource => configures,
            _ => true,
        };
        if allowed { Ok(()) } else { Err(GvcpStatus::AccessDenied) }
    }

    /// Whether the sequencer is switched on.
    pub fn runs(registers: &Registers) -> bool {
        registers.number(FeatureId::SequencerMode) == ON
    }

    fn selected(registers: &Registers) -> usize {
        registers.number(FeatureId::SequencerSetSelector) as usize
    }

    /// Saves the current settings to the selected set.
    pub fn save(&mut self, registers: &Registers, settings: CameraSettings) {
        if let Some(set) = self.sets.get_mut(Self::selected(registers)) {
            let number = |id| registers.number(id);
            *set = Set {
                settings,
                next: number(FeatureId::SequencerSetNext),
                source: number(FeatureId::SequencerTriggerSource),
            };
        }
    }

    /// Writes the selected set's successor and trigger source to the registers.
    pub fn show(&self, registers: &mut Registers) {
        if let Some(set) = self.sets.get(Self::selected(registers)) {
            registers.set_number(FeatureId::SequencerSetNext, set.next);
            registers.set_number(FeatureId::SequencerTriggerSource, set.source);
        }
    }

    /// Loads the selected set into the registers.
    pub fn load(&self, registers: &mut Registers) {
        self.show(registers);
        if let Some(Set { settings, .. }) = self.sets.get(Self::selected(registers)) {
            registers.set_float(FeatureId::ExposureTime, settings.exposure_us);
            registers.set_float(FeatureId::TriggerDelay, settings.trigger_delay_us);
        }
    }

    /// The sets for the frames; features that are not enabled keep their values in `settings`.
    pub fn sequence(&self, registers: &Registers, settings: CameraSettings) -> Sets {
        let enabled = |feature| registers.number_for(FeatureId::SequencerFeatureEnable, feature) == ON;
        let (exposure, delay) = (enabled(EXPOSURE_TIME), enabled(TRIGGER_DELAY));
        let sets = self.sets.iter().enumerate().map(|(place, set)| {
            let of_set = CameraSettings {
                shutter: settings.shutter,
                exposure_us: if exposure { set.settings.exposure_us } else { settings.exposure_us },
                trigger_delay_us: if delay {
                    set.settings.trigger_delay_us
                } else {
                    settings.trigger_delay_us
                },
            };
            (of_set, if set.source == FRAME_START { set.next as usize } else { place })
        });
        sets.collect()
    }
}
