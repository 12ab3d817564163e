//! The settings that a sweep changes from point to point: written if they differ, always read back.

use raysweep_core::{CameraSettings, DeviceErrorKind, Shutter};

use super::features::{FeatureError, Features, Result, first_present, put_text};
use super::setup::require;

/// The camera's names of the features that sweeps change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Names {
    /// Feature of the exposure time, us.
    pub exposure: &'static str,
    /// Feature of the trigger delay, us.
    pub delay: Option<&'static str>,
    /// Feature of the shutter mode.
    pub shutter: Option<&'static str>,
}

impl Names {
    pub fn probe(features: &impl Features) -> Result<Self> {
        Ok(Self {
            exposure: require(features, &["ExposureTime", "ExposureTimeAbs"], "an exposure time")?,
            delay: first_present(features, &["TriggerDelay", "TriggerDelayAbs"]),
            shutter: first_present(features, &["SensorShutterMode", "ShutterMode", "ShutterType"]),
        })
    }

    /// The camera's enumeration entry for a shutter.
    fn shutter_entry(&self, features: &impl Features, name: &str, shutter: Shutter) -> Result<String> {
        let words: &[&str] = match shutter {
            Shutter::Rolling => &["Rolling", "RollingShutter"],
            Shutter::Global => &["Global", "GlobalReset", "GlobalResetRelease", "GlobalShutter"],
        };
        let choices = features.choices(name)?;
        let word = words.iter().find(|word| choices.iter().any(|choice| choice == *word));
        word.map(|word| (*word).to_owned()).ok_or_else(|| {
            let what = format!("a {shutter:?} shutter was asked for: must be one of {}", choices.join(", "));
            FeatureError::new(name, DeviceErrorKind::Unsupported, what)
        })
    }
}

/// Writes settings to a camera and remembers them.
#[derive(Debug)]
pub struct FeatureWriter {
    names: Names,
    /// The settings as requested and as applied; `None` if the camera's settings are unknown.
    last: Option<(CameraSettings, CameraSettings)>,
}

impl FeatureWriter {
    pub fn new(names: Names) -> Self {
        Self { names, last: None }
    }

    /// The names that it writes to.
    pub fn names(&self) -> &Names {
        &self.names
    }

    /// Marks the camera's settings as unknown.
    pub fn forget(&mut self) {
        self.last = None;
    }

    /// Whether these settings need another shutter than the present one.
    pub fn changes_shutter(&self, settings: &CameraSettings) -> bool {
        self.names.shutter.is_some() && self.last.is_none_or(|(asked, _)| asked.shutter != settings.shutter)
    }

    /// Writes what has changed, reads it back and returns the camera's settings.
    pub fn write(&mut self, features: &impl Features, settings: &CameraSettings) -> Result<CameraSettings> {
        let last = self.last.take();
        let mut actual = last.map_or(*settings, |(_, actual)| actual);
        if last.is_none_or(|(asked, _)| asked.shutter != settings.shutter) {
            match self.names.shutter {
                Some(name) => {
                    put_text(features, name, &self.names.shutter_entry(features, name, settings.shutter)?)?;
                }
                None if settings.shutter == Shutter::Global => {
                    let what = "is not there: the camera has no global shutter that could be chosen";
                    return Err(FeatureError::new("SensorShutterMode", DeviceErrorKind::Unsupported, what));
                }
                None => {}
            }
            actual.shutter = settings.shutter;
        }
        if let Some(name) = self.names.delay {
            if last.is_none_or(|(asked, _)| asked.trigger_delay_us != settings.trigger_delay_us) {
                features.set_float(name, settings.trigger_delay_us)?;
                actual.trigger_delay_us = features.float(name)?;
            }
        } else {
            actual.trigger_delay_us = 0.0;
        }
        if last.is_none_or(|(asked, _)| asked.exposure_us != settings.exposure_us) {
            features.set_float(self.names.exposure, settings.exposure_us)?;
            actual.exposure_us = features.float(self.names.exposure)?;
        }
        self.last = Some((*settings, actual));
        Ok(actual)
    }
}

#[cfg(test)]
mod tests {
    use super::super::features::scripted::{Scripted, Value};
    use super::*;

    fn settings(exposure_us: f64, trigger_delay_us: f64) -> CameraSettings {
        CameraSettings { shutter: Shutter::Rolling, exposure_us, trigger_delay_us }
    }

    #[test]
    fn only_what_changed_is_written_and_what_the_camera_made_of_it_is_told() {
        let camera = Scripted { step: 0.5, ..Scripted::default() }
            .with("ExposureTimeAbs", Value::Float(1.0, 1.0..=1e6))
            .with("TriggerDelayAbs", Value::Float(0.0, 0.0..=1e6))
            .with_text("ShutterMode", &["GlobalResetRelease", "Rolling"]);
        let mut writer = FeatureWriter::new(Names::probe(&camera).unwrap());
        assert!(writer.changes_shutter(&settings(600.0, 0.0)));
        let actual = writer.write(&camera, &settings(600.2, 100.0)).unwrap();
        assert_eq!((actual.exposure_us, actual.trigger_delay_us), (600.0, 100.0));
        let written = ["ShutterMode=Rolling", "TriggerDelayAbs=100", "ExposureTimeAbs=600.2"];
        assert_eq!(camera.take_written(), written);

        let actual = writer.write(&camera, &settings(600.2, 120.4)).unwrap();
        assert_eq!((actual.exposure_us, actual.trigger_delay_us), (600.0, 120.5));
        assert_eq!(camera.take_written(), ["TriggerDelayAbs=120.4"]);
        assert!(!writer.changes_shutter(&settings(600.0, 0.0)));
        let global = CameraSettings { shutter: Shutter::Global, ..settings(600.2, 120.4) };
        assert!(writer.changes_shutter(&global));
        writer.write(&camera, &global).unwrap();
        assert_eq!(camera.take_written(), ["ShutterMode=GlobalResetRelease"]);
    }

    #[test]
    fn after_a_failure_everything_is_written_again() {
        let camera = Scripted::default().with("ExposureTime", Value::Float(1.0, 1.0..=1e6));
        let mut writer = FeatureWriter::new(Names::probe(&camera).unwrap());
        writer.write(&camera, &settings(600.0, 0.0)).unwrap();
        camera.take_written();
        let global = CameraSettings { shutter: Shutter::Global, ..settings(600.0, 0.0) };
        assert_eq!(writer.write(&camera, &global).unwrap_err().kind, DeviceErrorKind::Unsupported);
        writer.write(&camera, &settings(600.0, 0.0)).unwrap();
        assert_eq!(camera.take_written(), ["ExposureTime=600"]);
    }
}
