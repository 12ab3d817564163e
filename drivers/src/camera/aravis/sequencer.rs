//! The camera's own sequencer (SFNC 2.7, "Sequencer Control"): the camera steps through stored settings by itself,
//! one per frame, without register writes.

use raysweep_core::{CameraSettings, DeviceErrorKind};

use super::features::{FeatureError, Features, Result, first_present, put_boolean, put_integer, put_text};
use super::settings::{FeatureWriter, Names};
use super::setup::require;

/// Events that advance the sets: each occurs once per frame.
const ADVANCED_BY: [&str; 2] = ["FrameStart", "ExposureStart"];

/// A running sequence of the camera.
#[derive(Debug, PartialEq)]
pub struct SequencerSets {
    /// The number of the first set.
    pub first_set: i64,
    /// The settings of each set, as the camera applied them.
    pub settings: Vec<CameraSettings>,
}

/// Whether the camera reports that it has a sequencer.
pub fn is_offered(features: &impl Features) -> bool {
    features.has("SequencerMode")
}

/// Switches the sequencer off, if there is one: another program may have left it running or half configured.
pub fn stop(features: &impl Features) -> Result<()> {
    for mode in ["SequencerMode", "SequencerConfigurationMode"] {
        // While one of the modes is on, the other may not be writable.
        if features.has(mode) && features.text(mode)? != "Off" {
            put_text(features, mode, "Off")?;
        }
    }
    Ok(())
}

/// Saves settings as a ring of sets, verifies that the camera kept them, and switches the sequencer on.
///
/// # Errors
/// A missing feature, or a set that was not kept; the sequencer is then off.
pub fn start(features: &impl Features, names: &Names, settings: &[CameraSettings]) -> Result<SequencerSets> {
    stop(features)?;
    require(features, &["SequencerConfigurationMode"], "a way to configure its sequencer")?;
    put_text(features, "SequencerConfigurationMode", "On")?;
    let loaded = load(features, names, settings);
    // Left on, this mode would also block the register writes that are used instead of sets.
    put_text(features, "SequencerConfigurationMode", "Off")?;
    let sequence = loaded?;
    put_text(features, "SequencerMode", "On")?;
    Ok(sequence)
}

fn load(features: &impl Features, names: &Names, settings: &[CameraSettings]) -> Result<SequencerSets> {
    let delay = names.delay.map_or_else(|| require(features, &["TriggerDelay"], "a trigger delay"), Ok)?;
    enable(features, names.exposure, delay)?;
    let sets = features.integer_range("SequencerSetSelector")?;
    let last = *sets.start() + settings.len() as i64 - 1;
    if !sets.contains(&last) {
        let what =
            format!("{} sets are needed, {} to {} are there", settings.len(), sets.start(), sets.end());
        return Err(FeatureError::new("SequencerSetSelector", DeviceErrorKind::OutOfRange, what));
    }
    let mut writer = FeatureWriter::new(*names);
    let mut actual = Vec::with_capacity(settings.len());
    for (set, settings) in (*sets.start()..=last).zip(settings) {
        put_integer(features, "SequencerSetSelector", set)?;
        actual.push(writer.write(features, settings)?);
        if features.has("SequencerPathSelector") {
            put_integer(
                features,
                "SequencerPathSelector",
                *features.integer_range("SequencerPathSelector")?.start(),
            )?;
        }
        let next = if set == last { *sets.start() } else { set + 1 };
        put_integer(features, "SequencerSetNext", next)?;
        let choices = features.choices("SequencerTriggerSource")?;
        let source = ADVANCED_BY.into_iter().find(|source| choices.iter().any(|choice| choice == source));
        put_text(features, "SequencerTriggerSource", source.unwrap_or(ADVANCED_BY[0]))?;
        features.execute("SequencerSetSave")?;
    }
    if features.has("SequencerSetStart") {
        put_integer(features, "SequencerSetStart", *sets.start())?;
    }
    for (set, saved) in (*sets.start()..=last).zip(&actual) {
        put_integer(features, "SequencerSetSelector", set)?;
        features.execute("SequencerSetLoad")?;
        for (name, saved) in [(names.exposure, saved.exposure_us), (delay, saved.trigger_delay_us)] {
            let kept = features.float(name)?;
            if kept != saved {
                let what =
                    format!("set {set} was saved with {saved} and has {kept}: the camera does not keep it");
                return Err(FeatureError::new(name, DeviceErrorKind::Unsupported, what));
            }
        }
    }
    Ok(SequencerSets { first_set: *sets.start(), settings: actual })
}

/// Includes exposure and delay in the sets, if that can be chosen.
fn enable(features: &impl Features, exposure: &str, delay: &str) -> Result<()> {
    if first_present(features, &["SequencerFeatureSelector"]).is_none() {
        return Ok(());
    }
    for name in [exposure, delay] {
        put_text(features, "SequencerFeatureSelector", name)?;
        // A feature that is always part of the sets may be read-only.
        if !features.boolean("SequencerFeatureEnable")? {
            put_boolean(features, "SequencerFeatureEnable", true)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use raysweep_core::Shutter;

    use super::super::features::scripted::{Scripted, Value};
    use super::*;

    fn camera(sets: i64) -> Scripted {
        Scripted::default()
            .with("ExposureTime", Value::Float(100.0, 1.0..=1e6))
            .with("TriggerDelay", Value::Float(0.0, 0.0..=1e6))
            .with_text("SequencerMode", &["Off", "On"])
            .with_text("SequencerConfigurationMode", &["Off", "On"])
            .with("SequencerSetSelector", Value::Integer(0, 0..=sets - 1))
            .with("SequencerSetNext", Value::Integer(0, 0..=sets - 1))
            .with("SequencerSetStart", Value::Integer(0, 0..=sets - 1))
            .with_text("SequencerTriggerSource", &["Off", "ExposureStart", "Line1"])
            .with("SequencerSetSave", Value::Command)
            .with("SequencerSetLoad", Value::Command)
    }

    fn settings(delay_us: f64) -> CameraSettings {
        CameraSettings { shutter: Shutter::Rolling, exposure_us: 600.0, trigger_delay_us: delay_us }
    }

    fn started(camera: &Scripted, delays_us: &[f64]) -> Result<SequencerSets> {
        let all: Vec<_> = delays_us.iter().map(|&delay_us| settings(delay_us)).collect();
        start(camera, &Names::probe(camera).unwrap(), &all)
    }

    #[test]
    fn settings_are_saved_in_a_ring_between_the_modes() {
        let camera = camera(4);
        // The table can play only one set: it stores nothing per set.
        let sequence = SequencerSets { first_set: 0, settings: vec![settings(50.0)] };
        assert_eq!(started(&camera, &[50.0]).unwrap(), sequence);
        let written = camera.take_written();
        let expected = [
            "SequencerConfigurationMode=On",
            "SequencerSetSelector=0",
            "TriggerDelay=50",
            "ExposureTime=600",
            "SequencerSetNext=0",
            "SequencerTriggerSource=ExposureStart",
            "SequencerSetSave=",
            "SequencerSetStart=0",
            "SequencerSetSelector=0",
            "SequencerSetLoad=",
            "SequencerConfigurationMode=Off",
            "SequencerMode=On",
        ];
        assert_eq!(written, expected);
    }

    #[test]
    fn what_another_program_left_on_is_switched_off() {
        let left = camera(4);
        stop(&left).unwrap();
        assert!(left.take_written().is_empty());
        for mode in ["SequencerMode", "SequencerConfigurationMode"] {
            let left = camera(4).with(mode, Value::Text("On".into(), vec!["Off", "On"]));
            stop(&left).unwrap();
            assert_eq!(left.take_written(), [format!("{mode}=Off")]);
        }
    }

    #[test]
    fn a_camera_that_cannot_is_left_with_its_sequencer_off() {
        let is_off = |camera: &Scripted| {
            let written = camera.take_written();
            assert_eq!(written.last().unwrap(), "SequencerConfigurationMode=Off");
            assert!(!written.contains(&"SequencerMode=On".to_owned()));
        };
        let small = camera(2);
        let error = started(&small, &[0.0, 1.0, 2.0]).unwrap_err().to_string();
        assert!(error.contains("3 sets are needed, 0 to 1 are there"), "{error}");
        is_off(&small);
        let forgetful = camera(4);
        let error = started(&forgetful, &[10.0, 20.0]).unwrap_err().to_string();
        assert!(error.contains("set 0 was saved with 10 and has 20"), "{error}");
        is_off(&forgetful);
        let by_line = camera(4).with_text("SequencerTriggerSource", &["Off", "Line1"]);
        assert!(started(&by_line, &[10.0]).unwrap_err().to_string().contains("must be one of Off, Line1"));
        is_off(&by_line);
        let fixed = camera(4).with_text("SequencerFeatureSelector", &["ExposureTime"]);
        let fixed = fixed.with("SequencerFeatureEnable", Value::Boolean(true));
        assert!(started(&fixed, &[10.0]).unwrap_err().to_string().contains("\"TriggerDelay\" was refused"));
        is_off(&fixed);
    }
}
